//! What an interrupted command has measured so far: a file of numbers, a line for each thing measured.

use dpm_common::files::write_atomically;
use dpm_device::regular_file;
use dpm_rig::failure::{Failure, FailureKind};
use std::io::Write;
use std::path::{Path, PathBuf};

/// Largest file that is read.
const MAX_BYTES: u64 = 1 << 20;

/// Lines of `N` numbers in a file that outlives an interruption.
pub struct Lines<const N: usize> {
    path: PathBuf,
    lines: Vec<[f64; N]>,
}

impl<const N: usize> Lines<N> {
    /// Those of an interrupted run, or none.
    ///
    /// # Errors
    /// The file is there and cannot be read (exit code 2).
    pub fn resume(path: PathBuf) -> Result<Self, Failure> {
        let bad = |e: String| {
            let told = format!("{}: {e}; delete it to begin anew", path.display());
            Failure::new(FailureKind::BadInput, told)
        };
        let mut lines = Vec::new();
        if path.exists() {
            let text = regular_file::read_text(&path, MAX_BYTES).map_err(|e| bad(e.to_string()))?;
            for (number, line) in text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty()) {
                let numbers: Option<Vec<f64>> = line.split_whitespace().map(|w| w.parse().ok()).collect();
                let numbers = numbers.and_then(|n| <[f64; N]>::try_from(n).ok());
                lines.push(numbers.ok_or_else(|| bad(format!("line {} is not {N} numbers", number + 1)))?);
            }
        }
        Ok(Self { path, lines })
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The lines.
    pub fn lines(&self) -> &[[f64; N]] {
        &self.lines
    }

    /// Adds a line.
    ///
    /// # Errors
    /// The file cannot be written (exit code 2).
    pub fn push(&mut self, line: [f64; N]) -> Result<(), Failure> {
        self.lines.push(line);
        self.write()
    }

    /// Takes the last line back.
    ///
    /// # Errors
    /// The file cannot be written (exit code 2).
    pub fn pop(&mut self) -> Result<(), Failure> {
        self.lines.pop();
        self.write()
    }

    fn write(&self) -> Result<(), Failure> {
        write_atomically(&self.path, |out| {
            self.lines.iter().try_for_each(|line| {
                let words: Vec<String> = line.iter().map(|v| format!("{v:?}")).collect();
                writeln!(out, "{}", words.join(" "))
            })
        })
        .map_err(|e| Failure::new(FailureKind::BadInput, format!("{}: {e}", self.path.display())))
    }

    /// Deletes the file: the result has been written.
    pub fn forget(self) {
        // A file that stays would only be offered again.
        let _ = std::fs::remove_file(&self.path);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_outlive_an_interruption() {
        let path = std::env::temp_dir().join(format!("dpm-lines-{}", std::process::id()));
        let _ = std::fs::remove_file(&path);
        let mut lines = Lines::<3>::resume(path.clone()).unwrap();
        let line = |i: f64| [0.1 * i, 1.0 / 3.0, -i];
        (0..4).for_each(|i| lines.push(line(f64::from(i))).unwrap());
        lines.pop().unwrap();
        let again = Lines::<3>::resume(path.clone()).unwrap();
        assert_eq!(again.lines(), &[line(0.0), line(1.0), line(2.0)]);
        for bad in ["1 2\n", "1 2 3\n1 2 x\n"] {
            std::fs::write(&path, bad).unwrap();
            let told = Lines::<3>::resume(path.clone()).err().unwrap().message;
            assert!(told.contains("is not 3 numbers"), "{told}");
        }
        again.forget();
        assert!(!path.exists());
    }
}
