//! Whether link and machine carry the frames that a measurement shows, and the rate at which they would.

use dpm_device::time::FrameRate;
use dpm_rig::config::{ProjectorBackend, RigConfig};
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::telemetry::monitor::{ProjectorHealth, RunMonitor};
use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// Time over which frames are counted.
const LOOK_BACK: Duration = Duration::from_secs(2);
/// Less than this share of the slots with a frame of their own is too little. The others repeat the picture before, which
/// is known and does no harm until pictures stay so long that their light ends.
const LEAST_SHARE: f64 = 0.3;
/// The next rate is this share of what was carried, so that there is room.
const ROOM: f64 = 0.8;
/// Frames a second below which no measurement makes sense.
const SLOWEST_HZ: u32 = 8;

/// What a measurement came to.
#[derive(Clone, Debug, PartialEq)]
pub enum Paced<T> {
    /// Its result.
    Done(T),
    /// The link carried only so many frames a second, so it was given up.
    TooFast {
        /// Frames a second.
        carried_hz: f64,
    },
}

impl<T> Paced<T> {
    /// Changes the result.
    ///
    /// # Errors
    /// That of `change`.
    pub fn and_then<U, E>(self, change: impl FnOnce(T) -> Result<U, E>) -> Result<Paced<U>, E> {
        match self {
            Self::Done(result) => change(result).map(Paced::Done),
            Self::TooFast { carried_hz } => Ok(Paced::TooFast { carried_hz }),
        }
    }
}

/// Counts the frames of a run while it goes on.
pub struct Pace<'a> {
    monitor: &'a RunMonitor,
    rate: FrameRate,
    seen: VecDeque<(Instant, u64)>,
}

impl<'a> Pace<'a> {
    /// Of the run of `config` that `monitor` watches, from now on.
    pub fn of(config: &RigConfig, monitor: &'a RunMonitor) -> Self {
        Self { monitor, rate: config.projector.frame_rate, seen: VecDeque::new() }
    }

    /// Looks at the counters; call it some times a second. Frames a second, if those of the last two seconds are too few.
    ///
    /// # Errors
    /// The projector is dark for another reason than its frames (exit code 3).
    pub fn look(&mut self) -> Result<Option<f64>, Failure> {
        let (now, lit) = (Instant::now(), self.monitor.counts().frames_lit);
        match self.monitor.projector() {
            ProjectorHealth::Up | ProjectorHealth::Stopped => Ok(self.count(now, lit)),
            // The link was lost and comes up again, with slots that begin elsewhere.
            ProjectorHealth::Connecting | ProjectorHealth::Lost => Ok(Some(self.carried_hz(now, lit))),
            health => {
                let told = format!("the light went off: the projector is {health}");
                Err(Failure::new(FailureKind::Device, told))
            }
        }
    }

    /// Frames a second since the oldest look that is remembered.
    fn carried_hz(&self, now: Instant, lit: u64) -> f64 {
        self.seen.front().map_or(0.0, |(begin, before)| {
            lit.saturating_sub(*before) as f64 / now.duration_since(*begin).as_secs_f64().max(1e-3)
        })
    }

    fn count(&mut self, now: Instant, lit: u64) -> Option<f64> {
        self.seen.push_back((now, lit));
        let begin = self.seen.front().map_or(now, |(begin, _)| *begin);
        if now.duration_since(begin) < LOOK_BACK {
            return None;
        }
        let carried_hz = self.carried_hz(now, lit);
        self.seen.pop_front();
        (carried_hz < LEAST_SHARE * self.rate.hz()).then_some(carried_hz)
    }

    /// Watches the first seconds of light. Frames a second, if they are too few.
    ///
    /// # Errors
    /// As [`Pace::look`].
    pub fn try_out(&mut self) -> Result<Option<f64>, Failure> {
        let begin = Instant::now();
        let mut last = None;
        while begin.elapsed() < LOOK_BACK + LOOK_BACK / 4 && !self.monitor.stop_requested() {
            std::thread::sleep(Duration::from_millis(50));
            last = self.look()?;
            if self.monitor.projector() != ProjectorHealth::Up {
                break;
            }
        }
        Ok(last)
    }
}

/// The rig at a rate that a link which carried `carried_hz` can keep.
///
/// # Errors
/// There is none (exit code 3).
pub fn slower(config: &RigConfig, carried_hz: f64) -> Result<RigConfig, Failure> {
    let hz = (ROOM * carried_hz) as u32;
    if let ProjectorBackend::Display(_) | ProjectorBackend::Window(_) = config.projector.backend {
        let told = format!(
            "only {carried_hz:.1} of {:.0} frames/s reached the display in time; end other programs, or take a mode with \
             fewer pixels or frames",
            config.projector.frame_rate.hz()
        );
        return Err(Failure::new(FailureKind::Device, told));
    }
    let rate = FrameRate::new(hz, 1).filter(|_| hz >= SLOWEST_HZ).ok_or_else(|| {
        let told = format!(
            "only {carried_hz:.1} of {:.0} frames/s reached the projector, and a measurement needs {SLOWEST_HZ}: is the \
             link fast enough? `dpm link-test` measures it; end other programs, or take a smaller raster",
            config.projector.frame_rate.hz()
        );
        Failure::new(FailureKind::Device, told)
    })?;
    let mut config = config.clone();
    config.projector.frame_rate = rate;
    Ok(config)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn too_few_frames_are_seen_within_two_seconds_and_not_before() {
        let monitor = RunMonitor::default();
        let rate = FrameRate::new(60, 1).unwrap();
        let begin = Instant::now();
        let mut pace = Pace { monitor: &monitor, rate, seen: VecDeque::new() };
        let mut at = |ms: u64, lit: u64| pace.count(begin + Duration::from_millis(ms), lit);
        let hz = 30.0;
        for ms in (0..=3000).step_by(50) {
            assert_eq!(at(ms, (hz * ms as f64 * 1e-3) as u64), None, "half are enough");
        }
        // The light stops: the last two seconds had some until two more have passed.
        assert_eq!(at(3050, 90), None);
        let few = (3100..5000).step_by(50).find_map(|ms| at(ms, 90)).unwrap();
        assert!((10.0..18.0).contains(&few), "{few}");
        assert_eq!((5000..8000).step_by(50).filter_map(|ms| at(ms, 90)).last(), Some(0.0));
    }

    #[test]
    fn a_display_keeps_the_rate_of_its_mode() {
        let mut config = RigConfig::default();
        config.projector.backend = ProjectorBackend::Display(Default::default());
        assert!(slower(&config, 30.0).unwrap_err().message.contains("mode"));
    }

    #[test]
    fn a_slower_rate_has_room_and_an_end() {
        let config = RigConfig::default();
        let slow = slower(&config, 100.0).unwrap();
        assert_eq!(slow.projector.frame_rate, FrameRate::new(80, 1).unwrap());
        assert_eq!(slow.projector.width, config.projector.width);
        for hz in [9.0, 0.0] {
            let told = slower(&config, hz).unwrap_err().message;
            assert!(told.contains("frames/s reached the projector"), "{told}");
        }
    }
}
