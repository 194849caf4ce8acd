//! STL: triangles without anything else, as text or binary.

use super::document::{Document, Object, Part};
use super::{lines, numbers};
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

/// Reads a file; each solid of a text is an object.
pub(super) fn read(
    bytes: &[u8],
    name: &str,
    limits: &Limits,
    cancel: &Cancel,
) -> Result<Document, SceneError> {
    let first = bytes.iter().position(|b| !b.is_ascii_whitespace()).unwrap_or(0);
    let is_text = bytes[first..].get(..5).is_some_and(|word| word.eq_ignore_ascii_case(b"solid"));
    if is_text && !is_binary(bytes) {
        return read_text(bytes, name, limits, cancel);
    }
    let count = promised(bytes).ok_or_else(|| {
        SceneError::broken("file", format!("has {} bytes: too few for STL, it is cut off", bytes.len()))
    })?;
    let there = (bytes.len() - HEAD) / TRIANGLE;
    if there < count {
        return Err(SceneError::broken(
            "STL header",
            format!("promises {count} triangles, {there} are there: it is cut off"),
        ));
    }
    check_triangles(count, limits)?;
    let mut part = Part::default();
    part.positions.reserve(3 * count);
    for (i, triangle) in bytes[HEAD..].chunks_exact(TRIANGLE).take(count).enumerate() {
        if i % 65_536 == 0 {
            cancel.check(limits)?;
        }
        let number = |k: usize| f32::from_le_bytes([0, 1, 2, 3].map(|b| triangle[12 + 4 * k + b]));
        part.positions.extend([0, 3, 6].map(|k| [number(k), number(k + 1), number(k + 2)]));
    }
    Ok(document(vec![(name.to_owned(), part)]))
}

fn check_triangles(count: usize, limits: &Limits) -> Result<(), SceneError> {
    SceneError::check_limit("the number of triangles", count as u64, limits.triangles, "decimate the mesh")
}

fn document(solids: Vec<(String, Part)>) -> Document {
    let objects = solids.into_iter().map(|(name, mut part)| {
        part.triangles =
            (0..part.positions.len() as u32 / 3).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect();
        Object { name, parts: vec![part] }
    });
    Document { objects: objects.collect(), ..Document::default() }
}

fn read_text(bytes: &[u8], name: &str, limits: &Limits, cancel: &Cancel) -> Result<Document, SceneError> {
    let mut solids: Vec<(String, Part)> = vec![];
    let mut corners = vec![];
    let mut total = 0;
    for (line, text) in lines(bytes) {
        if line % 65_536 == 0 {
            cancel.check(limits)?;
        }
        let mut words = text.split_ascii_whitespace();
        match words.next().map(str::to_ascii_lowercase).as_deref() {
            Some("solid") => {
                let own = words.collect::<Vec<_>>().join(" ");
                solids.push((if own.is_empty() { name.to_owned() } else { own }, Part::default()));
            }
            Some("facet") => corners.clear(),
            Some("vertex") => corners.push(numbers::<3>(line, &mut words, "a vertex")?),
            Some("endfacet") => {
                let facet: [[f32; 3]; 3] = corners[..].try_into().map_err(|_| {
                    SceneError::broken(
                        format!("line {line}"),
                        format!("ends a facet of {} vertices; it must have 3", corners.len()),
                    )
                })?;
                let (_, part) = solids
                    .last_mut()
                    .ok_or_else(|| SceneError::broken(format!("line {line}"), "lies outside of a solid"))?;
                part.positions.extend(facet);
                total += 1;
                check_triangles(total, limits)?;
            }
            _ => {}
        }
    }
    Ok(document(solids))
}
