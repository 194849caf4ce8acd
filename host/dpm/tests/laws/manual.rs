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
    let wanted: BTreeSet<String> = named.chain(["dpm.1".to_owned()]).collect();
    assert_eq!(pages, wanted);
    for page in &pages {
        let text = std::fs::read_to_string(folder.join(page)).expect("a page");
        let title = page.trim_end_matches(".1");
        assert!(text.contains(&format!(".TH {title} 1")), "{page}: {}", &text[..200.min(text.len())]);
        assert!(text.contains(".SH SYNOPSIS"), "{page}");
    }
    std::fs::remove_dir_all(&folder).expect("removed");
    let refused = dpm(&["man", "/dev/null/pages"], &[]);
    assert!(code(&refused) == 2 && err(&refused).contains("/dev/null/pages"), "{}", err(&refused));
}

#[test]
fn completions_name_every_command_in_every_packaged_shell() {
    let all = all_commands();
    for shell in ["bash", "zsh", "fish"] {
        let done = dpm(&["completions", shell], &[]);
        assert_eq!((code(&done), err(&done)), (0, String::new()), "{shell}");
        let script = out(&done);
        let is_part = |c: char| c.is_ascii_alphanumeric() || c == '-';
        let words: BTreeSet<&str> = script.split(|c| !is_part(c)).collect();
        for name in all.iter().filter_map(|command| command.last()) {
            assert!(words.contains(name.as_str()), "{shell} does not know {name}");
        }
        // Fish writes flags without their dashes.
        let has_flags = words.iter().any(|word| word.trim_start_matches('-') == "simulate");
        assert!(has_flags, "{shell} does not know flags");
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
