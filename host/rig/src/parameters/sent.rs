//! What became of a request about the parameters: it is answered when planning uses the change, or the disk has it.

use super::desk::ParameterDesk;
use crate::control::answer::Answer;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

/// How long an answer waits for a frame that uses the change.
const USED_WITHIN: Duration = Duration::from_millis(500);
/// How long an answer waits for the disk.
const KEPT_WITHIN: Duration = Duration::from_millis(1500);

/// The result of the thread that writes files.
pub(super) type Writing = Arc<OnceLock<Result<String, String>>>;

/// A request that was not refused.
#[derive(Clone, Debug)]
pub enum Sent {
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
pub struct Saving(pub(super) Writing);

impl Sent {
    /// The answer to a request that was made `ago`; `None` while a better one is possible.
    pub fn answer(&self, ago: Duration, desk: &ParameterDesk) -> Option<Answer> {
        let answer = |is_done, text| Some(Answer { is_done, text });
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
