//! Reads OpenCV's YAML.
//!
//! `%YAML:1.0` is not valid YAML, and tools misspell and rename the entries, so no library of YAML reads what calibration
//! programs write. This is a small tolerant reader of exactly the parts that calibrations use: matrices, lists, numbers and
//! words by name in nested sections. Files without the tag `!!opencv-matrix` (ROS writes such), lists of lists line by line
//! (kalibr and PyYAML) and maps in braces are read as well.

use super::entries::{inner, number, Entries, FileEntry, MatrixParts};
use super::{json, StorageError};

/// Deepest nesting that is read.
const DEEPEST: usize = 64;

/// A name at its column, inside of which the lines after it stand.
struct Open<'a> {
    indent: usize,
    name: &'a str,
    /// Section that the name stands in.
    section: String,
    tagged: bool,
    parts: MatrixParts<'a>,
    /// Members of a sequence whose lines follow, and what they are.
    sequence: Sequence,
}

/// The members of a sequence, one a line.
#[derive(Default)]
struct Sequence {
    rows: Vec<Vec<f64>>,
    /// Column of the first line.
    indent: usize,
    nested: bool,
    other: bool,
}

impl Sequence {
    fn is_empty(&self) -> bool {
        self.rows.is_empty() && !self.other
    }

    /// Takes one number or word, which stands at a column behind a number of dashes.
    fn take(&mut self, word: &str, indent: usize, dashes: usize) {
        let Some(value) = number(word) else {
            self.other = true;
            return;
        };
        if self.rows.is_empty() {
            (self.indent, self.nested) = (indent, dashes > 1);
            self.rows.push(vec![value]);
        } else if self.nested && indent <= self.indent {
            self.rows.push(vec![value]);
        } else if let Some(row) = self.rows.last_mut() {
            row.push(value);
        }
    }

    fn entry(self) -> FileEntry {
        if self.other {
            return FileEntry::Other;
        }
        Entries::list(self.rows)
    }
}

/// One line: its value, behind its key if it has one.
struct Item<'a> {
    /// Column of the line.
    indent: usize,
    /// Column of the key or of the value.
    inner: usize,
    /// Dashes before it.
    dashes: usize,
    key: Option<&'a str>,
    value: &'a str,
}

/// The item of a line; `None` for comments, directives and markers.
fn item(line: &str) -> Option<Item<'_>> {
    let mut rest = line.trim_start();
    let indent = line.len() - rest.len();
    let mut dashes = 0;
    if rest.starts_with("---") || rest.starts_with("...") {
        return None;
    }
    while let Some(after) = rest.strip_prefix("- ") {
        rest = after.trim_start();
        dashes += 1;
    }
    let inner = line.len() - rest.len();
    let rest = rest.trim_end();
    if rest.is_empty() || rest.starts_with(['#', '%']) {
        return None;
    }
    let bare = Item { indent, inner, dashes, key: None, value: rest };
    if rest.starts_with(['[', '{']) || rest.starts_with("!!opencv-matrix") {
        return Some(bare);
    }
    let Some((key, value)) = rest.split_once(':') else { return Some(bare) };
    let key = key.trim().trim_matches(['"', '\'']);
    let is_key = !key.is_empty() && !key.contains(['[', ']', '{', '}', ',', '#', '%']);
    is_key.then(|| Item { key: Some(key), value: value.trim(), ..bare })
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
    let mut open: Vec<Open> = Vec::new();
    let mut at = 0;
    while at < text.len() {
        let line_end = text[at..].find('\n').map_or(text.len(), |i| at + i + 1);
        let line = &text[at..line_end];
        let start = at;
        at = line_end;
        let Some(item) = item(line) else { continue };
        // A sequence may stand at the column of its own name.
        let is_inside = |o: &Open| o.indent < item.indent || (item.dashes > 0 && o.indent == item.indent);
        while open.last().is_some_and(|o| !is_inside(o)) {
            close(&mut open, &mut found)?;
        }
        // Where the value begins, also behind the end of the line.
        let value_at = start + line.rfind(item.value).unwrap_or(0);
        let value_at = if item.value.is_empty() { line_end } else { value_at };
        let rest = &text[value_at..];
        let taken = match (item.key, open.last_mut()) {
            (None, None) => 0,
            (None, Some(o)) => o.take_member(&item, rest)?,
            (Some(key), around) => {
                match around.map_or(Ok(None), |o| o.take_part(key, &item, rest, &mut found))? {
                    Some(taken) => taken,
                    None => take_named(key, &item, (text, start, value_at), &mut open, &mut found)?,
                }
            }
        };
        at = at.max(value_at + taken);
    }
    while !open.is_empty() {
        close(&mut open, &mut found)?;
    }
    Ok(found)
}

impl<'a> Open<'a> {
    /// Takes a member of a sequence, whose value `rest` begins with. Returns the bytes that it takes of it, 0 if it ends with its
    /// line.
    fn take_member(&mut self, item: &Item<'a>, rest: &str) -> Result<usize, StorageError> {
        if !item.value.starts_with('[') {
            self.sequence.take(item.value, item.indent, item.dashes);
            return Ok(0);
        }
        let length = list_length(rest)
            .ok_or_else(|| StorageError::matrix(self.name, "the list does not end with ]"))?;
        match rows(&rest[..length]) {
            Some(rows) => self.sequence.rows.extend(rows),
            None => self.sequence.other = true,
        }
        Ok(length)
    }

    /// Takes what `key` is of a matrix, with the bytes that it takes of `rest`; `None` if it is no part of one.
    fn take_part(
        &mut self,
        key: &str,
        item: &Item<'a>,
        rest: &'a str,
        found: &mut Entries,
    ) -> Result<Option<usize>, StorageError> {
        let is_matrix = self.tagged || self.parts.rows.is_some();
        match key {
            "rows" => self.parts.rows = Some(item.value),
            "cols" => self.parts.columns = Some(item.value),
            "dt" => self.parts.kind = Some(item.value),
            // Numbers line by line follow as a sequence, which has a name of its own.
            "data" if is_matrix && !rest.trim_start().starts_with("- ") => {
                let error = |what: &str| StorageError::matrix(self.name, what);
                // The list may start on the next line.
                let list = rest.trim_start();
                let list = list.strip_prefix('[').ok_or_else(|| error("data does not start with ["))?;
                let end = list.find(']').ok_or_else(|| error("data does not end with ]"))?;
                let matrix = self.parts.matrix(self.name, &list[..end])?;
                found.add(&self.section, self.name, FileEntry::Matrix(matrix));
                (self.tagged, self.parts) = (false, MatrixParts::default());
                return Ok(Some(rest.len() - list.len() + end + 1));
            }
            _ => return Ok(None),
        }
        Ok(Some(0))
    }
}

/// Takes a name with a value of its own, or opens one whose value follows. Returns the bytes that it takes from `value_at` on, 0 if
/// it ends with its line, which begins at `start`.
fn take_named<'a>(
    key: &'a str,
    item: &Item<'a>,
    (text, start, value_at): (&'a str, usize, usize),
    open: &mut Vec<Open<'a>>,
    found: &mut Entries,
) -> Result<usize, StorageError> {
    let rest = &text[value_at..];
    let section = open.last().map_or(Ok(String::new()), |o| inner(&o.section, o.name))?;
    if item.value.is_empty() || item.value.starts_with("!!opencv-matrix") {
        if open.len() == DEEPEST {
            let what = format!("sections are nested more than {DEEPEST} deep");
            let line = text[..start].matches('\n').count() + 1;
            return Err(StorageError::Syntax { form: "YAML", line, what });
        }
        let tagged = !item.value.is_empty();
        let (parts, sequence) = (MatrixParts::default(), Sequence::default());
        open.push(Open { indent: item.inner, name: key, section, tagged, parts, sequence });
    } else if item.value.starts_with('[') {
        let length =
            list_length(rest).ok_or_else(|| StorageError::matrix(key, "the list does not end with ]"))?;
        found.add(&section, key, rows(&rest[..length]).map_or(FileEntry::Other, Entries::list));
        return Ok(length);
    } else if item.value.starts_with('{') {
        return json::add_map(found, &section, key, rest);
    } else {
        let word = item.value.split(" #").next().unwrap_or("").trim_end();
        found.add(&section, key, Entries::word(word));
    }
    Ok(0)
}

/// Ends the innermost name: a matrix must have had its numbers, and the members of a sequence are its value.
fn close<'a>(open: &mut Vec<Open<'a>>, found: &mut Entries) -> Result<(), StorageError> {
    let Some(Open { name, section, tagged, parts, sequence, .. }) = open.pop() else { return Ok(()) };
    if let Some(around) = open.last_mut().filter(|o| name == "data" && o.parts.rows.is_some()) {
        let matrix = around.parts.matrix_of(around.name, sequence.rows.concat())?;
        found.add(&around.section, around.name, FileEntry::Matrix(matrix));
        (around.tagged, around.parts) = (false, MatrixParts::default());
        return Ok(());
    }
    if tagged {
        return Err(StorageError::matrix(name, "no data"));
    }
    if !sequence.is_empty() {
        found.add(&section, name, sequence.entry());
        return Ok(());
    }
    let inside = inner(&section, name)?;
    // PyYAML sorts the keys, so that the numbers stand before the rows.
    if let (Some(_), Some(_), Some(data)) = (parts.rows, parts.columns, found.take_matrix(&inside, "data")) {
        found.add(&section, name, FileEntry::Matrix(parts.matrix_of(name, data)?));
        return Ok(());
    }
    // A section that counts rows and columns without being a matrix.
    for (key, word) in [("rows", parts.rows), ("cols", parts.columns), ("dt", parts.kind)] {
        if let Some(word) = word {
            found.add(&inside, key, Entries::word(word));
        }
    }
    Ok(())
}
