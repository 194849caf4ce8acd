//! Laws of the eye guard: what the mask cuts, against an oracle that looks at the ray of every mirror, and that no light
//! meets a head that moves, is lost, or whose label the tracker gives to another.

use super::*;
use crate::config::{Overrides, RigConfig};
use crate::mock::{MockTracker, MockTrackerConfig};
use crate::plan::eyes::HeadWatch;
use crate::tracks::{TrackSnapshot, TrackingStage};
use dpm_device::planes::{Channel, PlaneSchedule, PlaneSpec};
use dpm_device::rng::Draws;
use dpm_device::time::{FrameRate, HostTime};
use dpm_device::tracker::{BodyIndex, Tracker, TrackerError, TrackerSample};
use dpm_handoff::latest::latest;
use dpm_scene::geometry::lens::Lens;
use glam::{DAffine3, DQuat};

/// Unit directions of the rays of all mirrors in the world, row after row.
fn rays(camera: &ProjectorCamera) -> Vec<DVec3> {
    let (width, height) = (camera.raster.width(), camera.raster.height());
    let at = |i: u32| DVec2::new(f64::from(i % width) + 0.5, f64::from(i / width) + 0.5);
    (0..width * height).map(|i| camera.ray(at(i)).direction).collect()
}

/// How near the half-line from `origin` along `direction` comes to `point`.
fn distance(origin: DVec3, direction: DVec3, point: DVec3) -> f64 {
    let to = point - origin;
    (to - direction * to.dot(direction).max(0.0)).length()
}

fn is_lit(planes: &BitPlaneFrame, raster: Raster, mirror: usize) -> bool {
    let (x, y) = (mirror % raster.width() as usize, mirror / raster.width() as usize);
    let byte = y * raster.row_bytes() + x / 8;
    planes.bytes().chunks_exact(raster.plane_bytes()).any(|plane| plane[byte] >> (7 - x % 8) & 1 == 1)
}

/// A projector that is drawn: anywhere, with a lens or without, a shifted one or not.
fn camera(draws: Draws) -> ProjectorCamera {
    let between = |i: u64, low: f64, high: f64| low + (high - low) * draws.unit(i);
    let raster = Raster::new(9 + (draws.bits(0) % 72) as u32, 5 + (draws.bits(1) % 60) as u32).unwrap();
    let axis = DVec3::from_array(draws.normal3(2)).normalize();
    let pose = DAffine3::from_rotation_translation(
        DQuat::from_axis_angle(axis, between(3, 0.0, 3.1)),
        DVec3::from_array(draws.stream(1).normal3(0)),
    );
    let (w, h) = (f64::from(raster.width()), f64::from(raster.height()));
    let f = w * between(20, 0.6, 3.0);
    let (cx, cy) = (w * between(21, 0.2, 0.8), h * between(22, -0.5, 1.0));
    let plain = ProjectorCamera::new(raster, pose, f, f * between(23, 0.8, 1.2), cx, cy).unwrap();
    let lens = match draws.bits(24) % 3 {
        0 => Lens::default(),
        1 => Lens::opencv(&[between(25, -0.25, 0.2), between(26, -0.05, 0.05), 0.004, -0.003, 0.01]).unwrap(),
        _ => Lens::fisheye([between(25, -0.05, 0.05), 0.01, 0.0, 0.0]).unwrap(),
    };
    // A lens that folds over this raster is none.
    plain.with_lens(lens).unwrap_or(plain)
}

/// A sphere that is drawn: in the beam, beside it, behind the projector, far away, or around it.
fn sphere(draws: Draws, camera: &ProjectorCamera) -> EyeGuard {
    let far_m = 10f64.powf(-1.5 + 3.0 * draws.unit(0));
    let mirror = DVec2::new(
        f64::from(camera.raster.width()) * (1.6 * draws.unit(1) - 0.3),
        f64::from(camera.raster.height()) * (1.6 * draws.unit(2) - 0.3),
    );
    let ray = camera.ray(mirror).direction;
    let way =
        if draws.happens(3, 0.2) || !ray.is_finite() { DVec3::from_array(draws.normal3(4)) } else { ray };
    EyeGuard {
        centre: camera.position() + way.normalize() * far_m,
        radius_m: 10f64.powf(-2.0 + 1.7 * draws.unit(5)),
    }
}

/// `cases` projectors with up to three spheres each.
fn cut_as_the_oracle(cases: u64, first: u64) {
    let (mut some, mut none, mut all) = (0, 0, 0);
    for case in first..first + cases {
        let draws = Draws::new(case);
        let camera = camera(draws);
        let (raster, rays, origin) = (camera.raster, rays(&camera), camera.position());
        let mut mask = EyeMask::new(&camera, false);
        let schedule = PlaneSchedule::mono8();
        let mut planes = BitPlaneFrame::new(raster, schedule);
        for round in 0..4 {
            let draws = draws.stream(100 + round);
            let spheres: Vec<_> = (0..draws.bits(9) % 4).map(|i| sphere(draws.stream(i), &camera)).collect();
            let eyes = GuardedEyes { spheres, lost: None };
            // The padding of rows stays dark.
            planes.bytes_mut().fill(0);
            let width = raster.width() as usize;
            for mirror in 0..raster.pixel_count() {
                let (x, y) = (mirror % width, mirror / width);
                planes.bytes_mut()[y * raster.row_bytes() + x / 8] |= 0x80 >> (x % 8);
            }
            let cut = mask.cut(&eyes, &camera, &mut planes);
            let mut dark = 0;
            for (mirror, ray) in rays.iter().enumerate() {
                let lit = is_lit(&planes, raster, mirror);
                dark += u32::from(!lit);
                assert_eq!(!lit, mask.is_cut(mirror), "case {case}, mirror {mirror}");
                let meets = |s: &EyeGuard| distance(origin, *ray, s.centre) <= s.radius_m;
                assert!(
                    !(lit && eyes.spheres.iter().any(meets)),
                    "case {case}: light in the guard at {mirror}"
                );
                // Nothing is cut that lies more than a tile's breadth beside every sphere.
                let (x, y) = (mirror % width, mirror / width);
                let corner = |dx: usize, dy: usize| {
                    let x = (x / TILE * TILE + dx).min(width - 1);
                    rays[(y / TILE * TILE + dy).min(raster.height() as usize - 1) * width + x]
                };
                let across = |a: DVec3, b: DVec3| a.angle_between(b);
                let breadth = across(corner(0, 0), corner(7, 7)).max(across(corner(7, 0), corner(0, 7)));
                let near = |s: &EyeGuard| {
                    let to = s.centre - origin;
                    let half = (s.radius_m / to.length()).min(1.0).asin();
                    to.length() <= s.radius_m || ray.angle_between(to) <= half + 1.5 * breadth + 0.03
                };
                assert!(lit || eyes.spheres.iter().any(near), "case {case}: {mirror} is cut for nobody");
            }
            assert_eq!(cut, dark, "case {case}: the mirrors that are counted");
            let size = raster.pixel_count() as u32;
            *(if cut == 0 {
                &mut none
            } else if cut == size {
                &mut all
            } else {
                &mut some
            }) += 1;
        }
    }
    assert!(some * 10 > 4 * cases && none > 0 && all > 0, "{some} {none} {all}: the cases are of one kind");
}

#[test]
fn no_mirror_is_lit_whose_ray_meets_a_sphere_and_few_others_are_dark() {
    cut_as_the_oracle(60, 0);
}

/// Where a head is not known it may be anywhere: nothing is lit, and neither is it where its place is no number.
#[test]
fn a_head_that_is_lost_or_nowhere_makes_all_dark() {
    let camera = camera(Draws::new(7));
    let mut mask = EyeMask::new(&camera, false);
    let nowhere = EyeGuard { centre: DVec3::new(0.0, f64::NAN, 1.0), radius_m: 0.1 };
    let endless = EyeGuard { centre: DVec3::ZERO, radius_m: f64::INFINITY };
    for (spheres, lost) in [(vec![], Some(0)), (vec![nowhere], None), (vec![endless], None)] {
        let mut planes = BitPlaneFrame::new(camera.raster, PlaneSchedule::rgb24());
        planes.bytes_mut().fill(0xff);
        let cut = mask.cut(&GuardedEyes { spheres, lost }, &camera, &mut planes);
        assert_eq!(cut as usize, camera.raster.pixel_count());
        assert!(planes.bytes().iter().all(|byte| *byte == 0));
        assert!((0..camera.raster.pixel_count()).all(|mirror| mask.is_cut(mirror)));
    }
}

/// A projector that moves light by tracks moves none into the guard: every mirror from which light could come is dark too.
#[test]
fn tracks_move_no_light_into_the_guard() {
    for seed in 0..40 {
        let camera = camera(Draws::new(seed));
        let (raster, rays) = (camera.raster, rays(&camera));
        let (width, height) = (raster.width() as i64, raster.height() as i64);
        let sphere = sphere(Draws::new(seed).stream(3), &camera);
        let mut mask = EyeMask::new(&camera, true);
        let mut planes = BitPlaneFrame::new(raster, PlaneSchedule::mono8());
        mask.cut(&GuardedEyes { spheres: vec![sphere], lost: None }, &camera, &mut planes);
        for (mirror, ray) in rays.iter().enumerate() {
            if distance(camera.position(), *ray, sphere.centre) > sphere.radius_m {
                continue;
            }
            let (x, y) = (mirror as i64 % width, mirror as i64 / width);
            let most = TILE as i64;
            for (dx, dy) in [(-most, 0), (most, 0), (0, -most), (0, most), (most, most), (-most, most)] {
                let (x, y) = ((x + dx).clamp(0, width - 1), (y + dy).clamp(0, height - 1));
                assert!(mask.is_cut((y * width + x) as usize), "seed {seed}: light may come from {x}, {y}");
            }
        }
    }
}

/// A tracker that gives a head's label to the other one, and loses heads, as a plan of draws says.
struct LabelMuddle {
    inner: MockTracker,
    draws: Draws,
}

/// Length of a stretch in which labels and losses stay as they are, nanoseconds.
const STRETCH_NS: i64 = 700_000_000;

impl LabelMuddle {
    /// In one stretch of six the labels are exchanged; in one of eight a head is lost, sometimes both.
    fn mood(&self, at: HostTime) -> (bool, [bool; 2]) {
        let stretch = (at.0 / STRETCH_NS) as u64;
        let lost = [0, 1].map(|head| self.draws.stream(head).happens(stretch, 0.125));
        (self.draws.stream(9).happens(stretch, 1.0 / 6.0), lost)
    }
}

impl Tracker for LabelMuddle {
    fn poll(&mut self, now: HostTime, sink: &mut dyn FnMut(&TrackerSample)) -> Result<usize, TrackerError> {
        let mut samples = Vec::new();
        self.inner.poll(now, &mut |sample| samples.push(*sample))?;
        for sample in &mut samples {
            let (swapped, lost) = self.mood(sample.captured_at);
            if lost[usize::from(sample.body.0)] {
                continue;
            }
            if swapped {
                sample.body = BodyIndex(1 - sample.body.0);
            }
            sink(sample);
        }
        Ok(samples.len())
    }

    fn name(&self) -> &str {
        "muddled"
    }
}

/// Two heads move through the beam, turn, are lost, and exchange their labels, for `frames` frames. In no frame is a mirror
/// lit whose ray meets the sphere about a true head, from its first photon to the end of the slot after its own. Returns the
/// shares of frames that were dark as a whole, and of mirrors that were cut of the others.
fn no_light_meets_a_head(frames: i64, seed: u64) -> [f64; 2] {
    let motion = |x: f64, y: f64, v: f64, a: f64| {
        format!(
            "motion={{kind=\"together\",parts=[\
             {{kind=\"sinusoid\",direction=[{x},{y},0.1],peak_speed_m_s={v},peak_acceleration_m_s2={a}}},\
             {{kind=\"sinusoid\",direction=[0.1,1,0.3],peak_speed_m_s=0.4,peak_acceleration_m_s2=3.1}},\
             {{kind=\"sway\",axis=[0,1,0],peak_rate_rad_s=2,peak_acceleration_rad_s2=11}}]}}"
        )
    };
    let glasses = motion(1.0, 0.1, 1.3, 6.0);
    let visitor = motion(-0.8, 0.6, 1.1, 4.7);
    let flags = [
        format!("observer.tracked={{name=\"glasses\",position=[0.1,0.3,0.45],{glasses}}}"),
        format!("safety.eyes.heads=[\"glasses\",{{name=\"visitor\",position=[-0.35,0.2,0.1],{visitor}}}]"),
        "safety.eyes.radius=0.06".to_owned(),
        "projector.width=64".to_owned(),
        "projector.height=48".to_owned(),
        "tracker.noise_m=0.0002".to_owned(),
    ];
    let config = RigConfig::demo(&Overrides { variables: vec![], flags: flags.to_vec() }).unwrap();
    let rig = Rig::of_projector(&config).unwrap();
    let rate = FrameRate::new(500, 1).unwrap();
    let tracker = MockTrackerConfig {
        seed,
        rate,
        position_noise_m: 2e-4,
        rotation_noise_rad: 1e-3,
        latency_ns: 3_000_000,
        ..Default::default()
    };
    let motions = rig.tracked().filter_map(|b| b.motion.clone()).collect();
    let muddled = LabelMuddle { inner: MockTracker::new(tracker, motions).unwrap(), draws: Draws::new(seed) };
    let mut stage = TrackingStage::new(&rig, Box::new(muddled));
    let (mut publisher, mut reader) = latest(TrackSnapshot::empty(rig.tracked_count()));
    let mut watch = HeadWatch::new(&rig);
    let mut eyes = GuardedEyes::empty(&rig);
    let mut mask = EyeMask::new(&rig.camera, false);
    let white = PlaneSchedule::new(&[PlaneSpec { channel: Channel::White, bit: 7 }]).unwrap();
    let mut planes = BitPlaneFrame::new(rig.camera.raster, white);
    let (rays, origin) = (rays(&rig.camera), rig.camera.position());
    let (slot_ns, size) = (rig.rate().slot_len_ns(0), rays.len() as u64);
    let (mut dark, mut cut, mut met) = (0u64, 0u64, 0u64);
    for frame in 0..frames {
        let now = HostTime(1_000_000_000 + frame * slot_ns);
        stage.step(now, &mut publisher).unwrap();
        // Latched three slots before its light; without a successor it is lit for a slot more.
        let first = now.plus_ns(3 * slot_ns);
        let last = first.plus_ns(2 * slot_ns);
        watch.guard(&rig.heads, reader.latest().0, now, [first, last], &mut eyes);
        planes.bytes_mut().fill(0xff);
        let mirrors = u64::from(mask.cut(&eyes, &rig.camera, &mut planes));
        if eyes.lost.is_some() {
            dark += 1;
            assert_eq!(mirrors, size);
            continue;
        }
        cut += mirrors;
        let at =
            first.plus_ns((Draws::new(seed).stream(77).unit(frame as u64) * (2 * slot_ns) as f64) as i64);
        for head in rig.true_poses(at.0).unwrap() {
            let to = head.translation - origin;
            let least = (1.0 - (config.safety.eyes.radius / to.length()).powi(2)).sqrt() * to.length();
            for (mirror, _) in rays.iter().enumerate().filter(|(_, ray)| ray.dot(to) >= least) {
                met += 1;
                assert!(
                    mask.is_cut(mirror),
                    "seed {seed}, frame {frame}: light at {mirror} on a head: {eyes:?}"
                );
                assert!(!is_lit(&planes, rig.camera.raster, mirror));
            }
        }
    }
    assert!(met > frames as u64, "{met} mirrors in {frames} frames: the heads are not in the beam");
    [dark as f64 / frames as f64, cut as f64 / ((frames as u64 - dark) * size).max(1) as f64]
}

#[test]
fn no_light_meets_a_head_that_moves_is_lost_or_exchanged() {
    let [dark, cut] = no_light_meets_a_head(20_000, 1);
    // The guard is not won by darkness.
    assert!(dark < 0.4 && cut < 0.6, "{dark} {cut}");
}

mod breadth {
    use super::*;

    #[test]
    fn a_million_frames_light_no_head() {
        for seed in 2..10 {
            let [dark, cut] = no_light_meets_a_head(125_000, seed);
            assert!(dark < 0.4 && cut < 0.6, "{seed}: {dark} {cut}");
        }
    }

    #[test]
    fn thousands_of_projectors_cut_as_the_oracle() {
        cut_as_the_oracle(3000, 1000);
    }
}
