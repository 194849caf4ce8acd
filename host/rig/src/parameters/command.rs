//! What an operator asks for, as one line: `set NAME=NUMBER,NUMBER`, `undo`, `save` and `list`.

use super::ChangeRefusal;

/// Longest line, bytes.
pub const MAX_LINE: usize = 512;
/// Most numbers in a line.
const MAX_NUMBERS: usize = 16;

/// One request about the parameters.
#[derive(Clone, Debug, PartialEq)]
pub enum ParameterCommand {
    /// Changes a parameter.
    Set {
        /// Its name.
        name: String,
        /// Its numbers; none where the rig file's value is meant.
        numbers: Vec<f64>,
    },
    /// Takes the last change back.
    Undo,
    /// Keeps the values for the next run.
    Save,
    /// Tells all values.
    List,
}

impl ParameterCommand {
    /// Reads a line without its line feed; `None` if its first word is no command about parameters.
    ///
    /// # Errors
    /// `set` without a name, or with something that is no number.
    pub fn parse(line: &str) -> Result<Option<Self>, ChangeRefusal> {
        let change = match line.trim() {
            "undo" => return Ok(Some(Self::Undo)),
            "save" => return Ok(Some(Self::Save)),
            "list" => return Ok(Some(Self::List)),
            other => other.strip_prefix("set "),
        };
        change.map(Self::parse_change).transpose()
    }

    /// Reads `NAME=NUMBER,NUMBER`.
    ///
    /// # Errors
    /// There is no `=`, or something that is no number.
    pub fn parse_change(text: &str) -> Result<Self, ChangeRefusal> {
        let Some((name, numbers)) = text.rsplit_once('=') else {
            return Err(ChangeRefusal::Syntax("write NAME=VALUE, for example exposure=1.5".into()));
        };
        let name = name.trim().to_owned();
        Ok(Self::Set { numbers: numbers_of(&name, numbers)?, name })
    }

    /// The line that [`ParameterCommand::parse`] reads as this.
    pub fn line(&self) -> String {
        match self {
            Self::Set { name, numbers } => {
                let numbers: Vec<String> = numbers.iter().map(f64::to_string).collect();
                format!("set {name}={}", numbers.join(","))
            }
            Self::Undo => "undo".into(),
            Self::Save => "save".into(),
            Self::List => "list".into(),
        }
    }
}

/// Numbers that commas separate; none in an empty text.
fn numbers_of(name: &str, text: &str) -> Result<Vec<f64>, ChangeRefusal> {
    let (text, name) = (text.trim(), name.chars().take(80).collect::<String>());
    if text.is_empty() {
        return Ok(Vec::new());
    }
    let parts: Vec<&str> = text.split(',').take(MAX_NUMBERS + 1).collect();
    if parts.len() > MAX_NUMBERS {
        return Err(ChangeRefusal::Syntax(format!("{name}: more than {MAX_NUMBERS} numbers")));
    }
    let number = |part: &&str| {
        let short: String = part.trim().chars().take(40).collect();
        part.trim()
            .parse::<f64>()
            .map_err(|_| ChangeRefusal::Syntax(format!("{name}: {short:?} is no number")))
    };
    parts.iter().map(number).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_and_its_command_are_one_thing() {
        for command in [
            ParameterCommand::Set { name: "exposure".into(), numbers: vec![1.5] },
            ParameterCommand::Set {
                name: "body.my = hare".into(),
                numbers: vec![1.0, -0.25, 0.0, 1e-9, 5.0, 6.0],
            },
            ParameterCommand::Set { name: "gaze".into(), numbers: vec![] },
            ParameterCommand::Undo,
            ParameterCommand::Save,
            ParameterCommand::List,
        ] {
            assert_eq!(ParameterCommand::parse(&command.line()), Ok(Some(command)));
        }
        assert_eq!(ParameterCommand::parse("black"), Ok(None));
        assert_eq!(ParameterCommand::parse("undone"), Ok(None));
    }

    #[test]
    fn what_is_no_number_is_refused_by_name() {
        for (line, word) in
            [("set exposure", "NAME=VALUE"), ("set exposure=x", "exposure: \"x\""), ("set a=1,,2", "a: \"\"")]
        {
            let told = ParameterCommand::parse(line).unwrap_err().to_string();
            assert!(told.contains(word), "{line}: {told}");
        }
        assert!(ParameterCommand::parse(&format!("set a={}", "1,".repeat(100))).is_err());
    }
}
