//! Distributions into SVG plots, and the key that every plot has.

use dpm_rig::telemetry::interval::{Interval, IntervalKind};
use dpm_rig::telemetry::profile::Profiler;
use plotters::coord::Shift;
use plotters::element::DashedPathElement;
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

/// How a curve is drawn, on the chart and in its key.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stroke {
    /// A line of this width.
    Plain(u32),
    /// The same with its points marked.
    Marked(u32),
    /// Dashed.
    Dashed(u32),
}

/// Room for the key beside a chart, pixels.
const KEY_WIDTH: u32 = 190;
/// Room for the titles above a chart, pixels.
const TITLE_HEIGHT: u32 = 44;
/// Colour of the line at the length of a slot.
pub(super) const SLOT_LINE: RGBColor = RGBColor(120, 120, 120);

/// Names of curves with a piece of each, below each other beside the chart, where they cover none of it. Returns what is left for the chart.
///
/// # Errors
/// What the drawing library says.
pub fn key<B: DrawingBackend>(
    root: &DrawingArea<B, Shift>,
    curves: &[(&str, RGBColor, Stroke)],
) -> Result<DrawingArea<B, Shift>, DrawingAreaErrorKind<B::ErrorType>> {
    let (chart, beside) = root.split_horizontally(SIZE.0 - KEY_WIDTH);
    let font = ("sans-serif", 13).into_text_style(&beside).pos(Pos::new(HPos::Left, VPos::Center));
    for (i, (name, color, stroke)) in curves.iter().enumerate() {
        let y = 56 + 20 * i as i32;
        let (from, to) = ((4, y), (28, y));
        match *stroke {
            Stroke::Plain(width) | Stroke::Marked(width) => {
                beside.draw(&PathElement::new([from, to], color.stroke_width(width)))?;
            }
            Stroke::Dashed(width) => {
                beside.draw(&DashedPathElement::new([from, to], 6, 4, color.stroke_width(width)))?;
            }
        }
        beside.draw_text(name, &font, (36, y))?;
    }
    Ok(chart)
}

/// Writes two lines above a plot; returns what is left below them.
///
/// # Errors
/// What the drawing library says.
fn titled<B: DrawingBackend>(
    root: &DrawingArea<B, Shift>,
    titles: &[String; 2],
) -> Result<DrawingArea<B, Shift>, DrawingAreaErrorKind<B::ErrorType>> {
    let (_, below) = root.split_vertically(TITLE_HEIGHT);
    for (i, (title, size)) in titles.iter().zip([16, 12]).enumerate() {
        root.draw_text(title, &("sans-serif", size).into_text_style(root), (24, 6 + 22 * i as i32))?;
    }
    Ok(below)
}

/// Titles above, and beside the chart the key of the curves `names` and of the line of a slot, if there is one. Returns what is left for the
/// chart.
///
/// # Errors
/// What the drawing library says.
pub(super) fn framed<'a, B: DrawingBackend>(
    root: &DrawingArea<B, Shift>,
    titles: &[String; 2],
    names: impl Iterator<Item = &'a str>,
    has_slot: bool,
) -> Result<DrawingArea<B, Shift>, DrawingAreaErrorKind<B::ErrorType>> {
    let below = titled(root, titles)?;
    let mut named: Vec<_> = names.enumerate().map(|(i, name)| (name, color(i), Stroke::Plain(2))).collect();
    if has_slot {
        named.push(("one slot", SLOT_LINE, Stroke::Dashed(1)));
    }
    key(&below, &named)
}

/// Latency against percentile for every interval of a kind, with the axis stretched towards the rare: one decade per nine. `made` says
/// what ran, when and of which commit the program is; it stands above the plot with the number of frames.
///
/// # Errors
/// What the drawing library says.
pub fn percentiles(profiler: &Profiler, kind: IntervalKind, made: &str) -> Result<String, PlotError> {
    let curves: Vec<(String, Vec<(f64, f64)>)> = Interval::ALL
        .into_iter()
        .filter(|i| i.kind() == kind && !profiler.histogram(*i).is_empty())
        .map(|interval| {
            let h = profiler.histogram(interval);
            let points = (0..=100).map(|i| {
                let nines = f64::from(i) * 0.05;
                (nines, h.value_at_quantile(1.0 - 10f64.powf(-nines)) as f64 * 1e-6)
            });
            let modelled = if profiler.is_modelled(interval) { " (modelled)" } else { "" };
            (interval.name().replace('_', " ") + modelled, points.collect())
        })
        .collect();
    let what = match kind {
        IntervalKind::Work => "Work on a frame",
        IntervalKind::Wait => "Waiting of a frame",
        IntervalKind::Total => "From motion to light",
    };
    let titles = [format!("{what}, {} frames", profiler.frames_lit()), made.to_owned()];
    let slot_ms = profiler.rate().slot_len_ns(0) as f64 * 1e-6;
    draw(&curves, &titles, slot_ms).map_err(|e| PlotError { what: "percentiles", reason: e.to_string() })
}

fn draw(
    curves: &[(String, Vec<(f64, f64)>)],
    titles: &[String; 2],
    slot_ms: f64,
) -> Result<String, Box<dyn std::error::Error>> {
    let all = || curves.iter().flat_map(|(_, points)| points).map(|(_, y)| *y);
    let (least, most) = (all().fold(0f64, f64::min), all().fold(0f64, f64::max));
    // Five hundredths of the range above and, where something is early, below.
    let range = if most > least { most - least } else { 1.0 };
    let (bottom, top) =
        (if least < 0.0 { least - 0.05 * range } else { 0.0 }, most.max(least + range) + 0.05 * range);
    let mut text = String::new();
    {
        let root = SVGBackend::with_string(&mut text, SIZE).into_drawing_area();
        root.fill(&WHITE)?;
        let has_slot = (bottom..=top).contains(&slot_ms);
        let area = framed(&root, titles, curves.iter().map(|(name, _)| name.as_str()), has_slot)?;
        let mut chart = ChartBuilder::on(&area)
            .margin(24)
            .x_label_area_size(36)
            .y_label_area_size(64)
            .build_cartesian_2d(0.0..5.0, bottom..top)?;
        chart
            .configure_mesh()
            .x_desc("share of frames that take no longer")
            .y_desc("ms")
            // At whole nines.
            .x_labels(6)
            .x_label_formatter(&|x: &f64| {
                // The label's place, not a figure: below one nine there are no decimals to show.
                format!("{:.*} %", (*x - 2.0).max(0.0) as usize, 100.0 - 10f64.powf(2.0 - x))
            })
            .light_line_style(WHITE)
            .draw()?;
        if has_slot {
            let line = [(0.0, slot_ms), (5.0, slot_ms)];
            chart.draw_series(DashedLineSeries::new(line, 6, 4, SLOT_LINE.stroke_width(1)))?;
        }
        for (i, (_, points)) in curves.iter().enumerate() {
            chart.draw_series(LineSeries::new(points.iter().copied(), color(i).stroke_width(2)))?;
        }
        root.present()?;
    }
    Ok(text)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixture::frame;
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
    fn percentile_curves_rise_through_the_quantiles() {
        let mut profiler = Profiler::new(FrameRate::new(947, 1).unwrap(), true, 100);
        for k in 1..=2000 {
            profiler.lit(&frame(k, k * 1000), k as u64, false);
        }
        let svg = percentiles(&profiler, IntervalKind::Work, "made today").unwrap();
        assert!(
            svg.trim_end().ends_with("</svg>") && svg.contains("render") && svg.contains("99.9 %"),
            "{svg}"
        );
        let mut curves = polylines(&svg);
        curves.retain(|c| c.len() > 2);
        assert_eq!(curves.len(), 5);
        for curve in curves {
            // Downwards on the page is less.
            assert!(curve.windows(2).all(|w| w[1].1 <= w[0].1), "{curve:?}");
            let height = |i: usize| curve[0].1 - curve[i].1;
            assert!(height(100) > 50.0);
            // Evenly spread from 0 on: 90 % of the frames take no longer than 0.9 of the longest, at one nine; 99 % at two.
            for (nines, share) in [(1, 0.9), (2, 0.99)] {
                assert!((height(20 * nines) / height(100) - share).abs() < 0.02, "{nines}: {curve:?}");
            }
        }
    }

    #[test]
    fn nothing_is_an_empty_frame_and_labels_are_whole_nines() {
        let profiler = Profiler::new(FrameRate::new(947, 1).unwrap(), true, 100);
        let svg = percentiles(&profiler, IntervalKind::Work, "").unwrap();
        assert!(polylines(&svg).is_empty() && !svg.contains("NaN"));
        let labels: Vec<&str> =
            svg.lines().map(str::trim).filter(|l| l.ends_with(" %") && !l.contains('<')).collect();
        assert_eq!(labels, ["0 %", "90 %", "99 %", "99.9 %", "99.99 %", "99.999 %"]);
    }

    /// Found in use, user 4: a plot without title, count, date, commit and the slot's length cannot stand in a paper.
    #[test]
    fn a_plot_says_of_what_it_is_and_shows_the_slot() {
        let mut profiler = Profiler::new(FrameRate::new(947, 1).unwrap(), true, 100);
        (1..=20).for_each(|k| profiler.lit(&frame(k, k * 100_000), k as u64, false));
        let svg = percentiles(&profiler, IntervalKind::Total, "rig.toml, commit abc, 2026-11-22").unwrap();
        for part in [
            "From motion to light, 20 frames",
            "rig.toml, commit abc, 2026-11-22",
            "one slot",
            "motion to centre",
        ] {
            assert!(svg.contains(part), "{part}");
        }
    }

    /// Found in use (second look at latency, section 2b): early light was drawn at 0.
    #[test]
    fn what_is_early_is_drawn_below_zero() {
        let mut profiler = Profiler::new(FrameRate::new(947, 1).unwrap(), true, 100);
        for k in 1..=200 {
            let mut t = frame(k, 1000);
            t.due_at = t.lit_at.unwrap().plus_ns(400_000);
            profiler.lit(&t, k as u64, false);
        }
        let svg = percentiles(&profiler, IntervalKind::Total, "").unwrap();
        let flat: Vec<f64> = polylines(&svg).iter().filter(|c| c.len() > 2).map(|c| c[0].1).collect();
        let heights = Interval::ALL.iter().filter(|i| i.kind() == IntervalKind::Total).count();
        assert_eq!(flat.len(), heights);
        // Lateness is the first of the totals; the others are some microseconds above zero, 0.4 ms higher.
        assert!(flat[1..].iter().all(|y| *y < flat[0] - 100.0), "{flat:?}");
    }

    #[test]
    fn names_stand_beside_the_chart() {
        let mut profiler = Profiler::new(FrameRate::new(947, 1).unwrap(), true, 100);
        (1..=20).for_each(|k| profiler.lit(&frame(k, k * 1000), k as u64, false));
        let svg = percentiles(&profiler, IntervalKind::Work, "made today").unwrap();
        let right = f64::from(SIZE.0 - KEY_WIDTH);
        let (mut beside, mut on_chart) = (0, 0);
        for curve in polylines(&svg) {
            let on_key = curve.iter().all(|p| p.0 >= right);
            assert!(on_key || curve.iter().all(|p| p.0 < right), "{curve:?}");
            (beside, on_chart) = (beside + i32::from(on_key), on_chart + i32::from(!on_key));
        }
        assert_eq!((beside, on_chart), (5, 5));
    }
}
