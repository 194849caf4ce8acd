//! Radiance pictures, `.hdr`: eight orders of rows and columns, three encodings of a scan line, RGBE and XYZE.

use glam::Vec3;

use super::{check_piece, check_size, collect, header, line, Read};
use crate::primaries::Primaries;
use crate::SceneError;

/// What the header of a Radiance picture says.
struct RadianceHeader {
    /// What stored numbers are divided by.
    gain: Vec3,
    primaries: Option<Primaries>,
    is_xyz: bool,
    warnings: Vec<String>,
}

/// The order of rows and columns of a Radiance picture: scan lines, texels in each, and which way they run.
struct ScanOrder {
    /// Scan lines, and texels in each.
    lines: [u32; 2],
    /// Scan lines are rows, and not columns.
    by_rows: bool,
    /// X and Y rise along the file; up is +Y and right is +X.
    rises: [bool; 2],
}

/// Radiance pictures \[Ward91\]: in any order of rows and columns, plain or with each component run-length coded, as RGBE or
/// XYZE.
pub(super) fn read_rgbe(bytes: &[u8]) -> Result<Read, SceneError> {
    let mut rest = bytes;
    let RadianceHeader { gain, mut primaries, is_xyz, mut warnings } = read_rgbe_header(&mut rest)?;
    let order = read_rgbe_order(&line(&mut rest)?)?;
    let [width, height] = order.sides();
    check_piece(check_size(width, height)?, 4, bytes.len())?;
    let stored = read_rgbe_lines(&mut rest, order.lines, &mut warnings)?;
    let at = |x: u32, y: u32| {
        let [r, g, b, e] = stored[order.place_of(x, y)];
        let unit = if e == 0 { 0.0 } else { (f64::from(e) - 136.0).exp2() };
        let scaled = |x: u8, gain: f32| (f64::from(x) * unit / f64::from(gain)) as f32;
        Vec3::new(scaled(r, gain.x), scaled(g, gain.y), scaled(b, gain.z))
    };
    let ((width, height, texels), told) = collect([width, height], bytes.len(), at);
    warnings.extend(told);
    if is_xyz {
        let white = primaries.map_or(Primaries::XYZ.white, |p| p.white);
        primaries = Some(Primaries { white, ..Primaries::XYZ });
    }
    Ok(Read { width, height, texels, primaries, warnings })
}

fn read_rgbe_header(rest: &mut &[u8]) -> Result<RadianceHeader, SceneError> {
    let mut said = RadianceHeader { gain: Vec3::ONE, primaries: None, is_xyz: false, warnings: vec![] };
    line(rest)?;
    for lines in 1.. {
        let text = line(rest)?;
        if text.is_empty() {
            break;
        }
        if lines > 1000 {
            return Err(header("has more than 1000 lines"));
        }
        if let Some((name, value)) = text.split_once('=') {
            said.take_in(name.trim(), value.trim())?;
        }
    }
    Ok(said)
}

impl RadianceHeader {
    /// Some programs write an exposure of 0 where they have none.
    fn multiply(&mut self, name: &str, factor: Vec3) {
        let product = self.gain * factor;
        if product.is_finite() && product.min_element() > 0.0 {
            self.gain = product;
        } else {
            self.warnings
                .push(format!("its {name} is {factor}, which is no factor of light: it is left out"));
        }
    }

    fn take_in(&mut self, name: &str, value: &str) -> Result<(), SceneError> {
        let numbers: Vec<f32> = value.split_ascii_whitespace().map_while(|w| w.parse().ok()).collect();
        match (name, &numbers[..]) {
            ("FORMAT", _) => match value {
                "32-bit_rle_rgbe" => {}
                "32-bit_rle_xyze" => self.is_xyz = true,
                other => {
                    let what = format!("the pixel format {other}");
                    return Err(SceneError::unsupported(what, "save it as RGBE"));
                }
            },
            ("EXPOSURE", [value, ..]) => self.multiply(name, Vec3::splat(*value)),
            ("COLORCORR", [r, g, b, ..]) => self.multiply(name, Vec3::new(*r, *g, *b)),
            ("PRIMARIES", [rx, ry, gx, gy, bx, by, wx, wy, ..]) => {
                let at = |x: &f32, y: &f32| glam::DVec2::new(f64::from(*x), f64::from(*y));
                let rgb = [at(rx, ry), at(gx, gy), at(bx, by)];
                self.primaries = Some(Primaries { rgb, white: at(wx, wy) });
            }
            ("EXPOSURE" | "COLORCORR" | "PRIMARIES", _) => {
                self.warnings.push(format!("its {name} has too few numbers: it is left out"))
            }
            ("VIEW", _) if value.contains("-vt") && !value.contains("-vta") => {
                self.warnings.push(format!("its VIEW is {value}: it is read as latitude and longitude"));
            }
            _ => {}
        }
        Ok(())
    }
}

fn read_rgbe_order(size: &str) -> Result<ScanOrder, SceneError> {
    let words: Vec<&str> = size.split_ascii_whitespace().collect();
    let wrong = || {
        header("must give the size as '-Y height +X width' or in one of the seven other orders of rows and columns")
    };
    let [first, outer, second, inner] = words[..] else { return Err(wrong()) };
    let side = |s: &str| s.parse::<u32>().map_err(|_| header("gives a size that is not a number"));
    let lines = [side(outer)?, side(inner)?];
    let axis = |word: &str| Some((word.strip_prefix(['+', '-'])?.to_owned(), word.starts_with('+')));
    let ((outer, outer_rises), (inner, inner_rises)) = axis(first).zip(axis(second)).ok_or_else(wrong)?;
    match (outer.as_str(), inner.as_str()) {
        ("Y", "X") => Ok(ScanOrder { lines, by_rows: true, rises: [inner_rises, outer_rises] }),
        ("X", "Y") => Ok(ScanOrder { lines, by_rows: false, rises: [outer_rises, inner_rises] }),
        _ => Err(wrong()),
    }
}

impl ScanOrder {
    /// Width and height.
    fn sides(&self) -> [u32; 2] {
        let [outer, inner] = self.lines;
        if self.by_rows {
            [inner, outer]
        } else {
            [outer, inner]
        }
    }

    /// Where in the file the texel in column `x` and row `y` stands, counted from the upper left.
    fn place_of(&self, x: u32, y: u32) -> usize {
        let ([width, height], [x_rises, y_rises]) = (self.sides(), self.rises);
        let x = if x_rises { x } else { width - 1 - x };
        let y = if y_rises { height - 1 - y } else { y };
        let (outer_at, inner_at) = if self.by_rows { (y, x) } else { (x, y) };
        outer_at as usize * self.lines[1] as usize + inner_at as usize
    }
}

/// All texels, scan line by scan line. Light that is missing at the end is told; a picture that is mostly missing is none.
fn read_rgbe_lines(
    rest: &mut &[u8],
    [outer, inner]: [u32; 2],
    warnings: &mut Vec<String>,
) -> Result<Vec<[u8; 4]>, SceneError> {
    // No encoding of a scan line is shorter than one texel.
    if (rest.len() as u64) < 4 * u64::from(outer) / 2 {
        return Err(SceneError::broken("image", "has fewer bytes than its size needs: it is cut off"));
    }
    let mut stored = vec![[0u8; 4]; outer as usize * inner as usize];
    for (y, row) in stored.chunks_exact_mut(inner as usize).enumerate() {
        if read_rgbe_row(rest, row).is_none() {
            if y <= outer as usize / 2 {
                return Err(SceneError::broken(format!("row {y}"), "is cut off or damaged"));
            }
            warnings.push(format!(
                "it is cut off or damaged from scan line {y} of {outer} on: the rest is black"
            ));
            row.fill([0; 4]);
            break;
        }
    }
    Ok(stored)
}

/// Reads one row in any of the three encodings.
fn read_rgbe_row(rest: &mut &[u8], row: &mut [[u8; 4]]) -> Option<()> {
    let take = |rest: &mut &[u8], n: usize| -> Option<Vec<u8>> {
        let (head, tail) = rest.split_at_checked(n)?;
        *rest = tail;
        Some(head.to_vec())
    };
    let width = row.len();
    let by_component = (8..32768).contains(&width)
        && matches!(**rest, [2, 2, high, low, ..] if usize::from(high) << 8 | usize::from(low) == width);
    if by_component {
        *rest = &rest[4..];
        for component in [0, 1, 2, 3] {
            let mut x = 0;
            while x < width {
                let code = usize::from(take(rest, 1)?[0]);
                let run = code > 128;
                let n = if run { code - 128 } else { code };
                if n == 0 || x + n > width {
                    return None;
                }
                let values = take(rest, if run { 1 } else { n })?;
                for k in 0..n {
                    row[x + k][component] = values[if run { 0 } else { k }];
                }
                x += n;
            }
        }
        return Some(());
    }
    // Plain texels; (1, 1, 1, n) repeats the previous texel n times; each such code that directly follows another
    // counts eight bits higher.
    let (mut x, mut shift) = (0, 0);
    while x < width {
        let texel: [u8; 4] = take(rest, 4)?.try_into().ok()?;
        if texel[..3] == [1, 1, 1] {
            let n = usize::from(texel[3]).checked_shl(shift).filter(|_| shift <= 16)?;
            let before = row[x.checked_sub(1)?];
            row.get_mut(x..x.checked_add(n)?)?.fill(before);
            x += n;
            shift += 8;
        } else {
            row[x] = texel;
            x += 1;
            shift = 0;
        }
    }
    Some(())
}
