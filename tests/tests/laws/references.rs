//! Checks the citations in comments and documents against `docs/REFERENCES.md`: everything cited is listed, and
//! everything listed is cited.

use std::collections::BTreeSet;
use std::fs::read_to_string;
use std::path::{Path, PathBuf};

fn root() -> &'static Path {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/.."))
}

/// All files below a folder with one of the endings.
fn files(folder: &Path, endings: &[&str]) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).unwrap_or_else(|e| panic!("{}: {e}", folder.display())) {
        let path = entry.unwrap().path();
        if path.is_dir() && !path.ends_with("target") {
            found.extend(files(&path, endings));
        } else if path.extension().is_some_and(|e| endings.iter().any(|wanted| e == *wanted)) {
            found.push(path);
        }
    }
    found
}

/// Keys in brackets in a text. Brackets with backslashes, which doc comments use for text that is not a link, always
/// cite; two keys are separated by `;`. Other brackets cite if they contain letters followed by two or more digits.
fn cited(text: &str) -> Vec<String> {
    let mut keys = Vec::new();
    for (at, _) in text.match_indices('[') {
        let Some(inside) = text[at + 1..].split(']').next() else { continue };
        if text[..at].ends_with('\\') {
            let first = |of: &str| of.trim().split([' ', '\\']).next().unwrap_or_default().to_owned();
            keys.extend(inside.split(';').map(first));
        } else {
            let digits = inside.trim_start_matches(|c: char| c.is_ascii_alphabetic());
            let year = digits.len() >= 2 && digits.chars().all(|c| c.is_ascii_digit());
            if year && inside.len() > digits.len() + 1 {
                keys.push(inside.to_owned());
            }
        }
    }
    keys
}

#[test]
fn whatever_is_cited_is_listed_and_whatever_is_listed_is_cited() {
    let list = read_to_string(root().join("docs/REFERENCES.md")).unwrap();
    let first_column = list.lines().filter(|l| l.starts_with("| [")).filter_map(|l| l.split('|').nth(1));
    let listed: BTreeSet<String> = first_column
        .flat_map(|cell| cell.split(','))
        .map(|key| key.trim().trim_matches(['[', ']']).to_owned())
        .collect();
    assert!(listed.len() > 40 && listed.contains("paper") && listed.contains("Heitz18"), "{listed:?}");
    let mut seen = BTreeSet::new();
    let crates = ["device", "hil-mock", "host", "shaders", "tests"].map(|c| root().join(c));
    for path in crates.iter().flat_map(|folder| files(folder, &["rs", "glsl", "comp"])) {
        for (n, line) in read_to_string(&path).unwrap().lines().enumerate() {
            let Some((_, comment)) = line.split_once("//") else { continue };
            for key in cited(comment) {
                assert!(listed.contains(&key), "{}:{}: no [{key}] in REFERENCES.md", path.display(), n + 1);
                seen.insert(key);
            }
        }
    }
    for path in files(&root().join("docs"), &["md"]) {
        if !path.ends_with("REFERENCES.md") {
            seen.extend(cited(&read_to_string(&path).unwrap()));
        }
    }
    let unused: Vec<&String> = listed.difference(&seen).collect();
    assert!(unused.is_empty(), "listed, but cited nowhere: {unused:?}");
}
