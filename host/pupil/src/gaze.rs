//! What a message of Pupil says: a sample of gaze in the frame of its scene camera.
//!
//! Topics are `gaze.3d.01.` for both eyes, `gaze.3d.0.` and `gaze.3d.1.` for one, and `gaze` in old versions. The payload is
//! a map with `timestamp` (seconds of Pupil's clock), `confidence` (0 to 1), `gaze_point_3d`, and `eye_center_3d` and
//! `gaze_normal_3d`, or `eye_centers_3d` and `gaze_normals_3d` by the number of the eye. Lengths are millimetres; x points
//! to the right of the picture, y down and z forward. The 2D method of Pupil gives none of them.

use crate::msgpack::{BadMsgpack, Element, ElementDecoder};

/// Longest distance between the eye and what it looks at, metres; farther is as far.
const FARTHEST_M: f64 = 100.0;
/// Shortest distance, metres.
const NEAREST_M: f64 = 0.05;
/// Where an eye may be, metres from the scene camera.
const MOST_EYE_M: f64 = 1.0;
/// Where one eye alone is assumed to look, metres: Pupil's own first guess.
const ALONE_M: f64 = 0.5;
/// Farthest instant of Pupil's clock, seconds. Real ones count from the start of the machine, from 1970, or from what a
/// program has set.
pub(crate) const FARTHEST_S: f64 = 8e9;

/// A sample of gaze.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gaze {
    /// Seconds of Pupil's clock.
    pub at_s: f64,
    /// How sure Pupil is of the pupils, 0 to 1.
    pub confidence: f64,
    /// Between the eyes that are seen, or the one that is: metres, in the frame of the scene camera.
    pub eye_m: [f64; 3],
    /// What they look at, the same.
    pub point_m: [f64; 3],
}

/// Why a message is no sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum NoGaze {
    /// It has no directions in space: Pupil Capture maps in 2D.
    #[error("it has no gaze in space: choose the 3D method in Pupil Capture's calibration")]
    Flat,
    /// It is no message of Pupil.
    #[error(transparent)]
    Malformed(#[from] BadMsgpack),
    /// Numbers that no eye can have.
    #[error("it has numbers that no eye can have")]
    Impossible,
}

#[derive(Default)]
struct Fields {
    at_s: Option<f64>,
    confidence: Option<f64>,
    point: Option<[f64; 3]>,
    centres: Mean,
    normals: Mean,
}

/// The mean of one or two vectors.
#[derive(Default)]
struct Mean {
    sum: [f64; 3],
    count: f64,
}

impl Mean {
    fn add(&mut self, vector: [f64; 3]) {
        self.sum = [0, 1, 2].map(|i| self.sum[i] + vector[i]);
        self.count += 1.0;
    }

    fn get(&self) -> Option<[f64; 3]> {
        (self.count > 0.0).then(|| self.sum.map(|x| x / self.count))
    }
}

/// Reads the payload of a message whose topic begins with `gaze`.
///
/// # Errors
/// It is none, or has numbers that make no sense.
pub fn decode(payload: &[u8]) -> Result<Gaze, NoGaze> {
    let mut reader = ElementDecoder::new(payload);
    let mut found = Fields::default();
    for _ in 0..reader.map()? {
        match reader.head()? {
            Element::Text(key) => read_value(key, &mut reader, &mut found)?,
            // A key of another kind has been read as a whole, unless it contains others.
            Element::Array(_) | Element::Map(_) => return Err(BadMsgpack.into()),
            _ => reader.skip()?,
        }
    }
    if !reader.is_at_end() {
        return Err(BadMsgpack.into());
    }
    sample(&found)
}

fn read_value(key: &[u8], reader: &mut ElementDecoder<'_>, found: &mut Fields) -> Result<(), NoGaze> {
    match key {
        b"timestamp" => found.at_s = Some(reader.f64()?),
        b"confidence" => found.confidence = Some(reader.f64()?),
        b"gaze_point_3d" => found.point = Some(reader.vector()?),
        b"eye_center_3d" => found.centres.add(reader.vector()?),
        b"gaze_normal_3d" => found.normals.add(reader.vector()?),
        b"eye_centers_3d" => read_eyes(reader, &mut found.centres)?,
        b"gaze_normals_3d" => read_eyes(reader, &mut found.normals)?,
        _ => reader.skip()?,
    }
    Ok(())
}

/// A map from the number of an eye, as a number or a text, to a vector.
fn read_eyes(reader: &mut ElementDecoder<'_>, mean: &mut Mean) -> Result<(), NoGaze> {
    let count = reader.map()?;
    if count > 2 {
        return Err(NoGaze::Impossible);
    }
    for _ in 0..count {
        match reader.head()? {
            Element::Number(_) | Element::Text(_) => mean.add(reader.vector()?),
            _ => return Err(BadMsgpack.into()),
        }
    }
    Ok(())
}

fn sample(found: &Fields) -> Result<Gaze, NoGaze> {
    let (at_s, confidence) = found.at_s.zip(found.confidence).ok_or(BadMsgpack)?;
    // NaN is in no range.
    if !(-FARTHEST_S..=FARTHEST_S).contains(&at_s) || !(0.0..=1.0).contains(&confidence) {
        return Err(NoGaze::Impossible);
    }
    let eye_m = found.centres.get().ok_or(NoGaze::Flat)?.map(|mm| mm * 1e-3);
    let normal = found.normals.get();
    let to_point = found.point.map(|point| [0, 1, 2].map(|i| point[i] * 1e-3 - eye_m[i]));
    let ahead = |v: &[f64; 3]| normal.is_none_or(|normal| dot(&normal, v) > 0.0);
    // Lines of sight that part meet behind the eyes; then their direction alone is of use.
    let line = match to_point.filter(ahead) {
        Some(line) => line,
        None => {
            let normal = normal.ok_or(NoGaze::Flat)?;
            let length = dot(&normal, &normal).sqrt();
            normal.map(|x| x / length * if to_point.is_some() { FARTHEST_M } else { ALONE_M })
        }
    };
    let length = dot(&line, &line).sqrt();
    if !(1e-6..f64::INFINITY).contains(&length) || dot(&eye_m, &eye_m).sqrt() > MOST_EYE_M {
        return Err(NoGaze::Impossible);
    }
    let scale = length.clamp(NEAREST_M, FARTHEST_M) / length;
    Ok(Gaze { at_s, confidence, eye_m, point_m: [0, 1, 2].map(|i| eye_m[i] + scale * line[i]) })
}

fn dot(a: &[f64; 3], b: &[f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}
