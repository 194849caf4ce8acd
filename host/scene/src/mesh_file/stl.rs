//! STL: triangles, as text or binary; some binary files give them colours.

use super::document::{Document, MaterialTriangles, Object};
use super::{far, linear, lines, mtl, numbers};
use crate::limits::{Cancel, Limits};
use crate::SceneError;

/// Bytes before the triangles of a binary file, and of each triangle.
const HEAD: usize = 84;
const TRIANGLE: usize = 50;

/// Number of triangles that the header of a binary file promises.
fn promised(bytes: &[u8]) -> Option<usize> {
    let count = bytes.get(80..HEAD)?;
    Some(u32::from_le_bytes([count[0], count[1], count[2], count[3]]) as usize)
}

/// True if the length is exactly that of a binary file. Some binary files begin with the word of a text.
pub(super) fn is_binary(bytes: &[u8]) -> bool {
    promised(bytes).is_some_and(|n| n > 0 && bytes.len() == HEAD + n * TRIANGLE)
}

/// True if the file begins with the word of a text, and goes on as one.
pub(super) fn is_text(bytes: &[u8]) -> bool {
    let bytes = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes).trim_ascii_start();
    let begins = bytes.get(..5).is_some_and(|word| word.eq_ignore_ascii_case(b"solid"));
    // A name may have any bytes, what follows its line may not.
    let after = bytes.iter().position(|b| matches!(b, b'\n' | b'\r')).map_or(&[][..], |end| &bytes[end..]);
    let next = after.trim_ascii_start();
    let goes_on = ["facet", "endsolid", "color"]
        .iter()
        .any(|word| next.get(..word.len()).is_some_and(|start| start.eq_ignore_ascii_case(word.as_bytes())));
    begins && !is_binary(bytes) && (goes_on || bytes.len() < HEAD)
}

/// Reads a file; each solid of a text is an object.
pub(super) fn read(
    bytes: &[u8],
    name: &str,
    limits: &Limits,
    cancel: &Cancel,
) -> Result<Document, SceneError> {
    if is_text(bytes) {
        let bytes = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
        return read_text(bytes, name, limits, cancel);
    }
    let promised = promised(bytes).ok_or_else(|| {
        SceneError::broken("file", format!("has {} bytes: too few for STL, it is cut off", bytes.len()))
    })?;
    let there = (bytes.len() - HEAD) / TRIANGLE;
    // The header's number is a hint: some writers leave it zero, and a file may be cut off.
    let count = if promised == 0 { there } else { promised.min(there) };
    check_triangles(count, limits)?;
    let mut warnings = vec![];
    if count < promised {
        warnings.push(format!(
            "the STL header promises {promised} triangles, {there} are there: it is cut off, and what is missing is left out"
        ));
    } else if HEAD + count * TRIANGLE < bytes.len() {
        let more = bytes.len() - HEAD - count * TRIANGLE;
        warnings.push(format!("{more} bytes behind the last triangle are left out"));
    }
    let triangles = &bytes[HEAD..HEAD + count * TRIANGLE];
    let mut part = MaterialTriangles::default();
    part.positions.reserve(3 * count);
    for (i, triangle) in triangles.chunks_exact(TRIANGLE).enumerate() {
        if i % 65_536 == 0 {
            cancel.check(limits)?;
        }
        let number = |k: usize| f32::from_le_bytes([0, 1, 2, 3].map(|b| triangle[12 + 4 * k + b]));
        part.positions.extend([0, 3, 6].map(|k| [number(k), number(k + 1), number(k + 2)]));
    }
    part.colours = colours(&bytes[..80], triangles);
    let mut made = document(vec![(name.to_owned(), part)]);
    made.warnings = warnings;
    Ok(made)
}

/// Linear colours of the corners of all triangles, if the two bytes behind each are colours: as Magics writes them, where the
/// header gives the colour of those that have none, or as VisCAM does, where the highest bit says that there is one.
fn colours(head: &[u8], triangles: &[u8]) -> Vec<[f32; 3]> {
    let words = triangles.chunks_exact(TRIANGLE).map(|t| u16::from_le_bytes([t[48], t[49]]));
    let five = |word: u16, shift: u16| linear(f32::from(word >> shift & 31) / 31.0);
    let of_all = head.windows(6).position(|w| w == b"COLOR=").and_then(|at| head.get(at + 6..at + 9));
    let colour: Box<dyn Fn(u16) -> [f32; 3]> = match of_all {
        Some(all) => {
            let whole = [0, 1, 2].map(|i| linear(f32::from(all[i]) / 255.0));
            // Where no triangle has a word of its own, all are of the header's colour.
            let has_own = words.clone().any(|w| w != 0);
            let own = move |w: u16| has_own && w >> 15 == 0;
            Box::new(move |w| if own(w) { [five(w, 0), five(w, 5), five(w, 10)] } else { whole })
        }
        None => {
            // Other programs leave anything there: then not nearly all of them have the bit.
            let marked = words.clone().filter(|w| w >> 15 == 1).count();
            if marked == 0 || 10 * marked < 9 * words.len() {
                return vec![];
            }
            Box::new(move |w| if w >> 15 == 1 { [five(w, 10), five(w, 5), five(w, 0)] } else { [1.0; 3] })
        }
    };
    words.flat_map(|word| [colour(word); 3]).collect()
}

fn check_triangles(count: usize, limits: &Limits) -> Result<(), SceneError> {
    SceneError::check_limit("the number of triangles", count as u64, limits.triangles, "decimate the mesh")
}

fn document(solids: Vec<(String, MaterialTriangles)>) -> Document {
    let objects = solids.into_iter().map(|(name, mut part)| {
        part.material = Some(0);
        part.triangles =
            (0..part.positions.len() as u32 / 3).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect();
        Object { name, parts: vec![part] }
    });
    Document { objects: objects.collect(), materials: vec![mtl::plain("STL")], ..Document::default() }
}

fn read_text(bytes: &[u8], name: &str, limits: &Limits, cancel: &Cancel) -> Result<Document, SceneError> {
    // Names of solids, with the number of their first corner.
    let mut solids: Vec<(String, usize)> = vec![];
    let mut positions: Vec<[f64; 3]> = vec![];
    let mut corners: Vec<[f64; 3]> = vec![];
    let (mut damaged, mut is_open) = (0, false);
    for (line, text) in lines(bytes) {
        if line % 65_536 == 0 {
            cancel.check(limits)?;
        }
        let mut words = text.split_ascii_whitespace();
        match words.next().map(str::to_ascii_lowercase).as_deref() {
            Some("solid") => {
                let own = words.collect::<Vec<_>>().join(" ");
                solids.push((if own.is_empty() { name.to_owned() } else { own }, positions.len()));
            }
            Some("facet") => {
                damaged += usize::from(is_open);
                is_open = true;
                corners.clear();
            }
            Some("vertex") => match numbers::<3>(line, &mut words, "a vertex") {
                Ok(at) => corners.push(at),
                Err(_) => corners.push([f64::NAN; 3]),
            },
            Some("endfacet") => {
                is_open = false;
                let is_whole = corners.len() > 2 && corners.iter().flatten().all(|x| x.is_finite());
                if solids.is_empty() || !is_whole {
                    damaged += 1;
                    continue;
                }
                let fan = (2..corners.len()).flat_map(|i| [corners[0], corners[i - 1], corners[i]]);
                positions.extend(fan);
                check_triangles(positions.len() / 3, limits)?;
            }
            _ => {}
        }
    }
    damaged += usize::from(is_open);
    if positions.is_empty() {
        let why = format!("has no facet that is whole ({damaged} are damaged or cut off)");
        return Err(SceneError::broken("file", why));
    }
    let (near, offset) = far::single(&positions);
    let ends = solids.iter().skip(1).map(|(_, at)| *at).chain([near.len()]);
    let parts = solids.iter().zip(ends).map(|((name, from), to)| {
        (
            name.clone(),
            MaterialTriangles { positions: near[*from..to].to_vec(), ..MaterialTriangles::default() },
        )
    });
    let mut made = document(parts.collect());
    made.offset = offset;
    if damaged > 0 {
        made.warnings.push(format!("{damaged} facets are damaged or cut off: they are left out"));
    }
    Ok(made)
}
