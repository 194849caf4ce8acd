//! Splits a `.glb` or `.gltf` file into its JSON tree and its buffers; the only place that follows a URI.

use std::io::Read;
use std::path::{Component, Path, PathBuf};

use dpm_device::regular_file;
use serde_json::Value;

use super::super::names::composed;
use super::super::{Limits, SceneError};
use super::compressed::is_placeholder;
use super::json::{parse, shorten, Item};

const JSON_CHUNK: u32 = 0x4E4F_534A;
const BIN_CHUNK: u32 = 0x004E_4942;

/// The two halves of a file.
#[derive(Debug)]
pub(crate) struct Container {
    /// The document.
    pub root: Value,
    /// The binary chunk of a `.glb`.
    pub binary: Option<Vec<u8>>,
    /// What was wrong with the container, for the operator.
    pub told: Option<String>,
}

/// Reads a whole regular file of at most `limit` bytes.
pub(crate) fn read_file(path: &Path, limit: u64) -> Result<Vec<u8>, SceneError> {
    let (file, size) = regular_file::open(path).map_err(SceneError::Read)?;
    let check = |size| SceneError::check_limit("the file's size in bytes", size, limit, "simplify the file");
    check(size)?;
    let mut bytes = Vec::with_capacity(size as usize);
    file.take(limit + 1).read_to_end(&mut bytes).map_err(SceneError::Read)?;
    check(bytes.len() as u64)?;
    Ok(bytes)
}

/// Splits a file into JSON and binary chunk.
pub(super) fn split(bytes: &[u8], limits: &Limits) -> Result<Container, SceneError> {
    let (text, binary, told) =
        if bytes.starts_with(b"glTF") { split_glb(bytes)? } else { (bytes, None, None) };
    if text.is_empty() {
        return Err(SceneError::broken("file", "is empty: no glTF document in it"));
    }
    if bytes.starts_with(b"PK") || bytes.starts_with(&[0x1f, 0x8b]) {
        return Err(SceneError::unsupported(
            "a compressed archive",
            "unpack it and give the .glb or .gltf inside",
        ));
    }
    // A file that does not begin like JSON is of another kind; only white space and a byte-order mark may precede the
    // JSON.
    let first = text.iter().find(|b| !b.is_ascii_whitespace() && ![0xef, 0xbb, 0xbf].contains(*b));
    if !matches!(first, Some(b'{' | b'[')) {
        return Err(SceneError::broken(
            "file",
            "is neither a .glb nor the JSON of a .gltf: this is not glTF",
        ));
    }
    SceneError::check_limit(
        "the JSON text in bytes",
        text.len() as u64,
        limits.json_bytes,
        "keep bulk data in buffers",
    )?;
    let root = parse(text, limits.json_values)?;
    Ok(Container { root, binary: binary.map(<[u8]>::to_vec), told })
}

fn word(bytes: &[u8], at: usize) -> Option<u32> {
    Some(u32::from_le_bytes(bytes.get(at..at.checked_add(4)?)?.try_into().ok()?))
}

type Chunks<'a> = (&'a [u8], Option<&'a [u8]>, Option<String>);

fn split_glb(bytes: &[u8]) -> Result<Chunks<'_>, SceneError> {
    let header = |problem: String| SceneError::broken("GLB header", problem);
    let (Some(version), Some(length)) = (word(bytes, 4), word(bytes, 8)) else {
        return Err(header(format!("needs 12 bytes, the file has {}: it is cut off", bytes.len())));
    };
    if version != 2 {
        return Err(header(format!("is of version {version}; re-export as glTF 2.0")));
    }
    // The header's length is a hint: what counts is whether the chunks are there.
    let (length, there) = (length as usize, bytes.len());
    let told = match length.cmp(&there) {
        std::cmp::Ordering::Equal => None,
        std::cmp::Ordering::Less => {
            Some(format!("{} bytes behind the end of the GLB are left out", there - length))
        }
        std::cmp::Ordering::Greater => {
            Some(format!("the GLB header promises {length} bytes, the file has {there}: it is damaged"))
        }
    };
    let whole = bytes;
    let bytes = &bytes[..length.clamp(12, there)];
    let (mut text, mut binary) = (None, None);
    let (mut at, mut index) = (12usize, 0);
    while at < bytes.len() {
        let name = format!("GLB chunk {index}");
        let (Some(size), Some(kind)) = (word(whole, at), word(whole, at + 4)) else {
            // Padding behind the chunks.
            if text.is_some() {
                break;
            }
            return Err(SceneError::broken(name, "has no room for its header"));
        };
        let left = whole.len() - at - 8;
        let Some(content) = whole[at + 8..].get(..size as usize) else {
            if text.is_some() && !matches!(kind, JSON_CHUNK | BIN_CHUNK) {
                break;
            }
            return Err(SceneError::broken(
                name,
                format!("promises {size} bytes, the file has {left} left: it is cut off"),
            ));
        };
        match (index, kind) {
            (0, JSON_CHUNK) => text = Some(content),
            (0, _) => return Err(SceneError::broken(name, "must be the JSON chunk")),
            (1, BIN_CHUNK) => binary = Some(content),
            (_, JSON_CHUNK | BIN_CHUNK) => {
                return Err(SceneError::broken(name, "is a second JSON or binary chunk, or out of order"))
            }
            _ => {} // other chunks are for other programs, as the format says
        }
        at += 8 + size as usize;
        index += 1;
    }
    let Some(text) = text else { return Err(SceneError::broken("GLB", "has no JSON chunk")) };
    let end = text.iter().rposition(|&b| b != 0).map_or(0, |i| i + 1); // some writers pad with zeros
    Ok((&text[..end], binary, told))
}

/// The folder in which side files may lie.
#[derive(Clone, Debug)]
pub(super) struct SideFolder(PathBuf);

impl SideFolder {
    /// The folder that holds `file`.
    pub(super) fn of(file: &Path) -> Result<Self, SceneError> {
        let parent = file.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
        parent.canonicalize().map(Self).map_err(SceneError::Read)
    }

    fn read(&self, uri: &str, limit: u64) -> Result<Vec<u8>, SceneError> {
        let name = percent_decode(uri)?;
        let path = Path::new(&name);
        let plain = !name.is_empty()
            && !name.contains(['\\', '\0', ':'])
            && path
                .components()
                .all(|c| matches!(c, Component::Normal(part) if !is_device_name(&part.to_string_lossy())));
        if !plain {
            return Err(refused_uri(uri));
        }
        let resolved = match self.0.join(path).canonicalize() {
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => {
                self.alike(path).ok_or(SceneError::Read(e))?.canonicalize().map_err(SceneError::Read)?
            }
            other => other.map_err(SceneError::Read)?,
        };
        if !resolved.starts_with(&self.0) {
            return Err(refused_uri(uri));
        }
        read_file(&resolved, limit)
    }

    /// The file of this path with its letters in another case or composed otherwise: other systems find it.
    fn alike(&self, path: &Path) -> Option<PathBuf> {
        let fold = |name: &str| composed(name).to_lowercase();
        let mut at = self.0.clone();
        for component in path.components() {
            let wanted = component.as_os_str();
            if at.join(wanted).exists() {
                at.push(wanted);
                continue;
            }
            let wanted = fold(wanted.to_str()?);
            let names = std::fs::read_dir(&at).ok()?.take(MAX_NAMES).flatten().map(|entry| entry.file_name());
            let mut alike = names.filter(|name| name.to_str().is_some_and(|name| fold(name) == wanted));
            let (first, second) = (alike.next()?, alike.next());
            if second.is_some() {
                return None;
            }
            at.push(first);
        }
        Some(at)
    }
}

/// Names of a folder that are looked through.
const MAX_NAMES: usize = 10_000;

fn refused_uri(uri: &str) -> SceneError {
    SceneError::unsupported(
        format!("the URI '{}'", shorten(uri)),
        "only plain relative paths to files in the scene's folder, or below it, are followed",
    )
}

/// Names that Windows treats as devices, whatever follows the dot.
fn is_device_name(part: &str) -> bool {
    let stem = part.split('.').next().unwrap_or("").trim_end().to_ascii_uppercase();
    let numbered = |prefix| {
        stem.strip_prefix(prefix).is_some_and(|n: &str| n.len() == 1 && n.as_bytes()[0].is_ascii_digit())
    };
    matches!(stem.as_str(), "CON" | "PRN" | "AUX" | "NUL") || numbered("COM") || numbered("LPT")
}

fn percent_decode(uri: &str) -> Result<String, SceneError> {
    let bytes = uri.as_bytes();
    let mut out = Vec::with_capacity(bytes.len());
    let mut i = 0;
    while i < bytes.len() {
        let hex = |k: usize| bytes.get(i + k).and_then(|b| (*b as char).to_digit(16));
        match (bytes[i], hex(1), hex(2)) {
            (b'%', Some(high), Some(low)) => {
                out.push((high * 16 + low) as u8);
                i += 3;
            }
            (b'%', ..) => return Err(refused_uri(uri)),
            (b, ..) => {
                out.push(b);
                i += 1;
            }
        }
    }
    String::from_utf8(out).map_err(|_| refused_uri(uri))
}

/// The content of a URI: `data:` with base64, or a file in `folder`.
pub(crate) fn fetch(uri: &str, folder: Option<&SideFolder>, limit: u64) -> Result<Vec<u8>, SceneError> {
    if let Some(rest) = uri.strip_prefix("data:") {
        let Some((head, payload)) = rest.split_once(',') else {
            return Err(SceneError::broken("data URI", "has no comma before its content"));
        };
        if !head.ends_with(";base64") {
            return Err(SceneError::unsupported("a data URI that is not base64", "re-export as .glb"));
        }
        SceneError::check_limit(
            "a data URI in bytes",
            payload.len() as u64 / 4 * 3,
            limit,
            "simplify the file",
        )?;
        return base64(payload.as_bytes());
    }
    match folder {
        Some(folder) => folder.read(uri, limit),
        None => Err(refused_uri(uri)),
    }
}

/// Decodes base64 of the standard alphabet, padded or not.
fn base64(text: &[u8]) -> Result<Vec<u8>, SceneError> {
    let end = text.iter().rposition(|&b| b != b'=').map_or(0, |i| i + 1);
    if text.len() - end > 2 || end % 4 == 1 {
        return Err(SceneError::broken("data URI", "is not base64: its length is wrong"));
    }
    let mut out = Vec::with_capacity(end / 4 * 3 + 2);
    for group in text[..end].chunks(4) {
        let mut bits = 0u32;
        for (k, &b) in group.iter().enumerate() {
            let digit = match b {
                b'A'..=b'Z' => b - b'A',
                b'a'..=b'z' => b - b'a' + 26,
                b'0'..=b'9' => b - b'0' + 52,
                b'+' => 62,
                b'/' => 63,
                _ => {
                    return Err(SceneError::broken(
                        "data URI",
                        "is not base64: it holds a character of another alphabet",
                    ))
                }
            };
            bits |= u32::from(digit) << (18 - 6 * k);
        }
        out.extend_from_slice(&bits.to_be_bytes()[1..group.len()]);
    }
    Ok(out)
}

/// Loads every buffer of the document, each cut to its declared length; together at most `limits.bytes`. Also gives the bytes
/// of those that lie in other files.
pub(crate) fn load_buffers(
    root: &Item,
    binary: Option<Vec<u8>>,
    folder: Option<&SideFolder>,
    limits: &Limits,
) -> Result<(Vec<Vec<u8>>, u64), SceneError> {
    let mut binary = binary;
    let (mut total, mut of_others) = (0u64, 0);
    let mut out = vec![];
    for (i, buffer) in root.list("buffers", "buffer", limits.objects)?.iter().enumerate() {
        if is_placeholder(buffer)? {
            out.push(vec![]);
            continue;
        }
        let promised = buffer.whole("byteLength")?.ok_or_else(|| buffer.error("has no 'byteLength'"))?;
        total = total.saturating_add(promised);
        SceneError::check_limit(
            "the size of all buffers in bytes",
            total,
            limits.bytes,
            "simplify the scene",
        )?;
        let mut bytes = match buffer.text("uri")? {
            Some(uri) => {
                let fetched = fetch(uri, folder, limits.bytes).map_err(|e| buffer.error(e.to_string()))?;
                of_others += if uri.starts_with("data:") { 0 } else { fetched.len() as u64 };
                fetched
            }
            None if i == 0 && binary.is_some() => binary.take().unwrap_or_default(),
            None => return Err(buffer.error("has neither a 'uri' nor a binary chunk in this file")),
        };
        if (bytes.len() as u64) < promised {
            return Err(buffer.error(format!(
                "promises {promised} bytes, but {} are there: the data is cut off",
                bytes.len()
            )));
        }
        bytes.truncate(promised as usize);
        out.push(bytes);
    }
    Ok((out, of_others))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn base64_gives_the_vectors_of_rfc_4648() {
        for (text, bytes) in [
            ("", ""),
            ("Zg==", "f"),
            ("Zm8=", "fo"),
            ("Zm9v", "foo"),
            ("Zm9vYg==", "foob"),
            ("Zm9vYmE", "fooba"),
            ("Zm9vYmFy", "foobar"),
        ] {
            assert_eq!(base64(text.as_bytes()).unwrap(), bytes.as_bytes());
        }
        for bad in ["Z", "Zg===", "Zm9v!", "Zm 9v", "Z=9v"] {
            assert!(base64(bad.as_bytes()).is_err(), "{bad}");
        }
    }

    #[test]
    fn uris_stay_inside_the_folder() {
        let folder = SideFolder::of(Path::new("Cargo.toml")).unwrap();
        for uri in [
            "../Cargo.toml",
            "/etc/passwd",
            "file:///etc/passwd",
            "http://a/b",
            "src/../../x",
            "%2e%2e/Cargo.toml",
            "a%00b",
            "C:\\x",
            "..\\x",
            "",
            "src/NUL.txt",
            "com1",
            "%zz",
            "./x:y",
        ] {
            let e = fetch(uri, Some(&folder), 1 << 20).unwrap_err().to_string();
            assert!(e.contains("plain relative"), "{uri}: {e}");
        }
        assert!(fetch("Cargo.toml", Some(&folder), 1 << 20).is_ok());
        assert!(fetch("src%2Flib.rs", Some(&folder), 1 << 20).is_ok());
        assert!(fetch("src", Some(&folder), 1 << 20).unwrap_err().to_string().contains("a folder"));
        assert!(matches!(fetch("Cargo.toml", Some(&folder), 10), Err(SceneError::TooLarge { .. })));
    }
}
