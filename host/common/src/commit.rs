//! The commit that the running program was compiled from: the program tells it at its start, every report is stamped with it.

use std::sync::OnceLock;

static COMMIT: OnceLock<&'static str> = OnceLock::new();

/// Said once by the program, before anything is measured; what is said later is not heard.
pub fn set(commit: &'static str) {
    let _ = COMMIT.set(commit);
}

/// Twelve digits, with `-dirty` after them when the sources differed from the commit; `unknown` for programs that do not tell, and for one
/// that was compiled outside a Git work tree.
pub fn get() -> &'static str {
    COMMIT.get().copied().unwrap_or("unknown")
}
