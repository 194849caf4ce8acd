//! Picture times: how the planes of a frame share its time on a panel that shows a sequence at one picture time.

use dpm_device::planes::PlaneSchedule;
use dpm_device::time::FrameRate;

/// How long the planes of a frame are lit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Weights {
    /// All equally long: one sequence holds the frame. Levels come from a light source that is dimmed from plane to plane, or from planes
    /// that are halftones.
    Equal,
    /// By their bits: a plane of bit `b` is lit `2^b` times as long as one of bit 0. A sequence has one picture time, so every plane is a
    /// sequence of its own. The light source stays constant.
    Binary,
}

/// Part of a frame's time that is left free, so that a panel whose clock is slower than the host's is not outrun: 2 of 10,000.
const SPARE: f64 = 2e-4;

/// One sequence of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct SequencePart {
    /// Number of its first plane in the frame.
    pub(super) first: usize,
    /// Its planes.
    pub(super) planes: usize,
    /// Microseconds of each picture.
    pub(super) picture_us: i32,
}

/// The sequences of a frame, and the picture time of the dark picture behind them.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct FrameTiming {
    pub(super) parts: Vec<SequencePart>,
    pub(super) dark_us: i32,
}

/// Why a frame does not fit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Misfit {
    /// The shortest plane has so many microseconds; at most so many frames a second fit.
    TooFast { left_us: f64, most_hz: f64 },
    /// The longest plane would take so many microseconds.
    TooSlow { asked_us: i64 },
}

impl FrameTiming {
    /// The times of the frames of `schedule` at `rate` on a panel with these limits. Behind each frame there is a dark picture.
    pub(super) fn new(
        schedule: &PlaneSchedule,
        weights: Weights,
        rate: FrameRate,
        shortest_us: i32,
        longest_us: i32,
    ) -> Result<Self, Misfit> {
        let frame_us = 1e6 / rate.hz() * (1.0 - SPARE);
        let n = schedule.len();
        let (units, dark_us) = match weights {
            // The dark picture belongs to the sequence and is as long as the others.
            Weights::Equal => (n as f64 + 1.0, 0.0),
            Weights::Binary => {
                (schedule.planes().iter().map(|p| f64::from(1u32 << p.bit)).sum(), shortest_us.into())
            }
        };
        let smallest = match weights {
            Weights::Equal => 1,
            Weights::Binary => schedule.planes().iter().map(|p| 1 << p.bit).min().unwrap_or(1),
        };
        let unit_us = ((frame_us - dark_us) / units).floor();
        if unit_us * f64::from(smallest) < f64::from(shortest_us) {
            let unit = (f64::from(shortest_us) / f64::from(smallest)).ceil();
            let most_hz = 1e6 * (1.0 - SPARE) / (unit * units + dark_us);
            // Picture times are whole microseconds.
            let left_us = (unit_us * f64::from(smallest)).max(0.0);
            return Err(Misfit::TooFast { left_us, most_hz });
        }
        let of = |bit: u8| unit_us as i64 * if weights == Weights::Binary { 1 << bit } else { 1 };
        let asked_us = schedule.planes().iter().map(|p| of(p.bit)).max().unwrap_or(0);
        if asked_us > i64::from(longest_us) {
            return Err(Misfit::TooSlow { asked_us });
        }
        Ok(match weights {
            Weights::Equal => {
                let picture_us = unit_us as i32;
                Self { parts: vec![SequencePart { first: 0, planes: n, picture_us }], dark_us: picture_us }
            }
            Weights::Binary => {
                let part =
                    |(first, bit): (usize, u8)| SequencePart { first, planes: 1, picture_us: of(bit) as i32 };
                let parts = schedule.planes().iter().map(|p| p.bit).enumerate().map(part).collect();
                Self { parts, dark_us: shortest_us }
            }
        })
    }

    /// Time of a whole frame with its dark picture, microseconds.
    pub(super) fn frame_us(&self) -> i64 {
        let light: i64 = self.parts.iter().map(|p| p.planes as i64 * i64::from(p.picture_us)).sum();
        light + i64::from(self.dark_us)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn schedules() -> [PlaneSchedule; 3] {
        [PlaneSchedule::rgb24(), PlaneSchedule::mono8(), PlaneSchedule::equal24()]
    }

    proptest! {
        /// Whatever is accepted fits into the frame's time with the spare, keeps to the limits, and has the weights that were asked for;
        /// whatever is refused as too fast fits at the rate that the refusal names.
        #[test]
        fn frames_fit_their_time(hz in 1u32..5000, shortest in 10i32..200, which in 0usize..3, binary: bool) {
            let (schedule, rate) = (schedules()[which], FrameRate::new(hz, 1).unwrap());
            let weights = if binary { Weights::Binary } else { Weights::Equal };
            match FrameTiming::new(&schedule, weights, rate, shortest, 1_000_000) {
                Ok(timing) => {
                    prop_assert!(timing.frame_us() as f64 <= 1e6 / f64::from(hz) * (1.0 - SPARE));
                    let planes: usize = timing.parts.iter().map(|p| p.planes).sum();
                    prop_assert_eq!(planes, schedule.len());
                    for part in &timing.parts {
                        prop_assert!(part.picture_us >= shortest);
                        let bit = schedule.planes()[part.first].bit;
                        let unit = timing.parts[0].picture_us >> schedule.planes()[0].bit;
                        prop_assert!(!binary || part.picture_us == unit << bit);
                    }
                }
                Err(Misfit::TooFast { left_us, most_hz }) => {
                    prop_assert!(left_us < f64::from(shortest) + 1.0 && most_hz < f64::from(hz) + 0.01);
                    let fits = FrameRate::new((most_hz * 1000.0).floor() as u32, 1000).unwrap();
                    prop_assert!(FrameTiming::new(&schedule, weights, fits, shortest, 1_000_000).is_ok());
                }
                Err(Misfit::TooSlow { .. }) => prop_assert!(hz < 2),
            }
        }
    }

    /// A panel that shows a plane for 44 us at least, by hand: (24 + 1) * 44 us = 1.1 ms; 255 * 44 us + 44 us = 11.264 ms.
    #[test]
    fn the_limits_of_a_v7001() {
        let most = |schedule: PlaneSchedule, weights| {
            let rate = FrameRate::new(100_000, 1).unwrap();
            match FrameTiming::new(&schedule, weights, rate, 44, 1_000_000) {
                Err(Misfit::TooFast { most_hz, .. }) => most_hz,
                other => panic!("{other:?}"),
            }
        };
        assert!((most(PlaneSchedule::rgb24(), Weights::Equal) - 908.9).abs() < 0.1);
        assert!((most(PlaneSchedule::mono8(), Weights::Binary) - 88.76).abs() < 0.01);
        let slow = FrameTiming::new(
            &PlaneSchedule::mono8(),
            Weights::Equal,
            FrameRate::new(1, 1).unwrap(),
            44,
            100_000,
        );
        assert_eq!(slow, Err(Misfit::TooSlow { asked_us: 111_088 }));
    }
}
