//! Residuals and their derivatives into the parameters of least cost: Levenberg-Marquardt (\[Marquardt63\]) with
//! Huber's loss and with priors.

use crate::dense::solve_spd;

/// Half the weighted sum of squares around a state, to second order: `cost - slope . d + d . hessian . d / 2`.
#[derive(Clone, Debug)]
pub struct Equations {
    parameters: usize,
    /// Lower triangle of J^T W J, in rows of full length.
    hessian: Vec<f64>,
    /// Minus J^T W r.
    pub slope: Vec<f64>,
    /// Half the sum of the losses.
    pub cost: f64,
}

/// The weight of a residual under Huber's loss, and half its loss. Residuals up to `knee` count by their square, larger
/// ones by their size.
pub fn huber(size: f64, knee: f64) -> (f64, f64) {
    if size <= knee {
        (1.0, 0.5 * size * size)
    } else {
        (knee / size, knee * (size - 0.5 * knee))
    }
}

impl Equations {
    /// No residual yet, of so many parameters.
    pub fn new(parameters: usize) -> Self {
        Self {
            parameters,
            hessian: vec![0.0; parameters * parameters],
            slope: vec![0.0; parameters],
            cost: 0.0,
        }
    }

    /// Adds a residual with its derivatives. The caller adds the cost, since the loss need not be the square.
    pub fn add(&mut self, row: &[f64], residual: f64, weight: f64) {
        let n = self.parameters;
        for (a, value) in row.iter().enumerate() {
            let scaled = value * weight;
            if scaled == 0.0 {
                continue;
            }
            self.slope[a] -= scaled * residual;
            for (sum, other) in self.hessian[a * n..a * n + a + 1].iter_mut().zip(row) {
                *sum += scaled * other;
            }
        }
    }

    /// Adds what is known of a parameter beforehand: it deviates from the expectation by `deviation`, give or take
    /// `sigma`. A sigma that is infinite says nothing.
    pub fn expect(&mut self, parameter: usize, deviation: f64, sigma: f64) {
        let weight = 1.0 / (sigma * sigma);
        self.slope[parameter] -= weight * deviation;
        self.hessian[parameter * self.parameters + parameter] += weight;
        self.cost += 0.5 * weight * deviation * deviation;
    }

    /// The symmetric matrix in rows.
    pub fn matrix(&self) -> Vec<Vec<f64>> {
        let n = self.parameters;
        (0..n).map(|i| (0..n).map(|j| self.hessian[i.max(j) * n + i.min(j)]).collect()).collect()
    }
}

/// Where a descent ended.
pub struct Descent<S> {
    /// The last state.
    pub state: S,
    /// The equations at `state`.
    pub equations: Equations,
    /// Whether nothing is left to gain.
    pub converged: bool,
    /// Steps made.
    pub steps: usize,
}

/// Goes down from `start`. `equations` gives the equations of a state, `cost` only their cost (infinite where the state
/// is impossible), and `step` a neighbour. `None` if the start is impossible.
pub fn descend<S: Clone>(
    start: S,
    most_steps: usize,
    equations: impl Fn(&S) -> Option<Equations>,
    cost: impl Fn(&S) -> f64,
    step: impl Fn(&S, &[f64]) -> S,
) -> Option<Descent<S>> {
    let mut now = Descent { equations: equations(&start)?, state: start, converged: false, steps: 0 };
    let mut damping = 1e-4;
    while now.steps < most_steps && now.equations.cost.is_finite() {
        now.steps += 1;
        let matrix = now.equations.matrix();
        let mut better = None;
        while better.is_none() && damping < 1e10 {
            let mut damped = matrix.clone();
            damped.iter_mut().enumerate().for_each(|(i, row)| row[i] += damping * row[i].max(1e-300));
            let found = solve_spd(&damped, &now.equations.slope).map(|d| {
                let state = step(&now.state, &d);
                // What the second order promises to gain.
                let promised: f64 = d.iter().zip(&now.equations.slope).map(|(d, s)| 0.5 * d * s).sum();
                (cost(&state), promised, state)
            });
            match found {
                Some(found) if found.0 < now.equations.cost => better = Some(found),
                // Nothing is left to gain: rounding decides which of two neighbours is lower.
                Some((_, promised, _)) if promised <= 1e-9 * now.equations.cost + 1e-24 => {
                    now.converged = true;
                    return Some(now);
                }
                _ => damping *= 6.0,
            }
        }
        let Some((cost, promised, state)) = better else { break };
        let gain = now.equations.cost - cost;
        now.converged = damping < 1e-1 && gain.max(promised) <= 1e-7 * cost + 1e-24;
        damping = (damping * 0.2).max(1e-12);
        now.equations = equations(&state)?;
        now.state = state;
        if now.converged {
            break;
        }
    }
    Some(now)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Rosenbrock's valley has its only minimum at (1, 1).
    #[test]
    fn the_end_of_a_curved_valley_is_found() {
        let residuals = |s: &[f64; 2]| [1.0 - s[0], 10.0 * (s[1] - s[0] * s[0])];
        let cost = |s: &[f64; 2]| residuals(s).iter().map(|r| 0.5 * r * r).sum::<f64>();
        let equations = |s: &[f64; 2]| {
            let mut e = Equations::new(2);
            let r = residuals(s);
            e.add(&[-1.0, 0.0], r[0], 1.0);
            e.add(&[-20.0 * s[0], 10.0], r[1], 1.0);
            e.cost = cost(s);
            Some(e)
        };
        let step = |s: &[f64; 2], d: &[f64]| [s[0] + d[0], s[1] + d[1]];
        let found = descend([-1.2, 1.0], 200, equations, cost, step).unwrap();
        assert!(found.converged, "{} steps", found.steps);
        assert!((found.state[0] - 1.0).abs() < 1e-6 && (found.state[1] - 1.0).abs() < 1e-6);
    }

    #[test]
    fn the_loss_is_smooth_at_its_knee_and_linear_beyond() {
        let (below, above) = (huber(2.0 - 1e-9, 2.0), huber(2.0 + 1e-9, 2.0));
        assert!((below.0 - above.0).abs() < 1e-8 && (below.1 - above.1).abs() < 1e-8);
        assert!((huber(10.0, 2.0).1 - huber(9.0, 2.0).1 - 2.0).abs() < 1e-12);
    }
}
