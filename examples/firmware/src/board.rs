//! The board: QEMU's `ast1030-evb`, a Cortex-M4 with 768 kB, serial lines and a timer. It has no mirrors and no LEDs, so
//! what would be lit is written to the second serial line, a line of text for each plane.
//!
//! **A real board replaces what is marked "Yours".** Nothing else in this package depends on the board, but for `memory.x`.

use core::arch::asm;
use core::fmt::Write;
use core::ptr::{read_volatile, write_volatile};
use cortex_m_rt::exception;
use dpm_device::link::crc32c;
use dpm_device::planes::PlaneSpec;
use dpm_device::time::HostTime;

/// Yours: the shortest time in which a plane is loaded and shown.
pub const MIN_PLANE_NS: u32 = 200_000;
/// Yours: from the start of a slot to its first photon.
pub const SETTLE_NS: u32 = 0;

/// A register of the board.
#[derive(Clone, Copy)]
struct Register(usize);

impl Register {
    fn read(self) -> u32 {
        // SAFETY: every address in this file is a register of this board, which may be read at any time.
        unsafe { read_volatile(self.0 as *const u32) }
    }

    fn write(self, value: u32) {
        // SAFETY: as above; no register of this file gives the board access to memory.
        unsafe { write_volatile(self.0 as *mut u32, value) }
    }
}

/// A serial line of the board, from its first register on: a 16550, as most boards have.
#[derive(Clone, Copy)]
struct Uart(usize);

impl Uart {
    fn register(self, number: usize) -> Register {
        Register(self.0 + 4 * number)
    }

    /// Starts it with its greatest rate and its FIFOs; the third word says whether bytes that arrive wake the processor.
    fn start(self, interrupts: u32) {
        // The divisor of the rate is behind the registers of data and interrupts while bit 7 of the line's control is set.
        for (number, value) in [(3, 0x83), (0, 1), (1, 0), (3, 3), (2, 0xc7), (1, interrupts)] {
            self.register(number).write(value);
        }
    }

    fn read(self) -> Option<u8> {
        (self.register(5).read() & 1 != 0).then(|| self.register(0).read() as u8)
    }

    fn write(self, byte: u8) -> bool {
        let has_room = self.register(5).read() & 0x20 != 0;
        if has_room {
            self.register(0).write(byte.into());
        }
        has_room
    }
}

/// The line to the host, and the line of text that stands for the mirrors.
const LINE: Uart = Uart(0x7e78_4000);
const MIRRORS: Uart = Uart(0x7e78_3000);
/// A timer of 32 bits that counts microseconds down: its count, what it starts from, and its control.
const TIMER: Register = Register(0x7e78_2000);
const TIMER_RELOAD: Register = Register(0x7e78_2004);
const TIMER_CONTROL: Register = Register(0x7e78_2030);
/// Lets, and does not let, the line to the host interrupt the processor.
const INTERRUPT_ON: Register = Register(0xe000_e100);
const INTERRUPT_OFF: Register = Register(0xe000_e180);
const LINE_INTERRUPT: u32 = 1 << 8;
/// The processor's own timer, which ends a sleep: control and period.
const TICK_CONTROL: Register = Register(0xe000_e010);
const TICK_PERIOD: Register = Register(0xe000_e014);
/// Longest sleep: 200 us of 200 MHz.
const TICK: u32 = 40_000;

/// What is on the mirrors.
type Shown = (u32, u8);

/// The board.
pub struct Board {
    timer_before: u32,
    timer_wraps: u64,
    shown: Option<Shown>,
    /// The frame whose planes were written to the text, and the last of them.
    told: Option<Shown>,
}

impl Board {
    /// Starts the board, dark.
    pub fn start() -> Self {
        LINE.start(1);
        MIRRORS.start(0);
        TIMER_RELOAD.write(u32::MAX);
        // The first timer, on the clock of 1 MHz.
        TIMER_CONTROL.write(3);
        TICK_PERIOD.write(TICK);
        TICK_CONTROL.write(7);
        let _ = writeln!(Text, "dark");
        Self { timer_before: 0, timer_wraps: 0, shown: None, told: None }
    }

    /// Yours: a clock that never goes back, in nanoseconds. The timer wraps after 71 minutes and is read far more often.
    pub fn now(&mut self) -> HostTime {
        let count = !TIMER.read();
        self.timer_wraps += u64::from(count < self.timer_before);
        self.timer_before = count;
        HostTime(((self.timer_wraps << 32 | u64::from(count)) * 1000) as i64)
    }

    /// Yours: bits of `dpm_device::link::faults` whose cause is present now. The emulated board never gets hot.
    pub fn faults(&mut self) -> u32 {
        0
    }

    /// Yours: 64 bits that no other projector has, drawn when the board is first switched on, and kept
    /// (`FirmwareConfig::serial_number`). The emulated board keeps nothing while it is off and has nothing to draw from.
    /// It says 1, which names no projector, until that is done: with another number that every copy of this file has, an
    /// order for one board would hold all of them, and who arms one would lift the order for another.
    pub fn serial(&mut self) -> u64 {
        1
    }

    /// Yours: loads `mirrors` (rows of whole bytes, bit 7 is the leftmost) and lights the LED of `spec` at 2^bit / 255.
    /// It is called in every pass, so a plane that is there already is left as it is.
    pub fn light(&mut self, frame: u32, plane: u8, spec: PlaneSpec, mirrors: &[u8]) {
        if self.shown == Some((frame, plane)) {
            return;
        }
        self.shown = Some((frame, plane));
        // A frame that is repeated is written once.
        if self.told.is_none_or(|told| told.0 != frame || told.1 < plane) {
            self.told = self.shown;
            let lit: u32 = mirrors.iter().map(|byte| byte.count_ones()).sum();
            let (led, crc) = (spec.led_code(), crc32c(mirrors));
            let _ = writeln!(Text, "lit {frame} {plane} {led:02x} {crc:08x} {lit}");
        }
    }

    /// Yours: LEDs off, at once. It is called in every pass without light.
    pub fn dark(&mut self) {
        if self.shown.take().is_some() {
            self.told = None;
            let _ = writeln!(Text, "dark");
        }
    }

    /// The next byte from the host, if there is one.
    pub fn read(&mut self) -> Option<u8> {
        LINE.read()
    }

    /// Hands a byte to the line; `false` if it has no room now.
    pub fn write(&mut self, byte: u8) -> bool {
        LINE.write(byte)
    }

    /// Sleeps until a byte arrives, or for a fraction of a plane.
    pub fn wait(&mut self) {
        INTERRUPT_ON.write(LINE_INTERRUPT);
        // SAFETY: the instruction only waits for an interrupt: a byte's, or at the latest that of the timer.
        unsafe { asm!("wfi", options(nomem, nostack, preserves_flags)) }
    }
}

/// The line of text.
struct Text;

impl Write for Text {
    fn write_str(&mut self, text: &str) -> core::fmt::Result {
        for byte in text.bytes() {
            // The emulator takes every byte at once.
            while !MIRRORS.write(byte) {}
        }
        Ok(())
    }
}

/// A byte has arrived: the main loop reads it, and asks for the next interrupt when it sleeps again.
#[exception]
unsafe fn DefaultHandler(_: i16) {
    INTERRUPT_OFF.write(LINE_INTERRUPT);
}

/// A sleep has been long enough.
#[exception]
fn SysTick() {}

/// Yours: whatever went wrong, LEDs off, and the board's own watchdog starts it again.
#[panic_handler]
fn panic(info: &core::panic::PanicInfo) -> ! {
    let _ = writeln!(Text, "dark: {info}");
    loop {}
}
