//! A camera made of software before the bodies of a mock's scene.

use crate::mock::{two_tags, CameraHost, CameraOptics, MarkedBody, MockCamera, MockCameraConfig, ANY_PORT};
use crate::trackers::{MockScene, MockServer};
use dpm_device::pose::Pose;
use std::io;

/// Raster and angle of view: small, so that a busy machine paints them in time.
const SIZE: [u32; 2] = [640, 400];
const VIEW_DEG: f64 = 60.0;
/// From the middle of the bodies, m.
const AWAY_M: f64 = 1.2;
/// Two tags on the front of each body, and a camera before all of them.
pub(super) fn mock(scene: &MockScene) -> io::Result<MockServer> {
    let rests: Vec<[f64; 3]> = scene.motions.iter().map(|m| m.rest().position_m).collect();
    let mean = |i: usize| rests.iter().map(|r| r[i]).sum::<f64>() / rests.len().max(1) as f64;
    let place = [mean(0), mean(1), mean(2) + AWAY_M];
    let mut tags = Vec::new();
    let mut bodies = Vec::new();
    for (n, (name, motion)) in scene.names.iter().zip(&scene.motions).enumerate() {
        let own = two_tags(n);
        tags.extend(own.map(|tag| tag.as_toml(name)));
        bodies.push(MarkedBody { motion: motion.clone(), tags: own.to_vec(), markers: vec![] });
    }
    let config = MockCameraConfig {
        optics: CameraOptics::pinhole(SIZE, VIEW_DEG),
        pose: Pose { position_m: place, ..Pose::IDENTITY },
        ..MockCameraConfig::default()
    };
    let camera = MockCamera::new(config, bodies).map_err(io::Error::other)?;
    let host = CameraHost::start(camera, ANY_PORT, scene.clock.clone())?;
    let keys = vec![
        ("device", format!("\"tcp:{}\"", host.address())),
        ("size", format!("{SIZE:?}")),
        ("view_deg", format!("{VIEW_DEG:?}")),
        ("tags", format!("[{}]", tags.join(", "))),
        ("transform", format!("{{ position = {place:?} }}")),
    ];
    Ok(MockServer { keys, running: Box::new(host) })
}
