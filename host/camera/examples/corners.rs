//! Corners of the tags in pictures, as text: the picture's name, the tag, and x y of its four corners, pixels from the picture's
//! upper left corner. `tests/peers/tags.py` compares them.
//!
//! `cargo run --release -p dpm-camera --example corners -- PICTURE.pgm...`

use dpm_camera::{GreyImage, TagDetector};

/// Width, height and grey values of a binary PGM without comments, as OpenCV writes it.
fn pgm(bytes: &[u8]) -> Option<(usize, usize, &[u8])> {
    let head = std::str::from_utf8(bytes.get(..64.min(bytes.len()))?.split(|b| *b > 127).next()?).ok()?;
    let mut words = head.split_ascii_whitespace().skip(1);
    let (width, height): (usize, usize) = (words.next()?.parse().ok()?, words.next()?.parse().ok()?);
    let first = bytes.len().checked_sub(width.checked_mul(height)?)?;
    Some((width, height, &bytes[first..]))
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut detector = TagDetector::new();
    for path in std::env::args().skip(1) {
        let bytes = std::fs::read(&path)?;
        let (width, height, values) = pgm(&bytes).ok_or(format!("{path} is no PGM"))?;
        let picture = GreyImage::new(width, height, values).ok_or(format!("{path} has too few values"))?;
        let mut tags = Vec::new();
        detector.detect(&picture, None, &mut tags);
        for tag in tags {
            let corners: Vec<String> = tag.corners.iter().map(|c| format!("{} {}", c.x, c.y)).collect();
            println!("{path} {} {}", tag.id, corners.join(" "));
        }
    }
    Ok(())
}
