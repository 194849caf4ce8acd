//! What a calibration file holds, by section and name: matrices, lists, numbers and texts at any depth. The readers of
//! XML, YAML and JSON fill it.

use super::StorageError;
use std::collections::BTreeMap;

/// A matrix, rows first.
#[derive(Clone, Debug, PartialEq)]
pub struct Matrix {
    /// Rows.
    pub rows: usize,
    /// Columns; those of a matrix with several channels are `columns * channels`.
    pub columns: usize,
    /// `rows * columns` numbers.
    pub data: Vec<f64>,
}

/// What stands under a name.
#[derive(Clone, Debug, PartialEq)]
pub enum FileEntry {
    /// A matrix, a list of numbers (one row), or a list of equally long lists.
    Matrix(Matrix),
    /// A number.
    Number(f64),
    /// A word or a text without its quotes.
    Text(String),
    /// Anything else: a list of texts, rows of different lengths.
    Other,
}

/// Everything that a file holds. A section is the path of the names around an entry, joined by '/'; that of the file itself
/// is empty.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Entries {
    /// Sections with their entries.
    pub sections: BTreeMap<String, BTreeMap<String, FileEntry>>,
    /// Paths of entries that stand in the file twice with different values, of which the first counts.
    pub repeated: Vec<String>,
}

/// Names that a message lists at most.
const SHOWN: usize = 24;

impl Entries {
    /// Adds what stands under a name. The nameless members of a sequence are passed over.
    pub(super) fn add(&mut self, section: &str, name: &str, entry: FileEntry) {
        if matches!(name, "" | "_") {
            return;
        }
        if !self.sections.contains_key(section) {
            self.sections.insert(section.to_owned(), BTreeMap::new());
        }
        let Some(inside) = self.sections.get_mut(section) else { return };
        match inside.get(name) {
            None => {
                inside.insert(name.to_owned(), entry);
            }
            Some(first) if *first != entry && self.repeated.len() < SHOWN => {
                self.repeated.push(joined(section, name));
            }
            Some(_) => {}
        }
    }

    /// The numbers of a matrix that stands alone in its section, which are no entry any more.
    pub(super) fn take_matrix(&mut self, section: &str, name: &str) -> Option<Vec<f64>> {
        let inside = self.sections.get(section)?;
        let (1, Some(FileEntry::Matrix(matrix))) = (inside.len(), inside.get(name)) else { return None };
        let data = matrix.data.clone();
        self.sections.remove(section);
        Some(data)
    }

    /// A list of lists of numbers; rows of different lengths are no matrix.
    pub(super) fn list(rows: Vec<Vec<f64>>) -> FileEntry {
        let columns = rows.first().map_or(0, Vec::len);
        match rows.iter().all(|r| r.len() == columns) {
            true => FileEntry::Matrix(Matrix { rows: rows.len(), columns, data: rows.concat() }),
            false => FileEntry::Other,
        }
    }

    /// A number, or a text if it is none.
    pub(super) fn word(word: &str) -> FileEntry {
        number(word).map_or_else(|| FileEntry::Text(word.trim_matches(['"', '\'']).into()), FileEntry::Number)
    }

    /// The paths of all matrices, for a message.
    pub(super) fn matrices(&self) -> String {
        let all = self.sections.iter().flat_map(|(section, inside)| {
            let matrices = inside.iter().filter(|(_, entry)| matches!(entry, FileEntry::Matrix(_)));
            matrices.map(move |(name, _)| joined(section, name))
        });
        let names: Vec<String> = all.take(SHOWN).collect();
        if names.is_empty() {
            return "no matrix".into();
        }
        names.join(", ")
    }
}

/// Longest path of a section, bytes. Each section keeps its own.
const LONGEST: usize = 512;

/// The path of a section inside another.
pub(super) fn inner(section: &str, name: &str) -> Result<String, StorageError> {
    if section.len() + name.len() > LONGEST {
        let what = format!("names around it are longer than {LONGEST} bytes together");
        return Err(StorageError::Refused(what));
    }
    Ok(joined(section, name))
}

/// The path of an entry.
pub(super) fn joined(section: &str, name: &str) -> String {
    if section.is_empty() || name.is_empty() {
        return format!("{section}{name}");
    }
    format!("{section}/{name}")
}

/// A number as OpenCV writes it. Infinities and NaN become NaN.
pub(super) fn number(word: &str) -> Option<f64> {
    match word {
        ".Inf" | ".inf" | "-.Inf" | "-.inf" | ".Nan" | ".NaN" | ".nan" | "NaN" => Some(f64::NAN),
        // Words that Rust takes for numbers, and no calibration means so.
        "inf" | "infinity" | "nan" => None,
        _ => word.parse().ok(),
    }
}

/// The parts of a matrix as they are met.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct MatrixParts<'a> {
    pub rows: Option<&'a str>,
    pub columns: Option<&'a str>,
    /// Type of the elements, for example `d` or `2f`.
    pub kind: Option<&'a str>,
}

impl MatrixParts<'_> {
    /// The matrix of these parts and the numbers in `data`, which are separated by white space or commas.
    pub(super) fn matrix(self, name: &str, data: &str) -> Result<Matrix, StorageError> {
        let mut numbers = Vec::new();
        for word in data.split(|c: char| c.is_whitespace() || c == ',').filter(|w| !w.is_empty()) {
            let what = || StorageError::matrix(name, format!("{word:?} is not a number"));
            numbers.push(number(word).ok_or_else(what)?);
        }
        self.matrix_of(name, numbers)
    }

    /// The matrix of these parts and numbers.
    pub(super) fn matrix_of(self, name: &str, data: Vec<f64>) -> Result<Matrix, StorageError> {
        let side = |word: Option<&str>, which: &str| match word.and_then(|w| w.trim().parse::<f64>().ok()) {
            Some(v) if (0.0..=1e6).contains(&v) && v.fract() == 0.0 => Ok(v as usize),
            _ => {
                Err(StorageError::matrix(name, format!("{which} is missing or not a whole number from 1 on")))
            }
        };
        let (rows, columns) = (side(self.rows, "rows")?, side(self.columns, "cols")?);
        let digits = self.kind.unwrap_or("").trim().trim_matches('"');
        let digits = digits.trim_end_matches(|c: char| !c.is_ascii_digit());
        let channels = digits.parse::<usize>().unwrap_or(1).clamp(1, 512);
        if rows * columns * channels != data.len() {
            let what = format!("{rows} x {columns} but {} numbers", data.len());
            return Err(StorageError::matrix(name, what));
        }
        Ok(Matrix { rows, columns: columns * channels, data })
    }
}
