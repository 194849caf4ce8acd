//! Distributions and series into SVG plots.

use super::interval::{Interval, IntervalKind};
use super::profile::Profiler;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

/// A plot could not be drawn; the text says what the drawing library said.
#[derive(Debug, thiserror::Error)]
#[error("cannot draw {what}: {reason}")]
pub struct PlotError {
    /// Which plot.
    pub what: &'static str,
    /// Why.
    pub reason: String,
}

/// Pixels of every plot.
pub const SIZE: (u32, u32) = (960, 540);

fn failed<E: std::fmt::Display>(what: &'static str) -> impl Fn(E) -> PlotError {
    move |e| PlotError { what, reason: e.to_string() }
}

/// The `i`th curve's colour.
pub fn color(i: usize) -> RGBColor {
    // Okabe and Ito's colours, told apart by all kinds of eyes.
    const COLORS: [RGBColor; 7] = [
        RGBColor(0, 114, 178),
        RGBColor(230, 159, 0),
        RGBColor(0, 158, 115),
        RGBColor(204, 121, 167),
        RGBColor(86, 180, 233),
        RGBColor(213, 94, 0),
        RGBColor(0, 0, 0),
    ];
    COLORS[i % COLORS.len()]
}

/// A curve with a name.
type Curve = (String, Vec<(f64, f64)>);

/// Latency against percentile for every interval of a kind, with the axis stretched towards the rare: one decade per nine.
pub fn percentiles(profiler: &Profiler, kind: IntervalKind) -> Result<String, PlotError> {
    let curves: Vec<Curve> = Interval::ALL
        .into_iter()
        .filter(|i| i.kind() == kind && !profiler.histogram(*i).is_empty())
        .map(|interval| {
            let h = profiler.histogram(interval);
            let points = (0..=100).map(|i| {
                let nines = f64::from(i) * 0.05;
                (nines, h.value_at_quantile(1.0 - 10f64.powf(-nines)) as f64 * 1e-6)
            });
            (interval.name().to_owned(), points.collect())
        })
        .collect();
    let nines = |x: &f64| format!("{} %", 100.0 - 100.0 * 10f64.powf(-x));
    lines("percentiles", "share of frames", "ms", &curves, &nines)
}

/// Values over time (seconds): registration error, motion-to-light and the like.
pub fn series(title: &'static str, unit: &str, curves: &[Curve]) -> Result<String, PlotError> {
    lines(title, "s", unit, curves, &|x| format!("{x:.1}"))
}

fn lines(
    what: &'static str,
    x_name: &str,
    y_name: &str,
    curves: &[Curve],
    x_label: &dyn Fn(&f64) -> String,
) -> Result<String, PlotError> {
    let all = || curves.iter().flat_map(|(_, points)| points).filter(|(x, y)| x.is_finite() && y.is_finite());
    let x_range = all().fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), (x, _)| (a.min(*x), b.max(*x)));
    let y_most = all().fold(0f64, |m, (_, y)| m.max(*y));
    // Nothing to show is an empty frame, not an error.
    let (x_from, x_to) = if x_range.0 < x_range.1 { x_range } else { (0.0, 1.0) };
    let y_to = if y_most > 0.0 { 1.05 * y_most } else { 1.0 };
    let mut text = String::new();
    {
        let root = SVGBackend::with_string(&mut text, SIZE).into_drawing_area();
        root.fill(&WHITE).map_err(failed(what))?;
        let mut chart = ChartBuilder::on(&root)
            .margin(16)
            .caption(what, ("sans-serif", 20))
            .x_label_area_size(36)
            .y_label_area_size(64)
            .build_cartesian_2d(x_from..x_to, 0.0..y_to)
            .map_err(failed(what))?;
        chart
            .configure_mesh()
            .x_desc(x_name)
            .y_desc(y_name)
            .x_label_formatter(x_label)
            .light_line_style(WHITE)
            .draw()
            .map_err(failed(what))?;
        for (i, (name, points)) in curves.iter().enumerate() {
            let style = color(i);
            let finite = points.iter().copied().filter(|(x, y)| x.is_finite() && y.is_finite());
            chart.draw_series(LineSeries::new(finite, style.stroke_width(2))).map_err(failed(what))?;
            let anchor = Pos::new(HPos::Left, VPos::Center);
            let font = ("sans-serif", 14).into_text_style(&root).color(&style).pos(anchor);
            root.draw_text(name, &font, (90, 56 + 18 * i as i32)).map_err(failed(what))?;
        }
        root.present().map_err(failed(what))?;
    }
    Ok(text)
}

#[cfg(test)]
mod tests {
    use super::super::interval::tests::frame;
    use super::*;
    use dpm_device::time::FrameRate;

    /// The points of every polyline of a drawing.
    fn polylines(svg: &str) -> Vec<Vec<(f64, f64)>> {
        svg.split("<polyline")
            .skip(1)
            .filter(|p| p.contains("stroke-width=\"2\""))
            .map(|p| {
                let points = p.split("points=\"").nth(1).unwrap().split('"').next().unwrap();
                let pair = |s: &str| {
                    let (x, y) = s.split_once(',').unwrap();
                    (x.parse().unwrap(), y.parse().unwrap())
                };
                points.split_whitespace().map(pair).collect()
            })
            .collect()
    }

    #[test]
    fn percentile_curves_rise() {
        let mut profiler = Profiler::new(FrameRate::new(947, 1).unwrap(), true, 100);
        for k in 1..=2000 {
            profiler.lit(&frame(k, k * 1000), k as u64, false);
        }
        let svg = percentiles(&profiler, IntervalKind::Work).unwrap();
        assert!(
            svg.trim_end().ends_with("</svg>") && svg.contains("render") && svg.contains("99.9 %"),
            "{svg}"
        );
        let curves = polylines(&svg);
        assert_eq!(curves.len(), 5);
        for curve in curves {
            // Downwards on the page is less.
            assert!(curve.windows(2).all(|w| w[1].1 <= w[0].1), "{curve:?}");
            assert!(curve[0].1 > curve[curve.len() - 1].1 + 50.0);
        }
    }

    #[test]
    fn empty_and_broken_series_are_drawn_without_fuss() {
        assert!(series("registration error", "px", &[]).unwrap().contains("registration error"));
        let curves =
            vec![("a".to_owned(), vec![(0.0, f64::NAN), (1.0, 2.0), (2.0, 1.0), (f64::INFINITY, 3.0)])];
        let svg = series("registration error", "px", &curves).unwrap();
        assert_eq!(polylines(&svg)[0].len(), 2);
        assert!(!svg.contains("NaN"));
    }
}
