//! The mock's eyes, and the client at the wire: gaze at the mock's target, by its clock, over losses.

use super::eyes::EyeMotion;
use super::host::PupilHost;
use super::messages::{Mapping, PupilConfig};
use dpm_device::time::{HostClock, HostTime};
use dpm_pupil::client::{GazeAt, PupilClient, PupilSettings};
use std::sync::Arc;
use std::time::{Duration, Instant};

fn clock() -> Arc<dyn HostClock> {
    let begin = Instant::now();
    Arc::new(move || HostTime(begin.elapsed().as_nanos() as i64))
}

fn client(host: &PupilHost, clock: &Arc<dyn HostClock>, hears_pupils: bool) -> PupilClient {
    let settings = PupilSettings { address: host.address(), min_confidence: 0.6, hears_pupils };
    PupilClient::new(settings, clock.clone())
}

/// Polls for `seconds`, or until `is_enough`.
fn listen(client: &mut PupilClient, seconds: f64, is_enough: &dyn Fn(&[GazeAt]) -> bool) -> Vec<GazeAt> {
    let (begin, mut heard) = (Instant::now(), Vec::new());
    while begin.elapsed().as_secs_f64() < seconds && !is_enough(&heard) {
        client.poll(Duration::from_millis(20), &mut |gaze| heard.push(*gaze));
    }
    heard
}

/// Degrees between the line of sight of a sample and the target, seen from between the eyes.
fn off_deg(gaze: &GazeAt, target_m: [f64; 3]) -> f64 {
    let line = |to: [f64; 3]| [0, 1, 2].map(|i| to[i] - gaze.eye_m[i]);
    let (a, b) = (line(gaze.point_m), line(target_m));
    let dot = |a: &[f64; 3], b: &[f64; 3]| (0..3).map(|i| a[i] * b[i]).sum::<f64>();
    (dot(&a, &b) / (dot(&a, &a) * dot(&b, &b)).sqrt()).clamp(-1.0, 1.0).acos().to_degrees()
}

#[test]
fn eyes_rest_jump_and_blink() {
    let eyes = EyeMotion::default();
    let states: Vec<_> = (0..20_000i64).map(|ms| eyes.at(ms * 1_000_000)).collect();
    let share = |is: &dyn Fn(&super::eyes::EyeState) -> bool| {
        states.iter().filter(|s| is(s)).count() as f64 / states.len() as f64
    };
    let (fixed, shut) = (share(&|s| s.is_fixed), share(&|s| s.is_shut));
    assert!((0.85..0.93).contains(&fixed) && (0.03..0.045).contains(&shut), "{fixed} {shut}");
    let steps = states
        .windows(2)
        .map(|w| w[0].target_m.iter().zip(w[1].target_m).map(|(a, b)| (a - b).abs()).sum::<f64>());
    assert!(steps.fold(0.0, f64::max) < 0.1, "a jump within a millisecond");
    assert_eq!(eyes.at(-5), eyes.at(-5));
}

/// The clock stands apart and runs 200 ppm fast; a twentieth of the messages is lost, and blinks are of no confidence.
#[test]
fn a_client_hears_where_the_eyes_look_and_when() {
    let clock = clock();
    let config = PupilConfig {
        eyes: EyeMotion { blink_every_ns: 500_000_000, blink_ns: 100_000_000, ..EyeMotion::default() },
        clock_offset_s: 1.7e9,
        clock_ppm: 200.0,
        faults: "loss=0.05".parse().expect("a plan"),
        ..PupilConfig::default()
    };
    let host = PupilHost::here(config.clone(), clock.clone()).expect("sockets");
    let mut client = client(&host, &clock, false);
    let heard = listen(&mut client, 20.0, &|heard| heard.len() >= 300);
    assert!(heard.len() >= 300, "{} samples; {:?}", heard.len(), client.doubt());
    // Clock errors show where the eyes move: 45 ms for up to 36 degrees.
    for gaze in heard.iter().skip(10) {
        let state = config.eyes.at(gaze.at.0);
        let before = config.eyes.at(gaze.at.0 - 1_000_000);
        let after = config.eyes.at(gaze.at.0 + 1_000_000);
        let off =
            [before, state, after].map(|s| off_deg(gaze, s.target_m)).into_iter().fold(f64::MAX, f64::min);
        assert!(off < 0.5, "{off} degrees at {gaze:?}");
        if before.is_fixed && after.is_fixed && before.target_m == after.target_m {
            assert!(off < 1e-3, "{off} degrees at rest at {gaze:?}");
        }
    }
    let (counts, bound) = (client.counts(), client.clock_bound_ns().expect("asked"));
    assert!(counts.unsure > 0 && counts.unsure < counts.used, "{counts:?}");
    assert!(counts.refused + counts.flat == 0 && counts.sessions == 1, "{counts:?}");
    assert!((0..20_000_000).contains(&bound), "{bound} ns");
    let by_time = |w: &[GazeAt]| w[0].at < w[1].at;
    assert!(heard.windows(2).all(by_time));
}

#[test]
fn a_client_comes_back_and_says_meanwhile_what_is_wrong() {
    let clock = clock();
    let host = PupilHost::here(PupilConfig::default(), clock.clone()).expect("sockets");
    let address = host.address();
    let mut client = client(&host, &clock, false);
    assert!(!listen(&mut client, 10.0, &|heard| heard.len() > 10).is_empty());
    drop(host);
    listen(&mut client, 0.8, &|_| false);
    let doubt = client.doubt().expect("it is gone");
    assert!(
        doubt.found.contains(&address.to_string()) && doubt.remedy.contains("Pupil Capture"),
        "{doubt:?}"
    );
    let std::net::SocketAddr::V4(again) = address else { unreachable!("of this machine") };
    let host = PupilHost::start(
        PupilConfig { clock_offset_s: -3.0, ..PupilConfig::default() },
        again,
        clock.clone(),
    );
    let _host = host.expect("the port is free again");
    // Its clock has been set anew meanwhile, which three answers show.
    assert!(!listen(&mut client, 10.0, &|heard| heard.len() > 10).is_empty(), "{:?}", client.doubt());
    let counts = client.counts();
    assert_eq!((counts.sessions, counts.clock_steps), (2, 1), "{counts:?}");
    assert_eq!(client.doubt(), None);
}

#[test]
fn what_is_missing_at_pupil_is_named() {
    let clock = clock();
    let told = |config: PupilConfig, hears_pupils: bool| {
        let host = PupilHost::here(config, clock.clone()).expect("sockets");
        let mut client = client(&host, &clock, hears_pupils);
        let heard = listen(&mut client, 1.2, &|_| false);
        assert!(heard.is_empty(), "{heard:?}");
        client.doubt().expect("a doubt").found
    };
    let missing = PupilConfig { mapping: Mapping::Missing, ..PupilConfig::default() };
    assert!(told(missing.clone(), true).contains("no calibration"));
    assert!(told(missing, false).contains("sends no gaze"));
    assert!(told(PupilConfig { mapping: Mapping::Flat, ..PupilConfig::default() }, false).contains("2D"));
    let doubtful = PupilConfig { confidence: 0.4, ..PupilConfig::default() };
    assert!(told(doubtful, false).contains("below 0.6"));
    // A port that is open and says nothing, and one that speaks another language.
    let listener = std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
    let settings = PupilSettings {
        address: listener.local_addr().expect("bound"),
        min_confidence: 0.6,
        hears_pupils: false,
    };
    let mut client = PupilClient::new(settings, clock.clone());
    listen(&mut client, 1.3, &|_| false);
    assert!(client.doubt().expect("silent").found.contains("answers nothing"));
    let web = std::thread::spawn(move || {
        while let Ok((mut stream, _)) = listener.accept() {
            let ended = std::io::Write::write_all(&mut stream, b"HTTP/1.1 400 Bad Request\r\n\r\n").is_err();
            if ended {
                return;
            }
        }
    });
    listen(&mut client, 1.2, &|_| false);
    assert!(client.doubt().expect("no ZeroMQ").found.contains("ZeroMQ"));
    drop(web);
}
