//! What a file of OpenCV's `FileStorage` holds, by name: matrices, lists, numbers and texts at any depth. The readers of
//! XML, YAML and JSON fill it.

use super::StorageError;
use std::collections::{BTreeMap, BTreeSet};

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

/// Everything that a file holds. Of equal names the first counts.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Entries {
    /// Entries of the type `opencv-matrix`.
    pub matrices: BTreeMap<String, Matrix>,
    /// Plain lists of numbers, and lists of equally long lists.
    pub(super) lists: BTreeMap<String, Matrix>,
    pub(super) numbers: BTreeMap<String, f64>,
    pub(super) texts: BTreeMap<String, String>,
    /// Every name, whatever it names.
    pub(super) names: BTreeSet<String>,
}

impl Entries {
    /// The matrix or list of a name.
    pub(super) fn matrix(&self, name: &str) -> Option<&Matrix> {
        self.matrices.get(name).or_else(|| self.lists.get(name))
    }

    pub(super) fn add_matrix(&mut self, name: &str, matrix: Matrix) {
        if self.add_name(name) {
            self.matrices.entry(name.into()).or_insert(matrix);
        }
    }

    /// Adds a list of lists of numbers; ignores rows of different lengths.
    pub(super) fn add_list(&mut self, name: &str, rows: Vec<Vec<f64>>) {
        let columns = rows.first().map_or(0, Vec::len);
        if self.add_name(name) && rows.iter().all(|r| r.len() == columns) {
            let matrix = Matrix { rows: rows.len(), columns, data: rows.concat() };
            self.lists.entry(name.into()).or_insert(matrix);
        }
    }

    /// Adds a number, or a text if it is none.
    pub(super) fn add_word(&mut self, name: &str, word: &str) {
        if !self.add_name(name) {
            return;
        }
        if let Some(value) = number(word) {
            self.numbers.entry(name.into()).or_insert(value);
        } else {
            self.texts.entry(name.into()).or_insert_with(|| word.trim_matches('"').into());
        }
    }

    /// Notes a name. False for the nameless members of a sequence.
    pub(super) fn add_name(&mut self, name: &str) -> bool {
        let named = !matches!(name, "" | "_");
        if named && !self.names.contains(name) {
            self.names.insert(name.into());
        }
        named
    }
}

/// A number as OpenCV writes it. Infinities and NaN become NaN.
pub(super) fn number(word: &str) -> Option<f64> {
    match word {
        ".Inf" | ".inf" | "-.Inf" | "-.inf" | ".Nan" | ".NaN" | ".nan" => Some(f64::NAN),
        _ => word.parse().ok(),
    }
}

/// The parts of a matrix as they are met.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Parts<'a> {
    pub rows: Option<&'a str>,
    pub columns: Option<&'a str>,
    /// Type of the elements, for example `d` or `2f`.
    pub kind: Option<&'a str>,
}

impl Parts<'_> {
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
