//! Embeds the commit of the Git work tree in the program.
//!
//! This is a macro and not a build script. With a build script that watches Git, Cargo recompiles the whole package
//! at every commit. Files that this macro names as read concern only the crate that uses it, which is the thin
//! program at the end.

use proc_macro::TokenStream;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Digits of a commit that are kept.
const DIGITS: usize = 12;

/// The first twelve digits of the commit that is checked out, followed by `-dirty` if tracked files differ from it
/// and Git is available to tell; `unknown` if the sources are not a Git work tree of their own (an unpacked archive).
/// The argument is the path from the using package's folder to the top of the sources, as a string literal.
#[proc_macro]
pub fn commit(from_package_to_top: TokenStream) -> TokenStream {
    let way = from_package_to_top.to_string();
    let package = std::env::var_os("CARGO_MANIFEST_DIR").map(PathBuf::from).unwrap_or_default();
    let found = FolderCommit::at(&package.join(way.trim_matches('"')));
    // Named as read, so that only the using crate is recompiled when they change.
    let read: String = (found.read.iter().filter_map(|p| p.to_str()))
        .map(|path| format!("const _: &[u8] = include_bytes!({path:?});\n"))
        .collect();
    let text = found.text;
    format!("{{ {read} {text:?} }}").parse().expect("a block of constants and a string literal")
}

/// The commit of a folder.
#[derive(Debug, PartialEq)]
struct FolderCommit {
    text: String,
    /// Files that change when the commit does.
    read: Vec<PathBuf>,
}

impl FolderCommit {
    /// For the work tree whose top is `top`. A work tree further up belongs to another project that happens to
    /// contain the sources.
    fn at(top: &Path) -> Self {
        let unknown = Self { text: "unknown".to_owned(), read: Vec::new() };
        let Ok(top) = top.canonicalize() else { return unknown };
        let Some((commit, read)) = head(&top) else { return unknown };
        let dirty = if is_dirty(&top) { "-dirty" } else { "" };
        Self { text: format!("{commit}{dirty}"), read }
    }
}

/// The commit that is checked out at `top`, and the files that determine it.
fn head(top: &Path) -> Option<(String, Vec<PathBuf>)> {
    let dot = top.join(".git");
    // In a linked work tree and in a submodule, `.git` is a file that names the folder.
    let folder = match std::fs::read_to_string(&dot) {
        Ok(text) => top.join(text.strip_prefix("gitdir:")?.trim()),
        Err(_) => dot,
    };
    let at = folder.join("HEAD");
    let text = std::fs::read_to_string(&at).ok()?;
    let mut read = vec![at];
    let commit = match text.strip_prefix("ref:").map(str::trim) {
        None => text,
        Some(name) => {
            // Branches are stored in the common folder, loose or packed.
            let common = std::fs::read_to_string(folder.join("commondir"))
                .map_or(folder.clone(), |way| folder.join(way.trim()));
            let (loose, packed) = (common.join(name), common.join("packed-refs"));
            if let Ok(commit) = std::fs::read_to_string(&loose) {
                read.push(loose);
                commit
            } else {
                let all = std::fs::read_to_string(&packed).ok()?;
                read.push(packed);
                all.lines().find(|l| l.ends_with(&format!(" {name}")))?.to_owned()
            }
        }
    };
    // It grows with every commit, including the one that makes a packed branch a loose one.
    read.extend(Some(folder.join("logs/HEAD")).filter(|log| log.is_file()));
    let digits: String = commit.chars().take(DIGITS).collect();
    (digits.len() == DIGITS && digits.chars().all(|c| c.is_ascii_hexdigit())).then_some((digits, read))
}

/// True if Git reports that tracked files differ from the commit.
fn is_dirty(top: &Path) -> bool {
    let said = Command::new("git")
        .args(["--no-optional-locks", "status", "--porcelain", "--untracked-files=no"])
        .current_dir(top)
        .output();
    said.is_ok_and(|s| s.status.success() && !s.stdout.is_empty())
}

#[cfg(test)]
mod tests {
    use super::*;

    struct GitFolder(PathBuf);

    impl GitFolder {
        fn new(name: &str) -> Self {
            let path = std::env::temp_dir().join(format!("dpm-commit-{name}-{}", std::process::id()));
            std::fs::create_dir_all(&path).unwrap();
            Self(path.canonicalize().unwrap())
        }

        fn write(&self, name: &str, text: &str) {
            let path = self.0.join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, text).unwrap();
        }

        fn head(&self, place: &str) -> Option<String> {
            head(&self.0.join(place)).map(|found| found.0)
        }
    }

    impl Drop for GitFolder {
        fn drop(&mut self) {
            let _ = std::fs::remove_dir_all(&self.0);
        }
    }

    #[test]
    fn the_commit_is_found_on_a_branch_loose_or_packed_in_a_linked_tree_or_detached() {
        let root = GitFolder::new("heads");
        let [a, b, c] = ["a", "b", "c"].map(|d| d.repeat(40));
        root.write("main/.git/HEAD", "ref: refs/heads/main\n");
        let packed = format!("# pack-refs\n{b} refs/heads/other\n{a} refs/heads/main\n");
        root.write("main/.git/packed-refs", &packed);
        assert_eq!(root.head("main"), Some(a[..12].to_owned()));
        root.write("main/.git/refs/heads/main", &format!("{b}\n"));
        assert_eq!(root.head("main"), Some(b[..12].to_owned()), "a loose one is newer");
        root.write("tree/.git", "gitdir: ../main/.git/worktrees/tree\n");
        root.write("main/.git/worktrees/tree/HEAD", "ref: refs/heads/other\n");
        root.write("main/.git/worktrees/tree/commondir", "../..\n");
        assert_eq!(root.head("tree"), Some(b[..12].to_owned()));
        root.write("main/.git/HEAD", &format!("{c}\n"));
        assert_eq!(root.head("main"), Some(c[..12].to_owned()));
        root.write("main/.git/HEAD", "nonsense");
        assert_eq!(root.head("main"), None);
    }

    #[test]
    fn every_file_that_a_commit_changes_is_watched() {
        let root = GitFolder::new("watched");
        root.write(".git/HEAD", "ref: refs/heads/main\n");
        root.write(".git/packed-refs", &format!("{} refs/heads/main\n", "a".repeat(40)));
        root.write(".git/logs/HEAD", "");
        let watched = |root: &GitFolder| {
            let read = head(&root.0).unwrap().1;
            let names = read.iter().map(|p| p.strip_prefix(&root.0).unwrap().to_str().unwrap().to_owned());
            names.collect::<Vec<_>>()
        };
        assert_eq!(watched(&root), [".git/HEAD", ".git/packed-refs", ".git/logs/HEAD"]);
        root.write(".git/refs/heads/main", &"b".repeat(40));
        assert_eq!(watched(&root), [".git/HEAD", ".git/refs/heads/main", ".git/logs/HEAD"]);
    }

    #[test]
    fn an_archive_unpacked_in_another_projects_tree_has_no_commit() {
        let root = GitFolder::new("archive");
        root.write(".git/HEAD", &"a".repeat(40));
        root.write("unpacked/Cargo.toml", "");
        let unknown = FolderCommit { text: "unknown".into(), read: Vec::new() };
        assert_eq!(FolderCommit::at(&root.0.join("unpacked")), unknown);
        assert_eq!(FolderCommit::at(&root.0.join("nowhere")), unknown);
        // The folder itself has a commit, but it is not a work tree that Git knows, so nothing is said about changes.
        assert_eq!(FolderCommit::at(&root.0).text, "a".repeat(12));
    }

    #[test]
    fn a_changed_tracked_file_marks_the_commit_and_others_do_not() {
        let root = GitFolder::new("dirty");
        let git = |arguments: &[&str]| {
            let identity =
                ["-c", "user.name=n", "-c", "user.email=e@example.org", "-c", "commit.gpgsign=false"];
            let done = Command::new("git").args(identity).args(arguments).current_dir(&root.0).output();
            done.is_ok_and(|d| d.status.success())
        };
        if !git(&["init", "-q"]) {
            // Without Git the check is impossible. The program is built nevertheless, which is the purpose of
            // `unknown`.
            return;
        }
        root.write("tracked", "1");
        assert!(git(&["add", "tracked"]) && git(&["commit", "-q", "-m", "first"]));
        let clean = FolderCommit::at(&root.0).text;
        assert!(clean.len() == 12 && clean.chars().all(|c| c.is_ascii_hexdigit()), "{clean}");
        root.write("untracked", "1");
        assert_eq!(FolderCommit::at(&root.0).text, clean);
        root.write("tracked", "2");
        assert_eq!(FolderCommit::at(&root.0).text, format!("{clean}-dirty"));
        assert!(git(&["commit", "-q", "-a", "-m", "second"]));
        let next = FolderCommit::at(&root.0).text;
        assert!(next.len() == 12 && next != clean, "{next}");
    }
}
