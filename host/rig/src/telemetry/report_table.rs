//! The report as a table for people.

use super::report::{Report, MODELLED};
use crate::plan::dark::DarkCause;
use crate::telemetry::light_state::LightState;
use crate::telemetry::projector::ProjectorReport;
use crate::telemetry::report::Percentiles;
use dpm_render::RayWalker;

impl Report {
    /// The report as one sentence and a table of at most 100 columns.
    pub fn to_table(&self) -> String {
        let mut table = Table::default();
        self.state_row(&mut table);
        self.slot_rows(&mut table);
        self.frame_rows(&mut table);
        self.set_up_rows(&mut table);
        self.registration_rows(&mut table);
        self.latency_rows(&mut table);
        for stage in &self.stages_ms {
            let text = format!("p50 {:.3}  p99 {:.3} ms", stage.ms.p50, stage.ms.p99);
            table.row(&format!("  {}", stage.stage), text);
        }
        table.row("wall time", format!("{:.2} s, {:.1} frames/s", self.wall_s, self.frames_per_wall_second));
        if let Some(projector) = &self.projector {
            projector_rows(projector, &mut table);
        }
        self.light_rows(&mut table);
        let warnings = self.warnings.iter().map(|warning| format!("warning: {warning}\n"));
        let files = self.files.iter().map(|file| format!("see {}\n", file.display()));
        let sentence = format!("{}\n\n", self.sentence());
        std::iter::once(sentence).chain([table.to_text()]).chain(warnings).chain(files).collect()
    }

    /// What a newcomer asks first: did it work, how late was the light, how far off?
    fn sentence(&self) -> String {
        let lit = if self.frames_lit + self.frames_unrecorded == 0 {
            return match self.nothing_lit() {
                Some(_) => "It did not work: nothing was lit.".into(),
                None => "Nothing was lit, and nothing was to be.".into(),
            };
        } else if self.exceeded().is_some() {
            "It did not work throughout: a limit on light was latched".to_owned()
        } else if self.missed_share > 0.05 {
            format!(
                "It worked in part: {:.0} % of the slots had no frame of their own",
                100.0 * self.missed_share
            )
        } else if self.pace == "virtual" {
            format!("It worked: {} frames were lit", self.frames_lit)
        } else {
            format!(
                "It worked: {:.1} % of the slots had a frame of their own",
                100.0 * (1.0 - self.missed_share)
            )
        };
        let late = self.motion_to_light_centre_ms.map(|latency| {
            let modelled = if latency.modelled { " by the model of the stages" } else { "" };
            format!("; the light followed the motion by {:.1} ms{modelled}", latency.spread.p50)
        });
        let off = self.registration_error_px.map(|error| {
            let mm = self.pixel_mm.map_or(String::new(), |mm| format!("{} mm, ", few_digits(error.p99 * mm)));
            format!("; 99 of 100 points lay within {mm}{} px of their places", few_digits(error.p99))
        });
        [Some(lit), late, off].into_iter().flatten().collect::<String>() + "."
    }

    fn state_row(&self, table: &mut Table) {
        let time = |word: &&'static str| Some((*word, *self.light_s.get(&LightState::name_of(word))?));
        let times = LightState::WORDS.iter().filter_map(time).filter(|(_, s)| *s >= 0.001);
        let times: Vec<String> = times.map(|(word, s)| format!("{word} {s:.3} s")).collect();
        if !times.is_empty() {
            table.row("light", times.join(", "));
        }
    }

    fn slot_rows(&self, table: &mut Table) {
        if self.slots > 0 || self.ordered_dark.values().any(|n| *n > 0) {
            table.row("missed slots", self.missed_line());
            for (name, slots) in self.missed_by_cause.iter().filter(|(_, n)| **n > 0) {
                let told = if name == "standstill" { ", the machine itself stood still" } else { "" };
                table.row(&format!("  {name}"), format!("{slots} slots{told}"));
            }
        }
        for (reason, slots) in self.ordered_dark.iter().filter(|(_, n)| **n > 0) {
            let text = format!("{slots} more slots, neither missed nor lit");
            table.row(&format!("ordered: {reason}"), text);
        }
    }

    fn frame_rows(&self, table: &mut Table) {
        let some = |n: u64, text: String| if n > 0 { text } else { String::new() };
        let dark = some(self.frames_dark, format!("{} dark on every body, ", self.frames_dark));
        let unrecorded = some(self.frames_unrecorded, format!(", {} not recorded", self.frames_unrecorded));
        let withheld = some(self.frames_withheld, format!(", {} not wanted", self.frames_withheld));
        table.row(
            "frames",
            format!(
                "{} lit, {dark}{} dropped, {} late, {} repeated{withheld}{unrecorded}",
                self.frames_lit, self.frames_dropped, self.frames_late, self.frames_repeated
            ),
        );
        if let Some(t) = &self.tracker {
            let lost = [
                ("lost", t.lost),
                ("reordered", t.reordered),
                ("doubled", t.doubled),
                ("unlabelled", t.unlabelled),
                ("impossible", t.impossible),
                ("contradictory", t.contradictory),
            ];
            let lost = lost.into_iter().filter(|(_, n)| *n > 0).map(|(what, n)| format!(", {n} {what}"));
            table.row("samples", format!("{} used{}", t.used, lost.collect::<String>()));
        }
        if let Some(g) = &self.gaze {
            let share = 100.0 * g.unsure_share.unwrap_or(0.0);
            let text = format!(
                "{}: {} of {} samples used, {share:.1} % unsure, {} reconnects; {} frames by it, {} without",
                g.kind, g.used, g.samples, g.reconnects, g.frames_measured, g.frames_without
            );
            table.row("gaze", text);
        }
        if let Some(beat) = &self.beat {
            table.row("beat", beat.told(self.frame_rate_hz));
        }
        for body in self.dark_by_body.iter().filter(|b| b.total() > 0) {
            let causes = DarkCause::ALL.iter().filter(|c| body.of(**c) > 0);
            let causes: Vec<String> =
                causes.map(|c| format!("{} {}", c.name().replace('_', " "), body.of(*c))).collect();
            let text = format!("{} frames: {}", body.total(), causes.join(", "));
            table.row(&format!("  dark: {}", body.body), text);
        }
        if let Some(eyes) = &self.eyes {
            let (heads, cut) = (eyes.heads.join(", "), eyes.frames_cut);
            let lost: u64 = eyes.losses.iter().sum();
            let dark = some(lost, format!(", {} frames dark because one was lost", eyes.frames_dark));
            let (mirrors, m) = (eyes.most_mirrors, eyes.greatest_radius_m);
            let text = format!("{heads}: {cut} frames cut, by {mirrors} mirrors and {m:.2} m at most{dark}");
            table.row("eye guard", text);
        }
    }

    fn set_up_rows(&self, table: &mut Table) {
        let [width, height] = self.raster;
        let (planes, hz, pace) = (self.planes, self.frame_rate_hz, self.pace);
        table.row("raster", format!("{width} x {height}, {planes} planes, {hz:.3} frames/s ({pace} pace)"));
        let software = if self.software_gpu { " (software)" } else { "" };
        let rays = match self.ray_walk.map(|walk| walk.by) {
            Some(RayWalker::Host) => "; threads of the host walked the rays",
            _ => "",
        };
        table.row("GPU", format!("{}{software}{rays}", self.gpu));
        table.row("method", self.method.to_string());
        if let Some(choice) = &self.method_choice {
            table.row("method auto", choice.clone());
        }
        if let Some(used) = &self.calibration {
            table.row("calibration", used.clone());
        }
    }

    fn registration_rows(&self, table: &mut Table) {
        if let Some(error) = self.registration_error_px {
            let how = if self.prediction { "predicted" } else { "prediction off" };
            let at = self.registration_error_at.map_or(String::new(), |at| format!(", at {at}"));
            let drawn = if self.tracks_sent() { ", before tracks" } else { "" };
            table.row("registration error", format!("{} px ({how}{at}{drawn})", percentiles(error)));
        }
        if let Some(error) = self.registration_error_unpredicted_px {
            table.row("  without prediction", format!("{} px", percentiles(error)));
        }
        if let Some(offset) = self.followed_offset_px {
            let light = match self.followed_light.filter(|_| self.tracks_sent()) {
                None => "",
                Some("as lit") => " (with tracks)",
                Some(_) => " (before tracks; only the projector knows by how much they move light)",
            };
            table.row("  seen by a following eye", format!("{} px{light}", percentiles(offset)));
        }
        if let Some(smear) = self.followed_smear_px {
            table.row("    smeared by", format!("{} px (root mean square)", percentiles(smear)));
        }
    }

    /// True if the projector was told of tracks.
    fn tracks_sent(&self) -> bool {
        self.projector.as_ref().is_some_and(|projector| projector.tracks_sent > 0)
    }

    fn latency_rows(&self, table: &mut Table) {
        let latencies = [
            ("motion to first photon", self.motion_to_first_photon_ms),
            ("motion to centre of light", self.motion_to_light_centre_ms),
            ("motion to last photon", self.motion_to_last_photon_ms),
            ("lateness of light", self.lateness_ms),
        ];
        for (name, latency) in latencies {
            let Some(latency) = latency else { continue };
            let min = if latency.min < 0.0 { format!("min {:.3}  ", latency.min) } else { String::new() };
            let modelled = if latency.modelled { " (modelled)" } else { "" };
            table.row(name, format!("{min}{} ms{modelled}", percentiles(latency.spread)));
        }
        if latencies.iter().any(|(_, l)| l.is_some_and(|l| l.modelled)) {
            table.row("  modelled", MODELLED.into());
        }
    }

    fn light_rows(&self, table: &mut Table) {
        if let (Some(rays), Some(walked)) = (self.mrays_per_s, self.walked_mrays_per_s) {
            let proven = rays - walked;
            table.row("rays", format!("{walked:.2} million/s walked, {proven:.2} million/s proven to miss"));
        }
        if let Some(scale) = self.scale {
            let line =
                format!("mean {:.2}, least {:.2} of the raster's columns and rows", scale.mean, scale.least);
            table.row("traced scale", line);
        }
        if self.clipped > 0.0 {
            let advice = "raise projector.max_intensity or lower render.exposure";
            table.row("clipped", format!("{:.2} % of the light: {advice}", 100.0 * self.clipped));
        }
        if self.nan_pixels > 0 {
            table.row("not a number", format!("{} pixels became black", self.nan_pixels));
        }
        if !self.light_hash.is_empty() {
            table.row("hash of the light", self.light_hash.clone());
        }
    }

    /// The headline: raw missed slots first, what of them is the machine's second.
    fn missed_line(&self) -> String {
        let excused = if self.excused_by_standstill > 0 {
            format!("; {} of them while the machine itself stood still", self.excused_by_standstill)
        } else {
            String::new()
        };
        let unknowable = if self.pace == "virtual" { "; at virtual pace no frame can be late" } else { "" };
        format!(
            "{} of {} ({:.3} %){excused}{unknowable}",
            self.missed_slots,
            self.slots,
            100.0 * self.missed_share
        )
    }
}

fn projector_rows(p: &ProjectorReport, table: &mut Table) {
    let [raw, coded, kept] = p.planes;
    table.row("projector", format!("{}, {:.1} MB sent", p.name, p.sent_mb));
    if let Some(bound) = p.clock_bound_ns {
        table.row("  its clock", format!("known to {:.1} us", bound as f64 * 1e-3));
    }
    if coded + kept > 0 {
        table.row("  planes", format!("{raw} raw, {coded} coded, {kept} unchanged and not sent"));
    }
    if p.tracks_sent > 0 {
        let [moved, clamped, stale] = p.planes_by_tracks;
        let text = format!(
            "{} sent; planes: {moved} moved, {clamped} not as far as they should, {stale} without a valid track",
            p.tracks_sent
        );
        table.row("  tracks", text);
    }
    if let Some(d) = p.device {
        let text = format!(
            "{} lit, {} repeated, {} blank slots; dropped {} incomplete, {} too late, {} superseded, {} refused",
            d.lit, d.repeated, d.blank, d.incomplete, d.too_late, d.superseded, d.refused
        );
        table.row("  its report", text);
    }
    if p.sessions > 1 || p.rearmed > 0 {
        let times = p.sessions.saturating_sub(1);
        table.row("  came back", format!("{times} times, armed again {} times after a fault", p.rearmed));
    }
}

/// Two digits that say something.
fn few_digits(x: f64) -> String {
    let decimals = if x > 0.0 { (1.0 - x.log10().floor()).clamp(0.0, 4.0) } else { 1.0 };
    format!("{x:.*}", decimals as usize)
}

/// Rows of a name and a text.
#[derive(Default)]
struct Table(Vec<(String, String)>);

impl Table {
    fn row(&mut self, name: &str, text: String) {
        self.0.push((name.to_owned(), text));
    }

    /// One line a row, the texts below each other.
    fn to_text(&self) -> String {
        let width = self.0.iter().map(|(name, _)| name.chars().count()).max().unwrap_or(0);
        self.0.iter().map(|(name, text)| format!("{name:width$}  {text}\n")).collect()
    }
}

fn percentiles(s: Percentiles) -> String {
    format!("p50 {:.3}  p99 {:.3}  p99.9 {:.3}  max {:.3}", s.p50, s.p99, s.p999, s.max)
}
