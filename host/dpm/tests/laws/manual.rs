//! What packages carry beside the program: a man page for every command, and completions for every shell.

use crate::cli_common;
use crate::cli_common::{code, dpm, err, out};
use std::collections::BTreeSet;

/// The commands that the help of `words` lists, without `help`.
fn commands(words: &[&str]) -> Vec<String> {
    let told = out(&dpm(&[words, &["--help"]].concat(), &[]));
    let listed = told.lines().skip_while(|line| *line != "Commands:").skip(1);
    let names = listed.take_while(|line| !line.is_empty()).filter_map(|line| {
        let indent = line.len() - line.trim_start().len();
        (indent == 2).then(|| line.split_whitespace().next().unwrap_or_default().to_owned())
    });
    names.filter(|name| name != "help").collect()
}

/// Every command with those above it: `["calibrate", "wand"]`.
fn all_commands() -> Vec<Vec<String>> {
    let mut all: Vec<Vec<String>> = commands(&[]).into_iter().map(|name| vec![name]).collect();
    let mut next = 0;
    while next < all.len() {
        let above = all[next].clone();
        let words: Vec<&str> = above.iter().map(String::as_str).collect();
        all.extend(commands(&words).into_iter().map(|name| [above.clone(), vec![name]].concat()));
        next += 1;
    }
    assert!(all.len() > 30, "the help was not understood: {all:?}");
    all
}

#[test]
fn every_command_has_a_man_page_and_no_page_has_no_command() {
    let folder = std::env::temp_dir().join(format!("dpm-man-{}", std::process::id()));
    let done = dpm(&["man", folder.to_str().expect("text")], &[]);
    assert_eq!(code(&done), 0, "{}", err(&done));
    let pages: BTreeSet<String> = std::fs::read_dir(&folder)
        .expect("a folder")
        .map(|page| page.expect("an entry").file_name().to_string_lossy().into_owned())
        .collect();
    let named = all_commands().into_iter().map(|words| format!("dpm-{}.1", words.join("-")));
    let wanted: BTreeSet<String> = named.chain(["dpm.1".to_owned(), "dpm-rig.5".to_owned()]).collect();
    assert_eq!(pages, wanted);
    for page in pages.iter().filter(|page| page.ends_with(".1")) {
        let text = std::fs::read_to_string(folder.join(page)).expect("a page");
        let title = page.trim_end_matches(".1");
        assert!(text.contains(&format!(".TH {title} 1")), "{page}: {}", &text[..200.min(text.len())]);
        for section in ["SYNOPSIS", "\"EXIT STATUS\"", "ENVIRONMENT", "FILES", "\"SEE ALSO\""] {
            assert!(text.contains(&format!(".SH {section}")), "{page} has no section {section}");
        }
    }
    std::fs::remove_dir_all(&folder).expect("removed");
    let refused = dpm(&["man", "/dev/null/pages"], &[]);
    assert!(code(&refused) == 2 && err(&refused).contains("/dev/null/pages"), "{}", err(&refused));
}

/// What a shell offers for the last of `words`, by the protocol of fish.
fn offered(words: &[&str]) -> Vec<String> {
    let done = dpm(&[&["--", "dpm"], words].concat(), &[("COMPLETE", "fish")]);
    assert_eq!((code(&done), err(&done)), (0, String::new()), "{words:?}");
    out(&done).lines().map(|line| line.split('\t').next().unwrap_or_default().to_owned()).collect()
}

#[test]
fn every_command_and_flag_is_offered_in_every_packaged_shell() {
    for command in all_commands() {
        let (last, above) = command.split_last().expect("a name");
        let above: Vec<&str> = above.iter().map(String::as_str).collect();
        let offered = offered(&[&above[..], &[""]].concat());
        assert!(offered.contains(last), "{last} is not among {offered:?}");
    }
    assert_eq!(offered(&["run", "--simu"]), ["--simulate"]);
    // Found in use (O11): keys of the rig file and their values were not.
    assert_eq!(offered(&["run", "rig.toml", "--set", "projector.wi"]), ["projector.width="]);
    assert_eq!(offered(&["run", "rig.toml", "--set", "real_time.pace=v"]), ["real_time.pace=virtual"]);
    for shell in ["bash", "zsh", "fish"] {
        let done = dpm(&["completions", shell], &[]);
        assert_eq!((code(&done), err(&done)), (0, String::new()), "{shell}");
        assert!(out(&done).contains("COMPLETE"), "{shell} does not ask the program");
    }
    let unknown = dpm(&["completions", "csh"], &[]);
    assert!(code(&unknown) == 2 && err(&unknown).contains("fish"), "{}", err(&unknown));
}

/// A service that is started again after a mistake in its rig file would go on for ever.
#[test]
fn a_bad_rig_file_ends_with_a_code_after_which_the_service_stays_down() {
    let unit = include_str!("../../../../packaging/dpm.service");
    let value = |key: &str| {
        let line = unit.lines().find_map(|line| line.strip_prefix(key)?.strip_prefix('='));
        line.unwrap_or_else(|| panic!("{key} in the unit"))
    };
    let stays_down: Vec<i32> =
        value("RestartPreventExitStatus").split(' ').map(|code| code.parse().expect("a number")).collect();
    let words: Vec<&str> = value("ExecStart").split(' ').collect();
    let ["/usr/bin/dpm", "run", "/etc/dpm/rig.toml"] = words[..] else { panic!("{words:?}") };
    let folder = std::env::temp_dir().join(format!("dpm-bad-rig-{}", std::process::id()));
    std::fs::create_dir_all(&folder).expect("a folder");
    let rig = folder.join("rig.toml");
    for text in [None, Some("nonsense = 1\n"), Some("[scene]\nfile = \"gone.glb\"\n"), Some("[[[")] {
        if let Some(text) = text {
            std::fs::write(&rig, text).expect("written");
        }
        let output = dpm(&["run", rig.to_str().expect("text")], &[]);
        assert!(stays_down.contains(&code(&output)), "{text:?}: {} {}", code(&output), err(&output));
    }
    // Without a GPU, too.
    let output =
        dpm(&["run", concat!(env!("CARGO_MANIFEST_DIR"), "/../../rigs/mock.toml")], &cli_common::NO_DRIVER);
    assert!(stays_down.contains(&code(&output)), "{} {}", code(&output), err(&output));
    std::fs::remove_dir_all(&folder).expect("removed");
}
