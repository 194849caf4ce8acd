//! Archives that hold a calibration: the ZIP of MPCDI, and files that OpenCV compressed by gzip. What is unpacked is no larger
//! than a calibration file may be.

use super::{StorageError, MAX_BYTES};
use std::io::Read;

/// Members of an archive whose names a message shows.
const SHOWN: usize = 16;

/// The content of a file in gzip.
pub(super) fn unpacked(bytes: &[u8]) -> Result<Vec<u8>, StorageError> {
    let refused = |e: std::io::Error| StorageError::Refused(format!("it cannot be unpacked: {e}"));
    let content = bounded(flate2::read::MultiGzDecoder::new(bytes)).map_err(refused)?;
    if content.starts_with(&[0x1f, 0x8b]) {
        return Err(StorageError::Refused("it is compressed twice; unpack it".into()));
    }
    if content.len() > MAX_BYTES {
        return Err(StorageError::TooLarge(content.len()));
    }
    Ok(content)
}

/// At most one byte more than a calibration file may have.
fn bounded(content: impl Read) -> std::io::Result<Vec<u8>> {
    let mut out = Vec::new();
    content.take(MAX_BYTES as u64 + 1).read_to_end(&mut out)?;
    Ok(out)
}

/// A member of an archive.
struct Member<'a> {
    name: String,
    method: u16,
    data: &'a [u8],
}

fn u16_at(bytes: &[u8], at: usize) -> Option<usize> {
    Some(usize::from(u16::from_le_bytes(bytes.get(at..at + 2)?.try_into().ok()?)))
}

fn u32_at(bytes: &[u8], at: usize) -> Option<usize> {
    Some(u32::from_le_bytes(bytes.get(at..at + 4)?.try_into().ok()?) as usize)
}

/// The members that the archive's directory lists; `None` if it is damaged.
fn members(bytes: &[u8]) -> Option<Vec<Member<'_>>> {
    let tail = bytes.len().saturating_sub(66_000);
    let end = tail + bytes[tail..].windows(4).rposition(|w| w == b"PK\x05\x06")?;
    let (count, mut at) = (u16_at(bytes, end + 10)?, u32_at(bytes, end + 16)?);
    let mut out = Vec::new();
    for _ in 0..count {
        let entry = bytes.get(at..).filter(|entry| entry.starts_with(b"PK\x01\x02"))?;
        let (size, lengths) = (u32_at(entry, 20)?, [28, 30, 32].map(|i| u16_at(entry, i)));
        let [Some(name), Some(extra), Some(comment)] = lengths else { return None };
        let local = bytes.get(u32_at(entry, 42)?..)?;
        let begin = 30 + u16_at(local, 26)? + u16_at(local, 28)?;
        out.push(Member {
            name: String::from_utf8_lossy(entry.get(46..46 + name)?).into_owned(),
            method: u16_at(entry, 10)? as u16,
            data: local.get(begin..)?.get(..size)?,
        });
        at += 46 + name + extra + comment;
    }
    Some(out)
}

/// The text `mpcdi.xml` of an archive.
pub(super) fn mpcdi(bytes: &[u8]) -> Result<String, StorageError> {
    let refused = |what: String| Err(StorageError::Refused(what));
    let Some(members) = members(bytes) else {
        return refused("it is a ZIP archive that is damaged or cut off".into());
    };
    if members.iter().any(|m| m.name.ends_with(".npy")) {
        let names: Vec<&str> = members.iter().take(SHOWN).map(|m| m.name.trim_end_matches(".npy")).collect();
        return refused(format!(
            "it holds arrays of numpy ({}): save mtx, dist, rvec and tvec as JSON: \
             json.dump({{\"K\": mtx.tolist(), ...}}, file)",
            names.join(", ")
        ));
    }
    let is_xml = |m: &&Member| {
        let name = m.name.rsplit('/').next().unwrap_or_default();
        name.eq_ignore_ascii_case("mpcdi.xml")
    };
    let only_xml = || {
        let mut all = members.iter().filter(|m| m.name.to_ascii_lowercase().ends_with(".xml"));
        all.next().filter(|_| all.next().is_none())
    };
    let Some(member) = members.iter().find(is_xml).or_else(only_xml) else {
        let names: Vec<&str> = members.iter().take(SHOWN).map(|m| m.name.as_str()).collect();
        return refused(format!(
            "it is a ZIP archive without mpcdi.xml (it has: {}); unpack it and give the calibration that is in it",
            names.join(", ")
        ));
    };
    let content = match member.method {
        0 => bounded(member.data),
        8 => bounded(flate2::read::DeflateDecoder::new(member.data)),
        _ => {
            return refused(
                "its mpcdi.xml is compressed in an unusual way; unpack it and give mpcdi.xml".into(),
            )
        }
    };
    let content = match content {
        Ok(content) if content.len() > MAX_BYTES => return Err(StorageError::TooLarge(content.len())),
        Ok(content) => content,
        Err(e) => return refused(format!("its mpcdi.xml cannot be unpacked: {e}")),
    };
    match String::from_utf8(content) {
        Ok(text) if text.contains("<MPCDI") => Ok(text),
        Ok(_) => refused(format!("its {} is no MPCDI", member.name)),
        Err(_) => refused(format!("its {} is not text (UTF-8)", member.name)),
    }
}
