//! Two eyes that look about: fixations, saccades and blinks, as a function of time and a seed.

use dpm_device::rng::Draws;

/// What the eyes do.
#[derive(Clone, Copy, Debug)]
pub struct EyeMotion {
    /// Draws targets and instants.
    pub seed: u64,
    /// Mean time from one fixation to the next, nanoseconds, above 0.
    pub fixation_ns: i64,
    /// Duration of a saccade between them, nanoseconds.
    pub saccade_ns: i64,
    /// Mean time from one blink to the next, nanoseconds; 0 for none.
    pub blink_every_ns: i64,
    /// Duration of a blink, nanoseconds.
    pub blink_ns: i64,
    /// Largest angle between a target and straight ahead, degrees.
    pub widest_deg: f64,
}

impl Default for EyeMotion {
    fn default() -> Self {
        Self {
            seed: 1,
            fixation_ns: 400_000_000,
            saccade_ns: 45_000_000,
            blink_every_ns: 4_000_000_000,
            blink_ns: 150_000_000,
            widest_deg: 18.0,
        }
    }
}

/// The eyes at an instant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EyeState {
    /// What both look at: metres, in the frame of the scene camera (x right, y down, z forward).
    pub target_m: [f64; 3],
    /// They rest on it.
    pub is_fixed: bool,
    /// The lids are closed.
    pub is_shut: bool,
}

impl EyeMotion {
    /// Middle of the right eye (0) and of the left eye (1), metres, in the frame of the scene camera.
    pub const EYES_M: [[f64; 3]; 2] = [[0.012, 0.022, -0.03], [-0.05, 0.022, -0.03]];

    fn draws(&self, what: u64) -> Draws {
        Draws::new(self.seed).stream(what)
    }

    /// Target of fixation `k`: between 0.4 and 1.4 m away.
    fn target(&self, k: i64) -> [f64; 3] {
        let draw = |what| self.draws(what).unit(k as u64);
        // Even over the disc of directions.
        let (angle, round) =
            (self.widest_deg.to_radians() * libm::sqrt(draw(1)), core::f64::consts::TAU * draw(2));
        let far = 0.4 + draw(3);
        let aside = far * libm::sin(angle);
        [aside * libm::cos(round), aside * libm::sin(round), far * libm::cos(angle)]
    }

    /// When fixation `k` is left.
    fn leaves(&self, k: i64) -> i64 {
        let shift = (self.draws(4).unit(k as u64) - 0.5) * 0.5;
        k * self.fixation_ns + (shift * self.fixation_ns as f64) as i64
    }

    /// The eyes at `t_ns`, which may be any.
    pub fn at(&self, t_ns: i64) -> EyeState {
        let near = t_ns.div_euclid(self.fixation_ns);
        // The saccade that began last: instants of leaving are off by a quarter of a step at most.
        let k = (near - 1..=near + 1).rev().find(|k| self.leaves(*k) <= t_ns).unwrap_or(near - 1);
        let [from, to] = [self.target(k - 1), self.target(k)];
        let part = ((t_ns - self.leaves(k)) as f64 / self.saccade_ns.max(1) as f64).clamp(0.0, 1.0);
        let part = part * part * (3.0 - 2.0 * part);
        EyeState {
            target_m: [0, 1, 2].map(|i| from[i] + part * (to[i] - from[i])),
            is_fixed: part >= 1.0,
            is_shut: self.is_shut(t_ns),
        }
    }

    fn is_shut(&self, t_ns: i64) -> bool {
        if self.blink_every_ns <= 0 {
            return false;
        }
        let n = t_ns.div_euclid(self.blink_every_ns);
        let room = (self.blink_every_ns - self.blink_ns).max(0) as f64;
        let begin = (self.draws(5).unit(n as u64) * room) as i64;
        (begin..begin + self.blink_ns).contains(&(t_ns - n * self.blink_every_ns))
    }
}
