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

/// The functions above in the library that the program under test has opened.
struct Functions {
    add: unsafe extern "C" fn(*const u8, usize, i32) -> i32,
    plan: unsafe extern "C" fn(i32, *const u8, usize) -> i32,
    set_time: extern "C" fn(i32, i64),
    set_celsius: extern "C" fn(i32, f64),
    witness: unsafe extern "C" fn(i32, *mut Witness),
    shown: unsafe extern "C" fn(i32, *mut ShownHeader, *mut u8, usize),
}

fn functions() -> &'static Functions {
    static OPEN: OnceLock<(Functions, libloading::Library)> = OnceLock::new();
    let (functions, _) = OPEN.get_or_init(|| {
        // SAFETY: the library is this crate, which runs nothing when it is opened; the names are those of functions of this file, with their
        // types; the library stays open as long as the process lives.
        unsafe {
            let library = libloading::Library::new(library()).unwrap_or_else(|e| panic!("{e}"));
            let missing = |e: libloading::Error| -> ! { panic!("{e}") };
            let functions = Functions {
                add: *library.get(b"fake_alp_add").unwrap_or_else(|e| missing(e)),
                plan: *library.get(b"fake_alp_plan").unwrap_or_else(|e| missing(e)),
                set_time: *library.get(b"fake_alp_set_time").unwrap_or_else(|e| missing(e)),
                set_celsius: *library.get(b"fake_alp_set_celsius").unwrap_or_else(|e| missing(e)),
                witness: *library.get(b"fake_alp_witness").unwrap_or_else(|e| missing(e)),
                shown: *library.get(b"fake_alp_shown").unwrap_or_else(|e| missing(e)),
            };
            (functions, library)
        }
    });
    functions
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
        // SAFETY: pointer and length are of one slice.
        let number = unsafe { (functions().add)(settings.as_ptr(), settings.len(), i32::from(is_virtual)) };
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
        // SAFETY: pointer and length are of one slice.
        let code = unsafe { (functions().plan)(self.number, plan.as_ptr(), plan.len()) };
        assert_eq!(code, 0, "fake-alp: {plan:?}");
    }

    /// Moves the clock of a device at virtual pace. It never goes back.
    pub fn set_time(&self, ns: i64) {
        (functions().set_time)(self.number, ns);
    }

    /// Sets its temperature.
    pub fn set_celsius(&self, celsius: f64) {
        (functions().set_celsius)(self.number, celsius);
    }

    /// What it says of itself.
    pub fn witness(&self) -> Witness {
        let mut all = Witness::default();
        // SAFETY: the pointer is to a local of the type that the call fills.
        unsafe { (functions().witness)(self.number, &mut all) };
        all
    }

    /// The oldest picture that was shown and not yet taken.
    pub fn next_shown(&self) -> Option<Shown> {
        let (mut header, mut plane) = (ShownHeader::default(), vec![0; self.plane_bytes]);
        // SAFETY: both pointers are to locals, and the length is that of the plane.
        unsafe { (functions().shown)(self.number, &mut header, plane.as_mut_ptr(), plane.len()) };
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
