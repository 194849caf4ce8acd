//! `dpm calibrate camera --places`: bodies are carried through what several cameras see, and the place of each beside the first
//! comes out.

use dpm_calibration::beside::{place_beside, places_of, CameraPlace, SharedView};
use dpm_common::so3::so3_between;
use dpm_device::pose::{Pose, PoseCovariance};
use dpm_device::time::HostClock;
use dpm_device::tracker::TrackerSample;
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::trackers::DeviceTracker;
use glam::{DQuat, DVec3};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// What is looked for.
pub struct PlaceTask {
    /// The clock on which samples are stamped.
    pub clock: Arc<dyn HostClock>,
    /// Places at which a body was seen by two cameras that are enough.
    pub places: usize,
    /// Longest time.
    pub time: Duration,
}

/// The place of one of the further cameras.
pub struct OtherCamera {
    /// Its device.
    pub device: String,
    /// Where it stands.
    pub place: CameraPlace,
}

/// Two samples of the first camera between which one of another lies are no farther apart, ns.
const LONGEST_GAP_NS: i64 = 150_000_000;
/// What the way between them may be off in the middle, as a share of it: a hand curves.
const CURVE: f64 = 0.05;
/// Bodies that move and turn faster are not used: an error of the stamps would be one of the place. m/s and rad/s.
const FASTEST: [f64; 2] = [0.3, 1.0];
const POLL_EVERY: Duration = Duration::from_millis(5);
/// How often the operator reads how far it is.
const TELL_EVERY: Duration = Duration::from_secs(5);

/// Samples of one camera that wait for those of another one.
#[derive(Default)]
struct SampleQueues {
    first: Vec<TrackerSample>,
    others: Vec<Vec<TrackerSample>>,
}

/// Looks until there are enough places of each camera or the time is over, and solves. `cameras`: each as a tracker of its own,
/// the first one first. `say`: what the operator reads.
///
/// # Errors
/// A camera fails (exit code 3), or what they see together makes no place (2).
pub fn measure(
    cameras: &mut [DeviceTracker],
    task: &PlaceTask,
    say: &mut dyn FnMut(&str),
) -> Result<Vec<OtherCamera>, Failure> {
    say(
        "Carry a body with tags slowly through all that two cameras see, near and far, and turn it; or put it down at one place \
         after another.",
    );
    let others = cameras.len().saturating_sub(1);
    let mut waiting = SampleQueues { others: vec![Vec::new(); others], ..SampleQueues::default() };
    let mut views: Vec<Vec<SharedView>> = vec![Vec::new(); others];
    let (begin, mut said) = (Instant::now(), Instant::now());
    while begin.elapsed() < task.time && views.iter().any(|views| places_of(views) < task.places) {
        std::thread::sleep(POLL_EVERY);
        let now = task.clock.now();
        for (k, (device, tracker)) in cameras.iter_mut().enumerate() {
            let kept = if k == 0 { &mut waiting.first } else { &mut waiting.others[k - 1] };
            let polled = tracker.poll(now, &mut |sample| {
                if sample.tracked && sample.covariance.is_some() {
                    kept.push(*sample);
                }
            });
            polled.map_err(|e| Failure::new(FailureKind::Device, format!("{device}: {e}")))?;
        }
        for (waiting_of, views) in waiting.others.iter_mut().zip(&mut views) {
            views.extend(paired(&waiting.first, waiting_of));
        }
        let old = now.plus_ns(-10 * LONGEST_GAP_NS);
        waiting.first.retain(|sample| sample.captured_at > old);
        waiting.others.iter_mut().for_each(|others| others.retain(|sample| sample.captured_at > old));
        if said.elapsed() > TELL_EVERY {
            said = Instant::now();
            let counts: Vec<String> = views.iter().map(|views| places_of(views).to_string()).collect();
            say(&format!("{} of {} places", counts.join(" and "), task.places));
        }
    }
    let found = cameras[1..].iter().zip(&views).map(|((device, tracker), views)| {
        let place = place_beside(views).map_err(|e| {
            let told = format!("{device}: {e} ({})", tracker.status());
            Failure::new(FailureKind::BadInput, told)
        })?;
        Ok(OtherCamera { device: device.clone(), place })
    });
    found.collect()
}

/// Pairs of which both sides are there; they are taken out of `others`.
fn paired(first: &[TrackerSample], others: &mut Vec<TrackerSample>) -> Vec<SharedView> {
    let mut views = Vec::new();
    others.retain(|other| {
        let of = || first.iter().filter(|sample| sample.body == other.body);
        let after = of().filter(|s| s.captured_at >= other.captured_at).min_by_key(|s| s.captured_at);
        let before = of().filter(|s| s.captured_at <= other.captured_at).max_by_key(|s| s.captured_at);
        let Some(after) = after else { return true };
        views.extend(before.and_then(|before| view(before, after, other)));
        false
    });
    views
}

/// A body at the instant of `other`, between two samples of the first camera; `None` if that is no safe guess.
fn view(before: &TrackerSample, after: &TrackerSample, other: &TrackerSample) -> Option<SharedView> {
    let gap_ns = after.captured_at.ns_since(before.captured_at);
    if gap_ns > LONGEST_GAP_NS {
        return None;
    }
    let w =
        if gap_ns > 0 { other.captured_at.ns_since(before.captured_at) as f64 / gap_ns as f64 } else { 0.0 };
    let [from, to] = [before, after].map(|s| DVec3::from_array(s.pose.position_m));
    let [turn_from, turn_to] = [before, after].map(|s| DQuat::from_array(s.pose.rotation_xyzw));
    let (step, turned) = ((to - from).length(), so3_between(turn_from, turn_to).length());
    let seconds = gap_ns as f64 * 1e-9;
    if step > FASTEST[0] * seconds + 0.005 || turned > FASTEST[1] * seconds + 0.05 {
        return None;
    }
    let [a, b] = [before.covariance?.matrix(), after.covariance?.matrix()];
    let curve = 4.0 * w * (1.0 - w) * CURVE;
    let more = [(curve * step).powi(2), (curve * turned).powi(2)];
    let covariance = std::array::from_fn(|i| {
        std::array::from_fn(|j| {
            // Of both: the noise of a mean is less, what they have in common is not.
            let mean = a[i][j] * (1.0 - w) + b[i][j] * w;
            mean + if i == j { more[i / 3] } else { 0.0 }
        })
    });
    let pose = Pose {
        position_m: from.lerp(to, w).to_array(),
        rotation_xyzw: turn_from.slerp(turn_to, w).normalize().to_array(),
    };
    Some(SharedView {
        body: other.body.0,
        poses: [pose, other.pose],
        covariances: [PoseCovariance::of(&covariance), other.covariance?],
    })
}

/// What the operator is told of a place, and the keys for the rig file.
pub fn told_of(beside: &OtherCamera) -> String {
    let CameraPlace { first_from_other, sigma_m, sigma_rad, places, misfit } = &beside.place;
    let [x, y, z] = first_from_other.translation.to_array();
    let [a, b, c, d] = DQuat::from_mat3(&first_from_other.matrix3).normalize().to_array();
    format!(
        "{}: from {places} places, to {:.2} mm in the middle of what was seen and {:.3} degrees (one standard deviation); poses \
         differ by {misfit:.2} of what they say\ndevice = {:?}\nposition = [{x:.5}, {y:.5}, {z:.5}]\nrotation = [{a:.7}, {b:.7}, \
         {c:.7}, {d:.7}]",
        beside.device,
        1e3 * sigma_m,
        sigma_rad.to_degrees(),
        beside.device,
    )
}

#[cfg(test)]
mod tests;
