//! Commands about the parameters, from whichever side they come: what becomes of each, and when it is answered: when
//! planning uses the change, or the disk has it.

use super::answer::OrderOutcome;
use crate::parameters::desk::{AllShown, ParameterDesk, ParameterView, ToKeep};
use crate::parameters::{told_of, ChangeRefusal, ParameterCommand};
use crate::telemetry::monitor::RunMonitor;
use dpm_common::unix::monotonic_ns;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

/// How long an answer waits for a frame that uses the change.
const USED_WITHIN: Duration = Duration::from_millis(500);
/// How long an answer waits for the disk.
const KEPT_WITHIN: Duration = Duration::from_millis(1500);

/// The result of the thread that writes files.
type Writing = Arc<OnceLock<Result<String, String>>>;

/// A request that was not refused.
#[derive(Clone, Debug)]
pub enum ChangeResult {
    /// It is answered by this text.
    Told(String),
    /// Planning uses it from this version on.
    Changed {
        /// The version.
        version: u64,
        /// What has changed.
        told: String,
    },
    /// The files are being written.
    Saving(Saving),
}

/// Files that are being written.
#[derive(Clone, Debug)]
pub struct Saving(Writing);

impl ChangeResult {
    /// The answer to a request that was made `ago`; `None` while a better one is possible.
    pub fn answer(&self, ago: Duration, desk: &ParameterDesk) -> Option<OrderOutcome> {
        let answer = |is_done, text| Some(OrderOutcome { is_done, text });
        match self {
            Self::Told(text) => answer(true, text.clone()),
            Self::Changed { version, told } => match desk.used_since(*version) {
                Some(frame) => answer(true, format!("ok: {told}, from frame {frame} on")),
                None if ago < USED_WITHIN => None,
                None => answer(false, format!("not yet: {told}, but no frame has been planned since")),
            },
            Self::Saving(Saving(writing)) => match writing.get() {
                Some(Ok(told)) => answer(true, format!("ok: {told}")),
                Some(Err(why)) => answer(false, format!("NOT saved: {why}")),
                None if ago < KEPT_WITHIN => None,
                None => answer(false, "not saved yet: the disk is slow; a note will tell".into()),
            },
        }
    }
}

/// Does what `command` says to the run of `monitor`. `by` says who asks, for the notes.
///
/// # Errors
/// The command was refused, and nothing has changed.
pub fn give(
    monitor: &Arc<RunMonitor>,
    command: &ParameterCommand,
    by: &str,
) -> Result<ChangeResult, ChangeRefusal> {
    let desk = monitor.parameters();
    match command {
        ParameterCommand::Set { name, numbers } => {
            let (version, told, is_step) = desk.set(name, numbers, monotonic_ns())?;
            if is_step {
                monitor.note(format!("{by}: {told}"));
            }
            Ok(ChangeResult::Changed { version, told })
        }
        ParameterCommand::Undo => {
            let (version, told) = desk.undo()?;
            monitor.note(format!("{by}: undo: {told}"));
            Ok(ChangeResult::Changed { version, told })
        }
        ParameterCommand::Save => save(monitor, by),
        ParameterCommand::List => {
            let shown = desk.shown().ok_or(ChangeRefusal::NoRun)?;
            Ok(ChangeResult::Told(list(&shown)))
        }
    }
}

/// Starts a thread that writes the files: neither a client nor an order waits for the disk.
fn save(monitor: &Arc<RunMonitor>, by: &str) -> Result<ChangeResult, ChangeRefusal> {
    let desk = monitor.parameters();
    let not = |why: &str| ChangeRefusal::NotSaved(why.to_owned());
    let (rig, values, keep) = desk.to_keep()?;
    if desk.saver().is_none() {
        return Err(not("this run knows no rig file to write to"));
    }
    if keep == ToKeep::default() {
        return Ok(ChangeResult::Told("ok: nothing has changed since the files were read or written".into()));
    }
    if !desk.begin_saving() {
        return Err(not("the files are being written; save again in a moment"));
    }
    let writing: Writing = Arc::default();
    let (result, by) = (writing.clone(), by.to_owned());
    let started = std::thread::Builder::new().name("dpm-save".into()).spawn({
        let monitor = monitor.clone();
        move || {
            let desk = monitor.parameters();
            let done = desk.saver().map_or(Err("no rig file".into()), |saver| saver(&rig, &keep));
            if done.is_ok() {
                desk.kept(values);
            }
            monitor.note(match &done {
                Ok(told) => format!("{by}: saved: {told}"),
                Err(why) => format!("{by}: NOT saved: {why}"),
            });
            desk.end_saving();
            let _ = result.set(done);
        }
    });
    if let Err(e) = started {
        desk.end_saving();
        return Err(not(&format!("no thread can be started: {e}")));
    }
    Ok(ChangeResult::Saving(Saving(writing)))
}

/// All values, a line each.
fn list(shown: &AllShown) -> String {
    let line = |p: &ParameterView| {
        let range = match p.fields.as_slice() {
            [one] => format!("{} to {} {}", one.low, one.high, one.unit).trim_end().to_owned(),
            all => all.iter().map(|f| format!("{} {}", f.label, f.unit)).collect::<Vec<_>>().join(", "),
        };
        let began = if p.numbers == p.began_with {
            String::new()
        } else {
            format!("; began with {}", told_of(&p.began_with))
        };
        format!("{} = {}  ({range}{began}): {}", p.name, told_of(&p.numbers), p.told)
    };
    let mut text: String = shown.all.iter().map(|p| line(p) + "\n").collect();
    text += if shown.is_unsaved { "not saved" } else { "as the files say" };
    text
}

#[cfg(test)]
mod tests;
