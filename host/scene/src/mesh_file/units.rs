//! The unit and the upward axis of files that name neither.

use super::document::Document;
use super::MeshFormat;
use crate::{LoadOptions, UpAxis};

/// Sizes of things that stand before a projector, metres: the longest side.
const USUAL_M: std::ops::RangeInclusive<f64> = 0.03..=4.0;

/// Units with their names and metres.
const MILLIMETRES: (&str, f64) = ("millimetres", 1e-3);
const CENTIMETRES: (&str, f64) = ("centimetres", 1e-2);
const METRES: (&str, f64) = ("metres", 1.0);

/// What lengths and axes of a file mean.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Axes {
    /// Metres in a unit of the file.
    pub scale: f64,
    /// The axis that points up.
    pub up: UpAxis,
}

/// Units in the order in which they are tried, and the upward axis, by what writers of the format usually mean.
fn usual(format: MeshFormat) -> ([(&'static str, f64); 3], UpAxis) {
    match format {
        // Printers and CAD: millimetres, z up.
        MeshFormat::Stl => ([MILLIMETRES, METRES, CENTIMETRES], UpAxis::Z),
        // Modellers: metres, then centimetres; y up, as their exporters write it unless told otherwise.
        MeshFormat::Obj => ([METRES, CENTIMETRES, MILLIMETRES], UpAxis::Y),
        // Scanners: metres, then millimetres.
        MeshFormat::Ply => ([METRES, MILLIMETRES, CENTIMETRES], UpAxis::Y),
    }
}

/// Unit and upward axis of a document, as the options say or as guessed, and what the operator is told about them.
pub(super) fn axes(document: &Document, format: MeshFormat, options: &LoadOptions) -> (Axes, String) {
    let (units, up) = usual(format);
    let sides = document
        .bounds()
        .map_or([0.0; 3], |(low, high)| [0, 1, 2].map(|axis| f64::from(high[axis]) - f64::from(low[axis])));
    let longest = sides.into_iter().fold(0.0, f64::max);
    let fitting = units.into_iter().find(|(_, metres)| USUAL_M.contains(&(longest * metres)));
    let (unit, guessed) = fitting.unwrap_or(METRES);
    let axes = Axes { scale: options.scale.unwrap_or(guessed), up: options.up.unwrap_or(up) };
    let told_unit = match options.scale {
        Some(scale) => format!("a unit is {scale} m, as scene.scale says"),
        None if fitting.is_some() => format!("taken for {unit}"),
        None => {
            format!("taken for {unit}, but no usual unit makes it as large as things before a projector are")
        }
    };
    let told_up = match options.up {
        Some(up) => format!("{} points up, as scene.up says", up.word()),
        None => format!("{} is taken to point up", up.word()),
    };
    let [x, y, z] = sides.map(|side| side * axes.scale);
    let told = format!(
        "{} names no unit and no upward axis: {told_unit}, which makes it {x:.3} x {y:.3} x {z:.3} m; {told_up}; scene.scale and scene.up correct both",
        format.name()
    );
    (axes, told)
}
