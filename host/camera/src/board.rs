//! The printed board: as a page of PDF, and as what a picture shows of it.

use crate::detect::TagSighting;
use dpm_calibration::board::{BoardPoint, BoardView};
use dpm_device::tag36h11::{printed_cell, TagBoard, CELLS, PRINTED};
use glam::DVec2;
use std::fmt::Write;

/// Points of PDF in a millimetre.
const POINTS: f64 = 72.0 / 25.4;
/// Length of the line that shows whether the printer kept the size, millimetres.
const LINE_MM: f64 = 100.0;

/// The corners of the board's tags in a picture; tags of other numbers are none of it.
pub fn board_view(board: &TagBoard, tags: &[TagSighting]) -> BoardView {
    let half = 0.5 * board.side_m;
    let corners = [[-half, half], [half, half], [half, -half], [-half, -half]];
    let mut view = BoardView::new();
    for (id, middle) in board.tags() {
        let Some(tag) = tags.iter().find(|t| t.id == id) else { continue };
        let seen = corners.iter().zip(tag.corners).zip(tag.sigma_px);
        view.extend(seen.map(|((corner, pixel), sigma_px)| BoardPoint {
            place: DVec2::from_array(middle) + DVec2::from_array(*corner),
            pixel,
            sigma_px,
        }));
    }
    view
}

/// A page of PDF, `sheet_mm` wide and high, with the board in its middle and a line of 100 mm below it.
pub fn board_pdf(board: &TagBoard, sheet_mm: [f64; 2]) -> Vec<u8> {
    let (cell, side) = (1e3 * board.side_m / CELLS as f64, 1e3 * board.side_m);
    let mut drawn = String::from("0 g\n");
    let mut rectangle = |x: f64, y: f64, w: f64, h: f64| {
        let [x, y, w, h] = [x, y, w, h].map(|v| v * POINTS);
        // Writing to a string cannot fail.
        let _ = writeln!(drawn, "{x:.4} {y:.4} {w:.4} {h:.4} re f");
    };
    for (id, [x, y]) in board.tags() {
        let (left, top) = (
            0.5 * sheet_mm[0] + 1e3 * x - 0.5 * side - cell,
            0.5 * sheet_mm[1] + 1e3 * y + 0.5 * side + cell,
        );
        for row in 0..PRINTED {
            // A run of black cells is one rectangle: viewers draw seams between neighbours.
            let mut column = 0;
            while column < PRINTED {
                let is_black = |c: usize| c < PRINTED && printed_cell(id, c, row) == Some(false);
                let run = (column..PRINTED).take_while(|c| is_black(*c)).count();
                if run > 0 {
                    let y = top - (row + 1) as f64 * cell;
                    rectangle(left + column as f64 * cell, y, run as f64 * cell, cell);
                }
                column += run + 1;
            }
        }
    }
    let below = 0.5 * sheet_mm[1] - 500.0 * board.size_m()[1] - 4.0;
    rectangle(0.5 * sheet_mm[0] - 0.5 * LINE_MM, below, LINE_MM, 0.3);
    for end in [-0.5 * LINE_MM, 0.5 * LINE_MM - 0.3] {
        rectangle(0.5 * sheet_mm[0] + end, below - 1.5, 0.3, 3.3);
    }
    let last = board.first + board.columns * board.rows - 1;
    let _ = writeln!(
        drawn,
        "BT /F1 8 Tf {:.2} {:.2} Td (AprilTag 36h11, {} to {last}, border {side:.0} mm. The line is {LINE_MM:.0} mm long: print at 100 %.) Tj ET",
        (0.5 * sheet_mm[0] - 0.5 * LINE_MM) * POINTS,
        (below - 5.0) * POINTS,
        board.first
    );
    document(sheet_mm, &drawn)
}

/// A document of one page (ISO 32000-1, 7.5).
fn document([w, h]: [f64; 2], drawn: &str) -> Vec<u8> {
    let objects = [
        "<< /Type /Catalog /Pages 2 0 R >>".to_owned(),
        "<< /Type /Pages /Kids [3 0 R] /Count 1 >>".to_owned(),
        format!(
            "<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {:.4} {:.4}] /Contents 4 0 R /Resources << /Font << /F1 5 0 R >> >> >>",
            w * POINTS,
            h * POINTS
        ),
        format!("<< /Length {} >>\nstream\n{drawn}endstream", drawn.len()),
        "<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>".to_owned(),
    ];
    let mut out = String::from("%PDF-1.4\n");
    let mut starts = Vec::new();
    for (i, object) in objects.iter().enumerate() {
        starts.push(out.len());
        let _ = write!(out, "{} 0 obj\n{object}\nendobj\n", i + 1);
    }
    let table = out.len();
    let _ = write!(out, "xref\n0 {}\n0000000000 65535 f \n", objects.len() + 1);
    for at in &starts {
        let _ = writeln!(out, "{at:010} 00000 n ");
    }
    let _ =
        write!(out, "trailer\n<< /Size {} /Root 1 0 R >>\nstartxref\n{table}\n%%EOF\n", objects.len() + 1);
    out.into_bytes()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{GreyImage, TagDetector};

    /// The rectangles of the page, painted at 4 pixels a millimetre, are the board: every tag is found where it should be.
    #[test]
    fn the_page_shows_the_board_at_its_size() {
        let (board, sheet) = (TagBoard::SMALL, [297.0, 210.0]);
        let text = String::from_utf8(board_pdf(&board, sheet)).unwrap();
        let scale = 4.0;
        let (w, h) = ((sheet[0] * scale) as usize, (sheet[1] * scale) as usize);
        let mut pixels = vec![255u8; w * h];
        for line in text.lines().filter(|l| l.ends_with(" re f")) {
            let n: Vec<f64> =
                line.split(' ').filter_map(|v| v.parse().ok()).map(|v: f64| v / POINTS * scale).collect();
            let inside =
                |at: usize, from: f64, length: f64| (from..from + length).contains(&(at as f64 + 0.5));
            for y in (0..h).filter(|y| inside(h - 1 - *y, n[1], n[3])) {
                (0..w).filter(|x| inside(*x, n[0], n[2])).for_each(|x| pixels[y * w + x] = 0);
            }
        }
        let mut tags = Vec::new();
        TagDetector::new().detect(&GreyImage::new(w, h, &pixels).unwrap(), None, &mut tags);
        assert_eq!(tags.len(), 35);
        let view = board_view(&board, &tags);
        let off = |p: &BoardPoint| {
            let place = DVec2::new(p.place.x, -p.place.y) * 1e3 * scale;
            (p.pixel - place - 0.5 * DVec2::new(w as f64, h as f64)).length()
        };
        // An edge that falls into a pixel is drawn half a pixel off here at most.
        assert!(view.iter().all(|p| off(p) < 0.75), "{:?}", view.iter().map(off).fold(0.0, f64::max));
    }

    /// Whatever a reader looks up by the table of the document is there.
    #[test]
    fn the_table_of_the_document_points_at_its_objects() {
        let text = String::from_utf8(board_pdf(&TagBoard::LARGE, [420.0, 297.0])).unwrap();
        let table: usize = text.lines().rev().nth(1).unwrap().parse().unwrap();
        let rows: Vec<&str> = text[table..].lines().skip(3).take(5).collect();
        for (i, row) in rows.iter().enumerate() {
            let at: usize = row[..10].parse().unwrap();
            assert!(text[at..].starts_with(&format!("{} 0 obj", i + 1)), "{row}");
        }
        let stream = text.split("stream\n").nth(1).unwrap().len() - "end".len();
        assert!(text.contains(&format!("/Length {stream} ")));
    }
}
