//! Measured groups into curves: error against cost, both logarithmic, with the Pareto front.

use super::figure3::{Figure3Group, Figure3Row};
use super::plan::looks;
use super::runs::{ErrorRow, GroupResult};
use crate::stamp::Stamp;
use dpm_profile::plots::{color, key, Stroke, SIZE};
use plotters::coord::combinators::{LogCoord, WithKeyPoints};
use plotters::prelude::*;

/// One frame at 947 fps, ms: what the rig allows.
pub(crate) const FRAME_MS: f64 = 1.056;

/// What the horizontal axis shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cost {
    /// Rays of a frame.
    Rays,
    /// GPU time of a frame, ms.
    GpuMs,
}

/// Points that no other point beats in both cost and error, by rising cost.
pub(crate) fn pareto(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let mut sorted = points.to_vec();
    sorted.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
    let mut least = f64::INFINITY;
    sorted.retain(|&(_, error)| {
        let better = error < least;
        least = least.min(error);
        better
    });
    sorted
}

/// Places for labels on a logarithmic axis: 1, 2, 3, 5 and 7 of every decade, or 1, 2, 5, or 1, whichever leaves the most of at most ten.
fn ticks(low: f64, high: f64) -> Vec<f64> {
    let of = |steps: &[f64]| -> Vec<f64> {
        let decades = low.log10().floor() as i32..=high.log10().ceil() as i32;
        decades
            .flat_map(|d| steps.iter().map(move |s| s * 10f64.powi(d)))
            .filter(|t| (low..=high).contains(t))
            .collect()
    };
    let choices = [of(&[1.0, 2.0, 3.0, 5.0, 7.0]), of(&[1.0, 2.0, 5.0]), of(&[1.0])];
    choices.into_iter().find(|t| t.len() <= 10).unwrap_or_default()
}

/// A label of a tick: no more digits than it has.
fn label(v: &f64) -> String {
    let digits = (-v.log10().floor()).clamp(0.0, 12.0) as usize;
    format!("{v:.digits$}")
}

/// A logarithmic axis with its labels.
fn axis((low, high): (f64, f64)) -> WithKeyPoints<LogCoord<f64>> {
    (low..high).log_scale().with_key_points(ticks(low, high))
}

/// A curve with its name in the key.
struct Curve {
    name: String,
    points: Vec<(f64, f64)>,
    color: RGBColor,
    stroke: Stroke,
}

/// The points' range along one axis, a little wider.
fn range(values: impl Iterator<Item = f64>) -> (f64, f64) {
    let (low, high) = values.fold((f64::INFINITY, 0.0f64), |(a, b), v| (a.min(v), b.max(v)));
    if low <= high {
        (0.8 * low, 1.25 * high)
    } else {
        (0.1, 10.0)
    }
}

/// What a plot shows, on which devices and rasters.
fn title<'a>(what: &str, stamps: impl Iterator<Item = &'a Stamp>) -> String {
    let mut all: Vec<String> =
        stamps.map(|s| format!("{}, {} x {}", s.device, s.raster[0], s.raster[1])).collect();
    all.dedup();
    format!("{what}: {}", all.join("; "))
}

/// Perceived error against cost, both axes logarithmic, a curve a method, the Pareto front in grey, and for times one frame's 1.056 ms.
///
/// # Errors
/// What the drawing library says.
pub fn curves(groups: &[GroupResult], moving: bool, cost: Cost) -> Result<String, String> {
    let point = |r: &ErrorRow| (if cost == Cost::Rays { r.rays } else { r.gpu_ms }, r.perceived_rmse);
    let rows: Vec<&ErrorRow> = groups
        .iter()
        .flat_map(|g| &g.rows)
        .filter(|r| r.moving == moving && point(r).0 > 0.0 && point(r).1 > 0.0)
        .collect();
    let mut names: Vec<&str> = Vec::new();
    for r in &rows {
        if !names.contains(&r.method.as_str()) {
            names.push(&r.method);
        }
    }
    let all: Vec<(f64, f64)> = rows.iter().map(|r| point(r)).collect();
    let (mut x, y) = (range(all.iter().map(|p| p.0)), range(all.iter().map(|p| p.1)));
    let mut drawn = vec![Curve {
        name: "Pareto front".into(),
        points: pareto(&all),
        color: RGBColor(190, 190, 190),
        stroke: Stroke::Plain(6),
    }];
    drawn.extend(names.iter().enumerate().map(|(i, name)| Curve {
        name: (*name).to_owned(),
        points: rows.iter().filter(|r| r.method == *name).map(|r| point(r)).collect(),
        color: color(i),
        stroke: Stroke::Marked(2),
    }));
    if cost == Cost::GpuMs {
        x = (x.0.min(0.8 * FRAME_MS), x.1.max(1.25 * FRAME_MS));
        drawn.push(Curve {
            name: "1.056 ms".into(),
            points: vec![(FRAME_MS, y.0), (FRAME_MS, y.1)],
            color: BLACK,
            stroke: Stroke::Plain(1),
        });
    }
    let x_name = if cost == Cost::Rays { "rays a frame" } else { "GPU time of a frame, ms" };
    let motion = if moving { "moving" } else { "standing" };
    draw(
        &title(&format!("bodies {motion}"), groups.iter().map(|g| &g.stamp)),
        [x_name, "perceived RMSE"],
        (x, y),
        drawn,
    )
    .map_err(|e| e.to_string())
}

/// Perceived error by mean radiance against samples a pixel, both logarithmic: a colour a material, dashed when standing.
///
/// # Errors
/// What the drawing library says.
pub fn figure3(groups: &[Figure3Group]) -> Result<String, String> {
    let rows = || groups.iter().flat_map(|g| &g.rows).filter(|r| r.perceived > 0.0);
    let point = |r: &Figure3Row| (f64::from(r.spp), r.perceived);
    let ranges = (range(rows().map(|r| point(r).0)), range(rows().map(|r| point(r).1)));
    let looks = looks();
    let drawn = looks.iter().enumerate().flat_map(|(i, look)| {
        [false, true].map(|moving| Curve {
            name: format!("{}, {}", look.name, if moving { "moving" } else { "still" }),
            points: rows().filter(|r| r.material == look.name && r.moving == moving).map(point).collect(),
            color: color(i),
            stroke: if moving { Stroke::Marked(2) } else { Stroke::Dashed(2) },
        })
    });
    let names = ["samples a pixel and frame", "perceived RMSE / mean radiance"];
    let title = title("one body in four materials", groups.iter().map(|g| &g.stamp));
    draw(&title, names, ranges, drawn.collect()).map_err(|e| e.to_string())
}

/// Curves over two logarithmic axes, with a key beside them.
fn draw(
    title: &str,
    [x_name, y_name]: [&str; 2],
    (x, y): ((f64, f64), (f64, f64)),
    curves: Vec<Curve>,
) -> Result<String, Box<dyn std::error::Error>> {
    let mut text = String::new();
    {
        let root = SVGBackend::with_string(&mut text, SIZE).into_drawing_area();
        root.fill(&WHITE)?;
        let named: Vec<_> = curves.iter().map(|c| (c.name.as_str(), c.color, c.stroke)).collect();
        let area = key(&root, &named)?;
        let mut chart = ChartBuilder::on(&area)
            .margin(16)
            .caption(title, ("sans-serif", 15))
            .x_label_area_size(40)
            .y_label_area_size(80)
            .build_cartesian_2d(axis(x), axis(y))?;
        chart
            .configure_mesh()
            .x_desc(x_name)
            .y_desc(y_name)
            .x_label_formatter(&label)
            .y_label_formatter(&label)
            .light_line_style(WHITE)
            .draw()?;
        for Curve { mut points, color, stroke, .. } in curves {
            points.sort_by(|a, b| a.0.total_cmp(&b.0));
            match stroke {
                Stroke::Plain(w) | Stroke::Marked(w) => {
                    let size = if stroke == Stroke::Marked(w) { 4 } else { 0 };
                    chart.draw_series(LineSeries::new(points, color.stroke_width(w)).point_size(size))?;
                }
                Stroke::Dashed(w) => {
                    chart.draw_series(DashedLineSeries::new(points, 6, 4, color.stroke_width(w)))?;
                }
            }
        }
        root.present()?;
    }
    Ok(text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_axis_has_labels_and_they_say_what_they_stand_for() {
        for (low, high) in [(0.012, 0.05), (0.8, 80.0), (4800.0, 19_000.0), (1e-4, 1e3), (1.1, 1.9)] {
            let all = ticks(low, high);
            assert!((1..=10).contains(&all.len()) || high / low < 2.0, "{low}..{high}: {all:?}");
            for t in all {
                let read: f64 = label(&t).parse().unwrap();
                assert!((read / t - 1.0).abs() < 1e-9 && (low..=high).contains(&t), "{t}: {}", label(&t));
            }
        }
        assert_eq!([label(&0.02), label(&5.0), label(&3000.0)], ["0.02", "5", "3000"]);
    }

    #[test]
    fn the_front_holds_what_nothing_beats() {
        let front = pareto(&[(4.0, 1.0), (1.0, 4.0), (2.0, 4.5), (2.0, 2.0), (3.0, 2.0)]);
        assert_eq!(front, [(1.0, 4.0), (2.0, 2.0), (4.0, 1.0)]);
        assert!(pareto(&[]).is_empty());
    }
}
