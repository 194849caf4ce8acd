//! What `dpm doctor` says of a camera: each refusal by name, with what to do.

use crate::stage::*;
use dpm_camera::{examine_source, CameraDoubt, CameraLook, PictureRequest};

fn look(name: &str, request: &PictureRequest) -> Result<CameraLook, CameraDoubt> {
    examine_source(&path(name).display().to_string(), request).expect("a camera says what it is")
}

/// What a camera of these words answers.
fn of(name: &str, more: &str, request: &PictureRequest) -> Result<CameraLook, CameraDoubt> {
    let clock = clock();
    let host = host(request.rate_hz.min(100), 0, "", &clock);
    let fake = camera(name, &host, more);
    let answer = look(name, request);
    assert_eq!(fake.witness().open, 0, "nothing stays open");
    answer
}

fn refused(name: &str, more: &str, request: &PictureRequest, told: &[&str]) {
    let doubt = of(name, more, request).expect_err(more);
    told.iter().for_each(|word| assert!(doubt.to_string().contains(word), "{more}: {doubt}"));
}

fn doubted(name: &str, more: &str, request: &PictureRequest, told: &[&str]) {
    let look = of(name, more, request).unwrap_or_else(|e| panic!("{more}: {e}"));
    let all: Vec<String> = look.doubts.iter().map(ToString::to_string).collect();
    let has = |word: &&str| all.iter().any(|doubt| doubt.contains(word));
    assert!(told.iter().all(has), "{more}: {look:?}");
}

#[test]
fn a_camera_that_fits_is_described() {
    let look = of("fits", "rates=60,30 card=Eye_of_software formats=YUYV", &request(60)).unwrap();
    assert!(look.doubts.is_empty(), "{look:?}");
    for word in [
        "Eye of software",
        "48 x 32 YUYV",
        "pictures a second",
        "exposed for 2000 us",
        "begin of the exposure",
    ] {
        assert!(look.found.contains(word), "{word}: {look:?}");
    }
    let hz: f64 = look
        .found
        .split(", ")
        .find_map(|part| part.strip_suffix(" pictures a second")?.parse().ok())
        .unwrap();
    assert!((hz - 60.0).abs() < 2.0, "{look:?}");
}

#[test]
fn what_is_absent_closed_or_no_camera_is_told() {
    let doubt = look("absent", &request(60)).unwrap_err().to_string();
    assert!(doubt.contains("there is no ") && doubt.contains("plugged in?"), "{doubt}");
    // A file of this user lies at the path, and its group is named.
    std::fs::write(path("denied"), "").unwrap();
    let group = std::fs::metadata(path("denied")).unwrap();
    let group = dpm_rig_group(&group);
    refused("denied", "denied", &request(60), &["may not be opened by this user", &group]);
    std::fs::remove_file(path("denied")).unwrap();
    // Files of the system that are none.
    for (place, word) in [("/dev/null", "no video device"), ("/tmp", "it is a folder")] {
        let doubt = examine_source(place, &request(60)).unwrap().unwrap_err().to_string();
        assert!(doubt.contains("is no camera") && doubt.contains(word), "{place}: {doubt}");
    }
    // Metadata beside a camera; several planes; a camera that can only be read from.
    refused("meta", "capabilities=0x04800000", &request(60), &["gives no pictures", "-index0"]);
    refused("planes", "capabilities=0x04001000", &request(60), &["in several planes only"]);
    refused("reads", "capabilities=0x01000001", &request(60), &["cannot stream"]);
    refused("busy", "busy", &request(60), &["is in use by another program", "fuser -v"]);
    refused("lost", "fails=S_FMT:ENODEV", &request(60), &["was unplugged"]);
}

fn dpm_rig_group(file: &std::fs::Metadata) -> String {
    use std::os::unix::fs::MetadataExt;
    // Root's own group is no remedy, and the usual one is named.
    if file.gid() == 0 {
        return "video".into();
    }
    let groups = std::fs::read_to_string("/etc/group").unwrap();
    let line = groups.lines().find(|line| line.split(':').nth(2) == Some(&file.gid().to_string()));
    line.map_or(format!("gid {}", file.gid()), |line| line.split(':').next().unwrap().to_owned())
}

#[test]
fn formats_sizes_and_rates_that_it_has_not_are_told_with_those_it_has() {
    refused(
        "mjpeg",
        "formats=H264,BGR3",
        &request(60),
        &["no format that is read", "H264 48 x 32; BGR3 48 x 32", "GREY"],
    );
    let larger = PictureRequest { size: [640, 480], ..request(60) };
    refused("size", "formats=YUYV", &larger, &["no pictures of 640 x 480", "YUYV 48 x 32", "tracker.size"]);
    refused(
        "rate",
        "rates=30,15",
        &request(60),
        &["no 60 pictures a second", "GREY 30, 15", "tracker.rate_hz"],
    );
    // Without a list of rates the driver's answer counts.
    let more = "rates=30 fails=ENUM_FRAMEINTERVALS:ENOTTY";
    refused("fixed", more, &request(60), &["gives 30 pictures a second and not 60", "tracker.rate_hz = 30"]);
    // A camera that says 60 and gives 30, as in the dark.
    let clock = clock();
    let host = host(30, 0, "", &clock);
    let _fake = camera("slow", &host, "rates=60");
    let look = look("slow", &request(60)).unwrap();
    assert!(look.doubts[0].found.contains("where 60 are asked"), "{look:?}");
}

#[test]
fn exposures_that_blur_or_are_not_known_are_told() {
    let asks = |us| PictureRequest { exposure_us: us, ..request(60) };
    doubted("long", "", &asks(Some(9_000)), &["exposes for 9.0 ms, longer than half", "8.3 ms"]);
    refused("range", "exposure=5..20", &asks(Some(9_000)), &["exposures of 500 to 2000 us, and not 9000"]);
    doubted("coarse", "exposure=1..50", &asks(Some(130)), &["exposes for 100 us where 130 us are asked"]);
    doubted(
        "none",
        "exposure=none",
        &asks(Some(2_000)),
        &["has no control for its exposure; 2000 us is believed"],
    );
    refused("unknown", "exposure=none", &asks(None), &["no control for it", "set tracker.exposure_us"]);
    refused("automatic", "automatic", &asks(None), &["changes it by itself", "set tracker.exposure_us"]);
    // By hand its own setting is read: the fake's is 15.7 ms.
    doubted("own", "", &asks(None), &["exposes for 15.7 ms"]);
    refused("forbidden", "fails=S_EXT_CTRLS:EACCES", &asks(Some(2_000)), &["refuses an exposure of 2000 us"]);
    let gain = |gain| PictureRequest { gain: Some(gain), ..request(60) };
    refused("gainless", "", &gain(4), &["no control for its gain", "leave out tracker.gain"]);
    refused("gain", "gain=1..8", &gain(9), &["a gain of 1 to 8, and not 9"]);
}

/// A camera that exposes by itself is set to do as it is told, before its exposure is set.
#[test]
fn exposure_and_gain_are_set_by_hand() {
    let clock = clock();
    let host = host(60, 0, "", &clock);
    let fake = camera("hand", &host, "automatic gain=1..8");
    assert!(fake.witness().is_automatic);
    let asks = PictureRequest { gain: Some(5), ..request(60) };
    let look = look("hand", &asks).unwrap();
    assert!(look.doubts.is_empty(), "{look:?}");
    let witness = fake.witness();
    assert_eq!((witness.is_automatic, witness.exposure, witness.gain), (false, 20, 5));
}

#[test]
fn stamps_and_losses_are_judged() {
    refused("no-clock", "stamp=no-clock", &request(60), &["does not say by which clock", "none is used"]);
    refused("copied", "stamp=copied", &request(60), &["copied from another program"]);
    refused("wall-clock", "stamp=wall-clock", &request(60), &["cannot be of CLOCK_MONOTONIC", "uvcvideo"]);
    doubted("damaged", "damaged=4", &request(60), &["and damaged"]);
    doubted("silent-look", "silent", &request(60), &["gave 0 pictures while it was looked at"]);
}
