//! Finds keys of `[prediction]` that the motion of a body contradicts, for a note to the operator.
//!
//! The filters learn what the keys are wrong by. But every track begins with them again, and what a filter learns ends
//! at sixteen times the key and at a sixteenth.

use std::sync::atomic::{AtomicI32, Ordering};

/// Steps between key and motion from which the key is wrong; each is a factor of two.
const FAR: i32 = 3;
/// What the key must cost: forecasts 4 ms ahead err by so much more with it, m and rad. Where samples have hardly any noise
/// the sharpest filter is always the best, by next to nothing.
const COSTS: [f64; 2] = [1e-4, 5e-4];
/// For so many looks at a moving body in a row: five seconds of motion.
const LOOKS: u32 = 100;
/// A body that is slower than this rests, m/s and rad/s. Rest contradicts nothing.
const RESTS: [f64; 2] = [0.1, 0.3];

/// Counts the looks at one body, for its position and its rotation.
#[derive(Clone, Debug, Default)]
pub(super) struct KeyWatch([Option<KeyStreak>; 2]);

/// Looks in a row at which a key was wrong in the same direction.
#[derive(Clone, Copy, Debug)]
struct KeyStreak {
    sign: i32,
    looks: u32,
}

impl KeyWatch {
    /// Looks once, at the learned levels, what the keys cost (m, rad), and speeds (m/s, rad/s). Stores into `contradicted` by what level a key is wrong,
    /// once.
    pub(super) fn look(
        &mut self,
        (levels, excess): ([i32; 2], [f64; 2]),
        speeds: [f64; 2],
        contradicted: &[AtomicI32; 2],
    ) {
        for (k, run) in self.0.iter_mut().enumerate() {
            if speeds[k] < RESTS[k] {
                continue;
            }
            let sign = if levels[k].abs() < FAR || excess[k] < COSTS[k] { 0 } else { levels[k].signum() };
            let looks = run.filter(|run| run.sign == sign).map_or(0, |run| run.looks).saturating_add(1);
            *run = Some(KeyStreak { sign, looks });
            if sign != 0 && looks == LOOKS {
                contradicted[k].store(levels[k], Ordering::Relaxed);
            }
        }
    }
}

/// The note on a body whose motion is `level` steps from a key. `key`: its name, value and unit.
pub(crate) fn told(body: &str, level: i32, (key, value, unit): (&str, f64, &str)) -> String {
    let moves = value * f64::from(level).exp2();
    format!(
        "{body:?} moves as with {moves:.3} {unit}, and {key} is {value} {unit}: the filters have learned it, but every track \
         begins with the key's value; set it nearer"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn after(excess: f64, looks: impl Iterator<Item = (i32, f64)>) -> i32 {
        let (mut watch, contradicted) = (KeyWatch::default(), [AtomicI32::new(0), AtomicI32::new(0)]);
        looks.for_each(|(level, speed)| watch.look(([level, 0], [excess; 2]), [speed, 9.0], &contradicted));
        assert_eq!(contradicted[1].load(Ordering::Relaxed), 0);
        contradicted[0].load(Ordering::Relaxed)
    }

    #[test]
    fn what_moves_otherwise_for_seconds_contradicts_the_key_and_rest_does_not() {
        let n = LOOKS as usize;
        assert_eq!(after(1e-3, std::iter::repeat_n((3, 1.0), n)), 3);
        assert_eq!(after(1e-3, std::iter::repeat_n((-4, 1.0), n)), -4);
        assert_eq!(after(1e-3, std::iter::repeat_n((2, 1.0), 9 * n)), 0, "four times is learned soon");
        assert_eq!(after(1e-3, std::iter::repeat_n((-4, 0.01), 9 * n)), 0, "it rests");
        assert_eq!(after(1e-5, std::iter::repeat_n((4, 1.0), 9 * n)), 0, "the key costs nothing");
        assert_eq!(
            after(1e-3, (0..9 * n).map(|k| (if k % 90 == 0 { 0 } else { 3 }, 1.0))),
            0,
            "now and then"
        );
        let told = told("cup", 3, ("prediction.acceleration", 5.0, "m/s^2"));
        assert!(told.contains("40.000 m/s^2") && told.contains("prediction.acceleration is 5"), "{told}");
    }
}
