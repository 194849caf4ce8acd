//! Encodes DLPC900 commands and replies as 64-byte HID reports, and decodes them.
//!
//! A message is a header and data, split into zero-padded reports of 64 bytes; only the first report carries the
//! header. Command header, 6 bytes: flags, sequence, u16 length (opcode + data), u16 opcode. Reply header, 4 bytes:
//! flags, sequence, u16 length (data): a reply does not repeat the opcode. All numbers are little-endian.
//! \[DLPU018 section 1.2\]

/// Bytes of every report on the wire (the report ID 0 that HID libraries put in front is not sent).
pub const REPORT_BYTES: usize = 64;
/// The controller's command buffer: header and data of one message.
pub const BUFFER_BYTES: usize = 512;
/// Most data bytes of one command.
pub const MAX_COMMAND_DATA: usize = BUFFER_BYTES - COMMAND_HEADER;
/// Most data bytes of one reply.
pub const MAX_REPLY_DATA: usize = BUFFER_BYTES - REPLY_HEADER;
/// Most image bytes in one BMP data command (2 bytes of its data are the count).
pub const MAX_BMP_BYTES: usize = MAX_COMMAND_DATA - 2;

const COMMAND_HEADER: usize = 6;
const REPLY_HEADER: usize = 4;

/// Bits of the flags byte.
pub mod flag {
    /// The host reads; otherwise it writes.
    pub const READ: u8 = 0x80;
    /// The host wants a reply.
    pub const REPLY: u8 = 0x40;
    /// In a reply: the command was refused.
    pub const NACK: u8 = 0x20;
    /// Destination bits; 0 is the projector control.
    pub const DESTINATION: u8 = 0x07;
}

/// A USB opcode.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Opcode(pub u16);

macro_rules! opcodes {
    ($($(#[$doc:meta])* $name:ident = $code:literal, $text:literal;)*) => {
        impl Opcode {
            $($(#[$doc])* pub const $name: Self = Self($code);)*

            /// The name of the command in the programmer's guide; `None` for one that is not in the table.
            pub const fn name(self) -> Option<&'static str> {
                match self.0 {
                    $($code => Some($text),)*
                    _ => None,
                }
            }
        }
    };
}

opcodes! {
    /// Last error code, 1 byte.
    ERROR_CODE = 0x0100, "read error code";
    /// Last error as 128 bytes of text.
    ERROR_TEXT = 0x0101, "read error description";
    /// 0 normal, 1 standby, 2 software reset.
    POWER_MODE = 0x0200, "power mode";
    /// 50/50 mirror exercise on or off.
    DMD_IDLE = 0x0201, "DMD idle";
    /// Four versions.
    VERSION = 0x0205, "get version";
    /// Controller and DMD fitted.
    HARDWARE_ID = 0x0206, "get hardware";
    /// 1 park, 0 unpark.
    DMD_PARK = 0x0609, "DMD park";
    /// GPIO clock.
    GPIO_CLOCK = 0x0807, "GPIO clock configuration";
    /// LED currents, 3 bytes R, G, B.
    LED_CURRENT = 0x0b01, "LED current";
    /// Input display resolution, 8 x u16.
    DISPLAY_RESOLUTION = 0x1000, "input display resolution";
    /// Long axis flip.
    FLIP_LONG = 0x1008, "long axis flip";
    /// Short axis flip.
    FLIP_SHORT = 0x1009, "short axis flip";
    /// Curtain colour, 3 x u16; the guide's read and write example uses it.
    CURTAIN = 0x1100, "curtain colour";
    /// Test pattern.
    TEST_PATTERN = 0x1203, "test pattern select";
    /// Test pattern colours.
    TEST_COLOUR = 0x1204, "test pattern colours";
    /// Input source and depth.
    INPUT_SOURCE = 0x1a00, "input source";
    /// IT6535 receiver: 0 off, 1 HDMI, 2 DisplayPort.
    RECEIVER = 0x1a01, "IT6535 power mode";
    /// Pixel format.
    PIXEL_FORMAT = 0x1a02, "pixel format";
    /// Port and clock.
    PORT_CLOCK = 0x1a03, "port and clock configuration";
    /// LED PWM polarity.
    LED_POLARITY = 0x1a05, "LED PWM polarity";
    /// LED enable.
    LED_ENABLE = 0x1a07, "LED enable";
    /// Hardware status bits.
    HARDWARE_STATUS = 0x1a0a, "hardware status";
    /// System status bits.
    SYSTEM_STATUS = 0x1a0b, "system status";
    /// Main status bits.
    MAIN_STATUS = 0x1a0c, "main status";
    /// PWM enable.
    PWM_ENABLE = 0x1a10, "PWM enable";
    /// PWM setup.
    PWM_SETUP = 0x1a11, "PWM setup";
    /// Batch file name.
    BATCH_NAME = 0x1a14, "batch file name";
    /// Batch file execute.
    BATCH_RUN = 0x1a15, "batch file execute";
    /// Batch file delay.
    BATCH_DELAY = 0x1a16, "batch file delay";
    /// Display mode.
    DISPLAY_MODE = 0x1a1b, "display mode";
    /// TRIG_OUT1.
    TRIG_OUT1 = 0x1a1d, "trigger out 1";
    /// TRIG_OUT2.
    TRIG_OUT2 = 0x1a1e, "trigger out 2";
    /// Red LED enable delay.
    RED_DELAY = 0x1a1f, "red LED enable delay";
    /// Green LED enable delay.
    GREEN_DELAY = 0x1a20, "green LED enable delay";
    /// Blue LED enable delay.
    BLUE_DELAY = 0x1a21, "blue LED enable delay";
    /// 0 stop, 1 pause, 2 start.
    START_STOP = 0x1a24, "pattern display start/stop";
    /// Standby delay.
    STANDBY_DELAY = 0x1a25, "standby delay";
    /// Starts the load of an image into the primary controller.
    BMP_INIT_PRIMARY = 0x1a2a, "initialise pattern BMP load (primary)";
    /// Image bytes for the primary controller.
    BMP_DATA_PRIMARY = 0x1a2b, "pattern BMP load (primary)";
    /// Starts the load of an image into the secondary controller.
    BMP_INIT_SECONDARY = 0x1a2c, "initialise pattern BMP load (secondary)";
    /// Image bytes for the secondary controller.
    BMP_DATA_SECONDARY = 0x1a2d, "pattern BMP load (secondary)";
    /// Inverts the pattern data.
    INVERT = 0x1a30, "invert pattern data";
    /// Makes the LUT effective.
    LUT_CONFIG = 0x1a31, "pattern display LUT configuration";
    /// Shows the LUT in another order.
    LUT_REORDER = 0x1a32, "pattern display LUT reorder";
    /// One LUT entry.
    LUT_DEFINITION = 0x1a34, "pattern display LUT definition";
    /// TRIG_IN1.
    TRIG_IN1 = 0x1a35, "trigger in 1";
    /// TRIG_IN2.
    TRIG_IN2 = 0x1a36, "trigger in 2";
    /// Channel swap.
    CHANNEL_SWAP = 0x1a37, "channel swap";
    /// GPIO configuration.
    GPIO = 0x1a38, "GPIO configuration";
    /// Parallel port extras.
    INPUT_EXTRA = 0x1a39, "parallel port configuration";
    /// Gamma.
    GAMMA = 0x1a3b, "gamma configuration";
    /// Input source configuration.
    INPUT_CONFIG = 0x1a3c, "input source configuration";
    /// Which mirror blocks are loaded.
    BLOCK_LOAD = 0x1a40, "DMD block load";
    /// Shortest LED pulse, microseconds.
    MIN_LED_PULSE_US = 0x1a41, "minimum LED pulse width (us)";
    /// Shortest exposures by depth, 16 bytes (as table A-1 of the guide numbers it).
    MIN_EXPOSURE = 0x1a42, "minimum pattern exposure";
    /// Shortest LED pulse, nanoseconds.
    MIN_LED_PULSE_NS = 0x1a43, "minimum LED pulse width (ns)";
    /// DLPA200 faults (DLP5500).
    DLPA200_FAULT = 0x1a48, "DLPA200 fault";
    /// I2C pass-through configuration.
    I2C_CONFIG = 0x1a4e, "I2C pass-through configuration";
    /// I2C pass-through.
    I2C = 0x1a4f, "I2C pass-through";
}

impl core::fmt::Display for Opcode {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "{} (0x{:04X})", self.name().unwrap_or("command"), self.0)
    }
}

/// One message to the controller.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Command<'a> {
    /// Flags byte: [`flag::READ`], [`flag::REPLY`] and the destination.
    pub flags: u8,
    /// Echoed in the reply.
    pub sequence: u8,
    /// The command's opcode.
    pub opcode: Opcode,
    /// Its data, at most [`MAX_COMMAND_DATA`] bytes.
    pub data: &'a [u8],
}

/// The data do not fit the controller's buffer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TooLong {
    /// Bytes given.
    pub bytes: usize,
    /// Most bytes there is room for.
    pub most: usize,
}

impl core::fmt::Display for TooLong {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "{} data bytes do not fit the controller's buffer of {}", self.bytes, self.most)
    }
}

/// The reports of one message, in order.
#[derive(Clone, Debug)]
pub struct Reports<'a> {
    header: [u8; COMMAND_HEADER],
    header_bytes: usize,
    data: &'a [u8],
    first: bool,
}

impl Iterator for Reports<'_> {
    type Item = [u8; REPORT_BYTES];

    fn next(&mut self) -> Option<Self::Item> {
        if !self.first && self.data.is_empty() {
            return None;
        }
        let mut report = [0; REPORT_BYTES];
        let at = if self.first { self.header_bytes } else { 0 };
        report[..at].copy_from_slice(&self.header[..at]);
        let n = self.data.len().min(REPORT_BYTES - at);
        let (now, later) = self.data.split_at(n);
        report[at..at + n].copy_from_slice(now);
        self.data = later;
        self.first = false;
        Some(report)
    }
}

impl<'a> Command<'a> {
    /// A read: the controller always replies.
    pub const fn read(sequence: u8, opcode: Opcode, data: &'a [u8]) -> Self {
        Self { flags: flag::READ | flag::REPLY, sequence, opcode, data }
    }

    /// A write, with or without an acknowledgement.
    pub const fn write(sequence: u8, opcode: Opcode, data: &'a [u8], acknowledge: bool) -> Self {
        Self { flags: if acknowledge { flag::REPLY } else { 0 }, sequence, opcode, data }
    }

    /// The reports to send, in order.
    pub fn reports(&self) -> Result<Reports<'a>, TooLong> {
        if self.data.len() > MAX_COMMAND_DATA {
            return Err(TooLong { bytes: self.data.len(), most: MAX_COMMAND_DATA });
        }
        let length = (self.data.len() as u16 + 2).to_le_bytes();
        let opcode = self.opcode.0.to_le_bytes();
        let header = [self.flags, self.sequence, length[0], length[1], opcode[0], opcode[1]];
        Ok(Reports { header, header_bytes: COMMAND_HEADER, data: self.data, first: true })
    }

    /// True when the host expects a reply.
    pub const fn wants_reply(&self) -> bool {
        self.flags & (flag::READ | flag::REPLY) != 0
    }

    /// True for a read.
    pub const fn is_read(&self) -> bool {
        self.flags & flag::READ != 0
    }
}

/// One message from the controller.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Reply<'a> {
    /// Flags byte; [`flag::NACK`] says that the command was refused.
    pub flags: u8,
    /// The command's sequence byte.
    pub sequence: u8,
    /// Data, at most [`MAX_REPLY_DATA`] bytes.
    pub data: &'a [u8],
}

impl<'a> Reply<'a> {
    /// The reports to send, in order.
    pub fn reports(&self) -> Result<Reports<'a>, TooLong> {
        if self.data.len() > MAX_REPLY_DATA {
            return Err(TooLong { bytes: self.data.len(), most: MAX_REPLY_DATA });
        }
        let length = (self.data.len() as u16).to_le_bytes();
        let header = [self.flags, self.sequence, length[0], length[1], 0, 0];
        Ok(Reports { header, header_bytes: REPLY_HEADER, data: self.data, first: true })
    }

    /// True when the controller refused the command.
    pub const fn is_refused(&self) -> bool {
        self.flags & flag::NACK != 0
    }
}

/// Why a report was dropped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ReportFault {
    /// Shorter than a header.
    Short(usize),
    /// The header's length does not fit the controller's buffer, or leaves no room for an opcode.
    Length(u16),
}

impl core::fmt::Display for ReportFault {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Short(n) => write!(f, "a report of {n} bytes is shorter than a header"),
            Self::Length(n) => write!(f, "the header announces {n} bytes, which no message has"),
        }
    }
}

/// Assembles messages from reports. Holds one message; the next first report replaces it.
#[derive(Clone, Debug)]
struct Assembler {
    buffer: [u8; BUFFER_BYTES],
    filled: usize,
    wanted: usize,
}

impl Assembler {
    const fn new() -> Self {
        Self { buffer: [0; BUFFER_BYTES], filled: 0, wanted: 0 }
    }

    /// Adds a report; true when the message in `buffer[..wanted]` is complete. `least` and `total` interpret the
    /// header.
    fn push(&mut self, report: &[u8], header: usize, least: u16) -> Result<bool, ReportFault> {
        if self.filled >= self.wanted {
            if report.len() < header {
                return Err(ReportFault::Short(report.len()));
            }
            let length = u16::from_le_bytes([report[2], report[3]]);
            // A command's length counts its opcode, which the header holds too.
            let total = 4 + usize::from(length);
            if length < least || total > BUFFER_BYTES {
                return Err(ReportFault::Length(length));
            }
            (self.filled, self.wanted) = (0, total);
        }
        let n = report.len().min(REPORT_BYTES).min(self.wanted - self.filled);
        self.buffer[self.filled..self.filled + n].copy_from_slice(&report[..n]);
        self.filled += n;
        Ok(self.filled == self.wanted)
    }
}

/// Assembles commands from the host's reports (the controller's side of the wire).
#[derive(Clone, Debug)]
pub struct CommandAssembler(Assembler);

impl Default for CommandAssembler {
    fn default() -> Self {
        Self(Assembler::new())
    }
}

impl CommandAssembler {
    /// Adds one report; returns the command when it is complete. A malformed first report is dropped, and the next one
    /// starts anew.
    pub fn push(&mut self, report: &[u8]) -> Result<Option<Command<'_>>, ReportFault> {
        if !self.0.push(report, COMMAND_HEADER, 2)? {
            return Ok(None);
        }
        let b = &self.0.buffer[..self.0.wanted];
        let opcode = Opcode(u16::from_le_bytes([b[4], b[5]]));
        Ok(Some(Command { flags: b[0], sequence: b[1], opcode, data: &b[COMMAND_HEADER..] }))
    }

    /// Drops an incomplete command.
    pub fn reset(&mut self) {
        self.0.wanted = 0;
        self.0.filled = 0;
    }
}

/// Assembles replies from the controller's reports (the host's side of the wire).
#[derive(Clone, Debug)]
pub struct ReplyAssembler(Assembler);

impl Default for ReplyAssembler {
    fn default() -> Self {
        Self(Assembler::new())
    }
}

impl ReplyAssembler {
    /// Adds one report; returns the reply when it is complete.
    pub fn push(&mut self, report: &[u8]) -> Result<Option<Reply<'_>>, ReportFault> {
        if !self.0.push(report, REPLY_HEADER, 0)? {
            return Ok(None);
        }
        let b = &self.0.buffer[..self.0.wanted];
        Ok(Some(Reply { flags: b[0], sequence: b[1], data: &b[REPLY_HEADER..] }))
    }

    /// Drops an incomplete reply.
    pub fn reset(&mut self) {
        self.0.wanted = 0;
        self.0.filled = 0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn only_report(c: &Command<'_>) -> [u8; 64] {
        let mut r = c.reports().unwrap();
        let first = r.next().unwrap();
        assert!(r.next().is_none());
        first
    }

    fn starts_with_and_zeros(report: &[u8], head: &[u8]) {
        assert_eq!(&report[..head.len()], head);
        assert!(report[head.len()..].iter().all(|b| *b == 0));
    }

    /// The read, its reply and the write of DLPU018 tables 1-5 to 1-7, less the report ID.
    #[test]
    fn golden_curtain_read_reply_and_write() {
        let read = Command::read(0x11, Opcode::CURTAIN, &[]);
        starts_with_and_zeros(&only_report(&read), &[0xc0, 0x11, 0x02, 0x00, 0x00, 0x11]);
        let colour = [0xff, 0x01, 0xff, 0x01, 0xff, 0x01];
        let reply = Reply { flags: 0xc0, sequence: 0x11, data: &colour };
        let report = reply.reports().unwrap().next().unwrap();
        starts_with_and_zeros(&report, &[0xc0, 0x11, 0x06, 0x00, 0xff, 0x01, 0xff, 0x01, 0xff, 0x01]);
        let write = Command::write(0x12, Opcode::CURTAIN, &colour, false);
        let bytes = [0x00, 0x12, 0x08, 0x00, 0x00, 0x11, 0xff, 0x01, 0xff, 0x01, 0xff, 0x01];
        starts_with_and_zeros(&only_report(&write), &bytes);
        let mut commands = CommandAssembler::default();
        assert_eq!(commands.push(&only_report(&read)), Ok(Some(read)));
        assert_eq!(commands.push(&only_report(&write)), Ok(Some(write)));
        assert_eq!(ReplyAssembler::default().push(&report), Ok(Some(reply)));
    }

    /// 504 image bytes: only the first report has the header, with 58 data bytes; the others have 64 each.
    #[test]
    fn golden_layout_of_the_longest_command() {
        let mut data = [0u8; MAX_COMMAND_DATA];
        data[..2].copy_from_slice(&504u16.to_le_bytes());
        data[2..].iter_mut().enumerate().for_each(|(i, b)| *b = (i % 251) as u8);
        let c = Command::write(7, Opcode::BMP_DATA_PRIMARY, &data, false);
        let reports: Vec<_> = c.reports().unwrap().collect();
        assert_eq!(reports.len(), 8);
        // 508 = opcode and 506 data bytes.
        assert_eq!(reports[0][..8], [0x00, 7, 0xfc, 0x01, 0x2b, 0x1a, 0xf8, 0x01]);
        assert_eq!(reports[0][8..], data[2..58]);
        assert_eq!(reports[1][..], data[58..122]);
        assert_eq!(reports[7][..], data[442..506]);
        let mut a = CommandAssembler::default();
        for r in &reports[..7] {
            assert_eq!(a.push(r), Ok(None));
        }
        assert_eq!(a.push(&reports[7]), Ok(Some(c)));
        let long = Command::write(0, Opcode::BMP_DATA_PRIMARY, &[0; 507], false);
        assert_eq!(long.reports().unwrap_err(), TooLong { bytes: 507, most: 506 });
    }

    #[test]
    fn lengths_that_cannot_be_are_refused_and_the_next_report_is_read_afresh() {
        let mut a = CommandAssembler::default();
        assert_eq!(a.push(&[0x40, 0, 1, 0, 0, 0x11]), Err(ReportFault::Length(1)));
        assert_eq!(a.push(&[0x40, 0, 0xfd, 1, 0, 0x11]), Err(ReportFault::Length(509)));
        assert_eq!(a.push(&[0x40, 0, 2]), Err(ReportFault::Short(3)));
        let c = Command::read(1, Opcode::MAIN_STATUS, &[]);
        assert_eq!(a.push(&only_report(&c)), Ok(Some(c)));
    }

    proptest! {
        #[test]
        fn commands_and_replies_round_trip(
            flags: u8, sequence: u8, opcode: u16, data in prop::collection::vec(any::<u8>(), 0..=MAX_COMMAND_DATA)
        ) {
            let c = Command { flags, sequence, opcode: Opcode(opcode), data: &data };
            let mut a = CommandAssembler::default();
            let reports: Vec<_> = c.reports().unwrap().collect();
            prop_assert_eq!(reports.len(), (data.len() + 6).div_ceil(64));
            for (i, r) in reports.iter().enumerate() {
                let got = a.push(r).unwrap();
                prop_assert_eq!(got.is_some(), i + 1 == reports.len());
                if let Some(got) = got { prop_assert_eq!(got, c); }
            }
            let r = Reply { flags, sequence, data: &data };
            let mut a = ReplyAssembler::default();
            let mut whole = 0;
            for report in r.reports().unwrap() {
                if let Some(got) = a.push(&report).unwrap() { prop_assert_eq!(got, r); whole += 1; }
            }
            prop_assert_eq!(whole, 1);
        }

        #[test]
        fn any_reports_are_survived(reports in prop::collection::vec(prop::collection::vec(any::<u8>(), 0..80), 0..20)) {
            let (mut c, mut r) = (CommandAssembler::default(), ReplyAssembler::default());
            for report in &reports {
                if let Ok(Some(c)) = c.push(report) { prop_assert!(c.data.len() <= MAX_COMMAND_DATA); }
                if let Ok(Some(r)) = r.push(report) { prop_assert!(r.data.len() <= MAX_REPLY_DATA); }
            }
        }
    }
}
