//! Adjusts the ray budget to measured frame times, so that a frame stays inside its slot.
//!
//! The controller works in logarithms: x = ln(rays), e = ln(wanted time / measured time). Around the set point a slow
//! integral follows the load. The integral compares each measurement with the budget that the measured frame had, not
//! with the current budget, so frames in flight are not corrected twice (Smith's predictor with a pure delay). Beyond
//! the limit the budget falls at once by the whole excess. The budget falls fast because a late frame is visible. It
//! rises slowly because a slightly poorer frame is not visible, and because a loop whose gain may be wrong by 5 and
//! whose delay may be 3 frames must be slow to be free of oscillation.

/// The fewest rays of a frame, as a divisor of the most.
pub const FEWEST_OF_MOST: u64 = 8;

/// Settings of a [`BudgetController`]. Times are in nanoseconds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BudgetConfig {
    /// Length of a slot, > 0.
    pub slot_ns: i64,
    /// Share of the slot that the controller aims at, 0 to 1; the rest absorbs jitter.
    pub aim: f64,
    /// Share of the slot beyond which the budget falls at once; above `aim`.
    pub limit: f64,
    /// Fewest rays a frame gets, >= 1.
    pub min_rays: u64,
    /// Most rays a frame gets, >= `min_rays`.
    pub max_rays: u64,
    /// Rays of the first frame.
    pub initial_rays: u64,
}

/// Why a controller cannot be made.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum BudgetError {
    /// The slot has no length.
    #[error("the slot's length is {0} ns; it must be above 0")]
    Slot(i64),
    /// The shares are out of order.
    #[error("aim {aim} and limit {limit} must satisfy 0 < aim < limit <= 1")]
    Shares {
        /// Given.
        aim: f64,
        /// Given.
        limit: f64,
    },
    /// The ray counts are out of order.
    #[error("min_rays {min} and max_rays {max} must satisfy 1 <= min_rays <= max_rays")]
    Rays {
        /// Given.
        min: u64,
        /// Given.
        max: u64,
    },
}

/// Share of the error that the slow path corrects in each frame. A loop with a delay of d frames approaches without
/// overshoot while its gain stays below d^d / (d + 1)^(d + 1). A share of 0.02 on a plant that is five times too
/// steep stays below the 0.105 of d = 3.
const SLOW: f64 = 0.02;

/// The slow path limits the error to this (a factor of 20), so that an idle GPU does not make it jump.
const SLOW_CLAMP: f64 = 3.0;

/// Each fast step that was not enough makes the next one steeper by this factor, up to [`STEEPEST`], because most of
/// the time may go to work that does not depend on rays.
const STEEPEN: f64 = 1.6;
const STEEPEST: f64 = 6.0;

/// Keeps frames inside their slot by scaling the number of rays.
#[derive(Clone, Debug)]
pub struct BudgetController {
    config: BudgetConfig,
    ln_rays: f64,
    /// Excess of the last measurement (the negative of e); 0 when it was within the limit.
    last_excess: f64,
    steepness: f64,
    ignored: u64,
    cuts: u64,
}

impl BudgetController {
    /// Checks the settings.
    pub fn new(config: BudgetConfig) -> Result<Self, BudgetError> {
        if config.slot_ns <= 0 {
            return Err(BudgetError::Slot(config.slot_ns));
        }
        if !(config.aim > 0.0 && config.aim < config.limit && config.limit <= 1.0) {
            return Err(BudgetError::Shares { aim: config.aim, limit: config.limit });
        }
        if config.min_rays == 0 || config.min_rays > config.max_rays {
            return Err(BudgetError::Rays { min: config.min_rays, max: config.max_rays });
        }
        let initial = config.initial_rays.clamp(config.min_rays, config.max_rays);
        Ok(Self {
            config,
            ln_rays: (initial as f64).ln(),
            last_excess: 0.0,
            steepness: 1.0,
            ignored: 0,
            cuts: 0,
        })
    }

    /// Rays for the next frame, `min_rays` to `max_rays`.
    pub fn rays(&self) -> u64 {
        (self.ln_rays.exp().round() as u64).clamp(self.config.min_rays, self.config.max_rays)
    }

    /// From now on a frame gets at most `most` rays, and at least a share of them.
    pub fn within(&mut self, most: u64) {
        self.config.max_rays = most.max(1);
        self.config.min_rays = (most / FEWEST_OF_MOST).max(1);
        self.hold_bounds();
    }

    fn hold_bounds(&mut self) {
        let (low, high) = ((self.config.min_rays as f64).ln(), (self.config.max_rays as f64).ln());
        self.ln_rays = self.ln_rays.clamp(low, high);
    }

    /// Takes the time of a finished frame and the rays that it had. Measurements may be late and out of order.
    /// Impossible times (0, negative) and frames of 0 rays are ignored and counted.
    pub fn measured(&mut self, rays: u64, frame_ns: i64) {
        if rays == 0 || frame_ns <= 0 {
            self.ignored += 1;
            return;
        }
        let slot_ns = self.config.slot_ns as f64;
        let error = (self.config.aim * slot_ns / frame_ns as f64).ln();
        let ln_given = (rays as f64).ln();
        let excess = if frame_ns as f64 > self.config.limit * slot_ns { -error } else { 0.0 };
        // Takes the milder of two consecutive measurements, so that a single hiccup of the machine has no effect.
        let confirmed = excess.min(self.last_excess);
        self.last_excess = excess;
        if confirmed > 0.0 {
            let wanted = ln_given - confirmed * self.steepness;
            if wanted < self.ln_rays {
                // A frame was late although it already had no more rays than the current budget: the next step is
                // steeper.
                if ln_given <= self.ln_rays + 1e-3 && self.cuts > 0 {
                    self.steepness = (self.steepness * STEEPEN).min(STEEPEST);
                }
                self.ln_rays = wanted;
                self.cuts += 1;
            }
        } else if excess == 0.0 {
            self.steepness = 1.0;
            let foretold = error + ln_given - self.ln_rays;
            self.ln_rays += SLOW * foretold.clamp(-SLOW_CLAMP, SLOW_CLAMP);
        }
        self.hold_bounds();
    }

    /// True when the budget is at its minimum: if frames are still late, rays are not the reason.
    pub(crate) fn is_at_minimum(&self) -> bool {
        self.rays() == self.config.min_rays
    }

    /// True when frames get all rays that they may have.
    pub(crate) fn is_at_maximum(&self) -> bool {
        self.rays() == self.config.max_rays
    }

    /// Fewest rays of a frame.
    pub(crate) fn fewest(&self) -> u64 {
        self.config.min_rays
    }

    /// The number of impossible measurements, and the number of cuts.
    #[cfg(test)]
    pub(crate) fn counters(&self) -> (u64, u64) {
        (self.ignored, self.cuts)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::VecDeque;

    const SLOT: f64 = 1_055_966.0;

    fn config() -> BudgetConfig {
        BudgetConfig {
            slot_ns: SLOT as i64,
            aim: 0.8,
            limit: 0.92,
            min_rays: 10,
            max_rays: 100_000_000,
            initial_rays: 100_000,
        }
    }

    /// time = fixed + unit * (rays / 1e5)^gain, observed `delay` frames later.
    struct Plant {
        gain: f64,
        fixed: f64,
        unit: f64,
        flight: VecDeque<(u64, i64)>,
        delay: usize,
    }

    impl Plant {
        fn time(&self, rays: u64) -> f64 {
            self.fixed + self.unit * (rays as f64 / 1e5).powf(self.gain)
        }

        /// Simulates one frame; returns its time.
        fn frame(&mut self, controller: &mut BudgetController, jitter: f64) -> f64 {
            let rays = controller.rays();
            let time = self.time(rays) * jitter;
            self.flight.push_back((rays, time.min(1e18) as i64));
            if self.flight.len() > self.delay {
                let (rays, ns) = self.flight.pop_front().unwrap();
                controller.measured(rays, ns);
            }
            time
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(300))]

        /// For a plant whose gain is wrong by 5 either way, with delays of 1 to 3 frames and load jumps of up to 1e3
        /// either way, frames are late for a bounded number of frames, then never again, and then the budget is
        /// steady.
        #[test]
        fn holds_the_slot_without_oscillation(
            ln_gain in -1.6f64..1.6, delay in 1usize..=3, fixed in 0f64..0.4, jump in -6.9f64..6.9,
        ) {
            let gain = ln_gain.exp();
            let mut controller = BudgetController::new(config()).unwrap();
            // The first load fits at 1e5 rays. After the jump some budget inside the bounds still fits.
            let reach = gain * (10_000f64).ln() * 0.95;
            let jump = jump.clamp(-1e9, reach);
            let mut plant = Plant { gain, fixed: fixed * SLOT, unit: (0.8 - fixed) * SLOT, flight: VecDeque::new(), delay };
            for _ in 0..3000 {
                plant.frame(&mut controller, 1.0);
            }
            plant.unit *= jump.exp();
            let mut late = 0;
            let mut last_late = 0;
            for frame in 0..9000 {
                if plant.frame(&mut controller, 1.0) > SLOT {
                    late += 1;
                    last_late = frame;
                }
            }
            // The jump is observed after `delay`, confirmed one frame later, then corrected. A flat plant needs
            // several corrections.
            let answers = 1.0 + (1.0 / gain).max(1.0) * 4.0;
            prop_assert!(f64::from(late) <= answers * (delay as f64 + 2.0) + 2.0, "late for {late} frames");
            prop_assert!(last_late < 200, "late again at frame {last_late}");
            let (mut low, mut high) = (f64::INFINITY, 0f64);
            for _ in 0..500 {
                plant.frame(&mut controller, 1.0);
                let rays = controller.rays() as f64;
                (low, high) = (low.min(rays), high.max(rays));
            }
            prop_assert!(high / low < 1.02, "still moves by {}", high / low);
            let time = plant.time(controller.rays()) / SLOT;
            prop_assert!((0.7..=0.92).contains(&time) || controller.rays() == 100_000_000 || controller.is_at_minimum(),
                "settled at {time} of the slot");
        }

        /// With 5 % jitter and an occasional hiccup the budget stays within 10 % of its place, and few frames are
        /// late.
        #[test]
        fn hiccups_and_jitter_leave_it_alone(seed in 0u64..1000, delay in 1usize..=3) {
            let mut controller = BudgetController::new(config()).unwrap();
            let mut plant = Plant { gain: 1.0, fixed: 0.1 * SLOT, unit: 0.7 * SLOT, flight: VecDeque::new(), delay };
            let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
            for frame in 0..3000 {
                state ^= state << 13;
                state ^= state >> 7;
                state ^= state << 17;
                let noise = 1.0 + 0.05 * ((state >> 11) as f64 / (1u64 << 52) as f64 - 1.0);
                let hiccup = if frame % 50 == 49 { 100.0 } else { 1.0 };
                plant.frame(&mut controller, noise * hiccup);
                let rays = controller.rays() as f64;
                prop_assert!((0.9e5..1.15e5).contains(&rays), "{rays} rays at frame {frame}");
            }
        }

        /// Whatever is measured, the budget is a number within its bounds.
        #[test]
        fn any_measurement(m in prop::collection::vec((any::<u64>(), any::<i64>()), 0..200)) {
            let mut controller = BudgetController::new(config()).unwrap();
            for (rays, ns) in m {
                controller.measured(rays, ns);
                prop_assert!((10..=100_000_000).contains(&controller.rays()));
            }
        }
    }

    #[test]
    fn new_bounds_hold_at_once_and_leave_the_rest_to_the_times() {
        let mut controller = BudgetController::new(config()).unwrap();
        controller.within(4000);
        assert_eq!(controller.rays(), 4000);
        controller.measured(4000, 10 * SLOT as i64);
        controller.measured(4000, 10 * SLOT as i64);
        assert_eq!(controller.rays(), 500, "an eighth");
        controller.within(8000);
        assert_eq!(controller.rays(), 1000);
        controller.measured(1000, SLOT as i64 / 2);
        assert!((1001..1100).contains(&controller.rays()), "it rises slowly: {}", controller.rays());
    }

    #[test]
    fn impossible_times_are_ignored_and_counted() {
        let mut controller = BudgetController::new(config()).unwrap();
        let before = controller.rays();
        for (rays, ns) in [(0, 100), (5, 0), (5, -1), (5, i64::MIN)] {
            controller.measured(rays, ns);
        }
        assert_eq!((controller.rays(), controller.counters()), (before, (4, 0)));
        assert_eq!(
            BudgetController::new(BudgetConfig { slot_ns: 0, ..config() }).unwrap_err(),
            BudgetError::Slot(0)
        );
        assert!(BudgetController::new(BudgetConfig { aim: f64::NAN, ..config() }).is_err());
        assert!(BudgetController::new(BudgetConfig { min_rays: 0, ..config() }).is_err());
    }
}
