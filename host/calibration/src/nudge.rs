//! Small motions by hand, each of which can be taken back.

use dpm_common::so3::so3_log;
use glam::{DAffine3, DQuat, DVec3};

/// Angle of one turn, degrees.
pub const TURN_DEG: f64 = 0.1;
/// Motions that can be taken back; older ones stay.
const MOST_KEPT: usize = 10_000;

/// One letter of the operator.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum NudgeOrder {
    /// By one step along this unit vector.
    Move(DVec3),
    /// By [`TURN_DEG`] about this unit vector.
    Turn(DVec3),
    /// Take the last motion back.
    Undo,
    /// Write the result.
    Save,
    /// End.
    Quit,
}

impl NudgeOrder {
    /// Of a letter.
    pub fn of(letter: char) -> Option<Self> {
        Some(match letter {
            'x' => Self::Move(DVec3::X),
            'X' => Self::Move(DVec3::NEG_X),
            'y' => Self::Move(DVec3::Y),
            'Y' => Self::Move(DVec3::NEG_Y),
            'z' => Self::Move(DVec3::Z),
            'Z' => Self::Move(DVec3::NEG_Z),
            'a' => Self::Turn(DVec3::X),
            'A' => Self::Turn(DVec3::NEG_X),
            'b' => Self::Turn(DVec3::Y),
            'B' => Self::Turn(DVec3::NEG_Y),
            'c' => Self::Turn(DVec3::Z),
            'C' => Self::Turn(DVec3::NEG_Z),
            'u' | 'U' => Self::Undo,
            'w' | 'W' => Self::Save,
            'q' | 'Q' => Self::Quit,
            _ => return None,
        })
    }

    /// Of the letters of a line, between which there may be spaces.
    ///
    /// # Errors
    /// The first letter that says nothing; then no letter of the line counts.
    pub fn of_line(line: &str) -> Result<Vec<Self>, char> {
        line.chars().filter(|c| !c.is_whitespace()).map(|c| Self::of(c).ok_or(c)).collect()
    }
}

/// A rigid motion that is corrected step by step along its own axes (those of the frame it starts from: the mesh's for
/// body-from-mesh, the projector's for world-from-projector).
#[derive(Clone, Debug)]
pub struct Nudges {
    start: DAffine3,
    centre: DVec3,
    step_m: f64,
    now: DAffine3,
    before: Vec<DAffine3>,
}

impl Nudges {
    /// Begins at `start`. Turns leave `centre`, a point of the frame it starts from, where it is. A step is `step_m`
    /// metres.
    pub fn new(start: DAffine3, centre: DVec3, step_m: f64) -> Self {
        Self { start, centre, step_m, now: start, before: Vec::new() }
    }

    /// The corrected motion.
    pub fn now(&self) -> DAffine3 {
        self.now
    }

    /// Moves by one step along a unit vector.
    pub fn shift(&mut self, along: DVec3) {
        self.apply(DAffine3::from_translation(along * self.step_m));
    }

    /// Turns by [`TURN_DEG`] about a unit vector through the centre.
    pub fn turn(&mut self, about: DVec3) {
        let rotation = DQuat::from_axis_angle(about, TURN_DEG.to_radians());
        self.apply(DAffine3::from_rotation_translation(rotation, self.centre - rotation * self.centre));
    }

    fn apply(&mut self, step: DAffine3) {
        if self.before.len() == MOST_KEPT {
            self.before.remove(0);
        }
        self.before.push(self.now);
        self.now *= step;
    }

    /// Takes the last motion back; false if there is none.
    pub fn undo(&mut self) -> bool {
        match self.before.pop() {
            Some(last) => {
                self.now = last;
                true
            }
            None => false,
        }
    }

    /// How far the centre has moved, metres, and how far the frame has turned, as a rotation vector in radians; both
    /// along the axes at the start.
    pub fn offset(&self) -> (DVec3, DVec3) {
        let moved = self.start.inverse() * self.now;
        let turned = DQuat::from_mat3(&moved.matrix3).normalize();
        (moved.transform_point3(self.centre) - self.centre, so3_log(turned))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_calibration_file::moved;

    fn start() -> DAffine3 {
        DAffine3::from_rotation_translation(DQuat::from_rotation_x(0.7), DVec3::new(0.3, -0.2, 1.1))
    }

    fn type_in(nudges: &mut Nudges, line: &str) {
        for order in NudgeOrder::of_line(line).unwrap() {
            match order {
                NudgeOrder::Move(along) => nudges.shift(along),
                NudgeOrder::Turn(about) => nudges.turn(about),
                NudgeOrder::Undo => assert!(nudges.undo()),
                NudgeOrder::Save | NudgeOrder::Quit => panic!("{order:?}"),
            }
        }
    }

    #[test]
    fn a_motion_that_was_told_gives_the_same_place() {
        let centre = DVec3::new(0.05, 0.1, -0.02);
        let mut nudges = Nudges::new(start(), centre, 2e-3);
        type_in(&mut nudges, "xxx Y aab CC x");
        let (by, turn) = nudges.offset();
        assert!(moved(&start(), centre, by, turn).abs_diff_eq(nudges.now(), 1e-12));
    }

    #[test]
    fn nudges_compose() {
        let centre = DVec3::new(0.05, 0.1, -0.02);
        let mut nudges = Nudges::new(start(), centre, 2e-3);
        type_in(&mut nudges, "xxx Y zZ");
        let (moved, turned) = nudges.offset();
        assert!((moved - DVec3::new(6e-3, -2e-3, 0.0)).length() < 1e-12 && turned.length() < 1e-12);
        // A turn leaves the centre where it is, and 900 of them are a right angle.
        let before = nudges.now().transform_point3(centre);
        type_in(&mut nudges, &"b".repeat(900));
        assert!(nudges.now().transform_point3(centre).distance(before) < 1e-11);
        assert!((nudges.offset().1 - DVec3::Y * std::f64::consts::FRAC_PI_2).length() < 1e-11);
        // The next step goes along the turned axis: x has become -z.
        type_in(&mut nudges, "x");
        assert!((nudges.offset().0 - DVec3::new(6e-3, -2e-3, -2e-3)).length() < 1e-11);
        // What was composed is the motion at the start and then the step, and it stays rigid.
        let by_hand = start() * DAffine3::from_translation(DVec3::new(6e-3, -2e-3, 0.0));
        assert!((by_hand.transform_point3(centre) - before).length() < 1e-12);
        let m = nudges.now().matrix3;
        assert!((m.transpose() * m - glam::DMat3::IDENTITY).to_cols_array().iter().all(|v| v.abs() < 1e-11));
    }

    #[test]
    fn each_capital_is_the_inverse_of_its_letter() {
        for pair in ["xX", "yY", "zZ", "aA", "bB", "cC"] {
            let mut nudges = Nudges::new(start(), DVec3::ONE, 1e-3);
            type_in(&mut nudges, &pair[..1]);
            assert!(!nudges.now().abs_diff_eq(start(), 1e-6));
            type_in(&mut nudges, &pair[1..]);
            assert!(nudges.now().abs_diff_eq(start(), 1e-12), "{pair}");
        }
    }

    #[test]
    fn undo_takes_back_one_after_another() {
        let mut nudges = Nudges::new(start(), DVec3::ONE, 1e-3);
        type_in(&mut nudges, "xab");
        let mut shorter = Nudges::new(start(), DVec3::ONE, 1e-3);
        type_in(&mut shorter, "x");
        type_in(&mut nudges, "uu");
        assert_eq!(nudges.now(), shorter.now());
        assert!(nudges.undo() && !nudges.undo());
        assert_eq!(nudges.now(), start());
        // However many there were, memory is bounded.
        type_in(&mut nudges, &"x".repeat(MOST_KEPT + 5));
        assert_eq!(nudges.before.len(), MOST_KEPT);
    }

    #[test]
    fn a_line_with_a_wrong_letter_does_nothing() {
        assert_eq!(NudgeOrder::of_line("xx7w"), Err('7'));
        assert_eq!(NudgeOrder::of_line(" w q"), Ok(vec![NudgeOrder::Save, NudgeOrder::Quit]));
    }
}
