//! Writes notes and progress of a run to the standard error stream, from a thread of its own. If nobody reads the
//! stream or the terminal is stopped, that thread waits and the run continues.

use crossbeam::channel::{bounded, Receiver, RecvTimeoutError, Sender};
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::telemetry::light_state::LightState;
use dpm_rig::telemetry::monitor::{ProjectorHealth, RunCounts};
use dpm_rig::telemetry::notes::Notes;
#[cfg(feature = "terminal")]
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::collections::VecDeque;
#[cfg(feature = "terminal")]
use std::io::IsTerminal;
use std::io::Write;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Notes that wait for a reader; more are dropped.
const WAITING: usize = 256;
/// How long the end of a run waits for notes that are not written yet.
const END_WITHIN: Duration = Duration::from_millis(200);

/// How often progress is shown.
pub(super) const SHOWN_EVERY: Duration = Duration::from_millis(50);

enum Word {
    Note(String),
    Tick(LightState, RunCounts),
}

/// Writes notes without ever waiting.
pub(super) struct Teller {
    words: Option<Sender<Word>>,
    /// The last notes, for those who look later.
    kept: Arc<Notes>,
    over: Receiver<()>,
    thread: Option<JoinHandle<()>>,
}

impl Teller {
    /// For a run of `total` frames, or else `seconds` of time; 0 means without an end. A quiet one writes notes only.
    /// Without a terminal, progress is written once in `every`, if at all.
    ///
    /// # Errors
    /// No thread can be started (exit code 3).
    pub(super) fn start(
        total: u64,
        seconds: f64,
        every: Option<Duration>,
        is_quiet: bool,
    ) -> Result<Self, Failure> {
        let (words, heard) = bounded(WAITING);
        let (ended, over) = bounded::<()>(1);
        let thread = std::thread::Builder::new()
            .name("dpm-tell".into())
            .spawn(move || {
                // Dropped at the end of the thread, whatever ends it.
                let _ended = ended;
                let mut progress = Progress::new(total, seconds, every);
                let mut last = (LightState::NeverArmed(ProjectorHealth::Connecting), RunCounts::default());
                while let Ok(word) = heard.recv() {
                    match word {
                        Word::Note(text) => progress.note(&text),
                        Word::Tick(..) if is_quiet => {}
                        Word::Tick(light, counts) => {
                            last = (light, counts);
                            progress.tick(light, counts);
                        }
                    }
                }
                if !is_quiet {
                    progress.finish(last.0, last.1);
                }
            })
            .map_err(|e| Failure::new(FailureKind::Device, format!("cannot start a thread: {e}")))?;
        Ok(Self { words: Some(words), kept: Arc::default(), over, thread: Some(thread) })
    }

    /// The notes so far.
    pub(super) fn kept(&self) -> Arc<Notes> {
        self.kept.clone()
    }

    /// Writes `text` as one line, and keeps it for those who look later.
    pub(super) fn note(&self, text: &str) {
        self.kept.add(text);
        self.whisper(text);
    }

    /// Writes `text` as one line and keeps it nowhere.
    pub(super) fn whisper(&self, text: &str) {
        if let Some(words) = &self.words {
            let _ = words.try_send(Word::Note(text.to_owned()));
        }
    }

    /// Shows the progress of the run.
    pub(super) fn tick(&self, light: LightState, counts: RunCounts) {
        if let Some(words) = &self.words {
            let _ = words.try_send(Word::Tick(light, counts));
        }
    }

    /// Writes the rest, for at most a fifth of a second.
    pub(super) fn finish(&mut self, light: LightState, counts: RunCounts) {
        self.tick(light, counts);
        self.words = None;
        let told = self.over.recv_timeout(END_WITHIN) == Err(RecvTimeoutError::Disconnected);
        if let Some(thread) = self.thread.take().filter(|_| told) {
            let _ = thread.join();
        }
    }
}

impl Drop for Teller {
    fn drop(&mut self) {
        if self.thread.is_some() {
            self.words = None;
            // Writes what was noted before an error at the start.
            let _ = self.over.recv_timeout(END_WITHIN);
        }
    }
}

/// Frames per second over the last seconds.
struct RecentRate {
    /// The count starts at the oldest one.
    seen: VecDeque<(Duration, u64)>,
}

/// Time over which the rate is averaged.
const RATE_OVER: Duration = Duration::from_secs(2);
/// Maximum number of readings: one per [`SHOWN_EVERY`], and one more.
const RATE_READINGS: usize = (RATE_OVER.as_millis() / SHOWN_EVERY.as_millis()) as usize + 1;

impl RecentRate {
    /// Records the count at `elapsed`; returns the rate per second.
    fn at(&mut self, elapsed: Duration, count: u64) -> f64 {
        while self.seen.len() >= RATE_READINGS || self.seen.len() > 1 && self.seen[1].0 + RATE_OVER <= elapsed
        {
            self.seen.pop_front();
        }
        self.seen.push_back((elapsed, count));
        let (since, before) = self.seen[0];
        let seconds = elapsed.saturating_sub(since).as_secs_f64();
        if seconds > 0.0 {
            count.saturating_sub(before) as f64 / seconds
        } else {
            0.0
        }
    }
}

/// The text of the bar: the state of the light first, then the progress of the run, in columns that do not move.
fn told(light: LightState, counts: &RunCounts, total: u64, rate: f64) -> String {
    let of = if total > 0 { format!("/{total}") } else { String::new() };
    let lit = format!("{}{of}", counts.frames_lit);
    let mut text = format!("{:<13} {lit:>9} lit {rate:>7.1}/s", light.word());
    // A picture that does not move has no meaningful rate and no remaining time.
    let moves =
        matches!(light, LightState::Lit { is_held: false } | LightState::PartlyLit { is_held: false });
    if moves || matches!(light, LightState::NeverArmed(ProjectorHealth::Connecting)) {
        let left = total.saturating_sub(counts.frames_done());
        if rate > 0.0 && left > 0 {
            text += &format!(" {:>6.0} s left", left as f64 / rate);
        }
    } else {
        text = format!("{:<13} {lit:>9} lit, no new picture", light.word());
    }
    text += &format!(", {} slots missed, {} frames dropped", counts.slots_missed, counts.frames_dropped);
    if counts.frames_dark > 0 {
        text += &format!(", {} DARK on every body", counts.frames_dark);
    }
    text
}

enum TellView {
    #[cfg(feature = "terminal")]
    Bar(ProgressBar),
    Lines {
        next: Duration,
        every: Option<Duration>,
    },
}

/// The bar of a run on a terminal.
#[cfg(feature = "terminal")]
fn bar(total: u64, seconds: f64) -> Option<ProgressBar> {
    if !std::io::stderr().is_terminal() {
        return None;
    }
    let timed = total == 0 && seconds > 0.0;
    let bar = match total {
        0 if timed => ProgressBar::new((seconds * 1e3) as u64),
        0 => ProgressBar::no_length(),
        _ => ProgressBar::new(total),
    };
    bar.set_draw_target(ProgressDrawTarget::stderr());
    let template = if total == 0 && !timed { "{wide_msg}" } else { "{bar:20} {wide_msg}" };
    bar.set_style(ProgressStyle::with_template(template).expect("the template is a constant"));
    Some(bar)
}

struct Progress {
    started: Instant,
    /// Number of frames of the run; 0 for no end, or one in time.
    total: u64,
    /// Seconds of the run; 0 for no end, or one in frames.
    seconds: f64,
    /// When the first frame was planned; an end in time counts from there.
    began: Option<Instant>,
    rate: RecentRate,
    shown: TellView,
}

impl Progress {
    /// For `total` frames, or else `seconds` of time; 0 means without an end.
    fn new(total: u64, seconds: f64, every: Option<Duration>) -> Self {
        let lines = TellView::Lines { next: every.unwrap_or_default(), every };
        #[cfg(feature = "terminal")]
        let shown = bar(total, seconds).map_or(lines, TellView::Bar);
        #[cfg(not(feature = "terminal"))]
        let shown = lines;
        let rate = RecentRate { seen: VecDeque::new() };
        Self { started: Instant::now(), total, seconds, began: None, rate, shown }
    }

    /// The progress of the run: frames, or milliseconds if its end is in time.
    fn position(&mut self, counts: &RunCounts) -> u64 {
        if self.total == 0 && self.seconds > 0.0 {
            if counts.frames_planned > 0 {
                self.began.get_or_insert_with(Instant::now);
            }
            return self.began.map_or(0, |began| began.elapsed().as_millis() as u64);
        }
        counts.frames_done()
    }

    fn note(&self, text: &str) {
        match &self.shown {
            #[cfg(feature = "terminal")]
            TellView::Bar(bar) => bar.println(text),
            TellView::Lines { .. } => {
                let _ = writeln!(std::io::stderr(), "{}", serde_json::json!({ "note": text }));
            }
        }
    }

    fn tick(&mut self, light: LightState, counts: RunCounts) {
        let elapsed = self.started.elapsed();
        let rate = self.rate.at(elapsed, counts.frames_lit);
        #[cfg(feature = "terminal")]
        let done = self.position(&counts);
        match &mut self.shown {
            #[cfg(feature = "terminal")]
            TellView::Bar(bar) => {
                bar.set_position(done);
                bar.set_message(told(light, &counts, self.total, rate));
                bar.tick();
            }
            TellView::Lines { next, every } => {
                if let Some(every) = every.filter(|_| elapsed >= *next) {
                    // After a pause of this thread the next line follows at its usual distance, not a burst of lines
                    // at once.
                    *next = elapsed + every;
                    let line = serde_json::json!({
                        "elapsed_s": (elapsed.as_secs_f64() * 1e3).round() / 1e3,
                        "light": LightState::name_of(light.word()),
                        "frames_total": self.total,
                        "seconds_total": self.seconds,
                        "frames_lit": counts.frames_lit,
                        "frames_lit_per_s": (rate * 10.0).round() / 10.0,
                        "frames_dark": counts.frames_dark,
                        "frames_dropped": counts.frames_dropped,
                        "frames_withheld": counts.frames_withheld,
                        "frames_unrecorded": counts.frames_unrecorded,
                        "frames_late": counts.frames_late,
                        "slots": counts.slots,
                        "slots_missed": counts.slots_missed,
                    });
                    let _ = writeln!(std::io::stderr(), "{line}");
                }
            }
        }
    }

    fn finish(mut self, light: LightState, counts: RunCounts) {
        self.tick(light, counts);
        #[cfg(feature = "terminal")]
        if let TellView::Bar(bar) = self.shown {
            bar.finish_and_clear();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_rig::order::Order;
    use dpm_rig::telemetry::light_state::{Darkness, Stall};

    /// Found in use, O13: "17.5505/s" was followed by "17.476/s", and during BLACK the line looked normal.
    #[test]
    fn the_line_says_how_the_light_is_and_its_figures_stay_in_place() {
        use LightState::{Dark, DarkByOrder, Lit, NeverArmed, PartlyLit, Stalled};
        let counts = |lit| RunCounts { frames_lit: lit, slots_missed: 3, ..RunCounts::default() };
        let up = Lit { is_held: false };
        let at = |lit, rate| told(up, &counts(lit), 0, rate).find(" lit").unwrap();
        assert_eq!(at(7, 947.0), at(1_234_567, 17.476));
        let rate_ends = |rate| told(up, &counts(7), 0, rate).find("/s").unwrap();
        assert_eq!(rate_ends(17.5505), rate_ends(947.0));
        assert!(told(up, &counts(146), 0, 17.5505).contains("17.6/s"));
        assert!(told(PartlyLit { is_held: false }, &counts(100), 1000, 10.0).contains("90 s left"));
        for light in [
            Lit { is_held: true },
            DarkByOrder(Order::Black),
            Dark(Darkness::Projector(ProjectorHealth::Lost)),
            Dark(Darkness::Over),
            Stalled(Stall::NothingSent),
        ] {
            let text = told(light, &counts(146), 1000, 16.3);
            assert!(text.starts_with(light.word()) && text.contains("no new picture"), "{text}");
            assert!(!text.contains("/s") && !text.contains("left"), "{text}");
        }
        let begins = NeverArmed(ProjectorHealth::Connecting);
        assert!(told(begins, &counts(0), 0, 0.0).starts_with("NEVER ARMED"));
        let dark = RunCounts { frames_dark: 9, ..counts(0) };
        assert!(told(Dark(Darkness::Bodies), &dark, 0, 0.0).contains("9 DARK on every body"));
    }

    #[test]
    fn the_rate_is_that_of_the_last_seconds() {
        let mut rate = RecentRate { seen: VecDeque::new() };
        assert_eq!(rate.at(Duration::ZERO, 0), 0.0);
        let mut frames = 0;
        let mut last = 0.0;
        for tick in 1..=200 {
            frames += if tick <= 100 { 50 } else { 1 };
            last = rate.at(SHOWN_EVERY * tick, frames);
            if tick == 100 {
                assert!((last - 1000.0).abs() < 1e-6, "{last}");
            }
        }
        assert!((last - 20.0).abs() < 1e-6, "{last}");
        assert!(rate.seen.len() <= RATE_READINGS);
    }
}
