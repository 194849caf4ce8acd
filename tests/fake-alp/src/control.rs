//! What a test asks of the library that the program under test has opened: devices of its own, virtual time, faults, and the light.

// What crosses between two copies of this crate, the test's and the library's, has C types.
#![allow(unsafe_code)]

use std::path::PathBuf;
use std::sync::{Arc, OnceLock};

use crate::world::world;
use crate::{Settings, Shown};

/// A picture without its plane.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default)]
struct ShownHeader {
    from_ns: i64,
    until_ns: i64,
    sequence: u32,
    picture: u32,
    kept: u32,
    is_there: u32,
}

/// What a device says of itself.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Witness {
    /// Time of its clock, nanoseconds.
    pub now_ns: i64,
    /// When everything that was started ends by itself; `i64::MAX` if never.
    pub runs_until_ns: i64,
    /// Answers other than `ALP_OK` that no plan asked for.
    pub refusals: u64,
    /// Sequences that were not freed when their device was.
    pub leaked: u64,
    /// Records of light that were dropped before they were taken.
    pub shown_lost: u64,
    /// Sequences in its memory.
    pub sequences: u32,
    /// The last of the refusals.
    pub last_refusal: i32,
    /// A mirror sends light now.
    pub is_lit: u32,
    /// It is allocated.
    pub is_allocated: u32,
}

/// Makes a device of `settings` (text of `len` bytes, see [`Settings::parse`]) and returns its number; -1 if the text is not understood.
///
/// # Safety
/// `settings` points to `len` bytes.
#[no_mangle]
unsafe extern "C" fn fake_alp_add(settings: *const u8, len: usize, is_virtual: i32) -> i32 {
    // SAFETY: the caller's promise.
    let text = unsafe { std::slice::from_raw_parts(settings, len) };
    let parsed = std::str::from_utf8(text).ok().and_then(|text| Settings::parse(text).ok());
    parsed.map_or(-1, |settings| world().add(settings, is_virtual != 0))
}

/// Puts a plan of faults in force. An unplugged device is plugged in again.
///
/// # Safety
/// `plan` points to `len` bytes.
#[no_mangle]
unsafe extern "C" fn fake_alp_plan(number: i32, plan: *const u8, len: usize) -> i32 {
    // SAFETY: the caller's promise.
    let text = unsafe { std::slice::from_raw_parts(plan, len) };
    let (Ok(text), mut world) = (std::str::from_utf8(text), world()) else { return -1 };
    i32::from(world.devices.get_mut(&number).is_some_and(|device| device.set_plan(text))) - 1
}

/// Moves the clock of a device at virtual pace.
#[no_mangle]
extern "C" fn fake_alp_set_time(number: i32, ns: i64) {
    if let Some(device) = world().devices.get_mut(&number) {
        device.set_time(ns);
    }
}

/// Sets the temperature of a device.
#[no_mangle]
extern "C" fn fake_alp_set_celsius(number: i32, celsius: f64) {
    if let Some(device) = world().devices.get_mut(&number) {
        device.panel.settings.celsius = celsius;
    }
}

/// What a device says of itself.
///
/// # Safety
/// `to` points to a [`Witness`].
#[no_mangle]
unsafe extern "C" fn fake_alp_witness(number: i32, to: *mut Witness) {
    let mut world = world();
    let Some(device) = world.devices.get_mut(&number) else { return };
    let now = device.now();
    device.panel.advance(now);
    let witness = Witness {
        now_ns: now,
        runs_until_ns: device.panel.runs_until().unwrap_or(i64::MAX),
        refusals: device.refusals,
        leaked: device.panel.leaked,
        shown_lost: device.panel.shown_lost(),
        sequences: device.panel.sequences() as u32,
        last_refusal: device.last_refusal,
        is_lit: u32::from(device.panel.is_lit()),
        is_allocated: u32::from(device.allocated.is_some()),
    };
    // SAFETY: the caller's promise.
    unsafe { to.write(witness) };
}

/// Takes the oldest picture that was shown; `plane` has room for `len` bytes.
///
/// # Safety
/// `header` points to a header, `plane` to `len` bytes.
#[no_mangle]
unsafe extern "C" fn fake_alp_shown(number: i32, header: *mut ShownHeader, plane: *mut u8, len: usize) {
    let mut world = world();
    let Some(device) = world.devices.get_mut(&number) else { return };
    let now = device.now();
    device.panel.advance(now);
    let Some(shown) = device.panel.next_shown() else {
        // SAFETY: the caller's promise.
        return unsafe { header.write(ShownHeader::default()) };
    };
    let told = ShownHeader {
        from_ns: shown.from_ns,
        until_ns: shown.until_ns,
        sequence: shown.sequence,
        picture: shown.picture,
        kept: u32::from(shown.kept),
        is_there: 1,
    };
    let n = shown.plane.len().min(len);
    // SAFETY: the caller's promise; `n` is at most `len`.
    unsafe {
        header.write(told);
        plane.copy_from_nonoverlapping(shown.plane.as_ptr(), n);
    }
}

/// The library, which cargo builds beside the tests of every crate that depends on this one.
///
/// # Panics
/// When it is not there.
pub fn library() -> PathBuf {
    let program = std::env::current_exe().expect("a program");
    let name = "libfake_alp.so";
    let near = program.ancestors().skip(1).take(3);
    let mut found = near.flat_map(|folder| [folder.join(name), folder.join("deps").join(name)]);
    found.find(|path| path.exists()).unwrap_or_else(|| panic!("{name} is not beside {}", program.display()))
}

/// A device in the library that this process opens, with a number of its own, so that tests may run beside each other.
#[derive(Clone, Copy, Debug)]
pub struct FakeAlp {
    number: i32,
    plane_bytes: usize,
}

/// The symbol `name` of the library in this process.
fn symbol<T>(name: &str) -> libloading::Symbol<'static, T> {
    static LIBRARY: OnceLock<libloading::Library> = OnceLock::new();
    let library = LIBRARY.get_or_init(|| {
        // SAFETY: the library is this crate; it runs nothing when it is opened.
        unsafe { libloading::Library::new(library()) }.unwrap_or_else(|e| panic!("{e}"))
    });
    // SAFETY: every caller below names a function of this file with its type.
    unsafe { library.get(name.as_bytes()) }.unwrap_or_else(|e| panic!("{name}: {e}"))
}

impl FakeAlp {
    /// A device whose time the test sets. `settings` as in [`Settings::parse`].
    ///
    /// # Panics
    /// When the text is not understood.
    pub fn at_virtual_pace(settings: &str) -> Self {
        Self::add(settings, true)
    }

    /// A device on the machine's clock.
    ///
    /// # Panics
    /// When the text is not understood.
    pub fn at_real_pace(settings: &str) -> Self {
        Self::add(settings, false)
    }

    fn add(settings: &str, is_virtual: bool) -> Self {
        let plane_bytes = Settings::parse(settings).unwrap_or_else(|e| panic!("{e}")).plane_bytes();
        let add = symbol::<unsafe extern "C" fn(*const u8, usize, i32) -> i32>("fake_alp_add");
        // SAFETY: pointer and length are of one slice.
        let number = unsafe { add(settings.as_ptr(), settings.len(), i32::from(is_virtual)) };
        assert!(number > 0, "fake-alp: {settings:?}");
        Self { number, plane_bytes }
    }

    /// What `AlpDevAlloc` is told to open this device.
    pub fn number(&self) -> i32 {
        self.number
    }

    /// Puts a plan of faults in force, see the crate's page. An unplugged device is plugged in again.
    ///
    /// # Panics
    /// When the plan is not understood.
    pub fn plan(&self, plan: &str) {
        let set = symbol::<unsafe extern "C" fn(i32, *const u8, usize) -> i32>("fake_alp_plan");
        // SAFETY: pointer and length are of one slice.
        assert_eq!(unsafe { set(self.number, plan.as_ptr(), plan.len()) }, 0, "fake-alp: {plan:?}");
    }

    /// Moves the clock of a device at virtual pace. It never goes back.
    pub fn set_time(&self, ns: i64) {
        let set = symbol::<extern "C" fn(i32, i64)>("fake_alp_set_time");
        set(self.number, ns);
    }

    /// Sets its temperature.
    pub fn set_celsius(&self, celsius: f64) {
        let set = symbol::<extern "C" fn(i32, f64)>("fake_alp_set_celsius");
        set(self.number, celsius);
    }

    /// What it says of itself.
    pub fn witness(&self) -> Witness {
        let mut all = Witness::default();
        let ask = symbol::<unsafe extern "C" fn(i32, *mut Witness)>("fake_alp_witness");
        // SAFETY: the pointer is to a local of the type that the call fills.
        unsafe { ask(self.number, &mut all) };
        all
    }

    /// The oldest picture that was shown and not yet taken.
    pub fn next_shown(&self) -> Option<Shown> {
        let (mut header, mut plane) = (ShownHeader::default(), vec![0; self.plane_bytes]);
        let take = symbol::<unsafe extern "C" fn(i32, *mut ShownHeader, *mut u8, usize)>("fake_alp_shown");
        // SAFETY: both pointers are to locals, and the length is that of the plane.
        unsafe { take(self.number, &mut header, plane.as_mut_ptr(), plane.len()) };
        (header.is_there != 0).then(|| Shown {
            from_ns: header.from_ns,
            until_ns: header.until_ns,
            sequence: header.sequence,
            picture: header.picture,
            kept: header.kept != 0,
            plane: Arc::from(plane),
        })
    }
}
