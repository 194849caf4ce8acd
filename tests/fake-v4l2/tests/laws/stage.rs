//! A picture maker whose pictures say their own number, on a socket, and a fake camera that shows them.

use dpm_camera::PictureRequest;
use dpm_device::time::{FrameRate, HostClock, HostTime};
use dpm_mock::camera::{CameraHost, CameraOptics, Exposure, MockCamera, MockCameraConfig, PictureMaker};
use fake_v4l2::FakeCamera;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

pub(crate) const SIZE: [u32; 2] = [48, 32];
/// Exposure of the mock and of the requests here.
pub(crate) const EXPOSURE_NS: i64 = 2_000_000;
/// Longer than anything takes on a machine with other work.
pub(crate) const LONG: Duration = Duration::from_secs(60);

pub(crate) fn clock() -> Arc<dyn HostClock> {
    let epoch = Instant::now();
    Arc::new(move || HostTime(epoch.elapsed().as_nanos() as i64))
}

/// Every pixel is a function of its place and of the picture's number, which stands in the first four.
pub(crate) fn picture(number: u32) -> Vec<u8> {
    let pixel = |i: u32| ((number.wrapping_mul(2_654_435_761) ^ i.wrapping_mul(40_503)) >> 7) as u8;
    let mut all: Vec<u8> = (0..SIZE[0] * SIZE[1]).map(pixel).collect();
    all[..4].copy_from_slice(&number.to_le_bytes());
    all
}

/// The number that a picture says.
pub(crate) fn number(pixels: &[u8]) -> u32 {
    u32::from_le_bytes(*pixels.first_chunk().unwrap())
}

struct Numbers(MockCamera);

impl PictureMaker for Numbers {
    fn config(&self) -> &MockCameraConfig {
        self.0.config()
    }

    fn exposure(&self, number: u64) -> Option<Exposure> {
        self.0.exposure(number)
    }

    fn make(&mut self, exposure: &Exposure, _: &dyn HostClock, pixels: &mut Vec<u8>) {
        *pixels = picture(exposure.number as u32);
    }
}

/// A socket with such pictures, `hz` a second.
pub(crate) fn host(hz: u32, row_ns: i64, faults: &str, clock: &Arc<dyn HostClock>) -> CameraHost {
    let config = MockCameraConfig {
        optics: CameraOptics::pinhole(SIZE, 60.0),
        rate: FrameRate::new(hz, 1).unwrap(),
        exposure_ns: EXPOSURE_NS,
        row_ns,
        latency_ns: 1_000_000,
        faults: faults.parse().unwrap(),
        ..MockCameraConfig::default()
    };
    let maker = Numbers(MockCamera::new(config, vec![]).unwrap());
    CameraHost::start(maker, SocketAddrV4::new(Ipv4Addr::LOCALHOST, 0), clock.clone()).unwrap()
}

/// The path of a camera of this test, at which nothing lies.
pub(crate) fn path(name: &str) -> PathBuf {
    std::env::temp_dir().join(format!("fake-v4l2-{}-{name}", std::process::id()))
}

/// A camera that shows the socket's pictures, with more words.
pub(crate) fn camera(name: &str, host: &CameraHost, more: &str) -> FakeCamera {
    FakeCamera::plug_in(&words(name, host, more))
}

pub(crate) fn words(name: &str, host: &CameraHost, more: &str) -> String {
    format!("path={} from={} size={}x{} {more}", path(name).display(), host.address(), SIZE[0], SIZE[1])
}

pub(crate) fn request(hz: u32) -> PictureRequest {
    PictureRequest {
        size: SIZE,
        rate_hz: hz,
        exposure_us: Some((EXPOSURE_NS / 1_000) as u32),
        gain: None,
        readout_us: 0,
    }
}

/// Waits until `done`.
pub(crate) fn until(what: &str, mut done: impl FnMut() -> bool) {
    let begin = Instant::now();
    while !done() {
        assert!(begin.elapsed() < LONG, "{what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}
