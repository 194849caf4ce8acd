//! The rules of the interface, broken on purpose: the fake answers the code that the vendor names, and changes nothing.

// The library is called as a program without a driver would call it.
#![allow(unsafe_code)]

use fake_alp::codes::*;
use fake_alp::{library, FakeAlp, Progress};
use std::ffi::c_void;

/// A call of the library by its name.
macro_rules! alp {
    ($library:expr, $name:literal, $($argument:expr => $type:ty),*) => {{
        // SAFETY: the types are those of the library's function.
        unsafe {
            let call = $library.get::<unsafe extern "C" fn($($type),*) -> i32>($name.as_bytes()).unwrap();
            call($($argument),*)
        }
    }};
}

struct Bench {
    fake: FakeAlp,
    library: libloading::Library,
    id: u32,
}

impl Bench {
    fn new(settings: &str) -> Self {
        let fake = FakeAlp::at_virtual_pace(settings);
        // SAFETY: the library runs nothing when it is opened.
        let library = unsafe { libloading::Library::new(library()) }.unwrap();
        let mut id = 0;
        assert_eq!(alp!(library, "AlpDevAlloc", fake.number() => i32, 0 => i32, &mut id => *mut u32), OK);
        Self { fake, library, id }
    }

    fn allocate(&self, pictures: i32) -> Result<u32, i32> {
        let mut sequence = 0;
        let (id, to) = (self.id, &mut sequence);
        let code = alp!(self.library, "AlpSeqAlloc", id => u32, 1 => i32, pictures => i32, to => *mut u32);
        (code == OK).then_some(sequence).ok_or(code)
    }

    /// A sequence that is ready to be shown.
    fn ready(&self, pictures: i32) -> u32 {
        let sequence = self.allocate(pictures).unwrap();
        assert_eq!(self.set(sequence, 2110, 2), OK);
        assert_eq!(self.set(sequence, 2104, 2106), OK);
        assert_eq!(self.timing(sequence, 0, 100), OK);
        sequence
    }

    fn set(&self, sequence: u32, what: i32, value: i32) -> i32 {
        alp!(self.library, "AlpSeqControl", self.id => u32, sequence => u32, what => i32, value => i32)
    }

    fn timing(&self, sequence: u32, illuminate: i32, picture: i32) -> i32 {
        alp!(self.library, "AlpSeqTiming", self.id => u32, sequence => u32, illuminate => i32, picture => i32,
            0 => i32, 0 => i32, 0 => i32)
    }

    fn put(&self, sequence: u32, first: i32, count: i32, planes: &[u8]) -> i32 {
        alp!(self.library, "AlpSeqPut", self.id => u32, sequence => u32, first => i32, count => i32,
            planes.as_ptr().cast() => *const c_void)
    }

    fn start(&self, sequence: u32) -> i32 {
        alp!(self.library, "AlpProjStart", self.id => u32, sequence => u32)
    }

    fn free(&self, sequence: u32) -> i32 {
        alp!(self.library, "AlpSeqFree", self.id => u32, sequence => u32)
    }

    fn projection(&self, what: i32, value: i32) -> i32 {
        alp!(self.library, "AlpProjControl", self.id => u32, what => i32, value => i32)
    }

    fn progress(&self) -> Progress {
        let mut all = Progress::default();
        let to = std::ptr::from_mut(&mut all).cast();
        assert_eq!(
            alp!(self.library, "AlpProjInquireEx", self.id => u32, 2318 => i32, to => *mut c_void),
            OK
        );
        all
    }

    fn wait_ms(&self, ms: i64) {
        self.fake.set_time(self.fake.witness().now_ns + ms * 1_000_000);
    }
}

#[test]
fn a_sequence_in_use_is_neither_written_nor_freed_nor_changed() {
    let bench = Bench::new("size=16x2");
    let sequence = bench.ready(2);
    assert_eq!(bench.put(sequence, 0, 2, &[1; 8]), OK);
    assert_eq!(bench.start(sequence), OK);
    assert_eq!(bench.put(sequence, 0, 2, &[2; 8]), SEQ_IN_USE);
    assert_eq!(bench.free(sequence), SEQ_IN_USE);
    assert_eq!(bench.set(sequence, 2100, 3), SEQ_IN_USE);
    assert_eq!(bench.timing(sequence, 0, 200), SEQ_IN_USE);
    assert_eq!(alp!(bench.library, "AlpDevFree", bench.id => u32), NOT_IDLE);
    bench.wait_ms(10);
    assert_eq!(bench.put(sequence, 0, 2, &[2; 8]), OK);
    assert_eq!(bench.free(sequence), OK);
    assert_eq!(bench.free(sequence), PARM_INVALID);
    assert_eq!(bench.fake.witness().refusals, 6);
    // What was refused changed nothing: the light is that of the first bytes, 100 us a picture.
    let shown = [bench.fake.next_shown().unwrap(), bench.fake.next_shown().unwrap()];
    assert!(shown.iter().all(|s| *s.plane == [1; 4] && s.until_ns - s.from_ns == 100_000));
}

#[test]
fn memory_and_queue_are_finite_and_leaks_are_counted() {
    let bench = Bench::new("size=16x2,memory=10,queue=2");
    let sequence = bench.ready(6);
    assert_eq!(bench.allocate(5), Err(MEMORY_FULL));
    let other = bench.ready(4);
    assert_eq!(bench.projection(2314, 1), OK);
    assert_eq!(bench.put(sequence, 0, 0, &[0; 24]), OK);
    assert_eq!([0; 4].map(|_| bench.start(sequence)), [OK, OK, OK, NOT_IDLE]);
    assert_eq!(bench.projection(2314, 0), NOT_IDLE);
    let progress = bench.progress();
    assert_eq!((progress.waiting, progress.pictures_of_run, progress.sequence), (2, 6, sequence));
    bench.wait_ms(100);
    assert_eq!(bench.progress().flags, 1);
    assert_eq!(bench.free(other), OK);
    assert_eq!(alp!(bench.library, "AlpDevFree", bench.id => u32), OK);
    assert_eq!(bench.fake.witness().leaked, 1);
}

#[test]
fn times_pictures_formats_and_identifiers_are_checked() {
    let bench = Bench::new("size=16x2,min=44,max=1000");
    let sequence = bench.allocate(2).unwrap();
    // Without the binary format the bytes would be read as grey pixels.
    assert_eq!(bench.put(sequence, 0, 1, &[0; 4]), CONFIG_MISMATCH);
    assert_eq!(bench.set(sequence, 2110, 2), OK);
    for (first, count) in [(0, 3), (2, 1), (-1, 1), (1, -1), (i32::MAX, i32::MAX)] {
        assert_eq!(bench.put(sequence, first, count, &[0; 64]), PARM_INVALID, "{first} {count}");
    }
    // The normal binary mode has a dark phase, the uninterrupted one has none.
    assert_eq!(bench.timing(sequence, 0, 44), PARM_INVALID);
    assert_eq!(bench.set(sequence, 2104, 2106), OK);
    assert_eq!(bench.timing(sequence, 0, 44), OK);
    for (illuminate, picture) in [(0, 43), (0, 1001), (60, 50), (0, -1)] {
        assert_eq!(bench.timing(sequence, illuminate, picture), PARM_INVALID, "{illuminate} {picture}");
    }
    assert_eq!(bench.set(sequence, 2100, 0), PARM_INVALID);
    assert_eq!(bench.set(sequence, 9999, 0), PARM_INVALID);
    assert_eq!(bench.start(77), PARM_INVALID);
    assert_eq!(alp!(bench.library, "AlpDevHalt", 4_000_000 => u32), NOT_AVAILABLE);
    let null = std::ptr::null_mut();
    assert_eq!(
        alp!(bench.library, "AlpDevInquire", bench.id => u32, 2058 => i32, null => *mut i32),
        ADDR_INVALID
    );
    let mut id = 0;
    let again = |number: i32, to| alp!(bench.library, "AlpDevAlloc", number => i32, 0 => i32, to => *mut u32);
    assert_eq!((again(bench.fake.number(), &mut id), id), (NOT_READY, INVALID_ID));
    assert_eq!(again(1_000_000, &mut id), NOT_ONLINE);
}

#[test]
fn only_one_end_is_asked_for_at_a_time_and_what_waits_goes_on() {
    let bench = Bench::new("size=16x2,start=0,call=1");
    assert_eq!(bench.projection(2314, 1), OK);
    let (a, b) = (bench.ready(4), bench.ready(2));
    assert_eq!((bench.put(a, 0, 0, &[1; 16]), bench.put(b, 0, 0, &[2; 8])), (OK, OK));
    assert_eq!((bench.start(a), bench.start(b)), (OK, OK));
    assert_eq!(bench.projection(2321, 0), OK);
    assert_eq!(bench.projection(2321, 0), NOT_IDLE);
    assert_eq!(bench.projection(2320, 4711), NOT_IDLE);
    bench.wait_ms(5);
    let all: Vec<_> =
        std::iter::from_fn(|| bench.fake.next_shown()).map(|s| (s.sequence, s.picture)).collect();
    // The first picture ends in its own time, the three behind it are left out.
    assert_eq!(all, [(a, 0), (b, 0), (b, 1)]);
}

#[test]
fn a_pulled_cable_stops_the_light_or_does_not() {
    for (behaviour, stays) in [(2, false), (1, true)] {
        let bench = Bench::new("size=16x2");
        let sequence = bench.ready(1);
        assert_eq!(bench.put(sequence, 0, 1, &[0xff; 4]), OK);
        let control = alp!(bench.library, "AlpDevControl", bench.id => u32, 2078 => i32, behaviour => i32);
        assert_eq!(control, OK);
        assert_eq!(alp!(bench.library, "AlpProjStartCont", bench.id => u32, sequence => u32), OK);
        bench.wait_ms(1);
        assert_eq!((bench.fake.witness().is_lit, bench.fake.witness().runs_until_ns), (1, i64::MAX));
        bench.fake.plan("removed@any=1");
        assert_eq!(bench.start(sequence), DEVICE_REMOVED);
        bench.wait_ms(1000);
        assert_eq!(bench.fake.witness().is_lit == 1, stays);
    }
}
