//! The calibration of a rig as a guided page: its steps, and the commands that do them.

use crate::query::part;
use dpm_rig::calibration_steps::{Steps, SENSOR};
use std::fmt;
use std::sync::Arc;

/// Longest answer and longest path of a port that are taken, bytes.
const LONGEST: usize = 200;

/// What the guided page of a calibration shows and does.
pub trait Guide: Send + Sync + fmt::Debug {
    /// The steps as they are now. It may read files.
    fn steps(&self) -> Steps;

    /// Device files that may be a light sensor.
    fn ports(&self) -> Vec<String>;

    /// What is being done; `None` where the page shows commands and gives none.
    fn session(&self) -> Option<StepSession>;

    /// Does what the operator asks for. It may read and write files.
    ///
    /// # Errors
    /// Why it was not done, in words for the operator.
    fn act(&self, act: Act) -> Result<(), String>;
}

/// What the operator asks for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Act {
    /// To do a step.
    Start {
        /// Its name.
        step: String,
        /// The index of its way.
        way: usize,
        /// The port of the light sensor, if the way needs one.
        sensor: Option<String>,
        /// The gain of the light sensor.
        gain: u8,
    },
    /// To answer a question of the step by a line.
    Answer(String),
    /// To end the step.
    Stop,
    /// To take what was measured into the rig's calibration file.
    Keep,
    /// To throw it away.
    Discard,
}

/// A step that is being done, or that was done last.
#[derive(Clone, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct StepSession {
    /// The step's name; `None` before the first one.
    pub step: Option<String>,
    /// The index of its way.
    pub way: usize,
    /// It goes on.
    pub is_running: bool,
    /// How it ended, one sentence.
    pub ended: Option<String>,
    /// The end of what it wrote.
    pub output: String,
    /// What it measured and nobody has decided upon: heading of the step, how good it was and how good it is.
    pub proposed: Vec<(String, String, String)>,
}

/// What is told of a calibration.
#[derive(Debug, serde::Serialize)]
pub(crate) struct CalibrationView {
    /// A rig runs, so its projector is taken.
    runs: bool,
    #[serde(flatten)]
    steps: Steps,
    /// Device files that may be a light sensor.
    ports: Vec<String>,
    session: Option<StepSession>,
}

/// What there is to tell, where a rig `runs` or not; `None` if reading it failed in a way that nobody foresaw.
pub(crate) async fn told(guide: &Arc<dyn Guide>, runs: bool) -> Option<CalibrationView> {
    let guide = guide.clone();
    let tell = move || CalibrationView {
        runs,
        steps: guide.steps(),
        ports: guide.ports(),
        session: guide.session(),
    };
    // The disk may be slow, and an order must not wait for it.
    tokio::task::spawn_blocking(tell).await.ok()
}

/// Does what a path below `/api/calibration/` and its query ask for; `None` if there is nothing at this path.
pub(crate) async fn act(word: &str, query: &str, guide: &Arc<dyn Guide>) -> Option<Result<(), String>> {
    let act = match asked(word, query)? {
        Ok(act) => act,
        Err(why) => return Some(Err(why)),
    };
    let guide = guide.clone();
    let done = tokio::task::spawn_blocking(move || guide.act(act)).await;
    Some(done.unwrap_or_else(|_| Err("the program failed; look at its terminal".into())))
}

fn asked(word: &str, query: &str) -> Option<Result<Act, String>> {
    Some(match word {
        "start" => start(query),
        "answer" => match part(query, "line").filter(|line| is_line(line)) {
            Some(line) => Ok(Act::Answer(line)),
            None => Err(format!("write ?line= and at most {LONGEST} letters")),
        },
        "stop" => Ok(Act::Stop),
        "keep" => Ok(Act::Keep),
        "discard" => Ok(Act::Discard),
        _ => return None,
    })
}

fn start(query: &str) -> Result<Act, String> {
    let wrong = "write ?step=NAME&way=0, and &sensor=PORT&gain=0 for a step with the light sensor";
    let step = part(query, "step").ok_or(wrong)?;
    let way = part(query, "way").and_then(|n| n.parse().ok()).ok_or(wrong)?;
    let gain = match part(query, "gain") {
        Some(gain) => gain.parse().map_err(|_| "the gain is a whole number from 0 to 255")?,
        None => 0,
    };
    let sensor = part(query, "sensor").filter(|port| !port.is_empty());
    // The port becomes an argument of a command, which must not be taken for a flag.
    let is_port = |port: &String| is_line(port) && port.starts_with('/') && port != SENSOR;
    if sensor.as_ref().is_some_and(|port| !is_port(port)) {
        return Err("the port of the light sensor is the path of a device file, such as /dev/ttyACM0".into());
    }
    Ok(Act::Start { step, way, sensor, gain })
}

fn is_line(text: &str) -> bool {
    text.len() <= LONGEST && !text.chars().any(char::is_control)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_known_acts_with_sound_arguments_are_asked_for() {
        let start = |sensor: Option<&str>, gain| {
            Ok(Act::Start { step: "body:my hare".into(), way: 1, sensor: sensor.map(str::to_owned), gain })
        };
        assert_eq!(asked("start", "step=body%3Amy%20hare&way=1"), Some(start(None, 0)));
        let query = "step=body%3Amy%20hare&way=1&sensor=%2Fdev%2FttyACM0&gain=6";
        assert_eq!(asked("start", query), Some(start(Some("/dev/ttyACM0"), 6)));
        assert_eq!(asked("answer", "line="), Some(Ok(Act::Answer(String::new()))));
        assert_eq!(asked("answer", "line=d"), Some(Ok(Act::Answer("d".into()))));
        for (word, act) in [("stop", Act::Stop), ("keep", Act::Keep), ("discard", Act::Discard)] {
            assert_eq!(asked(word, ""), Some(Ok(act)));
        }
        assert_eq!(asked("arm", ""), None);
        let long = format!("line={}", "x".repeat(LONGEST + 1));
        for (word, bad) in [
            ("start", "way=0"),
            ("start", "step=wand"),
            ("start", "step=wand&way=-1"),
            ("start", "step=wand&way=0&gain=256"),
            ("start", "step=wand&way=0&sensor=--file"),
            ("start", "step=wand&way=0&sensor=/dev/tty%0A"),
            ("answer", ""),
            ("answer", "line=a%0Ab"),
            ("answer", long.as_str()),
        ] {
            assert!(asked(word, bad).unwrap().is_err(), "{word} {bad}");
        }
    }
}
