//! The secret that whoever gives orders through the page must know: 32 bytes from the operating system, as 64
//! hexadecimal digits in a file that only the rig's user can read.
//!
//! The file outlives the process, so a page that is open in a browser can still make the projector dark after the rig
//! was restarted.

use dpm_common::folder::{Folder, FolderError, Owner};
use std::fmt;
use std::fs::{File, Permissions};
use std::io::{Read, Seek, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

/// Name of the file in the state folder.
pub const FILE: &str = "page.token";
const DIGITS: usize = 64;

/// The secret. Its value is not printed by `{:?}`.
#[derive(Clone, PartialEq, Eq)]
pub struct Token(String);

impl fmt::Debug for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Token(secret)")
    }
}

/// Why there is no token, so that the page gives no orders.
#[derive(Debug, thiserror::Error)]
pub enum TokenError {
    /// The state folder or the file in it cannot be used.
    #[error("the token of the page cannot be kept: {0}; name another state folder by DPM_STATE_DIR")]
    Folder(#[from] FolderError),
    /// The operating system gave no random bytes.
    #[error("the operating system gave no random bytes for the token of the page: {0}")]
    Random(String),
}

impl Token {
    /// A new token from the operating system's random bytes.
    ///
    /// # Errors
    /// There are none.
    pub fn random() -> Result<Self, TokenError> {
        let mut bytes = [0u8; DIGITS / 2];
        getrandom::fill(&mut bytes).map_err(|e| TokenError::Random(e.to_string()))?;
        Ok(Self(bytes.iter().map(|b| format!("{b:02x}")).collect()))
    }

    /// The token in the state folder `folder`, which is made if there is none that can be used. Returns the token and
    /// the path of its file.
    ///
    /// # Errors
    /// The folder belongs to somebody else or cannot be written; no random bytes.
    pub fn kept_in(folder: &Path) -> Result<(Self, PathBuf), TokenError> {
        let folder = Folder::make(folder, Owner::Own)?;
        let path = folder.path().join(FILE);
        let failed = |source| FolderError::Io { path: path.clone(), source };
        let mut file = folder.open_file(FILE, true)?;
        let is_private = file.metadata().map_err(failed)?.permissions().mode() & 0o077 == 0;
        let mut text = String::new();
        // What is no text is no token.
        let _ = (&file).take(DIGITS as u64 + 2).read_to_string(&mut text);
        if let Some(token) = Self::parse(text.trim_end_matches('\n')).filter(|_| is_private) {
            return Ok((token, path));
        }
        // Others may have read it, or it is none.
        let token = Self::random()?;
        let write = |file: &mut File| {
            file.set_permissions(Permissions::from_mode(0o600))?;
            file.set_len(0)?;
            file.rewind()?;
            writeln!(file, "{}", token.0)?;
            file.sync_all()
        };
        write(&mut file).map_err(failed)?;
        Ok((token, path))
    }

    fn parse(text: &str) -> Option<Self> {
        let is_digit = |b: u8| b.is_ascii_digit() || (b'a'..=b'f').contains(&b);
        (text.len() == DIGITS && text.bytes().all(is_digit)).then(|| Self(text.to_owned()))
    }

    /// The digits.
    pub fn as_str(&self) -> &str {
        &self.0
    }

    /// True if `told` is the token. The time that this takes does not depend on where they differ.
    pub(crate) fn is(&self, told: &[u8]) -> bool {
        let differs = self.0.bytes().zip(told).fold(0, |all, (a, b)| all | (a ^ b));
        told.len() == DIGITS && std::hint::black_box(differs) == 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_token_outlives_the_process_and_only_its_user_reads_it() {
        let dir = std::env::temp_dir().join(format!("dpm-page-token-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&dir);
        let (first, path) = Token::kept_in(&dir).unwrap();
        assert_eq!(std::fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
        assert_eq!(std::fs::read_to_string(&path).unwrap().trim_end(), first.as_str());
        assert_eq!(Token::kept_in(&dir).unwrap().0, first);
        // One that others could read is replaced.
        std::fs::set_permissions(&path, Permissions::from_mode(0o644)).unwrap();
        let second = Token::kept_in(&dir).unwrap().0;
        assert_ne!(second, first);
        assert_eq!(std::fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
        // A file that holds no token is replaced.
        for bad in ["", "short", &"g".repeat(DIGITS), &"a".repeat(DIGITS + 7)] {
            std::fs::write(&path, bad).unwrap();
            let (token, _) = Token::kept_in(&dir).unwrap();
            assert!(token.as_str().len() == DIGITS && token != second, "{bad}");
        }
        std::fs::remove_dir_all(dir).unwrap();
    }

    #[test]
    fn only_the_whole_token_is_the_token() {
        let token = Token::random().unwrap();
        let text = token.as_str();
        assert!(token.is(text.as_bytes()));
        for k in 0..DIGITS {
            let mut other = text.as_bytes().to_vec();
            other[k] ^= 1;
            assert!(!token.is(&other) && !token.is(&text.as_bytes()[..k]), "{k}");
        }
        assert!(!token.is(format!("{text}0").as_bytes()) && !format!("{token:?}").contains(text));
        assert_ne!(Token::random().unwrap(), token);
    }
}
