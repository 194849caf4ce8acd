//! Whether link and machine carry the frames that a measurement shows, and the rate at which they would.

use dpm_device::link::faults;
use dpm_device::time::FrameRate;
use dpm_rig::config::RigConfig;
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::projectors::SlotClock;
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
/// Light that went off by a fault that passes is awaited for so long; the run gives such a fault a rest of its own.
const RETURN_WITHIN: Duration = Duration::from_secs(15);
/// What was seen in so long a time before such a fault was noticed may be spoilt by it: no frame came before the watchdog
/// acted, and reports of light arrive later than the light.
pub const SPOILT: Duration = Duration::from_secs(1);
/// The light of a measurement may go off so many times.
pub const MOST_INTERRUPTIONS: u32 = 3;

/// What a measurement came to.
#[derive(Clone, Debug, PartialEq)]
pub enum PaceResult<T> {
    /// Its result.
    Done(T),
    /// The link carried only so many frames a second, so it was given up.
    TooFast {
        /// Frames a second.
        carried_hz: f64,
    },
}

impl<T> PaceResult<T> {
    /// Changes the result.
    ///
    /// # Errors
    /// That of `change`.
    pub fn and_then<U, E>(self, change: impl FnOnce(T) -> Result<U, E>) -> Result<PaceResult<U>, E> {
        match self {
            Self::Done(result) => change(result).map(PaceResult::Done),
            Self::TooFast { carried_hz } => Ok(PaceResult::TooFast { carried_hz }),
        }
    }
}

/// What a look at a run shows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum RunLook {
    /// Enough frames arrive.
    Enough,
    /// Only so many frames a second arrive.
    TooFew(f64),
    /// A fault that passes put it off, and it is there again. What was seen since [`SPOILT`] before that is to be repeated.
    Interrupted,
}

/// Counts the frames of a run while it goes on.
pub struct FrameCounter<'a> {
    monitor: &'a RunMonitor,
    rate: FrameRate,
    seen: VecDeque<(Instant, u64)>,
    interruptions: u32,
}

impl<'a> FrameCounter<'a> {
    /// Of the run of `config` that `monitor` watches, from now on.
    pub fn of(config: &RigConfig, monitor: &'a RunMonitor) -> Self {
        Self { monitor, rate: config.projector.frame_rate, seen: VecDeque::new(), interruptions: 0 }
    }

    /// Looks at the counters; call it some times a second. Waits for the light where it comes back by itself.
    ///
    /// # Errors
    /// The projector is dark and stays so, or goes dark again and again (exit code 3).
    pub fn look(&mut self) -> Result<RunLook, Failure> {
        let (now, lit) = (Instant::now(), self.monitor.counts().frames_lit);
        match self.monitor.projector() {
            ProjectorHealth::Up | ProjectorHealth::Stopped => {
                Ok(self.count(now, lit).map_or(RunLook::Enough, RunLook::TooFew))
            }
            // The link was lost and comes up again, with slots that begin elsewhere.
            ProjectorHealth::Connecting | ProjectorHealth::Lost => {
                Ok(RunLook::TooFew(self.carried_hz(now, lit)))
            }
            ProjectorHealth::Faulted(mask) if mask != 0 && mask & !faults::PASSING == 0 => {
                self.wait_for_return(mask)
            }
            health => Err(went_off(&health.to_string())),
        }
    }

    /// Waits until the light is back after the passing faults `mask`.
    fn wait_for_return(&mut self, mask: u32) -> Result<RunLook, Failure> {
        self.interruptions += 1;
        let why = faults::names(mask);
        if self.interruptions > MOST_INTERRUPTIONS {
            let told = format!(
                "{} times ({why}), and each time what it had spoilt was repeated: is the link fast enough? `dpm link-test` \
                 measures it; end other programs, or raise safety.watchdog_ms",
                self.interruptions
            );
            return Err(went_off(&told));
        }
        let begin = Instant::now();
        while self.monitor.projector() != ProjectorHealth::Up {
            if begin.elapsed() > RETURN_WITHIN || self.monitor.stop_requested() {
                return Err(went_off(&format!(
                    "{why}, and it did not come back: {}",
                    self.monitor.projector()
                )));
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        // The frames that are missing since are those of the fault.
        self.seen.clear();
        Ok(RunLook::Interrupted)
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
    /// As [`FrameCounter::look`].
    pub fn try_out(&mut self) -> Result<Option<f64>, Failure> {
        let mut begin = Instant::now();
        let mut last = None;
        while begin.elapsed() < LOOK_BACK + LOOK_BACK / 4 && !self.monitor.stop_requested() {
            std::thread::sleep(Duration::from_millis(50));
            last = match self.look()? {
                RunLook::Enough => None,
                RunLook::TooFew(carried_hz) => Some(carried_hz),
                RunLook::Interrupted => {
                    begin = Instant::now();
                    None
                }
            };
            if self.monitor.projector() != ProjectorHealth::Up {
                break;
            }
        }
        Ok(last)
    }
}

fn went_off(why: &str) -> Failure {
    Failure::new(FailureKind::Device, format!("the light went off: {why}"))
}

/// The rig at a rate that a link which carried `carried_hz` can keep.
///
/// # Errors
/// There is none (exit code 3).
pub fn slower(config: &RigConfig, carried_hz: f64) -> Result<RigConfig, Failure> {
    let hz = (ROOM * carried_hz) as u32;
    if config.projector.backend.kind().slots == SlotClock::Blanks {
        let told = format!(
            "only {carried_hz:.1} of {:.0} frames/s reached the display in time; end other programs, or take a mode with \
             fewer pixels or frames",
            config.projector.frame_rate.hz()
        );
        return Err(Failure::new(FailureKind::Device, told));
    }
    let rate = FrameRate::new(hz, 1).filter(|_| hz >= SLOWEST_HZ).ok_or_else(|| {
        let told = format!(
            "only {carried_hz:.1} of {:.0} frames/s reached the projector, and a measurement needs {:.0}: it is made at \
             {:.0} % of what arrives, with {SLOWEST_HZ} frames/s or more. Is the link fast enough? `dpm link-test` measures \
             it; end other programs, or take a smaller raster",
            config.projector.frame_rate.hz(),
            f64::from(SLOWEST_HZ) / ROOM,
            100.0 * ROOM
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
        let mut pace = FrameCounter { monitor: &monitor, rate, seen: VecDeque::new(), interruptions: 0 };
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
        config.projector.backend = dpm_rig::projectors::backend("display").unwrap();
        assert!(slower(&config, 30.0).unwrap_err().message.contains("mode"));
    }

    #[test]
    fn a_slower_rate_has_room_and_an_end() {
        let config = RigConfig::default();
        let slow = slower(&config, 100.0).unwrap();
        assert_eq!(slow.projector.frame_rate, FrameRate::new(80, 1).unwrap());
        assert_eq!(slow.projector.width, config.projector.width);
        for hz in [9.8, 0.0] {
            let told = slower(&config, hz).unwrap_err().message;
            assert!(told.contains("frames/s reached the projector"), "{told}");
            // Found in use, O9: "only 9.8 of 60 frames/s reached the projector, and a measurement needs 8".
            assert!(told.contains("and a measurement needs 10:"), "{told}");
        }
        assert_eq!(
            slower(&config, 10.0).unwrap().projector.frame_rate,
            FrameRate::new(SLOWEST_HZ, 1).unwrap()
        );
    }

    /// Found in use, O9: a sweep of half a minute was thrown away for one event of the watchdog, which passes by itself.
    #[test]
    fn light_that_comes_back_by_itself_is_awaited_and_other_darkness_is_not() {
        use ProjectorHealth::{Black, Faulted, Up};
        let (config, monitor) = (RigConfig::default(), RunMonitor::default());
        let mut pace = FrameCounter::of(&config, &monitor);
        for round in 0..=MOST_INTERRUPTIONS {
            monitor.set_projector(Up);
            assert_eq!(pace.look().unwrap(), RunLook::Enough);
            assert_eq!(pace.seen.len(), 1, "what was counted before the fault is forgotten");
            monitor.set_projector(Faulted(faults::WATCHDOG));
            let looked = std::thread::scope(|scope| {
                scope.spawn(|| {
                    std::thread::sleep(Duration::from_millis(60));
                    monitor.set_projector(Up);
                });
                pace.look()
            });
            match looked {
                Ok(light) => {
                    assert!(light == RunLook::Interrupted && round < MOST_INTERRUPTIONS, "{light:?}")
                }
                Err(told) => assert!(
                    round == MOST_INTERRUPTIONS && told.message.contains("4 times (watchdog)"),
                    "{round}: {told}"
                ),
            }
        }
        for health in [Black, Faulted(faults::WATCHDOG | faults::LAMP), Faulted(0)] {
            monitor.set_projector(health);
            let told = FrameCounter::of(&config, &monitor).look().unwrap_err();
            assert!(told.message.starts_with("the light went off: "), "{told}");
        }
        // Whoever stops the measurement does not wait for the light.
        monitor.set_projector(Faulted(faults::CHECKSUM_STORM));
        monitor.request_stop();
        assert!(FrameCounter::of(&config, &monitor)
            .look()
            .unwrap_err()
            .message
            .contains("did not come back"));
    }
}
