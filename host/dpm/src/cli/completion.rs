//! What a shell offers while a command is typed: keys of the rig file with their values, parameters of a running rig, and what
//! the command line itself declares.

use clap_complete::engine::{ArgValueCompleter, CompletionCandidate};
use clap_complete::env::Shells;
use clap_complete::CompleteEnv;
use dpm_rig::config::RigConfig;
use dpm_rig::control::change::change;
use dpm_rig::parameters::ParameterCommand;
use std::ffi::OsStr;
use std::io;

/// The variable by which a shell asks this program what may follow.
const ASKED_BY: &str = "COMPLETE";

/// Answers a shell that asks what may follow, and ends the process; returns at once where none asks.
pub(super) fn answer() {
    CompleteEnv::with_factory(|| with_offers(super::command())).var(ASKED_BY).complete();
}

/// Flags whose values only a rig can offer, by the names of their values.
fn with_offers(command: clap::Command) -> clap::Command {
    let named = |arg: &clap::Arg, name: &str| arg.get_value_names().is_some_and(|names| names == [name]);
    command
        .mut_args(move |arg| match () {
            () if named(&arg, "KEY=VALUE") => arg.add(ArgValueCompleter::new(rig_keys)),
            () if named(&arg, "NAME=VALUE") => arg.add(ArgValueCompleter::new(parameters)),
            () => arg,
        })
        .mut_subcommands(with_offers)
}

/// Shells that can ask.
pub(super) fn shells() -> Vec<&'static str> {
    Shells::builtins().names().collect()
}

/// The script by which `shell`, one of [`shells`], asks the program `dpm` of its path.
///
/// # Errors
/// There is no such shell.
pub(super) fn script(shell: &str) -> io::Result<Vec<u8>> {
    let known = Shells::builtins();
    let asks = known.completer(shell).ok_or_else(|| io::Error::other(format!("no shell {shell}")))?;
    let mut script = Vec::new();
    asks.write_registration(ASKED_BY, "dpm", "dpm", "dpm", &mut script)?;
    Ok(script)
}

/// Keys of the rig file that begin as `typed` does, or, behind the sign =, the values that the key takes.
fn rig_keys(typed: &OsStr) -> Vec<CompletionCandidate> {
    let Some(typed) = typed.to_str() else { return Vec::new() };
    offers(typed)
        .into_iter()
        .map(|(text, help)| CompletionCandidate::new(text).help(Some(help.into())))
        .collect()
}

/// What is offered, and what it does.
fn offers(typed: &str) -> Vec<(String, String)> {
    // The first entry of a list stands for all.
    let named = RigConfig::key_docs().into_iter().map(|key| (key.key.replace("[]", ".0"), key));
    let (key, value) = typed.split_once('=').map_or((typed, None), |(key, value)| (key, Some(value)));
    let mut offers: Vec<(String, String)> = match value {
        None => named
            .filter(|(name, _)| name.starts_with(key))
            .map(|(name, key)| (format!("{name}="), first_sentence(&key.doc)))
            .collect(),
        Some(value) => named
            .filter(|(name, _)| name == key)
            .flat_map(|(name, key)| {
                words(&key.kind).map(move |word| (name.clone(), word)).collect::<Vec<_>>()
            })
            .filter(|(_, word)| word.starts_with(value.trim_start_matches('"')))
            .map(|(name, word)| (format!("{name}={word}"), String::new()))
            .collect(),
    };
    offers.sort();
    offers.dedup_by(|a, b| a.0 == b.0);
    offers
}

/// The words that a key takes, from its type: `"binary" | "equal"`, or true and false.
fn words(kind: &str) -> impl Iterator<Item = String> + '_ {
    let quoted = kind.split('|').map(str::trim).filter_map(|word| word.strip_prefix('"')?.strip_suffix('"'));
    let truth = ["true", "false"].into_iter().filter(move |_| kind.starts_with("true"));
    quoted.chain(truth).map(str::to_owned)
}

fn first_sentence(text: &str) -> String {
    text.split_inclusive(". ").next().unwrap_or(text).trim().to_owned()
}

/// Parameters of the running rig that begin as `typed` does.
fn parameters(typed: &OsStr) -> Vec<CompletionCandidate> {
    let Some(typed) = typed.to_str() else { return Vec::new() };
    let told = change(None, &ParameterCommand::List).unwrap_or_default();
    named_in(&told).filter(|name| name.starts_with(typed)).map(CompletionCandidate::new).collect()
}

/// The names in a rig's list of its parameters, each with the sign =.
fn named_in(told: &str) -> impl Iterator<Item = String> + '_ {
    told.lines().filter_map(|line| line.split_once('=')).map(|(name, _)| format!("{}=", name.trim()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn texts(typed: &str) -> Vec<String> {
        offers(typed).into_iter().map(|offer| offer.0).collect()
    }

    /// Found in use (O11): neither keys nor parameters were offered.
    #[test]
    fn keys_and_their_values_are_offered() {
        assert_eq!(texts("projector.wi"), ["projector.width="]);
        assert_eq!(texts("real_time.pace="), ["real_time.pace=real", "real_time.pace=virtual"]);
        assert_eq!(texts("real_time.pace=v"), ["real_time.pace=virtual"]);
        assert!(texts("scene.bodies").contains(&"scene.bodies.0.name=".to_owned()));
        assert!(texts("projector.width=").is_empty() && texts("nothing.like.it").is_empty());
        // Every key that is offered is one.
        assert!(texts("").len() > 100);
    }

    #[test]
    fn every_shell_has_a_script_that_asks_the_program() {
        for shell in shells() {
            let script = String::from_utf8(script(shell).unwrap()).unwrap();
            assert!(script.contains(ASKED_BY) && script.contains("dpm"), "{shell}: {script}");
        }
        assert!(script("vi").is_err());
    }
}
