//! Latencies into a histogram: how many frames took how long, with the length of a slot.

use super::plots::{color, framed, PlotError, SIZE, SLOT_LINE};
use dpm_rig::telemetry::interval::Interval;
use dpm_rig::telemetry::profile::Profiler;
use plotters::element::DashedPathElement;
use plotters::prelude::*;

/// The latencies that are drawn.
const DRAWN: [Interval; 4] = [
    Interval::LatchToFirstPhoton,
    Interval::MotionToFirstPhoton,
    Interval::MotionToCentre,
    Interval::MotionToLastPhoton,
];

/// Bins of the plot.
const BINS: u32 = 200;

/// The plot ends at so many times the 99th percentile of the longest latency, unless all frames took less.
const BEYOND: f64 = 3.0;

/// A curve: its name, and the frames in each bin.
type Curve = (String, Vec<u64>);

/// A histogram of the latencies of all frames as SVG, with frames on a logarithmic axis, so that single late ones are seen, and a line
/// at the length of a slot. `made` stands above it.
///
/// # Errors
/// What the drawing library says.
pub(super) fn latency_histogram(profiler: &Profiler, made: &str) -> Result<String, PlotError> {
    let drawn = || DRAWN.into_iter().filter(|i| !profiler.histogram(*i).is_empty());
    let slot_ns = profiler.rate().slot_len_ns(0).max(1) as f64;
    let last = |interval: Interval| {
        let h = profiler.histogram(interval);
        (h.value_at_quantile(1.0) as f64).min(BEYOND * h.value_at_quantile(0.99) as f64)
    };
    let end_ns = drawn().map(last).fold(1.25 * slot_ns, f64::max) * 1.02;
    let edge = |bin: u32| (end_ns * f64::from(bin) / f64::from(BINS)) as u64;
    let mut beyond = 0;
    let curves: Vec<Curve> = drawn()
        .map(|interval| {
            let late = profiler.histogram(interval).late();
            beyond = beyond.max(late.count_between(edge(BINS), u64::MAX));
            let counts = (0..BINS).map(|bin| late.count_between(edge(bin), edge(bin + 1) - 1));
            let modelled = if profiler.is_modelled(interval) { " (modelled)" } else { "" };
            (interval.name().replace('_', " ") + modelled, counts.collect())
        })
        .collect();
    let outside = if beyond > 0 {
        format!(", of which up to {beyond} took longer than is shown")
    } else {
        String::new()
    };
    let titles = [format!("Latency, {} frames{outside}", profiler.frames_lit()), made.to_owned()];
    draw(&curves, &titles, end_ns * 1e-6, slot_ns * 1e-6)
        .map_err(|e| PlotError { what: "the histogram of latencies", reason: e.to_string() })
}

fn draw(
    curves: &[Curve],
    titles: &[String; 2],
    end_ms: f64,
    slot_ms: f64,
) -> Result<String, Box<dyn std::error::Error>> {
    let most = curves.iter().flat_map(|(_, counts)| counts).copied().max().unwrap_or(0).max(1);
    let mut text = String::new();
    {
        let root = SVGBackend::with_string(&mut text, SIZE).into_drawing_area();
        root.fill(&WHITE)?;
        let area = framed(&root, titles, curves.iter().map(|(name, _)| name.as_str()), true)?;
        // The axis begins at half a frame: a bin without a frame lies on it.
        let (bottom, top) = (0.5, 1.5 * most as f64);
        let mut chart = ChartBuilder::on(&area)
            .margin(24)
            .x_label_area_size(36)
            .y_label_area_size(64)
            .build_cartesian_2d(0.0..end_ms, (bottom..top).log_scale())?;
        chart
            .configure_mesh()
            .x_desc("ms")
            .y_desc("frames")
            .y_label_formatter(&|y: &f64| format!("{y:.0}"))
            .light_line_style(WHITE)
            .draw()?;
        chart.draw_series(std::iter::once(DashedPathElement::new(
            [(slot_ms, bottom), (slot_ms, top)],
            6,
            4,
            SLOT_LINE.stroke_width(1),
        )))?;
        let width = end_ms / f64::from(BINS);
        for (i, (_, counts)) in curves.iter().enumerate() {
            let steps = counts.iter().enumerate().flat_map(|(bin, count)| {
                let (from, height) = (width * bin as f64, (*count as f64).max(bottom));
                [(from, height), (from + width, height)]
            });
            chart.draw_series(LineSeries::new(steps, color(i).stroke_width(2)))?;
        }
        root.present()?;
    }
    Ok(text)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixture::frame;
    use crate::svg::is_plain_svg;
    use dpm_device::time::FrameRate;

    /// Every frame is in one bin of its curve, and the slot has its line.
    #[test]
    fn frames_are_counted_in_their_bins_beside_the_slots_line() {
        let mut profiler = Profiler::new(FrameRate::new(1000, 1).unwrap(), true, 100);
        // The first photon is 8 steps after the motion: 0.8 ms, once 80 ms.
        (1..=999).for_each(|k| profiler.lit(&frame(k, 100_000), k as u64, false));
        profiler.lit(&frame(1000, 10_000_000), 1000, true);
        let svg = latency_histogram(&profiler, "rig.toml, commit abc").unwrap();
        for part in ["Latency, 1000 frames, of which up to 1 took longer", "rig.toml, commit abc", "one slot"]
        {
            assert!(svg.contains(part), "{part}");
        }
        assert!(is_plain_svg(&svg) && !svg.contains("NaN"));
        // Each curve leaves the axis at one place, and comes back to it.
        let curves: Vec<&str> = svg.split("<polyline").filter(|p| p.contains("stroke-width=\"2\"")).collect();
        assert_eq!(curves.len(), 2 * DRAWN.len(), "each stands in the key, too");
        let heights = |curve: &str| -> Vec<i32> {
            let points = curve.split("points=\"").nth(1).unwrap().split('"').next().unwrap();
            points.split_whitespace().map(|p| p.split_once(',').unwrap().1.parse().unwrap()).collect()
        };
        for curve in curves.iter().map(|curve| heights(curve)).filter(|heights| heights.len() > 2) {
            let axis = curve.iter().copied().max().unwrap();
            let off = curve.iter().filter(|y| **y < axis).count();
            assert!((1..=4).contains(&off), "{off} points off the axis");
        }
    }

    #[test]
    fn no_frames_are_an_empty_chart() {
        let profiler = Profiler::new(FrameRate::new(947, 1).unwrap(), true, 100);
        assert!(latency_histogram(&profiler, "").unwrap().contains("Latency, 0 frames"));
    }
}
