//! What the eye saw of every method beside what it should have seen, and how far apart: a contact sheet.

use super::runs::Measured;
use crate::metrics::white_of;
use crate::paint::glyphs::{ADVANCE, LINE};
use crate::paint::{Canvas, DOT, NOT_FINITE};
use dpm_rig::pictures::to_srgb;
use glam::Vec3;

/// A picture has at least so many columns on the sheet.
const LEAST_COLUMNS: usize = 192;
const GAP: usize = 8;
/// Errors are shown this much brighter than pictures.
const ERROR_GAIN: f32 = 8.0;
/// Lines of text over a picture.
const LINES: usize = 5;

/// Breaks a text at spaces into lines of at most `columns` characters, where its words allow.
fn wrapped(text: &str, columns: usize) -> String {
    let mut lines: Vec<String> = Vec::new();
    for word in text.split(' ') {
        match lines.last_mut() {
            Some(line) if line.len() + 1 + word.len() <= columns => *line += &format!(" {word}"),
            _ => lines.push(word.to_owned()),
        }
    }
    lines.join("\n")
}

/// One group: a column a method, the reference first; pictures above, absolute errors times eight below. Both are as bright as lets the
/// reference's brightest hundredth be white.
pub fn strip(measured: &Measured, title: &str) -> Canvas {
    let (w, h) = (measured.raster.width() as usize, measured.raster.height() as usize);
    let m = LEAST_COLUMNS.div_ceil(w).max(1);
    let cell = (w * m).max(LEAST_COLUMNS) + GAP;
    let head = LINES * LINE * DOT;
    let columns = measured.eyes.len() + 1;
    let mut sheet = Canvas::new(GAP + columns * cell, GAP + head + 2 * (h * m + GAP));
    let white = white_of(&measured.reference);
    let picture = |values: &dyn Fn(usize) -> Vec3, gain: f32| {
        let mut linear = vec![Vec3::ZERO; w * h];
        let mut lost = Vec::new();
        for (i, &pixel) in measured.pixels.iter().enumerate() {
            let v = values(i);
            if v.is_finite() {
                linear[pixel as usize] = v;
            } else {
                lost.push(pixel as usize);
            }
        }
        let mut rgb = to_srgb(&linear, gain / white);
        lost.iter().for_each(|&p| rgb[p * 3..][..3].copy_from_slice(&NOT_FINITE));
        Canvas { width: w, height: h, rgb }
    };
    let words = |name: &str, more: &str| {
        let columns = cell / (ADVANCE * DOT);
        format!("{}\n{more}", wrapped(name, columns))
    };
    sheet.text(GAP, GAP, &words(&format!("{title} reference"), ""));
    sheet.paste(GAP, GAP + head, m, &picture(&|i| measured.reference[i], 1.0));
    for (k, (name, eye)) in measured.eyes.iter().enumerate() {
        let x = GAP + (k + 1) * cell;
        let row = &measured.result.rows[k];
        sheet.text(x, GAP, &words(name, &format!("RMSE {:.4}\nFLIP {:.4}", row.perceived_rmse, row.flip)));
        sheet.paste(x, GAP + head, m, &picture(&|i| eye[i], 1.0));
        let error = |i: usize| (eye[i] - measured.reference[i]).abs();
        sheet.paste(x, 2 * GAP + head + h * m, m, &picture(&error, ERROR_GAIN));
    }
    sheet.text(GAP, 2 * GAP + head + h * m, &format!("error x {ERROR_GAIN}"));
    sheet
}

/// Sheets one below the other.
pub fn stack(sheets: &[Canvas]) -> Canvas {
    let width = sheets.iter().map(|s| s.width).max().unwrap_or(1);
    let mut all = Canvas::new(width, sheets.iter().map(|s| s.height).sum::<usize>().max(1));
    let mut y = 0;
    for s in sheets {
        all.paste(0, y, 1, s);
        y += s.height;
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_stay_whole_and_lines_short() {
        assert_eq!(wrapped("dpm, no spatial filter", 10), "dpm, no\nspatial\nfilter");
        assert_eq!(wrapped("paper", 3), "paper");
    }

    #[test]
    fn stacked_sheets_keep_their_pixels() {
        let plain = |w, h, c: u8| Canvas { width: w, height: h, rgb: vec![c; w * h * 3] };
        let all = stack(&[plain(4, 2, 7), plain(6, 3, 9)]);
        assert_eq!((all.width, all.height), (6, 5));
        assert_eq!((all.at(3, 1), all.at(5, 2), all.at(0, 4)), ([7; 3], [9; 3], [9; 3]));
        assert_ne!(all.at(5, 0), [7; 3], "paper beside the narrow one");
    }
}
