//! Measured groups into what people read: CSV, a Markdown table, and curves with the Pareto front.

use super::error_runs::{ErrorRow, GroupResult};
use plotters::prelude::*;
use std::fmt::Write;

/// One frame at 947 fps, ms: what the rig allows.
pub const FRAME_MS: f64 = 1.056;

fn optional(v: Option<f64>) -> String {
    v.map_or(String::new(), |v| format!("{v:.6e}"))
}

/// All rows as CSV with a head line. Columns are the fields of [`ErrorRow`], preceded by device and configuration hash.
pub fn csv(groups: &[GroupResult]) -> String {
    let mut text = String::from(
        "device,config,seed,motion,budget,method,spp,rays,rays_to_paper,samples,gpu_ms,wall_ms,single_rmse,single_rel_mse,\
         perceived_rmse,perceived_rmse_raw,perceived_fovea,perceived_periphery,bias,noise,mean_shift,flip,flicker,\
         flicker_periphery,ratio_to_paper,reference_error\n",
    );
    for g in groups {
        for r in &g.rows {
            // Writing into a string cannot fail.
            let _ = writeln!(
                text,
                "\"{}\",{},{},{},{},\"{}\",{:.4},{:.1},{:.5},{:.1},{:.6},{:.6},{:.6e},{:.6e},{:.6e},{:.6e},{},{},{:.6e},{:.6e},{:.6e},{:.6e},{:.6e},{},{:.5},{:.6e}",
                g.stamp.device.replace('"', "'"),
                g.stamp.config_hash,
                g.stamp.seed,
                if r.moving { "moving" } else { "still" },
                r.budget,
                r.method,
                r.spp,
                r.rays,
                r.rays_to_paper,
                r.samples,
                r.gpu_ms,
                r.wall_ms,
                r.single_rmse,
                r.single_rel_mse,
                r.perceived_rmse,
                r.perceived_rmse_raw,
                optional(r.perceived_fovea),
                optional(r.perceived_periphery),
                r.bias,
                r.noise,
                r.mean_shift,
                r.flip,
                r.flicker,
                optional(r.flicker_periphery),
                r.ratio_to_paper,
                g.reference_error
            );
        }
    }
    text
}

/// All rows as a Markdown table, with the stamp above and the best of the others beside dpm below.
pub fn markdown(groups: &[GroupResult]) -> String {
    let mut text = String::new();
    if let Some(g) = groups.first() {
        let s = &g.stamp;
        let _ = writeln!(
            text,
            "{} ({}), {} x {}, dpm {}, configuration {}, seed {}\n",
            s.device, s.driver, s.raster[0], s.raster[1], s.version, s.config_hash, s.seed
        );
    }
    text += "| motion | budget | method | rays/frame | rays / paper | GPU ms | single RMSE | perceived RMSE | bias | noise | FLIP | flicker | perceived / paper |\n";
    text += "|---|---:|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|\n";
    for r in groups.iter().flat_map(|g| &g.rows) {
        let _ = writeln!(
            text,
            "| {} | {} | {} | {:.0} | {:.3} | {:.2} | {:.4} | {:.5} | {:.5} | {:.5} | {:.4} | {:.5} | {:.2} |",
            if r.moving { "moving" } else { "still" },
            r.budget,
            r.method,
            r.rays,
            r.rays_to_paper,
            r.gpu_ms,
            r.single_rmse,
            r.perceived_rmse,
            r.bias,
            r.noise,
            r.flip,
            r.flicker,
            r.ratio_to_paper
        );
    }
    text.push('\n');
    for g in groups {
        let (Some(dpm), Some(best)) = (dpm_of(g), best_other(g)) else { continue };
        let _ = writeln!(
            text,
            "{}, budget {}: dpm has {:.2} of the perceived RMSE of the best other ({}) and {:.2} of the least flicker of the others; \
             reference error {:.5}, mean radiance {:.4}, {} probes.",
            if dpm.moving { "moving" } else { "still" },
            dpm.budget,
            dpm.perceived_rmse / best.perceived_rmse,
            best.method,
            dpm.flicker / least_flicker(g),
            g.reference_error,
            g.mean,
            g.probes
        );
    }
    text
}

fn dpm_of(g: &GroupResult) -> Option<&ErrorRow> {
    g.rows.iter().find(|r| r.method == "dpm")
}

fn others(g: &GroupResult) -> impl Iterator<Item = &ErrorRow> {
    g.rows.iter().filter(|r| !r.method.starts_with("dpm"))
}

fn best_other(g: &GroupResult) -> Option<&ErrorRow> {
    others(g).min_by(|a, b| a.perceived_rmse.total_cmp(&b.perceived_rmse))
}

fn least_flicker(g: &GroupResult) -> f64 {
    others(g).map(|r| r.flicker).fold(f64::INFINITY, f64::min)
}

/// What the horizontal axis shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cost {
    /// Rays of a frame.
    Rays,
    /// GPU time of a frame, ms.
    GpuMs,
}

/// Points that no other point beats in both cost and error, by rising cost.
pub fn pareto(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
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
    let range = |of: &dyn Fn(&(f64, f64)) -> f64| {
        let (low, high) = all.iter().map(of).fold((f64::INFINITY, 0.0f64), |(a, b), v| (a.min(v), b.max(v)));
        if low < high {
            (0.8 * low, 1.25 * high)
        } else {
            (0.1, 10.0)
        }
    };
    let (mut x, y) = (range(&|p| p.0), range(&|p| p.1));
    if cost == Cost::GpuMs {
        x = (x.0.min(0.8 * FRAME_MS), x.1.max(1.25 * FRAME_MS));
    }
    let mut text = String::new();
    draw(&mut text, &rows, &names, &pareto(&all), (x, y), cost, &point).map_err(|e| e.to_string())?;
    Ok(text)
}

type Ranges = ((f64, f64), (f64, f64));

fn draw(
    text: &mut String,
    rows: &[&ErrorRow],
    names: &[&str],
    front: &[(f64, f64)],
    (x, y): Ranges,
    cost: Cost,
    point: &dyn Fn(&ErrorRow) -> (f64, f64),
) -> Result<(), Box<dyn std::error::Error>> {
    // Okabe and Ito's colours, told apart by all kinds of eyes.
    let colors = [
        (0, 114, 178),
        (230, 159, 0),
        (0, 158, 115),
        (213, 94, 0),
        (204, 121, 167),
        (86, 180, 233),
        (0, 0, 0),
    ]
    .map(|(r, g, b)| RGBColor(r, g, b));
    let root = SVGBackend::with_string(text, (960, 540)).into_drawing_area();
    root.fill(&WHITE)?;
    let mut chart = ChartBuilder::on(&root)
        .margin(16)
        .x_label_area_size(40)
        .y_label_area_size(80)
        .build_cartesian_2d((x.0..x.1).log_scale(), (y.0..y.1).log_scale())?;
    let x_name = if cost == Cost::Rays { "rays a frame" } else { "GPU time of a frame, ms" };
    chart.configure_mesh().x_desc(x_name).y_desc("perceived RMSE").light_line_style(WHITE).draw()?;
    chart
        .draw_series(LineSeries::new(front.iter().copied(), RGBColor(190, 190, 190).stroke_width(6)))?
        .label("Pareto front")
        .legend(|(x, y)| PathElement::new([(x, y), (x + 16, y)], RGBColor(190, 190, 190).stroke_width(6)));
    for (i, name) in names.iter().enumerate() {
        let color = colors[i % colors.len()];
        let mut points: Vec<(f64, f64)> =
            rows.iter().filter(|r| r.method == *name).map(|r| point(r)).collect();
        points.sort_by(|a, b| a.0.total_cmp(&b.0));
        chart
            .draw_series(LineSeries::new(points, color.stroke_width(2)).point_size(4))?
            .label(*name)
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 16, y)], color.stroke_width(2)));
    }
    if cost == Cost::GpuMs {
        chart
            .draw_series(LineSeries::new([(FRAME_MS, y.0), (FRAME_MS, y.1)], BLACK.stroke_width(1)))?
            .label("1.056 ms")
            .legend(|(x, y)| PathElement::new([(x, y), (x + 16, y)], BLACK.stroke_width(1)));
    }
    chart.configure_series_labels().background_style(WHITE).border_style(BLACK).draw()?;
    root.present()?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_front_holds_what_nothing_beats() {
        let front = pareto(&[(4.0, 1.0), (1.0, 4.0), (2.0, 4.5), (2.0, 2.0), (3.0, 2.0)]);
        assert_eq!(front, [(1.0, 4.0), (2.0, 2.0), (4.0, 1.0)]);
        assert!(pareto(&[]).is_empty());
    }
}
