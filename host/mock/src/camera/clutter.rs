//! The background of the mock camera: uneven light, and shapes that look like what is sought.

use super::MockCameraConfig;
use dpm_device::rng::Draws;

/// Grey levels of every pixel.
pub(super) fn background(config: &MockCameraConfig, draws: Draws) -> Vec<f32> {
    let [w, h] = config.optics.size;
    let mut light = Vec::with_capacity(w as usize * h as usize);
    for y in 0..h {
        for x in 0..w {
            let (u, v) = (f64::from(x) / f64::from(w), f64::from(y) / f64::from(h));
            light.push((config.white * (0.25 + 0.2 * u + 0.1 * v)) as f32);
        }
    }
    for k in 0..u64::from(config.clutter) {
        let shape = ClutterShape::drawn(config, draws.stream(k));
        shape.paint(config, &mut light);
    }
    light
}

#[derive(Clone, Copy)]
enum ClutterKind {
    Disc,
    Plate,
    Stroke,
    /// A square with a white margin, a black border and cells, as a tag has; the cells are drawn.
    Cells(u64),
    /// A window: a dark frame around a bright inside.
    Frame,
}

struct ClutterShape {
    kind: ClutterKind,
    middle: [f64; 2],
    radius: f64,
    turn: (f64, f64),
    stretch: f64,
    level: f64,
}

impl ClutterShape {
    fn drawn(config: &MockCameraConfig, draws: Draws) -> Self {
        let [w, h] = config.optics.size.map(f64::from);
        let kind = match draws.bits(0) % 8 {
            0 => ClutterKind::Disc,
            1 | 2 => ClutterKind::Plate,
            3 => ClutterKind::Stroke,
            4 => ClutterKind::Frame,
            _ => ClutterKind::Cells(draws.bits(1)),
        };
        Self {
            kind,
            middle: [draws.unit(2) * w, draws.unit(3) * h],
            radius: 8.0 + 60.0 * draws.unit(4).powi(2),
            turn: (draws.unit(5) * std::f64::consts::TAU).sin_cos(),
            stretch: 0.6 + 0.4 * draws.unit(6),
            level: config.white * draws.unit(7),
        }
    }

    /// The grey level of the shape at a place in its own axes, where it reaches from -1 to 1.
    fn at(&self, [x, y]: [f64; 2], white: f64) -> Option<f64> {
        let edge = x.abs().max(y.abs());
        match self.kind {
            ClutterKind::Disc => (x.hypot(y) < 1.0).then_some(self.level),
            ClutterKind::Plate => (edge < 1.0).then_some(self.level),
            ClutterKind::Stroke => (x.abs() < 1.0 && y.abs() < 0.08).then_some(self.level),
            ClutterKind::Frame => (edge < 1.0).then_some(if edge > 0.8 { 0.1 * white } else { 0.8 * white }),
            ClutterKind::Cells(bits) => (edge < 1.0).then(|| {
                let cell = |v: f64| ((0.5 * (v + 1.0) * 10.0) as usize).min(9);
                let (i, j) = (cell(x), cell(y));
                let is_white = match i.min(j).min(9 - i).min(9 - j) {
                    0 => true,
                    1 => false,
                    _ => bits >> ((j - 2) * 6 + i - 2) & 1 == 1,
                };
                white * if is_white { 0.9 } else { 0.08 }
            }),
        }
    }

    fn paint(&self, config: &MockCameraConfig, light: &mut [f32]) {
        const SIDE: usize = 3;
        let [w, h] = config.optics.size.map(|s| s as usize);
        let reach = 1.5 * self.radius + 2.0;
        let range = |m: f64, most: usize| {
            ((m - reach).max(0.0) as usize)..(((m + reach).max(0.0)) as usize).min(most)
        };
        for j in range(self.middle[1], h) {
            for i in range(self.middle[0], w) {
                let (mut sum, mut hits) = (0.0, 0.0);
                for s in 0..SIDE * SIDE {
                    let part = |k: usize| (k as f64 + 0.5) / SIDE as f64;
                    let x = i as f64 + part(s % SIDE) - self.middle[0];
                    let y = j as f64 + part(s / SIDE) - self.middle[1];
                    let (sin, cos) = self.turn;
                    let own = [
                        (x * cos + y * sin) / self.radius,
                        (y * cos - x * sin) / (self.radius * self.stretch),
                    ];
                    if let Some(level) = self.at(own, config.white) {
                        (sum, hits) = (sum + level, hits + 1.0);
                    }
                }
                let share = hits / (SIDE * SIDE) as f64;
                let there = &mut light[j * w + i];
                *there = (f64::from(*there) * (1.0 - share) + sum / (SIDE * SIDE) as f64) as f32;
            }
        }
    }
}
