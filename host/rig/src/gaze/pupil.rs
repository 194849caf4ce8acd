//! `observer.gaze.kind = "pupil"`: Pupil Core's eye cameras, by the network interface of Pupil Capture or Pupil Service.

use super::kind::{GazeAim, GazeCounts, GazeDoubt, GazeKeys, GazeKind, GazeSample, GazeSource};
use super::plain::vector;
use dpm_common::keys::read::{refuse, KeyReader, NotEmpty, Within};
use dpm_common::keys::source::Value;
use dpm_common::section;
use dpm_device::time::HostClock;
use dpm_pupil::client::{PupilClient, PupilSettings, PORT};
use glam::{DAffine3, DQuat, DVec3, EulerRot};
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

section! {
    /// Gaze by Pupil Core.
    pub struct PupilGazeConfig {
        /// Address of the machine with Pupil Capture or Pupil Service.
        address: String = "127.0.0.1".into(), "", NotEmpty;
        /// TCP port of its plugin "Network API" (Pupil Remote), which says where the data are.
        port: u16 = PORT, "", Within(1, u16::MAX);
        /// Samples of less confidence are not used: in a blink it falls to almost 0.
        min_confidence: f64 = 0.6, "", Within(0.0, 1.0);
        /// Where Pupil's scene camera is, in the space of the body that carries the eye.
        camera_position: [f64; 3] = [0.0; 3], "m", Within(-1.0, 1.0);
        /// Rotations about the body's x, then y, then z, from the camera's axes (x to the right of its picture, y down,
        /// z forward) to the body's. By default it looks along -Z, with +Y up.
        camera_rotation_deg: [f64; 3] = [180.0, 0.0, 0.0], "deg", Within(-360.0, 360.0);
        /// Time by which a sample is older than its time stamp says.
        latency_us: i64 = 0, "us", Within(-200_000, 200_000);
    }
}

pub(super) static KIND: GazeKind = GazeKind::of::<PupilGazeConfig>(
    "pupil",
    "where the eye cameras of Pupil Core see the wearer of the glasses look (docs/TRACKERS.md).",
);

impl PupilGazeConfig {
    fn ip(&self) -> Option<IpAddr> {
        self.address.trim().parse().ok()
    }

    /// From the scene camera's frame to that of the body.
    fn body_from_camera(&self) -> DAffine3 {
        let [x, y, z] = self.camera_rotation_deg.map(f64::to_radians);
        let rotation = DQuat::from_euler(EulerRot::ZYX, z, y, x);
        DAffine3::from_rotation_translation(rotation, DVec3::from_array(self.camera_position))
    }
}

impl GazeKeys for PupilGazeConfig {
    fn aim(&self) -> GazeAim {
        GazeAim::Measured
    }

    fn written(&self) -> Vec<(&'static str, Value)> {
        vec![
            ("address", Value::String(self.address.clone())),
            ("port", Value::Integer(self.port.into())),
            ("min_confidence", Value::Float(self.min_confidence)),
            ("camera_position", vector(self.camera_position)),
            ("camera_rotation_deg", vector(self.camera_rotation_deg)),
            ("latency_us", Value::Integer(self.latency_us)),
        ]
    }

    fn check(&self, reader: &mut KeyReader) {
        if self.ip().is_none() {
            let problem = format!("{:?} is no address", self.address);
            refuse(reader, &["observer.gaze.address"], problem, "write for example \"192.168.1.10\"".into());
        }
    }

    fn open(&self, clock: Arc<dyn HostClock>, examines: bool) -> Option<Box<dyn GazeSource>> {
        // The check has refused what is no address.
        let ip = self.ip().unwrap_or(IpAddr::V4(Ipv4Addr::LOCALHOST));
        let settings = PupilSettings {
            address: SocketAddr::new(ip, self.port),
            min_confidence: self.min_confidence,
            hears_pupils: examines,
        };
        let client = PupilClient::new(settings, clock);
        let latency_ns = self.latency_us * 1000;
        Some(Box::new(PupilSource { client, body_from_camera: self.body_from_camera(), latency_ns }))
    }
}

struct PupilSource {
    client: PupilClient,
    body_from_camera: DAffine3,
    latency_ns: i64,
}

impl GazeSource for PupilSource {
    fn poll(&mut self, limit: Duration, sink: &mut dyn FnMut(&GazeSample)) {
        let Self { client, body_from_camera, latency_ns } = self;
        client.poll(limit, &mut |gaze| {
            sink(&GazeSample {
                at: gaze.at.plus_ns(-*latency_ns),
                received_at: gaze.received_at,
                point_m: body_from_camera.transform_point3(DVec3::from_array(gaze.point_m)),
            });
        });
    }

    fn counts(&self) -> GazeCounts {
        let counts = self.client.counts();
        GazeCounts {
            samples: counts.messages,
            used: counts.used,
            unsure: counts.unsure,
            refused: counts.flat + counts.refused,
            ill_timed: counts.ill_timed,
            sessions: counts.sessions,
            clock_steps: counts.clock_steps,
            clock_bound_ns: self.client.clock_bound_ns().unwrap_or(0).unsigned_abs(),
        }
    }

    fn doubt(&self) -> Option<GazeDoubt> {
        self.client.doubt().map(|doubt| GazeDoubt { found: doubt.found, remedy: doubt.remedy })
    }
}
