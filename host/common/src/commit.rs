//! The commit that the running program was compiled from. The program sets it at its start, and every report is stamped
//! with it.

use std::sync::OnceLock;

static COMMIT: OnceLock<&'static str> = OnceLock::new();

/// Sets the commit, once, before anything is measured; later calls have no effect.
pub fn set(commit: &'static str) {
    let _ = COMMIT.set(commit);
}

/// Twelve digits, with `-dirty` after them if the sources differed from the commit; `unknown` for programs that do not
/// set it, and for one that was compiled outside a Git work tree.
pub fn get() -> &'static str {
    COMMIT.get().copied().unwrap_or("unknown")
}
