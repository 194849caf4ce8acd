//! Checks the documents against the tree: every file that they link or name exists, every name that they mention
//! occurs in the sources, and no line of prose is longer than 120 characters.

use std::collections::BTreeSet;
use std::fs::read_to_string;
use std::path::{Path, PathBuf};

/// Maximum length of a line of prose, characters.
const MAX_CHARS: usize = 120;

fn root() -> &'static Path {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/.."))
}

/// Folders that documents may not name, because they are generated or belong to others.
const SKIPPED: [&str; 3] = ["target", "out", ".git"];

/// Files and folders below `folder`, as paths from the root, separated by `/`.
fn tree(folder: &Path, found: &mut BTreeSet<String>) {
    for entry in std::fs::read_dir(folder).unwrap_or_else(|e| panic!("{}: {e}", folder.display())) {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        if SKIPPED.contains(&name.as_str()) {
            continue;
        }
        let from_root = path.strip_prefix(root()).expect("below the root");
        found.insert(from_root.to_string_lossy().replace('\\', "/"));
        if path.is_dir() {
            tree(&path, found);
        }
    }
}

/// The hand-written documents, as paths from the root. A test generates `docs/CONFIG.md`.
fn documents(tree: &BTreeSet<String>) -> Vec<&str> {
    let is_document = |path: &&str| {
        let is_ours = path.starts_with("docs/") || !path.contains('/');
        is_ours && path.ends_with(".md") && *path != "THIRD-PARTY.md"
    };
    tree.iter().map(String::as_str).filter(is_document).collect()
}

/// The kind of a line of a document.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    Prose,
    Table,
    Code,
}

/// The lines of a document with their kinds. Indented lines are code unless they belong to a list.
fn lines(text: &str) -> Vec<(Kind, &str)> {
    let (mut is_fenced, mut in_list) = (false, false);
    let mut all = Vec::new();
    for line in text.lines() {
        let words = line.trim_start();
        let is_fence = words.starts_with("```");
        let indent = line.len() - words.len();
        let number = words.trim_start_matches(|c: char| c.is_ascii_digit());
        let is_item = words.starts_with("- ")
            || words.starts_with("* ")
            || words.len() > number.len() && number.starts_with(". ");
        if !words.is_empty() && !is_fenced {
            in_list = is_item || in_list && indent > 0;
        }
        let kind = if is_fence || is_fenced || indent >= 4 && !in_list {
            Kind::Code
        } else if words.starts_with('|') {
            Kind::Table
        } else {
            Kind::Prose
        };
        is_fenced ^= is_fence;
        all.push((kind, line));
    }
    all
}

/// Numbers of the lines of prose that are too long. Lines without a blank cannot be broken.
fn long_lines(text: &str) -> Vec<usize> {
    let is_long = |line: &str| line.chars().count() > MAX_CHARS && line.trim().contains(' ');
    let all = lines(text).into_iter().enumerate();
    all.filter(|(_, (kind, line))| *kind == Kind::Prose && is_long(line)).map(|(n, _)| n + 1).collect()
}

/// The text without its code blocks, and the code spans in it.
fn without_code(text: &str) -> (String, Vec<String>) {
    let kept: Vec<&str> = lines(text).into_iter().filter(|(k, _)| *k != Kind::Code).map(|(_, l)| l).collect();
    let kept = kept.join("\n");
    let parts = kept.split('`').map(|part| part.split_whitespace().collect::<Vec<_>>().join(" "));
    let spans = parts.skip(1).step_by(2).collect();
    (kept, spans)
}

/// Targets of links and pictures, except external ones: a path, and the heading after `#`. Either may be empty.
fn links(text: &str) -> Vec<(String, String)> {
    let (text, _) = without_code(text);
    let targets = text.split("](").skip(1).filter_map(|rest| rest.split(')').next());
    let paths = targets.filter(|t| !t.contains("://") && !t.starts_with("mailto:"));
    let parts = paths.map(|t| t.split_once('#').unwrap_or((t, "")));
    parts.map(|(path, heading)| (path.to_owned(), heading.to_owned())).collect()
}

/// The headings of a document as link targets: lower-case letters, digits, and `-` for blanks.
fn headings(text: &str) -> BTreeSet<String> {
    let of_line = |line: &str| {
        let kept =
            line.trim_start_matches('#').trim().chars().filter(|c| c.is_alphanumeric() || " -_".contains(*c));
        kept.flat_map(char::to_lowercase).map(|c| if c == ' ' { '-' } else { c }).collect()
    };
    let prose = lines(text).into_iter().filter(|(kind, line)| *kind == Kind::Prose && line.starts_with('#'));
    prose.map(|(_, line)| of_line(line)).collect()
}

/// Code spans that name a file or a folder of the tree: whatever has the ending of a source file, and whatever begins
/// with a folder of the root.
fn named_paths(text: &str, tree: &BTreeSet<String>) -> Vec<String> {
    let (_, spans) = without_code(text);
    let is_path = |span: &str| span.chars().all(|c| c.is_ascii_alphanumeric() || "_./-".contains(c));
    let is_source =
        |span: &str| [".rs", ".comp", ".glsl"].iter().any(|e| span.len() > e.len() && span.ends_with(e));
    let begins_at_root = |span: &str| {
        let first = span.split('/').next().unwrap_or_default();
        span.contains('/') && tree.contains(first)
    };
    spans.into_iter().filter(|s| is_path(s) && (is_source(s) || begins_at_root(s))).collect()
}

/// True if a path from the root, or the end of such a path, exists in the tree.
fn is_there(path: &str, tree: &BTreeSet<String>) -> bool {
    let path = path.trim_start_matches("./").trim_end_matches('/');
    let end = format!("/{path}");
    tree.contains(path) || tree.iter().any(|t| t.ends_with(&end))
}

/// A relative link from a file in `folder`, as a path from the root; `None` if it leads out of the tree.
fn resolved(folder: &str, link: &str) -> Option<String> {
    let mut parts: Vec<&str> = folder.split('/').filter(|p| !p.is_empty()).collect();
    for part in link.split('/') {
        match part {
            "" | "." => {}
            ".." => {
                parts.pop()?;
            }
            name => parts.push(name),
        }
    }
    Some(parts.join("/"))
}

/// Types and functions among the code spans: `Type`, `Type::function`.
fn names(text: &str) -> BTreeSet<String> {
    let is_word = |w: &str| w.chars().all(|c| c.is_ascii_alphanumeric() || c == '_') && !w.is_empty();
    let is_type = |w: &str| is_word(w) && w.starts_with(char::is_uppercase) && w.contains(char::is_lowercase);
    let (_, spans) = without_code(text);
    let paths = spans.iter().map(|s| s.split("::").collect::<Vec<_>>());
    let of_types = paths.filter(|p| p.len() <= 2 && is_type(p[0]) && p.iter().all(|w| is_word(w)));
    of_types.flatten().map(str::to_owned).collect()
}

fn whole_tree() -> BTreeSet<String> {
    let mut all = BTreeSet::new();
    tree(root(), &mut all);
    assert!(all.contains("README.md") && all.contains("tests/tests/laws/documents.rs"), "not the tree");
    all
}

fn text_of(path: &str) -> String {
    let path: PathBuf = root().join(path);
    read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

#[test]
fn every_link_leads_to_a_file_of_the_tree_and_to_a_heading_in_it() {
    let tree = whole_tree();
    let (mut broken, mut count) = (Vec::new(), 0);
    for document in documents(&tree) {
        let folder = document.rsplit_once('/').map_or("", |(folder, _)| folder);
        for (link, heading) in links(&text_of(document)) {
            count += 1;
            let path = if link.is_empty() { Some(document.to_owned()) } else { resolved(folder, &link) };
            let path = path.filter(|path| tree.contains(path));
            let is_whole = |path: &str| heading.is_empty() || headings(&text_of(path)).contains(&heading);
            if !path.is_some_and(|path| is_whole(&path)) {
                broken.push(format!("{document}: {link}#{heading}"));
            }
        }
    }
    assert!(count > 100, "{count} links: the documents were not understood");
    assert!(broken.is_empty(), "links to nowhere:\n{}", broken.join("\n"));
}

#[test]
fn every_source_file_that_a_document_names_exists() {
    let tree = whole_tree();
    let (mut missing, mut count) = (Vec::new(), 0);
    for document in documents(&tree) {
        for path in named_paths(&text_of(document), &tree) {
            count += 1;
            if !is_there(&path, &tree) {
                missing.push(format!("{document}: {path}"));
            }
        }
    }
    assert!(count > 200, "{count} paths: the documents were not understood");
    assert!(missing.is_empty(), "named, but not there:\n{}", missing.join("\n"));
}

/// The page on the architecture once showed types that existed nowhere.
#[test]
fn every_type_and_function_on_the_way_of_a_frame_stands_in_the_sources() {
    let tree = whole_tree();
    let sources: Vec<String> = tree.iter().filter(|p| p.ends_with(".rs")).map(|p| text_of(p)).collect();
    let is_part = |c: char| c.is_ascii_alphanumeric() || c == '_';
    let words: BTreeSet<&str> = sources.iter().flat_map(|s| s.split(|c| !is_part(c))).collect();
    for document in ["docs/FRAME.md", "docs/ARCHITECTURE.md"] {
        for name in names(&text_of(document)) {
            assert!(words.contains(name.as_str()), "{document} names {name}, which no source has");
        }
    }
    assert!(names(&text_of("docs/FRAME.md")).len() > 30, "the page was not understood");
}

#[test]
fn no_line_of_prose_is_longer_than_a_review_can_bear() {
    let tree = whole_tree();
    let mut long = Vec::new();
    for document in documents(&tree) {
        // It is generated from the declarations of the keys.
        if document != "docs/CONFIG.md" {
            long.extend(long_lines(&text_of(document)).into_iter().map(|n| format!("{document}:{n}")));
        }
    }
    assert!(long.is_empty(), "longer than {MAX_CHARS} characters:\n{}", long.join("\n"));
}

/// The tests above can fail.
#[test]
fn broken_links_missing_files_and_long_lines_are_seen() {
    let tree: BTreeSet<String> =
        ["docs", "docs/a.md", "host", "host/src", "host/src/run.rs"].map(String::from).into();
    let text = "See [a](a.md#part), [b](b.md), [web](https://example.org/x.md) and `host/src/run.rs`,\n`run.rs`, \
                `src/gone.rs`, `host/gone/`, `RunOptions::new`, `a.toml`.\n\n    [code](nowhere.md) `no.rs`\n\n```\n`no.rs`\n```\n";
    assert_eq!(links(text), [("a.md", "part"), ("b.md", "")].map(|(path, part)| (path.into(), part.into())));
    assert_eq!(
        headings("# A `b`, c\n\n```\n# no\n```\n## Über 2-3\n"),
        ["a-b-c", "über-2-3"].map(String::from).into()
    );
    assert_eq!(resolved("docs", "a.md").as_deref(), Some("docs/a.md"));
    assert_eq!(resolved("docs/lab", "../../x.rs").as_deref(), Some("x.rs"));
    assert_eq!(resolved("docs", "../../x.rs"), None, "out of the tree");
    let paths = named_paths(text, &tree);
    assert_eq!(paths, ["host/src/run.rs", "run.rs", "src/gone.rs", "host/gone/"]);
    let there: Vec<bool> = paths.iter().map(|p| is_there(p, &tree)).collect();
    assert_eq!(there, [true, true, false, false]);
    assert!(!is_there("un.rs", &tree), "whole names only");
    assert_eq!(names(text), ["RunOptions", "new"].map(String::from).into());

    let long = "word ".repeat(25);
    assert_eq!(long.len(), 125);
    let url = "x".repeat(130);
    let page = format!(
        "{long}\n| {long} |\n    {long}\n\n- item\n    {long}\n```\n{long}\n```\n{url}\n\n    {long}\n"
    );
    assert_eq!(long_lines(&page), [1, 6], "prose, and prose of lists");
    let page = format!("text\n\n    {long}\n{long}\n");
    assert_eq!(long_lines(&page), [4], "code after prose is code");
    let umlauts = "ä".repeat(60) + " " + &"ä".repeat(59);
    assert!(long_lines(&umlauts).is_empty(), "characters, not bytes");
}
