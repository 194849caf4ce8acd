//! Reads OpenCV's YAML.
//!
//! `%YAML:1.0` is not valid YAML, and tools misspell and rename the entries. So this is a small tolerant reader of
//! exactly the parts that calibrations use: matrices, lists, numbers and words by name at any depth. Files without the
//! tag `!!opencv-matrix` (ROS writes such) are read as well.

use super::entries::{number, Entries, Parts};
use super::StorageError;

/// A matrix of which some parts have been met.
struct Open<'a> {
    name: &'a str,
    indent: usize,
    tagged: bool,
    parts: Parts<'a>,
}

/// One `key: value`, at its column.
struct Item<'a> {
    indent: usize,
    key: &'a str,
    value: &'a str,
}

/// The item of a line; `None` for comments, markers and bare values.
fn item(line: &str) -> Option<Item<'_>> {
    let mut rest = line.trim_start();
    while let Some(after) = rest.strip_prefix("- ") {
        rest = after.trim_start();
    }
    let indent = line.len() - rest.len();
    let rest = rest.trim_end();
    if rest.starts_with("!!opencv-matrix") {
        return Some(Item { indent, key: "", value: rest });
    }
    let (key, value) = rest.split_once(':')?;
    let key = key.trim().trim_matches('"');
    let is_key = !key.is_empty() && !key.contains(['[', ']', '{', '}', ',', '#', '%']);
    is_key.then(|| Item { indent, key, value: value.trim() })
}

/// Length of the list at the start of `text`, with its brackets; `None` if it does not end.
fn list_length(text: &str) -> Option<usize> {
    let mut depth = 0usize;
    for (i, c) in text.char_indices() {
        match c {
            '[' => depth += 1,
            ']' => depth = depth.saturating_sub(1),
            _ => continue,
        }
        if depth == 0 {
            return Some(i + 1);
        }
    }
    None
}

/// Rows of a list of numbers or of a list of lists of numbers; `None` if there is anything else in it.
fn rows(list: &str) -> Option<Vec<Vec<f64>>> {
    let inner = list.strip_prefix('[')?.strip_suffix(']')?;
    let numbers = |text: &str| -> Option<Vec<f64>> {
        let words = text.split(|c: char| c.is_whitespace() || c == ',').filter(|w| !w.is_empty());
        words.map(number).collect()
    };
    if !inner.contains('[') {
        return Some(vec![numbers(inner)?]);
    }
    let parts = inner.split('[').skip(1);
    parts.map(|row| numbers(row.trim_end().trim_end_matches(',').trim_end().strip_suffix(']')?)).collect()
}

/// Everything in a text.
pub(super) fn entries(text: &str) -> Result<Entries, StorageError> {
    let mut found = Entries::default();
    let mut open: Option<Open> = None;
    let mut at = 0;
    while at < text.len() {
        let line_end = text[at..].find('\n').map_or(text.len(), |i| at + i + 1);
        let line = &text[at..line_end];
        let start = at;
        at = line_end;
        let Some(item) = item(line) else { continue };
        if let Some(o) = open.take_if(|o| item.indent <= o.indent) {
            unfinished(&o)?;
        }
        if item.key == "data" {
            if let Some(o) = open.take_if(|o| o.tagged || o.parts.rows.is_some()) {
                let error = |what: &str| StorageError::matrix(o.name, what);
                // The list may start on the next line.
                let colon = start + line.find(':').map_or(0, |i| i + 1);
                let list = text[colon..].trim_start();
                let list = list.strip_prefix('[').ok_or_else(|| error("data does not start with ["))?;
                let end = list.find(']').ok_or_else(|| error("data does not end with ]"))?;
                found.add_matrix(o.name, o.parts.matrix(o.name, &list[..end])?);
                at = at.max(text.len() - list.len() + end + 1);
                continue;
            }
        }
        if let Some(o) = &mut open {
            match item.key {
                "rows" => o.parts.rows = Some(item.value),
                "cols" => o.parts.columns = Some(item.value),
                "dt" => o.parts.kind = Some(item.value),
                _ => {}
            }
        }
        if item.value.is_empty() || item.value.starts_with("!!opencv-matrix") {
            if let Some(o) = open.take() {
                unfinished(&o)?;
            }
            found.add_name(item.key);
            let tagged = !item.value.is_empty();
            open = Some(Open { name: item.key, indent: item.indent, tagged, parts: Parts::default() });
        } else if item.value.starts_with('[') {
            let from = start + line.find('[').unwrap_or(0);
            found.add_name(item.key);
            let length = list_length(&text[from..])
                .ok_or_else(|| StorageError::matrix(item.key, "the list does not end with ]"))?;
            if let Some(rows) = rows(&text[from..from + length]) {
                found.add_list(item.key, rows);
            }
            at = at.max(from + length);
        } else {
            found.add_word(item.key, item.value.split(" #").next().unwrap_or("").trim_end());
        }
    }
    open.iter().try_for_each(unfinished)?;
    Ok(found)
}

/// A matrix that ends before its numbers.
fn unfinished(open: &Open) -> Result<(), StorageError> {
    if open.tagged {
        return Err(StorageError::matrix(open.name, "no data"));
    }
    Ok(())
}
