//! Decodes and encodes frame-of-data payloads: rigid bodies and stamps.

use super::wire::{begin, finish, id, Reader, Version, WireError};

/// A rigid body of a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RigidBody {
    /// Streaming number given in the tracking software.
    pub id: i32,
    /// Metres.
    pub position: [f32; 3],
    /// World-from-body, x y z w.
    pub rotation_xyzw: [f32; 4],
    /// Mean distance of the markers from where the model has them, metres.
    pub mean_error: f32,
    /// Bit 0: tracked in this frame.
    pub params: u16,
}

impl RigidBody {
    /// Bytes on the wire in all supported versions.
    pub const BYTES: usize = 38;

    /// True when the body was seen in this frame.
    pub const fn is_tracked(&self) -> bool {
        self.params & 1 != 0
    }
}

/// Everything of a frame but its contents.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct FrameInfo {
    /// Frame number since the server started; wraps, and starts anew with the server.
    pub number: i32,
    /// SMPTE time code and its subframe.
    pub timecode: [u32; 2],
    /// Seconds since the server started.
    pub timestamp_s: f64,
    /// Middle of the exposure, server ticks.
    pub mid_exposure: u64,
    /// Images received by the server, server ticks.
    pub data_received: u64,
    /// Frame sent, server ticks.
    pub transmit: u64,
    /// Precision time protocol stamp of the exposure, seconds and fraction (since 4.1).
    pub precision: [u32; 2],
    /// See [`FrameInfo::MODELS_CHANGED`] and its neighbours.
    pub params: u16,
}

impl FrameInfo {
    /// Bit of `params`: the server is recording.
    pub const RECORDING: u16 = 1;
    /// Bit of `params`: model definitions changed, request them again.
    pub const MODELS_CHANGED: u16 = 2;
    /// Bit of `params`: live (set) or edit mode.
    pub const LIVE: u16 = 4;
    /// Bit of `params`: the bit stream's version changed, connect again.
    pub const BITSTREAM_CHANGED: u16 = 8;
}

/// A labelled marker of a frame (written by the mock server; the client skips them).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LabeledMarker {
    /// Model in the upper half, member in the lower half.
    pub id: i32,
    /// Metres.
    pub position: [f32; 3],
    /// Diameter, metres.
    pub size: f32,
    /// Bits: occluded, point-cloud solved, model solved, has model, unlabelled, active.
    pub params: u16,
    /// Metres.
    pub residual: f32,
}

/// Content of a frame of the mock server.
#[derive(Clone, Copy, Debug, Default)]
pub struct FrameContent<'a> {
    /// Names and markers of the marker sets.
    pub marker_sets: &'a [(&'a str, &'a [[f32; 3]])],
    /// Markers that belong to nothing.
    pub other_markers: &'a [[f32; 3]],
    /// Rigid bodies.
    pub bodies: &'a [RigidBody],
    /// Labelled markers.
    pub labeled: &'a [LabeledMarker],
}

/// Reads a frame of `version`: `bodies` is emptied and filled with its rigid bodies. Whatever the bytes say, no more than
/// `payload.len() / 38` bodies are stored, so a buffer of 1,724 never grows. On error `bodies` is empty.
pub fn decode_frame(
    payload: &[u8],
    version: Version,
    bodies: &mut Vec<RigidBody>,
) -> Result<FrameInfo, WireError> {
    bodies.clear();
    let result = read_frame(payload, version, bodies);
    if result.is_err() {
        bodies.clear();
    }
    result
}

fn read_frame(payload: &[u8], version: Version, bodies: &mut Vec<RigidBody>) -> Result<FrameInfo, WireError> {
    if !version.is_spoken() {
        return Err(WireError::Version(version));
    }
    let mut r = Reader::new(payload);
    let number = r.i32("frame number")?;
    section(&mut r, version, "marker sets", 5, |r| {
        r.text("marker set name")?;
        items(r, "marker set markers", 12)
    })?;
    section(&mut r, version, "other markers", 12, |r| r.take(12, "other marker").map(drop))?;
    rigid_bodies(&mut r, version, bodies)?;
    section(&mut r, version, "skeletons", 8, |r| {
        r.i32("skeleton number")?;
        items(r, "skeleton bones", RigidBody::BYTES)
    })?;
    if version >= Version::V4_1 {
        section(&mut r, version, "assets", 12, |r| {
            r.i32("asset number")?;
            items(r, "asset bodies", RigidBody::BYTES)?;
            items(r, "asset markers", 26)
        })?;
    }
    section(&mut r, version, "labelled markers", 26, |r| r.take(26, "labelled marker").map(drop))?;
    for what in ["force plates", "devices"] {
        section(&mut r, version, what, 8, |r| {
            r.i32("plate or device number")?;
            let channels = r.count("channels", 4)?;
            (0..channels).try_for_each(|_| items(r, "channel samples", 4))
        })?;
    }
    let timecode = [r.u32("timecode")?, r.u32("timecode subframe")?];
    let timestamp_s = r.f64("timestamp")?;
    let mid_exposure = r.u64("mid-exposure ticks")?;
    let data_received = r.u64("data-received ticks")?;
    let transmit = r.u64("transmit ticks")?;
    let precision = if version >= Version::V4_1 {
        [r.u32("precision seconds")?, r.u32("precision fraction")?]
    } else {
        [0; 2]
    };
    let params = r.u16("frame parameters")?;
    // The end word is 0, and nothing follows it: a frame of another version hardly ever fits both.
    if r.i32("end of frame")? != 0 || r.left() != 0 {
        return Err(WireError::End { version });
    }
    Ok(FrameInfo { number, timecode, timestamp_s, mid_exposure, data_received, transmit, precision, params })
}

/// A count of fixed-size items, and the items.
fn items(r: &mut Reader<'_>, what: &'static str, bytes: usize) -> Result<(), WireError> {
    let n = r.count(what, bytes)?;
    r.take(n * bytes, what).map(drop)
}

/// Skips one section: by its size if the version gives one (so unknown content does not matter), item by item
/// otherwise.
fn section<'a>(
    r: &mut Reader<'a>,
    version: Version,
    what: &'static str,
    least_bytes: usize,
    mut item: impl FnMut(&mut Reader<'a>) -> Result<(), WireError>,
) -> Result<(), WireError> {
    if version.has_section_sizes() {
        // Items of later versions may have any size, so the count is only required not to be negative.
        let at = r.at();
        let count = r.i32(what)?;
        if count < 0 {
            return Err(WireError::Count { what, at, count, left: r.left() });
        }
        let size = r.size(what)?;
        return r.take(size, what).map(drop);
    }
    let n = r.count(what, least_bytes)?;
    (0..n).try_for_each(|_| item(r))
}

fn rigid_bodies(r: &mut Reader<'_>, version: Version, bodies: &mut Vec<RigidBody>) -> Result<(), WireError> {
    const WHAT: &str = "rigid bodies";
    let count = r.count(WHAT, RigidBody::BYTES)?;
    let mut stride = RigidBody::BYTES;
    if version.has_section_sizes() {
        let size = r.size(WHAT)?;
        // A later version may append fields to each body; all bodies of a frame are of one size.
        let fits = if count == 0 { size == 0 } else { size % count == 0 && size / count >= RigidBody::BYTES };
        if !fits {
            return Err(WireError::SectionSize { what: WHAT, at: r.at(), size, count });
        }
        stride = size.checked_div(count).unwrap_or(stride);
    }
    for _ in 0..count {
        let mut one = Reader::new(r.take(stride, WHAT)?);
        bodies.push(RigidBody {
            id: one.i32("body number")?,
            position: one.floats("body position")?,
            rotation_xyzw: one.floats("body rotation")?,
            mean_error: one.f32("body error")?,
            params: one.u16("body parameters")?,
        });
    }
    Ok(())
}

/// Writes a whole frame-of-data message of `version` into `out`. Skeletons, assets, force plates and devices are empty.
pub fn encode_frame(
    out: &mut Vec<u8>,
    version: Version,
    info: &FrameInfo,
    content: &FrameContent<'_>,
) -> Result<(), WireError> {
    begin(out, id::FRAME);
    out.extend_from_slice(&info.number.to_le_bytes());
    put_section(out, version, content.marker_sets.len(), |out| {
        for (name, markers) in content.marker_sets {
            out.extend_from_slice(name.as_bytes());
            out.push(0);
            out.extend_from_slice(&(markers.len() as i32).to_le_bytes());
            markers.iter().for_each(|m| put_floats(out, m));
        }
    });
    put_section(out, version, content.other_markers.len(), |out| {
        content.other_markers.iter().for_each(|m| put_floats(out, m));
    });
    put_section(out, version, content.bodies.len(), |out| {
        for body in content.bodies {
            out.extend_from_slice(&body.id.to_le_bytes());
            put_floats(out, &body.position);
            put_floats(out, &body.rotation_xyzw);
            put_floats(out, &[body.mean_error]);
            out.extend_from_slice(&body.params.to_le_bytes());
        }
    });
    put_section(out, version, 0, |_| {});
    if version >= Version::V4_1 {
        put_section(out, version, 0, |_| {});
    }
    put_section(out, version, content.labeled.len(), |out| {
        for m in content.labeled {
            out.extend_from_slice(&m.id.to_le_bytes());
            put_floats(out, &m.position);
            put_floats(out, &[m.size]);
            out.extend_from_slice(&m.params.to_le_bytes());
            put_floats(out, &[m.residual]);
        }
    });
    put_section(out, version, 0, |_| {});
    put_section(out, version, 0, |_| {});
    info.timecode.iter().for_each(|t| out.extend_from_slice(&t.to_le_bytes()));
    out.extend_from_slice(&info.timestamp_s.to_le_bytes());
    for ticks in [info.mid_exposure, info.data_received, info.transmit] {
        out.extend_from_slice(&ticks.to_le_bytes());
    }
    if version >= Version::V4_1 {
        info.precision.iter().for_each(|t| out.extend_from_slice(&t.to_le_bytes()));
    }
    out.extend_from_slice(&info.params.to_le_bytes());
    out.extend_from_slice(&[0; 4]);
    finish(out)
}

/// Count, size where the version has one, and the items that `fill` writes.
pub(super) fn put_section(
    out: &mut Vec<u8>,
    version: Version,
    count: usize,
    fill: impl FnOnce(&mut Vec<u8>),
) {
    out.extend_from_slice(&(count as i32).to_le_bytes());
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

pub(super) fn put_floats(out: &mut Vec<u8>, values: &[f32]) {
    values.iter().for_each(|v| out.extend_from_slice(&v.to_le_bytes()));
}
