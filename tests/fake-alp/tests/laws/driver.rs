//! The driver on the fake panel: the light is the planes, it ends by itself, and nothing of the device stays behind.

use dpm_alp::{Alp, AlpError, ShowMode, Weights};
use dpm_device::planes::{PlaneSchedule, Raster};
use dpm_device::rng::Sampler;
use dpm_device::time::{FrameRate, HostTime};
use fake_alp::{library, FakeAlp, Shown};

const MS: i64 = 1_000_000;

fn showing(schedule: PlaneSchedule, weights: Weights, hz: u32) -> ShowMode {
    ShowMode { schedule, weights, rate: FrameRate::new(hz, 1).unwrap(), frames: 3, runs: 1 }
}

fn open(settings: &str) -> (FakeAlp, Alp) {
    let fake = FakeAlp::at_virtual_pace(settings);
    let alp = open_on(fake).unwrap_or_else(|e| panic!("{e}"));
    (fake, alp)
}

/// The driver's pauses move the device's own clock.
fn open_on(fake: FakeAlp) -> Result<Alp, AlpError> {
    let pause = Box::new(move |time: std::time::Duration| wait(&fake, time.as_nanos() as i64));
    Alp::open_paced(Some(&library()), fake.number(), pause)
}

fn wait(fake: &FakeAlp, ns: i64) {
    fake.set_time(fake.witness().now_ns + ns);
}

/// What gave light so far, dark pictures left out.
fn lit(fake: &FakeAlp) -> Vec<Shown> {
    let all = std::iter::from_fn(|| fake.next_shown());
    all.filter(|shown| shown.plane.iter().any(|byte| *byte != 0)).collect()
}

/// Planes without a dark one.
fn random_planes(seed: u64, bytes: usize) -> Vec<u8> {
    let mut draw = Sampler::new(seed, 0);
    (0..bytes).map(|_| (draw.next_u64() >> 56) as u8 | 1).collect()
}

fn put(alp: &mut Alp, frame: usize, planes: &[u8]) {
    let bytes = alp.facts().raster.plane_bytes();
    for (k, plane) in planes.chunks_exact(bytes).enumerate() {
        alp.put(frame, k, plane).unwrap();
    }
}

#[test]
fn a_v7001_is_described() {
    let (fake, alp) = open("size=1024x768,celsius=45.5");
    let facts = alp.facts().clone();
    assert_eq!((facts.raster, facts.panel), (Raster::new(1024, 768).unwrap(), "XGA 0.7 inch (DLP7000)"));
    assert_eq!((facts.shortest_us, facts.longest_us, facts.free_memory), (44, 10_000_000, 43_690));
    assert_eq!(alp.temperatures().highest(), Some(45.5));
    drop(alp);
    let witness = fake.witness();
    assert_eq!((witness.refusals, witness.leaked, witness.sequences, witness.is_allocated), (0, 0, 0, 0));
}

/// Bit for bit, in order, and each as long as its weight says; with every plane of the pictures different.
#[test]
fn the_light_is_the_planes() {
    let cases = [
        (PlaneSchedule::rgb24(), Weights::Equal, 140),
        (PlaneSchedule::mono8(), Weights::Equal, 420),
        (PlaneSchedule::mono8(), Weights::Binary, 80),
    ];
    for (schedule, weights, hz) in cases {
        let (fake, mut alp) = open("size=100x7,call=2");
        alp.prepare(&showing(schedule, weights, hz)).unwrap();
        let bytes = alp.facts().raster.plane_bytes() * schedule.len();
        for frame in 0..5 {
            let planes = random_planes(frame, bytes);
            let at = frame as usize % 3;
            put(&mut alp, at, &planes);
            alp.show(at).unwrap();
            assert!(alp.is_busy(at));
            wait(&fake, 1_000_000_000 / i64::from(hz) + MS / 5);
            let light = lit(&fake);
            assert_eq!(light.len(), schedule.len(), "{weights:?}");
            let shown: Vec<u8> = light.iter().flat_map(|shown| shown.plane.to_vec()).collect();
            assert!(shown == planes, "frame {frame}, {weights:?}");
            let unit =
                (light[0].until_ns - light[0].from_ns) >> if weights == Weights::Binary { 7 } else { 0 };
            for (k, (shown, spec)) in light.iter().zip(schedule.planes()).enumerate() {
                let weight = if weights == Weights::Binary { 1 << spec.bit } else { 1 };
                assert_eq!(shown.until_ns - shown.from_ns, unit * weight, "plane {k}");
                assert!(k == 0 || shown.from_ns == light[k - 1].until_ns, "no gap before plane {k}");
            }
            assert_eq!(fake.witness().is_lit, 0, "the dark picture remains");
            assert!(alp.progress().unwrap().is_idle && !alp.is_busy(at));
        }
        assert_eq!(fake.witness().refusals, 0);
    }
}

/// Frames that are started while another is shown follow it without a gap, and a frame of several runs gives way to the next.
#[test]
fn frames_queue_and_runs_give_way() {
    for runs in 1..=3 {
        let (fake, mut alp) = open("size=16x2,call=2,start=0");
        let hz = 100;
        alp.prepare(&ShowMode { runs, ..showing(PlaneSchedule::mono8(), Weights::Equal, hz) }).unwrap();
        for frame in 0..40u8 {
            let at = usize::from(frame) % 3;
            alp.progress().unwrap();
            assert!(!alp.is_busy(at), "frame {frame} of {runs} runs");
            put(&mut alp, at, &[frame + 1; 32]);
            alp.show(at).unwrap();
            fake.set_time(fake.witness().now_ns.max((i64::from(frame) + 1) * 10 * MS));
        }
        let light = lit(&fake);
        for frame in 0..39u8 {
            let of: i64 =
                light.iter().filter(|s| s.plane[0] == frame + 1).map(|s| s.until_ns - s.from_ns).sum();
            // Eight planes of a ninth of the time each; a frame that gives way shows one plane more now and then.
            let planes = of as f64 / (10.0 * MS as f64 / 9.0);
            assert!((7.9..9.1).contains(&planes), "frame {frame} of {runs} runs: {planes} planes of light");
        }
        // The host falls silent: the last frame runs out.
        wait(&fake, 100 * MS);
        let last: i64 = lit(&fake).iter().map(|s| s.until_ns - s.from_ns).sum();
        assert!(last <= i64::from(runs) * 10 * MS, "{runs} runs: {last} ns");
        assert_eq!(fake.witness().is_lit, 0);
    }
}

#[test]
fn darkness_comes_within_a_plane_and_drops_what_waits() {
    for (weights, hz) in [(Weights::Equal, 100), (Weights::Binary, 50)] {
        let (fake, mut alp) = open("size=16x2,call=2,start=0");
        alp.prepare(&showing(PlaneSchedule::mono8(), weights, hz)).unwrap();
        for frame in 0..2 {
            put(&mut alp, frame, &[0xff; 32]);
            alp.show(frame).unwrap();
        }
        wait(&fake, MS);
        assert_eq!(fake.witness().is_lit, 1);
        alp.darken().unwrap();
        let ordered_at = fake.witness().now_ns;
        wait(&fake, 100 * MS);
        let end = lit(&fake).last().unwrap().until_ns;
        let longest = if weights == Weights::Binary { 128 * 78_000 } else { 1_112_000 };
        assert!(end <= ordered_at + longest, "{} ns after the order", end - ordered_at);
        // The second frame has asked for the end of the first one, and only one end can be asked for.
        assert!(fake.witness().is_lit == 0 && fake.witness().refusals <= 1);
    }
}

#[test]
fn what_panel_memory_queue_and_cable_cannot_do_is_refused_with_figures() {
    let text = |result: Result<(), AlpError>| result.unwrap_err().to_string();
    let (fake, mut alp) = open("size=1024x768,memory=60,queue=16");
    let fast = text(alp.prepare(&showing(PlaneSchedule::rgb24(), Weights::Equal, 947)));
    assert!(fast.contains("at least 44 us") && fast.contains("at most 908.9 frames/s"), "{fast}");
    let grey = text(alp.prepare(&showing(PlaneSchedule::mono8(), Weights::Binary, 140)));
    assert!(grey.contains("of binary weights") && grey.contains("at most 88.8 frames/s"), "{grey}");
    let memory = text(alp.prepare(&showing(PlaneSchedule::rgb24(), Weights::Equal, 100)));
    assert!(
        memory.contains("59 binary pictures") && memory.contains("3 frames in flight need 75"),
        "{memory}"
    );
    let queue = text(alp.prepare(&showing(PlaneSchedule::mono8(), Weights::Binary, 60)));
    assert!(queue.contains("queues 16 sequences") && queue.contains("need 18"), "{queue}");
    let good = ShowMode { frames: 2, ..showing(PlaneSchedule::rgb24(), Weights::Equal, 200) };
    alp.prepare(&good).unwrap();
    let rate = alp.measure_cable(&|| HostTime(fake.witness().now_ns)).unwrap();
    assert!((270e6..350e6).contains(&rate), "{rate} bytes/s of 350e6, less 30 us a call");
    let cable = text(alp.check_cable(&good, rate));
    assert!(cable.contains("472 MB/s"), "{cable}");
    alp.check_cable(&ShowMode { rate: FrameRate::new(120, 1).unwrap(), ..good }, rate).unwrap();
}

#[test]
fn libraries_and_devices_that_are_not_there_are_named() {
    let missing = Alp::open(Some("/nowhere/libalp44.so".as_ref()), 0).unwrap_err();
    assert!(
        matches!(missing, AlpError::Library { .. }) && missing.to_string().contains("/nowhere/libalp44.so")
    );
    let other = Alp::open(Some("libc.so.6".as_ref()), 0).unwrap_err();
    assert!(matches!(&other, AlpError::Function { function, .. } if *function == "AlpDevAlloc"), "{other}");
    let none = Alp::open(Some(&library()), 999_999).unwrap_err();
    assert!(none.is_gone() && none.to_string().contains("ALP_NOT_ONLINE (1001): no such device"), "{none}");
    let (fake, _alp) = open("size=16x2");
    let taken = Alp::open(Some(&library()), fake.number()).unwrap_err();
    assert!(taken.to_string().contains("another program uses it"), "{taken}");
}

/// At every call that a start makes, and at every call of a frame, whatever fails is told, and nothing is left in the device.
#[test]
fn whatever_call_fails_the_device_is_left_as_it_was() {
    let calls = [
        "alloc",
        "control",
        "inquire",
        "seq-alloc",
        "seq-control",
        "seq-inquire",
        "timing",
        "put",
        "start",
        "proj-control",
        "proj-inquire",
        "progress",
    ];
    let kinds = ["comm", "removed", "not-idle", "memory-full", "in-use", "halted", "unknown"];
    for call in calls {
        for kind in kinds {
            for when in 1..=12 {
                let fake = FakeAlp::at_virtual_pace("size=16x2,call=1");
                fake.plan(&format!("{kind}@{call}={when}"));
                let told = session(&fake);
                let witness = fake.witness();
                assert_eq!(witness.is_allocated, 0, "{kind} at {call} {when}");
                assert_eq!((witness.leaked, witness.sequences), (0, 0), "{kind} at {call} {when}");
                wait(&fake, 200 * MS);
                assert_eq!(fake.witness().is_lit, 0, "{kind} at {call} {when}");
                if when == 1 {
                    let error = told.expect_err("the first of its calls failed").to_string();
                    assert!(error.contains("ALP") && error.contains("answered"), "{error}");
                }
            }
        }
    }
}

/// A short life: open, prepare, show, go dark.
fn session(fake: &FakeAlp) -> Result<(), AlpError> {
    let mut alp = open_on(*fake)?;
    alp.prepare(&showing(PlaneSchedule::mono8(), Weights::Equal, 100))?;
    for frame in 0..3 {
        alp.progress()?;
        for plane in 0..8 {
            alp.put(frame, plane, &[0xff; 4])?;
        }
        alp.show(frame)?;
    }
    alp.darken()
}
