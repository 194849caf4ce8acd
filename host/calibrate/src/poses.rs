//! Poses of tracked bodies in the world while a calibration goes on, collected by a thread of their own.

use dpm_calibration::trajectory::TimedPose;
use dpm_common::clock::{Clock, MonotonicClock};
use dpm_common::so3::{so3_between, so3_exp};
use dpm_device::tracker::BodyKey;
use dpm_rig::config::RigConfig;
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::tracks::open_in_world;
use glam::{DAffine3, DQuat, DVec3};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

/// Time between two polls of the tracker, nanoseconds.
const POLL_EVERY_NS: i64 = 500_000;
/// Most poses that are kept: an hour of two bodies at 500 Hz.
const MOST: usize = 4_000_000;
/// How long the operator holds a point.
const HOLD: Duration = Duration::from_millis(700);
/// A tip that moves further than this while it is held, metres, is not held.
const HELD_M: f64 = 1.5e-3;
/// A body that moves further than this, metres, does not lie still.
const STILL_M: f64 = 5e-4;
/// A body that turns further than this, radians, does not lie still.
const STILL_RAD: f64 = 5e-3;
/// Fewest poses of a held point.
const FEWEST_HELD: usize = 20;

#[derive(Default)]
struct PoseStore {
    poses: Vec<Vec<TimedPose>>,
    status: String,
}

/// A tracker that is read until this is dropped.
pub struct Poses {
    names: Vec<String>,
    shared: Arc<Mutex<PoseStore>>,
    is_over: Arc<AtomicBool>,
    thread: Option<std::thread::JoinHandle<()>>,
}

impl Poses {
    /// Opens the tracker of `config` for the bodies `names`. Poses are in the rig's world; their times are the tracker's
    /// own, without `tracker.latency_us`. `clock` stamps them.
    ///
    /// # Errors
    /// The tracker is the one in this process, or it cannot be opened.
    pub fn start(config: &RigConfig, names: &[String], clock: MonotonicClock) -> Result<Self, Failure> {
        if config.tracker.is_mock() {
            return Err(Failure::new(
                FailureKind::BadInput,
                "tracker.kind = \"mock\" has no wand: set the tracker of your rig, or start `hil-mock serve sensor-wand` and \
                 set tracker.kind = \"natnet\"",
            ));
        }
        let of = |name: &String| {
            let declared = config.scene.bodies.iter().find(|b| b.name == *name);
            BodyKey { name: name.clone(), id: declared.and_then(|b| b.id) }
        };
        let keys: Vec<BodyKey> = names.iter().map(of).collect();
        let sleeping = clock.sleeping();
        let mut tracker = open_in_world(config, keys, Arc::new(move || sleeping.now()))?;
        let shared = PoseStore { poses: vec![Vec::new(); names.len()], status: String::new() };
        let (shared, is_over) = (Arc::new(Mutex::new(shared)), Arc::new(AtomicBool::new(false)));
        let (to, over) = (Arc::clone(&shared), Arc::clone(&is_over));
        let work = move || {
            let mut fresh = Vec::new();
            while !over.load(Ordering::Relaxed) {
                let now = sleeping.now();
                let result = tracker.poll(now, &mut |sample| {
                    let pose = TimedPose::new(sample.captured_at.0, &sample.pose).filter(|_| sample.tracked);
                    fresh.extend(pose.map(|p| (usize::from(sample.body.0), p)));
                });
                let mut shared = to.lock().unwrap_or_else(PoisonError::into_inner);
                for (body, pose) in fresh.drain(..) {
                    if let Some(list) = shared.poses.get_mut(body).filter(|list| list.len() < MOST) {
                        list.push(pose);
                    }
                }
                shared.status = match result {
                    Ok(_) => tracker.status(),
                    Err(e) => e.to_string(),
                };
                drop(shared);
                sleeping.wait_until(now.plus_ns(POLL_EVERY_NS));
            }
        };
        let thread = std::thread::Builder::new()
            .name("dpm-poses".into())
            .spawn(work)
            .map_err(|e| Failure::new(FailureKind::Device, format!("cannot start a thread: {e}")))?;
        Ok(Self { names: names.to_vec(), shared, is_over, thread: Some(thread) })
    }

    fn locked(&self) -> std::sync::MutexGuard<'_, PoseStore> {
        self.shared.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes what has been collected of each body, in the order of the names.
    pub fn take(&self) -> Vec<Vec<TimedPose>> {
        let count = self.names.len();
        std::mem::replace(&mut self.locked().poses, vec![Vec::new(); count])
    }

    /// Waits until every body was seen.
    ///
    /// # Errors
    /// One was not, within five seconds; the message has the tracker's own words.
    pub fn wait_until_seen(&self) -> Result<(), Failure> {
        for _ in 0..250 {
            if self.locked().poses.iter().all(|list| !list.is_empty()) {
                return Ok(());
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        let shared = self.locked();
        let unseen = self.names.iter().zip(&shared.poses).find(|(_, list)| list.is_empty());
        let name = unseen.map_or("", |(name, _)| name);
        Err(Failure::new(
            FailureKind::Device,
            format!(
                "the tracker has not reported the body \"{name}\" within 5 s; is it streamed under this name? {}",
                shared.status
            ),
        ))
    }

    /// Collects poses of a moment in which nothing should move.
    pub fn hold(&self) -> Vec<Vec<TimedPose>> {
        self.take();
        std::thread::sleep(HOLD);
        self.take()
    }
}

impl Drop for Poses {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Where a body was while it lay still: the mean over the poses.
///
/// # Errors
/// Too few poses, or a body that moved; one sentence for the operator.
pub fn still(name: &str, poses: &[TimedPose]) -> Result<DAffine3, String> {
    if poses.len() < FEWEST_HELD {
        return Err(format!(
            "the tracker reported \"{name}\" only {} times in {} ms; is it in view?",
            poses.len(),
            HOLD.as_millis()
        ));
    }
    let mean = |part: &[TimedPose]| {
        let n = part.len().max(1) as f64;
        let first = part.first().map_or(DQuat::IDENTITY, |p| p.rotation);
        // Turns of a body that lies still are small, so their mean is that of their rotation vectors.
        let turn = part.iter().map(|p| so3_between(first, p.rotation)).sum::<DVec3>() / n;
        (part.iter().map(|p| p.position).sum::<DVec3>() / n, so3_exp(turn) * first)
    };
    let (first, second) = poses.split_at(poses.len() / 2);
    let (first, second) = (mean(first), mean(second));
    let (moved, turned) = ((first.0 - second.0).length(), so3_between(first.1, second.1).length());
    if moved > STILL_M || turned > STILL_RAD {
        return Err(format!(
            "\"{name}\" moved by {:.1} mm and {:.2} degrees; hold it still and try again",
            1e3 * moved,
            turned.to_degrees()
        ));
    }
    let (position, rotation) = mean(poses);
    Ok(DAffine3::from_rotation_translation(rotation, position))
}

/// Where a tip was while it was held: the mean over the poses.
///
/// # Errors
/// Too few poses, or a tip that moved; one sentence for the operator.
pub fn held(tip: DVec3, poses: &[TimedPose]) -> Result<DVec3, String> {
    if poses.len() < FEWEST_HELD {
        return Err(format!(
            "the tracker reported the wand only {} times in {} ms; is it in view?",
            poses.len(),
            HOLD.as_millis()
        ));
    }
    let mean =
        |part: &[TimedPose]| part.iter().map(|p| p.place(tip)).sum::<DVec3>() / part.len().max(1) as f64;
    let (first, second) = poses.split_at(poses.len() / 2);
    let moved = (mean(first) - mean(second)).length();
    if moved > HELD_M {
        return Err(format!("the tip moved by {:.1} mm; hold it still and try again", 1e3 * moved));
    }
    Ok(mean(poses))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(position: DVec3) -> TimedPose {
        TimedPose { stamp_ns: 0, position, rotation: DQuat::from_rotation_z(std::f64::consts::FRAC_PI_2) }
    }

    #[test]
    fn a_held_tip_is_the_mean_and_a_moving_one_is_refused() {
        let tip = DVec3::new(0.1, 0.0, 0.0);
        let still: Vec<TimedPose> = (0..100).map(|i| at(DVec3::X * 1e-4 * f64::from(i % 3 - 1))).collect();
        let place = held(tip, &still).unwrap();
        assert!((place - DVec3::new(0.0, 0.1, 0.0)).length() < 1e-5, "{place}");
        let moving: Vec<TimedPose> = (0..100).map(|i| at(DVec3::X * 1e-4 * f64::from(i))).collect();
        assert!(held(tip, &moving).unwrap_err().contains("moved by 5.0 mm"));
        assert!(super::still("box", &moving).unwrap_err().contains("\"box\" moved by 5.0 mm"));
        assert!(super::still("box", &still[..5]).unwrap_err().contains("only 5 times"));
        let lies = super::still("box", &still).unwrap();
        assert!((lies.transform_point3(tip) - place).length() < 1e-12);
        assert!(held(tip, &still[..5]).unwrap_err().contains("only 5 times"));
    }
}
