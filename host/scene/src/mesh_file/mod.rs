//! Reads OBJ, PLY and STL files as a [`Scene`]: each into a [`document::Document`], and that through the reader of glTF.
//!
//! These formats name no unit and no upward axis; [`units`] guesses both, and the rig file corrects them.

mod document;
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

/// Most objects that stay apart: beyond, all are one.
const MAX_OBJECTS: usize = 10_000;

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
            (_, Some("obj")) => Some(Self::Obj),
            (_, Some("ply")) => Some(Self::Ply),
            (_, Some("stl")) => Some(Self::Stl),
            (_, Some("glb" | "gltf")) => None,
            _ => (bytes.starts_with(b"solid") || stl::is_binary(bytes)).then_some(Self::Stl),
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
    if document.objects.len() > MAX_OBJECTS {
        let told = format!("the file has {} objects; all are read as one", document.objects.len());
        document.warnings.push(told);
        let parts = document.objects.drain(..).flat_map(|object| object.parts).collect();
        document.objects = vec![document::Object { name, parts }];
    }
    let (axes, told) = units::axes(&document, format, options);
    let warnings = std::mem::take(&mut document.warnings);
    let glb = document.to_glb();
    drop::<Document>(document);
    let options = LoadOptions { scale: Some(axes.scale), up: Some(axes.up), ..options.clone() };
    let mut scene = gltf_file::read(&glb, beside, &options, cancel)?;
    scene.warnings.splice(0..0, warnings.into_iter().chain([told]));
    Ok(scene)
}

/// The text of a file, line by line with numbers from 1; what is no UTF-8 is replaced, since only names hold such bytes. A
/// backslash at the end of a line joins it with the next.
fn lines(bytes: &[u8]) -> impl Iterator<Item = (usize, std::borrow::Cow<'_, str>)> {
    let mut number = 0;
    let mut rest = Some(bytes);
    std::iter::from_fn(move || {
        let mut text = rest?;
        let first = number + 1;
        let mut joined = Vec::new();
        loop {
            number += 1;
            let (line, after) = match text.iter().position(|&b| b == b'\n') {
                Some(end) => (&text[..end], Some(&text[end + 1..])),
                None => (text, None),
            };
            let line = line.strip_suffix(b"\r").unwrap_or(line);
            rest = after;
            match (line.strip_suffix(b"\\"), after) {
                (Some(part), Some(next)) => {
                    joined.extend_from_slice(part);
                    joined.push(b' ');
                    text = next;
                }
                _ if joined.is_empty() => return Some((first, String::from_utf8_lossy(line))),
                _ => {
                    joined.extend_from_slice(line);
                    return Some((first, String::from_utf8_lossy(&joined).into_owned().into()));
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
) -> Result<[f32; N], SceneError> {
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
