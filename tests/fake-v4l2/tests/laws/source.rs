//! The source of pictures before a fake camera: what is handed on is what the camera saw, with the time at which it saw it.

use crate::stage::*;
use dpm_camera::{open_source, Picture, PictureRequest, PictureSource};
use dpm_device::time::HostClock;
use std::sync::Arc;
use std::time::{Duration, Instant};

fn source(name: &str, request: &PictureRequest, clock: &Arc<dyn HostClock>) -> Box<dyn PictureSource> {
    open_source(&path(name).display().to_string(), request, clock).unwrap()
}

/// The next `count` pictures.
fn pictures(source: &mut dyn PictureSource, count: usize) -> Vec<Picture> {
    let (mut all, mut picture, begin) = (Vec::new(), Picture::default(), Instant::now());
    while all.len() < count {
        assert!(begin.elapsed() < LONG, "{} pictures", all.len());
        match source.next(Duration::from_millis(100), &mut picture) {
            Ok(true) => all.push(picture.clone()),
            Ok(false) => {}
            Err(why) => panic!("{why}"),
        }
    }
    all
}

/// The next error.
fn error(source: &mut dyn PictureSource) -> String {
    let begin = Instant::now();
    loop {
        assert!(begin.elapsed() < LONG, "no error");
        if let Err(why) = source.next(Duration::from_millis(50), &mut Picture::default()) {
            return why;
        }
    }
}

/// Every format, both moments of stamps: the pixels are those that the mock made, and begin, exposure and rows are its own.
#[test]
fn pictures_and_their_times_are_those_of_the_camera() {
    let (clock, row_ns) = (clock(), 40_000);
    let host = host(100, row_ns, "", &clock);
    let readout_us = (row_ns * i64::from(SIZE[1]) / 1_000) as u32;
    for (format, stamp) in [
        ("GREY", "begin"),
        ("YUYV", "end"),
        ("UYVY", "begin"),
        ("NV12", "end"),
        ("Y10", "begin"),
        ("Y16", "begin"),
    ] {
        let name = format!("times-{format}");
        // A format that cannot be read is listed first, and is not taken.
        let fake = camera(&name, &host, &format!("formats=H264,{format} rates=100 stamp={stamp}"));
        let request = PictureRequest { readout_us, ..request(100) };
        let mut source = source(&name, &request, &clock);
        for seen in pictures(&mut *source, 5) {
            let number = number(&seen.pixels);
            assert_eq!([seen.width, seen.height], SIZE.map(|s| s as usize));
            assert!(seen.pixels == picture(number), "{format}: picture {number} has other pixels");
            // The mock begins picture n at n hundredths of a second of the clock. Stamps are whole microseconds, and between
            // the two readings of the clocks lies some time.
            let off_ns = seen.begin.0 - i64::from(number) * 10_000_000;
            assert!(off_ns.abs() < 200_000, "{format}: {off_ns} ns off");
            assert_eq!((seen.exposure_ns, seen.row_ns), (EXPOSURE_NS, row_ns));
        }
        assert_eq!(fake.witness().refusals, 0, "{format}");
        drop(source);
        let witness = fake.witness();
        assert_eq!((witness.open, witness.opened, witness.streams), (0, 1, 1));
        assert_eq!(witness.exposure, 20);
    }
}

/// Numbers that the driver left out are lost pictures; those that it marks or cuts are damaged; none of them is handed on.
#[test]
fn lost_and_damaged_pictures_are_counted() {
    let clock = clock();
    let host = host(100, 0, "loss=0.2", &clock);
    let _fake = camera("lossy", &host, "rates=100 damaged=7 short=5");
    let mut source = source("lossy", &request(100), &clock);
    let seen = pictures(&mut *source, 60);
    let numbers: Vec<u32> = seen.iter().map(|p| number(&p.pixels)).collect();
    assert!(seen.iter().all(|p| p.pixels == picture(number(&p.pixels))));
    let losses = source.losses();
    // From the first picture on, each number was seen or is counted. Numbers before the first may be counted too.
    let missing = u64::from(numbers[59] - numbers[0]) - 59;
    let counted = losses.all();
    assert!((missing..missing + 8).contains(&counted), "{losses:?}, {missing} missing of {numbers:?}");
    assert!(losses.lost >= 4 && losses.damaged >= 8, "{losses:?}");
    // The source's own numbers have the same gaps.
    for (two, told) in numbers.windows(2).zip(seen.windows(2)) {
        assert_eq!(two[1] - two[0], told[1].number - told[0].number, "{numbers:?}");
    }
}

/// Who looks seldom sees the newest picture, and the buffers do not run dry.
#[test]
fn the_newest_of_several_counts() {
    let clock = clock();
    let host = host(100, 0, "", &clock);
    let fake = camera("late", &host, "rates=100");
    let mut source = source("late", &request(100), &clock);
    pictures(&mut *source, 1);
    for _ in 0..5 {
        // Two buffers are filled, the third stays with the driver or with us.
        std::thread::sleep(Duration::from_millis(60));
        pictures(&mut *source, 1);
    }
    assert!(source.losses().passed_over >= 5, "{:?}", source.losses());
    assert!(fake.witness().without_buffer > 0, "the camera had to leave pictures out");
    assert!(source.losses().lost > 0, "and they are counted as lost: {:?}", source.losses());
}

#[test]
fn an_unplugged_camera_is_opened_again_and_another_one_is_not_taken_for_it() {
    let clock = clock();
    let host = host(100, 0, "", &clock);
    let fake = camera("plug", &host, "rates=100 card=Eye");
    let mut source = source("plug", &request(100), &clock);
    let before = pictures(&mut *source, 3)[2].number;
    fake.unplug();
    let why = error(&mut *source);
    assert!(why.contains("was unplugged") && why.contains("check its cable"), "{why}");
    let why = error(&mut *source);
    assert!(why.contains("there is no ") && why.contains("plugged in?"), "{why}");
    assert_eq!(fake.witness().open, 0, "a camera that is gone is not kept open");

    fake.return_as(&words("plug", &host, "rates=100 card=Ear"));
    let why = error(&mut *source);
    assert!(why.contains("is \"Ear\" now, and was \"Eye\"") && why.contains("/dev/v4l/by-id"), "{why}");

    fake.return_as(&words("plug", &host, "rates=100 card=Eye"));
    let after = pictures(&mut *source, 3);
    assert!(after.iter().all(|p| p.pixels == picture(number(&p.pixels))));
    assert!(after[0].number > before && after[0].number < before + 100, "numbers go on");
}

/// Whatever request fails, the error names the camera, nothing stays open, and the next call works.
#[test]
fn every_request_may_fail() {
    let clock = clock();
    let host = host(100, 0, "", &clock);
    let fake = camera("fails", &host, "rates=100");
    let mut source = source("fails", &request(100), &clock);
    for call in
        ["QUERYCAP", "S_FMT", "S_PARM", "REQBUFS", "QUERYBUF", "QBUF", "DQBUF", "STREAMON", "S_EXT_CTRLS"]
    {
        fake.unplug();
        error(&mut *source);
        fake.return_as(&words("fails", &host, &format!("rates=100 fails={call}:EIO")));
        let why = error(&mut *source);
        assert!(
            why.contains(&path("fails").display().to_string()) && why.contains("error 5"),
            "{call}: {why}"
        );
        assert_eq!(fake.witness().open, 0, "{call}");
        fake.return_as(&words("fails", &host, "rates=100"));
        pictures(&mut *source, 1);
    }
    // What a driver need not have is no error.
    for call in ["TRY_FMT:ENOTTY", "S_PARM:ENOTTY", "ENUM_FRAMESIZES:ENOTTY,ENUM_FRAMEINTERVALS:ENOTTY"] {
        fake.unplug();
        error(&mut *source);
        fake.return_as(&words("fails", &host, &format!("rates=100 fails={call}")));
        pictures(&mut *source, 1);
    }
    // The stream ends though its end cannot be asked for.
    fake.return_as(&words("fails", &host, "rates=100 fails=STREAMOFF:EIO"));
    drop(source);
    assert_eq!(fake.witness().open, 0);
}

/// No picture is used whose time would be a guess.
#[test]
fn stamps_that_say_nothing_are_refused() {
    let clock = clock();
    let host = host(100, 0, "", &clock);
    for (stamp, told) in [
        ("no-clock", "does not say by which clock"),
        ("copied", "copied from another program"),
        ("odd-moment", "a moment that is not known"),
        ("wall-clock", "cannot be of CLOCK_MONOTONIC"),
    ] {
        let name = format!("stamp-{stamp}");
        let _fake = camera(&name, &host, &format!("rates=100 stamp={stamp}"));
        let mut source = source(&name, &request(100), &clock);
        for _ in 0..3 {
            let why = error(&mut *source);
            assert!(why.contains(told) && why.contains("none is used"), "{stamp}: {why}");
        }
    }
}

/// What takes seconds.
mod breadth {
    use super::*;

    /// A stream that falls silent is begun anew, and says so.
    #[test]
    fn a_silent_camera_is_opened_anew() {
        let clock = clock();
        let host = host(100, 0, "", &clock);
        let fake = camera("silent", &host, "rates=100 silent");
        let mut source = source("silent", &request(100), &clock);
        let begin = Instant::now();
        let why = error(&mut *source);
        assert!(why.contains("given no picture for 3 s"), "{why}");
        assert!(begin.elapsed() >= Duration::from_secs(3) && fake.witness().open == 0);
        fake.return_as(&words("silent", &host, "rates=100"));
        pictures(&mut *source, 1);
    }
}
