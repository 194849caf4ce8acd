//! Reads OBJ, PLY and STL files as a [`Scene`]: each into a [`document::Document`], and that through the reader of glTF.
//!
//! These formats name no unit and no upward axis; [`units`] guesses both, and the rig file corrects them. They store no side
//! either: surfaces without a material reflect on both.
//!
//! No library takes the place of these readers. `tobj` ends at the first line that it cannot read, and readers of PLY build a
//! map of names for every vertex, whose memory no length of a file bounds; binary STL that begins with the word of a text, and
//! lengths that are wrong, are read by none. What a part of a file lacks is left out here and counted.

mod document;
mod far;
mod mtl;
mod obj;
mod ply;
mod stl;
mod units;

use std::path::Path;

use super::gltf_file;
use super::limits::Cancel;
use super::srgb::to_linear;
use super::{LoadOptions, Scene, SceneError};
use document::Document;

/// Most parts of objects, one for each material, that stay apart: beyond, all objects are one.
const MAX_PARTS: usize = 10_000;

/// A format of meshes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MeshFormat {
    /// Wavefront OBJ, with MTL beside it.
    Obj,
    /// Polygon file format: text, or binary of either byte order.
    Ply,
    /// Stereolithography: text or binary.
    Stl,
}

impl MeshFormat {
    /// The format of a file by its first bytes, its length and its ending; `None`: it is read as glTF.
    pub(super) fn of(path: Option<&Path>, bytes: &[u8]) -> Option<Self> {
        let ending = path.and_then(Path::extension).map(|e| e.to_string_lossy().to_ascii_lowercase());
        match (bytes, ending.as_deref()) {
            ([b'g', b'l', b'T', b'F', ..], _) => None,
            ([b'p', b'l', b'y', b'\r' | b'\n', ..], _) => Some(Self::Ply),
            // Some programs write one format under the ending of another.
            (_, Some("obj" | "ply" | "gltf" | "glb")) if stl::is_binary(bytes) && !is_text(bytes) => {
                Some(Self::Stl)
            }
            (_, Some("ply" | "gltf" | "glb" | "stl")) if !begins_json(bytes) && obj::is_likely(bytes) => {
                Some(Self::Obj)
            }
            (_, Some("obj" | "ply" | "glb")) if stl::is_text(bytes) => Some(Self::Stl),
            (_, Some("obj" | "ply" | "stl")) if begins_json(bytes) => None,
            (_, Some("obj")) => Some(Self::Obj),
            (_, Some("ply")) => Some(Self::Ply),
            (_, Some("stl")) => Some(Self::Stl),
            (_, Some("glb" | "gltf")) => None,
            _ if stl::is_text(bytes) || stl::is_binary(bytes) => Some(Self::Stl),
            _ => obj::is_likely(bytes).then_some(Self::Obj),
        }
    }

    fn name(self) -> &'static str {
        match self {
            Self::Obj => "OBJ",
            Self::Ply => "PLY",
            Self::Stl => "STL",
        }
    }
}

/// Whether the beginning of a file is text.
fn is_text(bytes: &[u8]) -> bool {
    bytes.iter().take(1024).all(|b| *b >= b' ' || b.is_ascii_whitespace())
}

/// Whether a file begins as a document of glTF.
fn begins_json(bytes: &[u8]) -> bool {
    let bytes = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
    bytes.trim_ascii_start().first() == Some(&b'{')
}

/// Reads `bytes`, the content of a file of `format`; files that it names are searched in the folder of `beside`.
pub(super) fn read(
    bytes: &[u8],
    format: MeshFormat,
    beside: Option<&Path>,
    options: &LoadOptions,
    cancel: &Cancel,
) -> Result<Scene, SceneError> {
    let limits = &options.limits.of_file(bytes.len() as u64);
    let name =
        beside.and_then(Path::file_stem).map_or("object".into(), |stem| stem.to_string_lossy().into_owned());
    let mut document = match format {
        MeshFormat::Obj => obj::read(bytes, &name, beside, limits, cancel)?,
        MeshFormat::Ply => ply::read(bytes, &name, beside, limits, cancel)?,
        MeshFormat::Stl => stl::read(bytes, &name, limits, cancel)?,
    };
    if document.objects.iter().map(|object| object.parts.len()).sum::<usize>() > MAX_PARTS {
        document.join(name);
    }
    document.drop_colours_beside_textures();
    let (axes, told) = units::axes(&document, format, options);
    if let Some(told) = far::centre(&mut document, axes.scale) {
        document.warnings.push(told);
    }
    let warnings = std::mem::take(&mut document.warnings);
    let glb = document.to_glb();
    drop::<Document>(document);
    let options =
        LoadOptions { scale: Some(axes.scale), up: Some(axes.up), limits: limits.clone(), ..options.clone() };
    let mut scene = gltf_file::read(&glb, beside, &options, cancel)?;
    scene.warnings.splice(0..0, warnings.into_iter().chain([told]));
    Ok(scene)
}

/// Text as UTF-8, or as Latin-1 where it is none.
fn text_of(bytes: &[u8]) -> std::borrow::Cow<'_, str> {
    match std::str::from_utf8(bytes) {
        Ok(text) => text.into(),
        Err(_) => bytes.iter().map(|b| char::from(*b)).collect::<String>().into(),
    }
}

/// The text of a file, line by line with numbers from 1; a line that is no UTF-8 is Latin-1, since only names hold such bytes.
/// Lines end as on any system. A backslash at the end of a line joins it with the next.
fn lines(bytes: &[u8]) -> impl Iterator<Item = (usize, std::borrow::Cow<'_, str>)> {
    let mut number = 0;
    let mut rest = Some(bytes);
    std::iter::from_fn(move || {
        let mut text = rest?;
        let first = number + 1;
        let mut joined = Vec::new();
        loop {
            number += 1;
            let (line, after) = match text.iter().position(|&b| b == b'\n' || b == b'\r') {
                Some(end) => {
                    let both = text[end..].starts_with(b"\r\n");
                    (&text[..end], Some(&text[end + 1 + usize::from(both)..]))
                }
                None => (text, None),
            };
            rest = after;
            match (line.strip_suffix(b"\\"), after) {
                (Some(part), Some(next)) => {
                    joined.extend_from_slice(part);
                    joined.push(b' ');
                    text = next;
                }
                _ if joined.is_empty() => return Some((first, text_of(line))),
                _ => {
                    joined.extend_from_slice(line);
                    return Some((first, text_of(&joined).into_owned().into()));
                }
            }
        }
    })
}

/// `N` numbers at the beginning of a line's words.
fn numbers<'a, const N: usize>(
    line: usize,
    words: &mut impl Iterator<Item = &'a str>,
    what: &str,
) -> Result<[f64; N], SceneError> {
    let mut out = [0.0; N];
    for slot in &mut out {
        // "nan" and "inf" are numbers here: the reader leaves out the triangles that have them.
        let read = words.next().and_then(|word| word.parse().ok());
        *slot = read
            .ok_or_else(|| SceneError::broken(format!("line {line}"), format!("{what} needs {N} numbers")))?;
    }
    Ok(out)
}

/// The beginning of a word of a file, for a message.
fn shortened(word: &str) -> String {
    word.chars().filter(|c| !c.is_control()).take(60).collect()
}

/// A display's colour value as linear light; what is no colour is black or full.
fn linear(value: f32) -> f32 {
    to_linear(if value.is_nan() { 0.0 } else { value.clamp(0.0, 1.0) })
}

/// The URI under which the reader of glTF finds the file that `name` means: beside the mesh file, also where its writer has
/// named a path of another machine.
fn uri_of(name: &str) -> String {
    let name = name.trim().trim_matches('"').replace('\\', "/");
    let is_foreign = name.starts_with('/') || name.contains(':') || name.split('/').any(|part| part == "..");
    let kept =
        if is_foreign { name.rsplit('/').next().unwrap_or_default() } else { name.trim_start_matches("./") };
    kept.replace('%', "%25")
}

#[cfg(test)]
mod tests;
