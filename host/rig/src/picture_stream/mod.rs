//! Pictures that other programs make, from a pipe or from PipeWire onto the bodies of the rig file
//! (`scene.bodies[].texture`). One thread for each body reads them, beside the frame path.
//!
//! A body is black until the first picture is there, and again when its program has ended: what is old or missing is
//! not shown as if it were new. A program that keeps its pipe open and sends nothing keeps its last picture, as a
//! screen does on which nothing moves.

mod decode;
mod fit;
mod source;

use crate::config::LiveSource;
use crate::rig::Rig;
use crate::telemetry::monitor::RunMonitor;
use decode::Decoder;
use dpm_common::realtime::os::give_way;
use dpm_scene::LivePictures;
pub use source::look_at;
use source::{OpenSource, StreamEnd};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::thread::{sleep, Builder, JoinHandle};
use std::time::{Duration, Instant};

/// Rest before a source is opened again, at first and at most.
const FIRST_REST: Duration = Duration::from_millis(200);
const LONGEST_REST: Duration = Duration::from_secs(5);
/// The longest wait in which nothing is looked at.
const STEP: Duration = Duration::from_millis(50);
/// How long a source that is open may send nothing before the operator is told. It may have nothing new to show; but a
/// node of PipeWire that is gone does not tell of itself.
const SILENT: Duration = Duration::from_secs(3);
/// Shortest time between two notes about one body.
const NOTE_EVERY: Duration = Duration::from_secs(2);

/// The threads that read the pictures of a rig, until this is dropped.
pub struct PictureStreams {
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
    /// What each is called for the operator, and its pictures.
    pictures: Vec<(String, Arc<LivePictures>)>,
}

impl PictureStreams {
    /// Begins to read for every body of the rig that shows another program's pictures. What an operator has to know
    /// goes to the notes of `monitor`.
    pub fn start(rig: &Rig, monitor: &Arc<RunMonitor>) -> Self {
        let stop = Arc::new(AtomicBool::new(false));
        let mut streams = Self { stop: stop.clone(), threads: Vec::new(), pictures: Vec::new() };
        for (body, source, pictures) in rig.live_pictures() {
            let mut reader = StreamReader {
                told_as: format!("{body}: {source}"),
                source: source.clone(),
                pictures: pictures.clone(),
                monitor: monitor.clone(),
                stop: stop.clone(),
                told: None,
                waiting: None,
            };
            streams.pictures.push((reader.told_as.clone(), pictures.clone()));
            match Builder::new().name("dpm-pictures".into()).spawn(move || reader.run()) {
                Ok(thread) => streams.threads.push(thread),
                Err(e) => monitor.note(format!("{body}: its pictures are not read: no thread: {e}")),
            }
        }
        streams
    }

    /// One sentence for every body that has had no picture.
    pub(crate) fn without_pictures(&self) -> impl Iterator<Item = String> + '_ {
        let without = self.pictures.iter().filter(|(_, pictures)| pictures.count() == 0);
        without.map(|(told, _)| format!("{told}: no picture has come, so it was black"))
    }

    /// Waits until every body has its first picture, at most `limit`. Says whether they have.
    pub fn wait_for_first(&self, limit: Duration) -> bool {
        let begin = Instant::now();
        loop {
            let all = self.pictures.iter().all(|(_, pictures)| pictures.count() > 0);
            if all || begin.elapsed() >= limit {
                return all;
            }
            sleep(Duration::from_millis(5));
        }
    }
}

impl Drop for PictureStreams {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            // A panic of a reader has lost its pictures and nothing else.
            let _ = thread.join();
        }
    }
}

/// The thread of one body.
struct StreamReader {
    /// What the operator knows it by.
    told_as: String,
    source: LiveSource,
    pictures: Arc<LivePictures>,
    monitor: Arc<RunMonitor>,
    stop: Arc<AtomicBool>,
    /// The last note, and when.
    told: Option<(String, Instant)>,
    /// The next one, which came too soon after it.
    waiting: Option<String>,
}

impl StreamReader {
    fn run(&mut self) {
        give_way(5);
        let mut rest = FIRST_REST;
        while !self.is_stopped() {
            let mut shown = 0;
            let ended = self.read(&mut shown);
            if self.is_stopped() {
                return;
            }
            if shown > 0 {
                self.pictures.show_black();
                rest = FIRST_REST;
            }
            self.note(format!("{ended}; it is black until pictures come again"));
            self.rest(rest);
            rest = (2 * rest).min(LONGEST_REST);
        }
    }

    /// Opens the source and shows what it sends, until it ends or is no sequence of pictures. Counts in `shown`.
    fn read(&mut self, shown: &mut u64) -> StreamEnd {
        let size = self.pictures.size();
        let mut stream = match OpenSource::open(&self.source, size) {
            Ok(stream) => stream,
            Err(ended) => return ended,
        };
        let mut decoder = Decoder::new(stream.form(), size);
        let mut bytes = vec![0; source::MOST_BYTES];
        let mut silent_since = Some(Instant::now());
        loop {
            if self.is_stopped() {
                return StreamEnd::Stopped;
            }
            // That it is black was told when the program before has ended.
            let is_told = *shown == 0 && (self.told.is_some() || self.waiting.is_some());
            self.tell_waiting();
            if !is_told && silent_since.is_some_and(|since| since.elapsed() >= SILENT) {
                silent_since = None;
                let stays = if *shown == 0 { "it is black" } else { "the last one stays" };
                self.note(format!("no picture has come for {} s; {stays}", SILENT.as_secs()));
            }
            let count = match stream.read(&mut bytes, STEP) {
                Ok(count) => count,
                Err(ended) => return ended,
            };
            let before = *shown;
            let decoded = decoder.push(&bytes[..count], |picture| {
                self.pictures.show(picture);
                *shown += 1;
            });
            if *shown > before {
                silent_since = Some(Instant::now());
            }
            if before == 0 && *shown > 0 {
                let [width, height] = decoder.sent();
                let [columns, rows] = size;
                let fitted = if [width, height] == size {
                    String::new()
                } else {
                    format!(", shown as {columns} x {rows}")
                };
                self.note(format!("pictures of {width} x {height} have begun{fitted}"));
            }
            if let Err(wrong) = decoded {
                return StreamEnd::Wrong(wrong);
            }
        }
    }

    fn is_stopped(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    fn rest(&mut self, for_: Duration) {
        let begin = Instant::now();
        while begin.elapsed() < for_ && !self.is_stopped() {
            self.tell_waiting();
            sleep(STEP.min(for_));
        }
    }

    /// Tells the operator: not the same again and again, and of what changes quickly the last.
    fn note(&mut self, text: String) {
        self.waiting = Some(text);
        self.tell_waiting();
    }

    fn tell_waiting(&mut self) {
        let is_soon = self.told.as_ref().is_some_and(|(_, at)| at.elapsed() < NOTE_EVERY);
        let Some(text) = self.waiting.take_if(|_| !is_soon) else { return };
        if self.told.as_ref().is_none_or(|(last, _)| *last != text) {
            self.monitor.note(format!("{}: {text}", self.told_as));
            self.told = Some((text, Instant::now()));
        }
    }
}

#[cfg(test)]
mod tests;
