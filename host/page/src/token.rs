//! The secret that rig and page prove to each other ([`crate::proof`]): 32 bytes from the operating system, as 64
//! hexadecimal digits in a file that only the rig's user can read. Every port has its own, so that what is proven to the
//! page of one rig is worth nothing at another rig's.
//!
//! The file outlives the process, so a page that is open in a browser can still make the projector dark after the rig
//! was restarted.

use crate::hex::{hex, unhex};
use dpm_common::folder::{Folder, FolderError, Owner};
use std::fmt;
use std::fs::{File, Permissions};
use std::io::{Read, Seek, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

/// Name of the file in the state folder for the page at `port`.
pub fn file(port: u16) -> String {
    format!("page-{port}.token")
}

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
        Ok(Self(hex(&bytes)))
    }

    /// The token for the page at `port` in the state folder `folder`, which is made if there is none that can be used. Returns the token and
    /// the path of its file.
    ///
    /// # Errors
    /// The folder belongs to somebody else or cannot be written; no random bytes.
    pub fn kept_in(folder: &Path, port: u16) -> Result<(Self, PathBuf), TokenError> {
        let folder = Folder::make(folder, Owner::Own)?;
        let name = file(port);
        let path = folder.path().join(&name);
        let failed = |source| FolderError::Io { path: path.clone(), source };
        let mut file = folder.open_file(&name, true)?;
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
        (text.len() == DIGITS && unhex(text).is_some()).then(|| Self(text.to_owned()))
    }

    /// The token that `folder` holds for the page at `port`; `None` if it holds none that can be read.
    pub fn read_in(folder: &Path, port: u16) -> Option<Self> {
        let text = std::fs::read_to_string(folder.join(file(port))).ok()?;
        Self::parse(text.trim_end_matches('\n'))
    }

    /// The digits.
    pub fn as_str(&self) -> &str {
        &self.0
    }

    /// The bytes.
    pub(crate) fn bytes(&self) -> [u8; DIGITS / 2] {
        unhex(&self.0).and_then(|bytes| bytes.try_into().ok()).expect("a token is so many digits")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_token_outlives_the_process_and_only_its_user_reads_it() {
        let dir = std::env::temp_dir().join(format!("dpm-page-token-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&dir);
        let (first, path) = Token::kept_in(&dir, 7).unwrap();
        assert_eq!(std::fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
        assert_eq!(std::fs::read_to_string(&path).unwrap().trim_end(), first.as_str());
        assert_eq!(Token::kept_in(&dir, 7).unwrap().0, first);
        // One that others could read is replaced.
        std::fs::set_permissions(&path, Permissions::from_mode(0o644)).unwrap();
        let second = Token::kept_in(&dir, 7).unwrap().0;
        assert_ne!(second, first);
        assert_eq!(std::fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
        // A file that holds no token is replaced.
        for bad in ["", "short", &"g".repeat(DIGITS), &"a".repeat(DIGITS + 7)] {
            std::fs::write(&path, bad).unwrap();
            let (token, _) = Token::kept_in(&dir, 7).unwrap();
            assert!(token.as_str().len() == DIGITS && token != second, "{bad}");
        }
        std::fs::remove_dir_all(dir).unwrap();
    }

    #[test]
    fn every_port_has_its_own_token_and_none_is_printed() {
        let dir = std::env::temp_dir().join(format!("dpm-page-tokens-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&dir);
        let [one, two] = [1, 2].map(|port| Token::kept_in(&dir, port).unwrap().0);
        assert_ne!(one, two);
        assert_eq!(Token::read_in(&dir, 1).as_ref(), Some(&one));
        assert_eq!(Token::read_in(&dir, 3), None);
        assert!(!format!("{one:?}").contains(one.as_str()));
        assert_eq!(hex(&one.bytes()), one.as_str());
        std::fs::remove_dir_all(dir).unwrap();
    }
}
