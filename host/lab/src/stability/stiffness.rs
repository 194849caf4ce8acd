//! What makes the stiff cases stiff, as one number each, and their error against that number.
//!
//! The number is a ratio of time scales, of lengths or of light, or a condition number: 1 is harmless. A case has one value of it.
//! Its curve says what comes before and after: whether the error grows with the number, and from where on the part gives up.

use super::{calibration, clocks, predictor, scattering, tracer};
use serde::Serialize;

/// Values of the number on a curve, evenly spaced by its logarithm.
const POINTS: i32 = 9;
/// Halvings of the ratio between a number that passes and one that fails, in search of the least that fails.
const HALVINGS: u32 = 24;

/// The stiffness of a case.
pub(crate) struct Stiffness {
    /// Name of the case.
    pub(crate) case: &'static str,
    /// What the number is.
    of: &'static str,
    /// Its value in the case.
    number: f64,
    /// The ends of the curve.
    over: [f64; 2],
    /// Error of the case for a number and a seed, in the case's unit; not finite where the part gives no answer.
    error: fn(f64, u64) -> f64,
}

/// All stiff cases that need no device.
pub(crate) const STIFF: &[Stiffness] = &[
    Stiffness {
        case: "tracer-scale-invariance",
        of: "size of the scene over a metre, or a metre over it",
        number: 1e6,
        over: [1.0, 1e9],
        error: tracer::scaled_by,
    },
    Stiffness {
        case: "tracer-far-from-origin",
        of: "distance from the origin over the size of the scene",
        number: 1.26e5,
        over: [1.0, 1e9],
        error: tracer::as_far_as,
    },
    Stiffness {
        case: "tracer-lamp-at-a-micrometre",
        of: "width of the lamp over its distance",
        number: 2e6,
        over: [2e2, 2e8],
        error: tracer::lamp_as_near_as,
    },
    Stiffness {
        case: "compensation-f32",
        of: "contrast of distance^2 / cos between the nearest and the farthest surface",
        number: 2.5e12,
        over: [1.0, 1e24],
        error: scattering::compensation_over,
    },
    Stiffness {
        case: "predictor-screw",
        of: "angle between two samples, rad: their interval over the time of a radian",
        number: 0.0754,
        over: [0.0025, 0.64],
        error: predictor::screw_of,
    },
    Stiffness {
        case: "predictor-covariance-extremes",
        of: "variance of the prior over that of a measurement",
        number: 1e48,
        over: [1.0, 1e96],
        error: predictor::covariance_of,
    },
    Stiffness {
        case: "predictor-a-day",
        of: "uptime over the interval of samples",
        number: 1.728e10,
        over: [1e3, 1e12],
        error: predictor::up_for,
    },
    Stiffness {
        case: "clock-400-days",
        of: "uptime over the interval of exchanges",
        number: 3.456e8,
        over: [1e2, 1e10],
        error: clocks::up_for,
    },
    Stiffness {
        case: "calibration-exact-data",
        of: "width of the points over their relief, to which the condition number of the equations is proportional",
        number: 1.0,
        over: [1.0, 1e8],
        error: calibration::flattened_by,
    },
    Stiffness {
        case: "distortion-round-trip",
        of: "condition number of the inverse: 1 over the slope of the lens",
        number: 1.46,
        over: [1.46, 1e8],
        error: calibration::bent_to,
    },
];

/// What a result says of a stiff case.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct StiffnessResult {
    /// What the number is.
    pub of: &'static str,
    /// Its value in the case.
    pub number: f64,
    /// Numbers with their errors; none where no curve was asked for. An error is absent where the part gave no answer.
    pub curve: Vec<(f64, Option<f64>)>,
    /// Of a case that failed: the least number with which it fails, by halving the ratio to one that passes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fails_from: Option<f64>,
}

impl Stiffness {
    /// That of a case; `None` if it is not stiff.
    pub(crate) fn of(case: &str) -> Option<&'static Self> {
        STIFF.iter().find(|stiff| stiff.case == case)
    }

    /// What is said of a case that ran with `seed`, and failed or not; with its curve if that is wanted.
    pub(crate) fn result(&self, seed: u64, failed: Option<f64>, with_curve: bool) -> StiffnessResult {
        let error = |number| Some((self.error)(number, seed)).filter(|e| e.is_finite());
        let [from, to] = self.over;
        let at = |i: i32| from * (to / from).powf(f64::from(i) / f64::from(POINTS - 1));
        StiffnessResult {
            of: self.of,
            number: self.number,
            curve: (0..POINTS).filter(|_| with_curve).map(|i| (at(i), error(at(i)))).collect(),
            fails_from: failed.and_then(|bound| {
                least_failing([from, self.number], |n| error(n).is_some_and(|e| e <= bound))
            }),
        }
    }
}

/// The least number between two ends that does not pass, where the lower end does and the upper does not: the case shrunk. The
/// lower end itself where that fails already, and `None` where the upper passes.
fn least_failing([from, to]: [f64; 2], passes: impl Fn(f64) -> bool) -> Option<f64> {
    if passes(to) {
        return None;
    }
    if !passes(from) {
        return Some(from);
    }
    let (mut good, mut bad) = (from, to);
    for _ in 0..HALVINGS {
        let middle = (good * bad).sqrt();
        *(if passes(middle) { &mut good } else { &mut bad }) = middle;
    }
    Some(bad)
}

#[cfg(test)]
mod tests {
    use super::super::cases;
    use super::*;

    /// Every stiff case is one, its number lies on its curve, and its error there is no more than what it is held to.
    #[test]
    fn a_case_is_its_curve_at_its_number() {
        let all = cases();
        for stiff in STIFF {
            let case = all.iter().find(|c| c.name == stiff.case).unwrap_or_else(|| panic!("{}", stiff.case));
            assert!(stiff.over[0] <= stiff.number && stiff.number <= stiff.over[1], "{}", stiff.case);
            let error = (stiff.error)(stiff.number, super::super::SEED);
            assert!(error <= case.bound, "{}: {error} at {}", stiff.case, stiff.number);
        }
    }

    /// A part that fails from a number on is shrunk to it.
    #[test]
    fn a_failing_case_shrinks_to_the_least_number_that_fails() {
        let found = least_failing([1.0, 1e12], |n| n < 3.7e5).unwrap();
        assert!((found / 3.7e5 - 1.0).abs() < 1e-5 && found >= 3.7e5, "{found}");
        assert_eq!(least_failing([1.0, 1e12], |_| true), None);
        assert_eq!(least_failing([2.0, 1e12], |_| false), Some(2.0));
        let fails = Stiffness {
            case: "x",
            of: "",
            number: 1e6,
            over: [1.0, 1e8],
            error: |n, _| if n < 1e4 { 0.5 } else { f64::NAN },
        };
        let told = fails.result(1, Some(1.0), true);
        assert!((told.fails_from.unwrap() / 1e4 - 1.0).abs() < 1e-4, "{told:?}");
        assert_eq!((told.curve.len(), told.curve[0], told.curve[8].1), (9, (1.0, Some(0.5)), None));
    }
}
