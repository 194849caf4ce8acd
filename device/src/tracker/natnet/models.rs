//! Decodes and encodes model-definition payloads: names and streaming numbers of rigid bodies.

use super::frame::put_floats;
use super::wire::{begin, finish, id, Reader, Version, WireError};

/// Maximum number of rigid bodies kept from one message.
pub const MAX_MODELS: usize = 1024;

/// Name and number of a rigid body.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BodyModel {
    /// Name given in the tracking software.
    pub name: String,
    /// Streaming number, the `id` of its poses.
    pub id: i32,
}

/// Kinds of definitions.
mod kind {
    pub(super) const MARKER_SET: i32 = 0;
    pub(super) const RIGID_BODY: i32 = 1;
    pub(super) const SKELETON: i32 = 2;
    pub(super) const FORCE_PLATE: i32 = 3;
    pub(super) const DEVICE: i32 = 4;
    pub(super) const CAMERA: i32 = 5;
}

/// The rigid bodies in a model-definition payload of `version`, in its order. A later body with a number that was
/// already used is kept too: the caller resolves the ambiguity.
pub fn decode_models(payload: &[u8], version: Version) -> Result<Vec<BodyModel>, WireError> {
    read_models(payload, version).map(|(models, _)| models)
}

/// The rigid bodies of a model-definition payload, read in the layout that its bytes fit without a remainder, and a
/// version that has this layout. A server may announce one version and send another, so `first`, the version that is
/// tried first, is only a guess. If no layout fits without a remainder, the payload is read as `first`.
///
/// # Errors
/// Those of [`decode_models`] for `first`.
pub fn decode_models_that_fit(
    payload: &[u8],
    first: Version,
) -> Result<(Vec<BodyModel>, Version), WireError> {
    let as_first = read_models(payload, first);
    if let Ok((models, true)) = as_first {
        return Ok((models, first));
    }
    for version in [Version::V4_2, Version::V4_1, Version::V4_0, Version::V3_0] {
        if let Ok((models, true)) = read_models(payload, version) {
            return Ok((models, version));
        }
    }
    as_first.map(|(models, _)| (models, first))
}

/// The rigid bodies, and whether every byte of the payload and of each body's definition was read.
fn read_models(payload: &[u8], version: Version) -> Result<(Vec<BodyModel>, bool), WireError> {
    if !version.is_spoken() {
        return Err(WireError::Version(version));
    }
    let mut r = Reader::new(payload);
    let mut models = Vec::new();
    let mut fits = true;
    // The smallest definition is its kind and an empty name.
    let n = r.count("definitions", 5)?;
    for _ in 0..n {
        let kind = r.i32("kind of definition")?;
        if version.has_section_sizes() {
            let size = r.size("size of definition")?;
            let mut one = Reader::new(r.take(size, "definition")?);
            if kind == kind::RIGID_BODY {
                keep(&mut models, rigid_body(&mut one, version)?);
                fits &= one.left() == 0;
            }
            continue;
        }
        match kind {
            kind::MARKER_SET => {
                r.text("marker set name")?;
                texts(&mut r, "marker names")?;
            }
            kind::RIGID_BODY => keep(&mut models, rigid_body(&mut r, version)?),
            kind::SKELETON => {
                r.text("skeleton name")?;
                r.i32("skeleton number")?;
                let bones = r.count("bones", 21)?;
                for _ in 0..bones {
                    rigid_body(&mut r, version)?;
                }
            }
            kind::FORCE_PLATE => {
                r.i32("plate number")?;
                r.text("plate serial number")?;
                // Width, length, origin, 12 x 12 calibration, 4 corners, plate type, channel type.
                r.take(4 * (2 + 3 + 144 + 12 + 2), "plate geometry")?;
                texts(&mut r, "plate channels")?;
            }
            kind::DEVICE => {
                r.i32("device number")?;
                r.text("device name")?;
                r.text("device serial number")?;
                r.take(8, "device types")?;
                texts(&mut r, "device channels")?;
            }
            kind::CAMERA => {
                r.text("camera name")?;
                r.take(4 * 7, "camera pose")?;
            }
            // Without a size an unknown definition cannot be skipped; earlier definitions still count.
            _ => break,
        }
    }
    Ok((models, fits && r.left() == 0))
}

fn keep(models: &mut Vec<BodyModel>, model: BodyModel) {
    if models.len() < MAX_MODELS {
        models.push(model);
    }
}

fn texts(r: &mut Reader<'_>, what: &'static str) -> Result<(), WireError> {
    let n = r.count(what, 1)?;
    (0..n).try_for_each(|_| r.text(what).map(drop))
}

fn rigid_body(r: &mut Reader<'_>, version: Version) -> Result<BodyModel, WireError> {
    let name = r.text("body name")?;
    // Some tracking software writes names in the code page of its system: Latin-1 shows and matches most of them.
    let name = match core::str::from_utf8(name) {
        Ok(name) => name.to_owned(),
        Err(_) => name.iter().map(|b| char::from(*b)).collect(),
    };
    let id = r.i32("body number")?;
    r.i32("body parent")?;
    r.take(12, "body offset")?;
    if version >= Version::V4_2 {
        r.take(16, "body rotation")?;
    }
    let markers = r.count("body markers", 16)?;
    r.take(markers * 16, "body markers")?;
    if version >= Version::V4_0 {
        (0..markers).try_for_each(|_| r.text("marker name").map(drop))?;
    }
    Ok(BodyModel { name, id })
}

/// A rigid body of the mock server.
#[derive(Clone, Copy, Debug)]
pub struct BodyDefinition<'a> {
    /// Name.
    pub name: &'a str,
    /// Streaming number.
    pub id: i32,
    /// Markers in body space, metres.
    pub markers: &'a [[f32; 3]],
}

/// Writes a model-definition message of `version` into `out`: one marker set and one rigid body for each of `bodies`.
pub fn encode_models(
    out: &mut Vec<u8>,
    version: Version,
    bodies: &[BodyDefinition<'_>],
) -> Result<(), WireError> {
    begin(out, id::MODEL_DEF);
    out.extend_from_slice(&(2 * bodies.len() as i32).to_le_bytes());
    for body in bodies {
        put_definition(out, version, kind::MARKER_SET, |out| {
            put_text(out, body.name);
            out.extend_from_slice(&(body.markers.len() as i32).to_le_bytes());
            put_marker_names(out, body.markers.len());
        });
        put_definition(out, version, kind::RIGID_BODY, |out| {
            put_text(out, body.name);
            out.extend_from_slice(&body.id.to_le_bytes());
            // No parent, no offset from it.
            out.extend_from_slice(&(-1i32).to_le_bytes());
            put_floats(out, &[0.0; 3]);
            if version >= Version::V4_2 {
                put_floats(out, &[0.0, 0.0, 0.0, 1.0]);
            }
            out.extend_from_slice(&(body.markers.len() as i32).to_le_bytes());
            body.markers.iter().for_each(|m| put_floats(out, m));
            // Passive markers have no active label.
            body.markers.iter().for_each(|_| out.extend_from_slice(&[0; 4]));
            if version >= Version::V4_0 {
                put_marker_names(out, body.markers.len());
            }
        });
    }
    finish(out)
}

fn put_definition(out: &mut Vec<u8>, version: Version, kind: i32, fill: impl FnOnce(&mut Vec<u8>)) {
    out.extend_from_slice(&kind.to_le_bytes());
    let at = out.len();
    if version.has_section_sizes() {
        out.extend_from_slice(&[0; 4]);
    }
    fill(out);
    if version.has_section_sizes() {
        let size = (out.len() - at - 4) as i32;
        out[at..at + 4].copy_from_slice(&size.to_le_bytes());
    }
}

fn put_text(out: &mut Vec<u8>, text: &str) {
    out.extend_from_slice(&text.as_bytes()[..text.len().min(255)]);
    out.push(0);
}

fn put_marker_names(out: &mut Vec<u8>, n: usize) {
    for i in 1..=n {
        put_text(out, &format!("Marker{i:03}"));
    }
}
