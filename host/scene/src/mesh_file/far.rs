//! Files whose coordinates lie far from their origin, as those of surveyors and of large CAD models do, come to it: single
//! precision would bend them, and no body is that far from its own origin.

use super::document::Document;

/// Distances from the origin, in sizes of the mesh, beyond which single precision is coarser than a ten-thousandth of it.
const FAR_SIZES: f64 = 1000.0;
/// Distance from the origin that no mesh has in its body, metres.
const FAR_M: f64 = 100.0;

/// Positions in single precision, and what was taken off them first: the middle of those that lie too far away for it.
pub(super) fn single(positions: &[[f64; 3]]) -> (Vec<[f32; 3]>, [f64; 3]) {
    let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    for p in positions.iter().filter(|p| p.iter().all(|x| x.is_finite())) {
        for axis in 0..3 {
            (low[axis], high[axis]) = (low[axis].min(p[axis]), high[axis].max(p[axis]));
        }
    }
    let side = (0..3).map(|axis| high[axis] - low[axis]).fold(0.0, f64::max);
    let reach = low.iter().chain(&high).map(|x| x.abs()).fold(0.0, f64::max);
    let is_far = reach.is_finite() && side.is_finite() && side > 0.0 && reach > FAR_SIZES * side;
    let middle = if is_far { [0, 1, 2].map(|axis| 0.5 * (low[axis] + high[axis])) } else { [0.0; 3] };
    let near = |p: &[f64; 3]| [0, 1, 2].map(|axis| (p[axis] - middle[axis]) as f32);
    (positions.iter().map(near).collect(), middle)
}

/// Moves a document to its origin if it lies too far away with units of `scale` metres; tells from where.
pub(super) fn centre(document: &mut Document, scale: f64) -> Option<String> {
    let (low, high) = document.bounds()?;
    let middle = [0, 1, 2].map(|axis| 0.5 * (f64::from(low[axis]) + f64::from(high[axis])));
    let length = |v: [f64; 3]| v.iter().map(|x| x * x).sum::<f64>().sqrt();
    if document.offset == [0.0; 3] && length(middle) * scale > FAR_M {
        document.offset = middle;
        let parts = document.objects.iter_mut().flat_map(|object| &mut object.parts);
        for p in parts.flat_map(|part| &mut part.positions) {
            *p = [0, 1, 2].map(|axis| (f64::from(p[axis]) - middle[axis]) as f32);
        }
    }
    let offset = document.offset;
    (offset != [0.0; 3]).then(|| {
        format!(
            "its coordinates lie {} from the origin, where single precision would bend it: it is centred, and ({}, {}, {}) of the \
             file is its origin now; scene.bodies[].mesh_to_body moves it in its body",
            distance(length(offset) * scale),
            offset[0],
            offset[1],
            offset[2]
        )
    })
}

/// A distance with the unit that suits it.
fn distance(metres: f64) -> String {
    if metres < 1e4 {
        format!("{metres:.0} m")
    } else {
        format!("{:.1} km", 1e-3 * metres)
    }
}
