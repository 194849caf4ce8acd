//! The committed table, and the page that shows it.

use crate::table::Table;
use std::path::Path;

/// The table, from the root of the project.
pub const TABLE: &str = "docs/lab/gpu-compile.json";
/// The page that shows it.
pub const PAGE: &str = "docs/lab/GPU.md";
/// The table in the page lies between these lines.
const MARKS: [&str; 2] = ["<!-- table of ./x gpu-compile -->\n", "<!-- end of the table -->\n"];

/// The committed table under this folder; `None` if there is none.
///
/// # Errors
/// The file is none that this program writes.
pub fn committed(root: &Path) -> Result<Option<Table>, String> {
    match std::fs::read_to_string(root.join(TABLE)) {
        Ok(text) => serde_json::from_str(&text).map(Some).map_err(|e| format!("{TABLE}: {e}")),
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => Ok(None),
        Err(e) => Err(format!("{TABLE}: {e}")),
    }
}

/// The page with this table in it; `None` if it has no place for one.
pub fn with_table(page: &str, table: &Table) -> Option<String> {
    let (before, rest) = page.split_once(MARKS[0])?;
    let (_, after) = rest.split_once(MARKS[1])?;
    Some([before, MARKS[0], &table.markdown(), MARKS[1], after].concat())
}

/// Writes the table and its page.
///
/// # Errors
/// A file cannot be read or written, or the page has no place for the table.
pub fn record(root: &Path, table: &Table) -> Result<(), String> {
    let named = |path: &'static str| move |e: std::io::Error| format!("{path}: {e}");
    let page = std::fs::read_to_string(root.join(PAGE)).map_err(named(PAGE))?;
    let page = with_table(&page, table).ok_or_else(|| format!("{PAGE} has no place for the table"))?;
    std::fs::write(root.join(TABLE), table.json()).map_err(named(TABLE))?;
    std::fs::write(root.join(PAGE), page).map_err(named(PAGE))
}
