//! A connector of a graphics card into the display that is plugged in there, by its EDID.

use super::port::System;
use dpm_device::regular_file;
use std::fs;
use std::path::Path;

/// Bytes of the base block of an EDID.
const BASE: usize = 128;
/// A longer EDID is none.
const MOST_BYTES: u64 = 64 * 1024;

impl System {
    /// The display at `connector`, or without a name the only one that is plugged in: vendor, product and serial number.
    /// `None` if it tells no serial number, and where several may be meant.
    pub(super) fn display(&self, connector: Option<&str>) -> Option<String> {
        let folder = Path::new(self.root).join("sys/class/drm");
        let mut found = None;
        for entry in fs::read_dir(folder).ok()?.flatten() {
            let name = entry.file_name().into_string().ok()?;
            // `card1-HDMI-A-1`; a card itself has no dash.
            let Some((_, here)) = name.split_once('-') else { continue };
            let edid =
                || regular_file::read(&entry.path().join("edid"), MOST_BYTES).ok().filter(|e| !e.is_empty());
            if connector.is_some_and(|named| named != here) {
                continue;
            }
            if let Some(edid) = edid() {
                if found.is_some() {
                    return None;
                }
                found = Some(named_by(&edid));
            }
        }
        found?
    }
}

/// Vendor, product and serial number of an EDID (VESA E-EDID 1.4, section 3.4 and 3.10.3.1).
fn named_by(edid: &[u8]) -> Option<String> {
    let base: &[u8; BASE] = edid.first_chunk()?;
    let is_sound = base.starts_with(&[0, 255, 255, 255, 255, 255, 255, 0])
        && base.iter().fold(0u8, |sum, byte| sum.wrapping_add(*byte)) == 0;
    if !is_sound {
        return None;
    }
    let letters = u16::from_be_bytes([base[8], base[9]]);
    let letter = |shift: u16| char::from(b'@' + (letters >> shift & 31) as u8);
    let vendor: String = [10, 5, 0].map(letter).iter().collect();
    let product = u16::from_le_bytes([base[10], base[11]]);
    let number = u32::from_le_bytes([base[12], base[13], base[14], base[15]]);
    // A descriptor with the tag 0xff is the serial number as text.
    let text =
        base[54..126].as_chunks::<18>().0.iter().find(|d| d.starts_with(&[0, 0, 0, 0xff, 0])).map(|d| {
            let text = d[5..].iter().take_while(|byte| **byte != b'\n');
            text.map(|byte| char::from(*byte)).filter(char::is_ascii_alphanumeric).collect::<String>()
        });
    let text = text.filter(|text| text.chars().any(|c| c != '0'));
    let serial = match (number, text) {
        (0, None) => return None,
        (0, Some(text)) => text,
        (number, text) => format!("{number} {}", text.unwrap_or_default()).trim_end().to_owned(),
    };
    Some(format!("edid {vendor} {product:04x} {serial}"))
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// The EDID of a display.
    pub(in super::super) fn edid(number: u32, text: Option<&str>) -> Vec<u8> {
        let mut bytes = vec![0; BASE];
        bytes[..8].copy_from_slice(&[0, 255, 255, 255, 255, 255, 255, 0]);
        bytes[8..12].copy_from_slice(&[0x10, 0xac, 0x34, 0x12]);
        bytes[12..16].copy_from_slice(&number.to_le_bytes());
        if let Some(text) = text {
            bytes[72..77].copy_from_slice(&[0, 0, 0, 0xff, 0]);
            bytes[77..90].fill(b' ');
            bytes[77..77 + text.len()].copy_from_slice(text.as_bytes());
            bytes[77 + text.len()] = b'\n';
        }
        bytes[127] = bytes.iter().fold(0u8, |sum, byte| sum.wrapping_sub(*byte));
        bytes
    }

    #[test]
    fn a_display_is_known_by_its_serial_number_and_by_nothing_less() {
        assert_eq!(named_by(&edid(7, None)).as_deref(), Some("edid DEL 1234 7"));
        assert_eq!(named_by(&edid(0, Some("CN0X"))).as_deref(), Some("edid DEL 1234 CN0X"));
        assert_eq!(named_by(&edid(7, Some("CN0X"))).as_deref(), Some("edid DEL 1234 7 CN0X"));
        for nothing in [edid(0, None), edid(0, Some("0000")), vec![], edid(7, None)[..100].to_vec()] {
            assert_eq!(named_by(&nothing), None);
        }
        for byte in 0..BASE {
            let mut damaged = edid(7, None);
            damaged[byte] ^= 1;
            assert_eq!(named_by(&damaged), None, "byte {byte}");
        }
    }
}
