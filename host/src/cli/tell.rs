//! Notes and progress of a run to the standard error stream, from a thread of its own: where nobody reads it or the terminal is
//! stopped, that thread waits and the run goes on.

use crate::failure::{Failure, FailureKind};
use crate::telemetry::monitor::RunCounts;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::io::{IsTerminal, Write};
use std::sync::mpsc::{sync_channel, Receiver, RecvTimeoutError, SyncSender};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Notes that wait for a reader; more are dropped.
const WAITING: usize = 256;
/// How long the end of a run waits for what is not yet told.
const END_WITHIN: Duration = Duration::from_millis(200);

enum Word {
    Note(String),
    Tick(RunCounts),
}

/// Says things without ever waiting.
pub(super) struct Teller {
    words: Option<SyncSender<Word>>,
    over: Receiver<()>,
    thread: Option<JoinHandle<()>>,
}

impl Teller {
    /// For a run of `total` frames; 0 for one without end.
    ///
    /// # Errors
    /// No thread can be started (exit code 3).
    pub(super) fn start(total: u64) -> Result<Self, Failure> {
        let (words, heard) = sync_channel(WAITING);
        let (ended, over) = sync_channel::<()>(1);
        let thread = std::thread::Builder::new()
            .name("dpm-tell".into())
            .spawn(move || {
                // Dropped at the end of the thread, however that comes.
                let _ended = ended;
                let mut progress = Progress::new(total);
                let mut last = RunCounts::default();
                while let Ok(word) = heard.recv() {
                    match word {
                        Word::Note(text) => progress.note(&text),
                        Word::Tick(counts) => {
                            last = counts;
                            progress.tick(counts);
                        }
                    }
                }
                progress.finish(last);
            })
            .map_err(|e| Failure::new(FailureKind::Device, format!("cannot start a thread: {e}")))?;
        Ok(Self { words: Some(words), over, thread: Some(thread) })
    }

    /// Says `text`, a line.
    pub(super) fn note(&self, text: &str) {
        if let Some(words) = &self.words {
            let _ = words.try_send(Word::Note(text.to_owned()));
        }
    }

    /// Shows how far the run is.
    pub(super) fn tick(&self, counts: RunCounts) {
        if let Some(words) = &self.words {
            let _ = words.try_send(Word::Tick(counts));
        }
    }

    /// Says the rest, for a fifth of a second at most.
    pub(super) fn finish(&mut self, counts: RunCounts) {
        self.tick(counts);
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
            // What was noted before an error at the start.
            let _ = self.over.recv_timeout(END_WITHIN);
        }
    }
}

enum Progress {
    Bar(ProgressBar),
    Lines { started: Instant, next: Duration, total: u64 },
}

impl Progress {
    fn new(total: u64) -> Self {
        if !std::io::stderr().is_terminal() {
            return Self::Lines { started: Instant::now(), next: Duration::from_secs(1), total };
        }
        let bar = if total > 0 { ProgressBar::new(total) } else { ProgressBar::no_length() };
        bar.set_draw_target(ProgressDrawTarget::stderr());
        let template = match total {
            0 => "{spinner} {pos} frames lit, {per_sec}, {msg}",
            _ => "{bar:40} {pos}/{len} frames lit, {per_sec}, {eta} left, {msg}",
        };
        bar.set_style(ProgressStyle::with_template(template).expect("the template is a constant"));
        Self::Bar(bar)
    }

    fn note(&self, text: &str) {
        match self {
            Self::Bar(bar) => bar.println(text),
            Self::Lines { .. } => {
                let _ = writeln!(std::io::stderr(), "{}", serde_json::json!({ "note": text }));
            }
        }
    }

    fn tick(&mut self, counts: RunCounts) {
        match self {
            Self::Bar(bar) => {
                bar.set_position(counts.frames_lit);
                bar.set_message(format!("{} dropped, {} late", counts.frames_dropped, counts.frames_late));
                bar.tick();
            }
            Self::Lines { started, next, total } => {
                let elapsed = started.elapsed();
                if elapsed >= *next {
                    // After a pause of this thread the next line comes a second later, not a burst of lines at once.
                    *next = elapsed + Duration::from_secs(1);
                    let line = serde_json::json!({
                        "elapsed_s": (elapsed.as_secs_f64() * 1e3).round() / 1e3,
                        "frames_total": total,
                        "frames_lit": counts.frames_lit,
                        "frames_dropped": counts.frames_dropped,
                        "frames_late": counts.frames_late,
                    });
                    let _ = writeln!(std::io::stderr(), "{line}");
                }
            }
        }
    }

    fn finish(mut self, counts: RunCounts) {
        self.tick(counts);
        if let Self::Bar(bar) = self {
            bar.finish_and_clear();
        }
    }
}
