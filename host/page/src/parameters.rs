//! A change of the parameters that came over HTTP: given as the control socket gives it, and answered when planning
//! uses it or the disk has it.

use crate::query::part;
use crate::shared::RunView;
use dpm_rig::control::parameters;
use dpm_rig::parameters::{ChangeRefusal, ParameterCommand};
use std::time::{Duration, Instant};

/// How often to look whether a change is in use.
const LOOK: Duration = Duration::from_millis(2);

/// What is answered to a change.
#[derive(Debug, serde::Serialize)]
pub(crate) struct ChangeAnswer {
    /// Planning uses it, or the disk has it.
    pub done: bool,
    /// One line for the operator.
    pub text: String,
}

/// The command that a path below `/api/parameters/` and its query mean; `None` if there is none at this path.
pub(crate) fn asked(word: &str, query: &str) -> Option<Result<ParameterCommand, ChangeRefusal>> {
    match word {
        "undo" => Some(Ok(ParameterCommand::Undo)),
        "save" => Some(Ok(ParameterCommand::Save)),
        "set" => Some(change(query)),
        _ => None,
    }
}

/// `name=NAME&value=NUMBERS`, percent-encoded.
fn change(query: &str) -> Result<ParameterCommand, ChangeRefusal> {
    let wrong = || ChangeRefusal::Syntax("write ?name=exposure&value=1.5".into());
    let part = |key: &str| part(query, key).ok_or_else(wrong);
    ParameterCommand::parse_change(&format!("{}={}", part("name")?, part("value")?))
}

/// Gives `command` and waits for its result, for two seconds at most.
///
/// # Errors
/// It was refused.
pub(crate) async fn give(
    command: &ParameterCommand,
    shared: &RunView,
) -> Result<ChangeAnswer, ChangeRefusal> {
    let begin = Instant::now();
    let sent = parameters::give(&shared.monitor, command, "page")?;
    loop {
        if let Some(answer) = sent.answer(begin.elapsed(), shared.monitor.parameters()) {
            return Ok(ChangeAnswer { done: answer.is_done, text: answer.text });
        }
        tokio::time::sleep(LOOK).await;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::query::MAX_QUERY;

    #[test]
    fn a_query_names_a_parameter_whatever_its_letters() {
        let set = |name: &str, numbers: &[f64]| {
            Ok(ParameterCommand::Set { name: name.into(), numbers: numbers.into() })
        };
        assert_eq!(asked("set", "name=exposure&value=1.5"), Some(set("exposure", &[1.5])));
        assert_eq!(
            asked("set", "value=1%2C-2,3&name=body.my%20h%C3%A4re"),
            Some(set("body.my häre", &[1.0, -2.0, 3.0]))
        );
        assert_eq!(asked("set", "name=gaze&value="), Some(set("gaze", &[])));
        assert_eq!(asked("undo", ""), Some(Ok(ParameterCommand::Undo)));
        assert_eq!(asked("arm", ""), None);
        for bad in [
            "",
            "name=a",
            "value=1",
            "name=%zz&value=1",
            "name=%e4&value=1",
            "name=a&value=x",
            "name=a%2&value=1",
        ] {
            assert!(asked("set", bad).unwrap().is_err(), "{bad}");
        }
        assert!(asked("set", &format!("name={}&value=1", "a".repeat(MAX_QUERY))).unwrap().is_err());
    }
}
