//! Reads one checked primitive of a mesh as a [`TriangleMesh`] in the mesh's own space, or with a skin in that of its body.

use std::collections::HashMap;

use glam::{Vec2, Vec3, Vec4};
use gltf::json::mesh::{Mode, Primitive, Semantic};
use gltf::json::validation::Checked;

use super::super::limits::Cancel;
use super::super::mesh::DropCounts;
use super::super::{Limits, SceneError, TriangleMesh};
use super::accessor::{Accessor, Data};
use super::bake::Vertices;
use super::deform::Deformation;
use super::look::SceneLook;
use super::vertex_paint::Paint;

/// Reads a primitive's triangles with their material; decodes only vertices that a triangle uses. `None` if there is
/// nothing to see (points, lines, no positions), about which the check has warned.
pub(crate) fn read_primitive(
    primitive: &Primitive,
    data: &Data,
    (look, material): (&SceneLook, u32),
    deformation: &Deformation,
    paint: &mut Paint,
    stop: (&Cancel, &Limits),
) -> Result<Option<(TriangleMesh, DropCounts)>, SceneError> {
    let attribute = |semantic: Semantic| accessor_of(primitive, data, semantic);
    let Some(positions) = attribute(Semantic::Positions) else { return Ok(None) };
    let all = match deformation.faces() {
        Some(some) => Some(some.to_vec()),
        None => faces(primitive, data)?,
    };
    let Some(faces) = all else { return Ok(None) };
    // A NaN texture coordinate would spoil whole pixels; zero spoils only the texture.
    let uv = |set: u32, i: u64| {
        let numbers = attribute(Semantic::TexCoords(set)).map(|a| data.floats::<2>(a, i));
        Vec2::from(numbers.unwrap_or_default().map(|x| if x.is_finite() { x } else { 0.0 }))
    };
    let colours = attribute(Semantic::Colors(0));
    let colour = |i: u64| colours.map_or(Vec3::ONE, |a| Vec3::from(data.floats::<3>(a, i)));
    let vertices = Vertices { uv: &uv, colour: colours.is_some().then_some(&colour) };
    // The address of the primitive names it as long as the document is read.
    let name = std::ptr::from_ref(primitive) as usize;
    let painted = paint.faces(look, (name, &faces), material, &vertices)?;
    let uv_set = look.set_of(material);
    let (used, triangles) = match painted {
        Some(_) => apart(&faces),
        None => shared(&faces),
    };
    let floats3 = |a: &Accessor| used.iter().map(|&i| Vec3::from(data.floats::<3>(a, i))).collect::<Vec<_>>();
    let (material, painted_uvs) = painted.unwrap_or((material, vec![]));
    let uvs = used.iter().map(|&i| uv(uv_set, i)).collect();
    let normals = attribute(Semantic::Normals).map(floats3);
    let has_normals = normals.is_some();
    let mut mesh = TriangleMesh {
        positions: floats3(positions),
        normals: normals.unwrap_or_else(|| vec![Vec3::ZERO; used.len()]),
        // Tangents without normals have no meaning in glTF.
        tangents: match attribute(Semantic::Tangents).filter(|_| has_normals) {
            Some(a) => used.iter().map(|&i| Vec4::from(data.floats::<4>(a, i))).collect(),
            None => vec![],
        },
        uvs,
        later_uvs: painted_uvs,
        materials: vec![material; triangles.len()],
        triangles,
        sources: if deformation.is_bind_pose() { used.iter().map(|&i| i as u32).collect() } else { vec![] },
    };
    deformation.apply(data, &used, &mut mesh, stop)?;
    let dropped = mesh.drop_unusable();
    if has_normals {
        mesh.repair_normals();
    } else {
        mesh.split_into_flat_faces();
    }
    if mesh.tangents.is_empty() {
        mesh.generate_tangents();
    } else {
        mesh.repair_tangents();
    }
    if !mesh.later_uvs.is_empty() {
        mesh.uvs = std::mem::take(&mut mesh.later_uvs);
    }
    Ok(Some((mesh, dropped)))
}

fn accessor_of<'a>(primitive: &Primitive, data: &'a Data, semantic: Semantic) -> Option<&'a Accessor> {
    primitive.attributes.get(&Checked::Valid(semantic)).map(|i| &data.accessors[i.value()])
}

/// The corners of a primitive's triangles, as numbers of its vertices; `None` if there is nothing to see.
///
/// # Errors
/// An index points at a vertex that is not there.
pub(super) fn faces(primitive: &Primitive, data: &Data) -> Result<Option<Vec<[u64; 3]>>, SceneError> {
    let Some(positions) = accessor_of(primitive, data, Semantic::Positions) else { return Ok(None) };
    let corners = corners(primitive, data, positions.count)?;
    Ok(Some(match primitive.mode {
        Checked::Valid(Mode::Triangles) => corners.chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect(),
        Checked::Valid(Mode::TriangleStrip) => {
            // Every second face of a strip is flipped, so that all face the same way.
            let face =
                |(i, c): (usize, &[u64])| if i % 2 == 0 { [c[0], c[1], c[2]] } else { [c[1], c[0], c[2]] };
            corners.windows(3).enumerate().map(face).collect()
        }
        Checked::Valid(Mode::TriangleFan) => {
            corners[1..].windows(2).map(|c| [c[0], c[1], corners[0]]).collect()
        }
        _ => return Ok(None),
    }))
}

/// The vertices that triangles use, each once, and the triangles in their numbers.
fn shared(faces: &[[u64; 3]]) -> (Vec<u64>, Vec<[u32; 3]>) {
    let mut used = vec![];
    let mut new_index = HashMap::new();
    let mut number = |i: u64| {
        *new_index.entry(i).or_insert_with(|| {
            used.push(i);
            used.len() as u32 - 1
        })
    };
    let triangles = faces.iter().map(|face| face.map(&mut number)).collect();
    (used, triangles)
}

/// The same with vertices of its own for each triangle.
fn apart(faces: &[[u64; 3]]) -> (Vec<u64>, Vec<[u32; 3]>) {
    let triangles = (0..faces.len() as u32).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect();
    (faces.as_flattened().to_vec(), triangles)
}

/// Vertex numbers in the order of the file, each below `vertices`.
fn corners(primitive: &Primitive, data: &Data, vertices: u64) -> Result<Vec<u64>, SceneError> {
    let Some(indices) = &primitive.indices else { return Ok((0..vertices).collect()) };
    let accessor = &data.accessors[indices.value()];
    let read = |k| match data.index(accessor, k) {
        i if i < vertices => Ok(i),
        i => Err(SceneError::broken(
            &accessor.name,
            format!("index {k} points at vertex {i}, but there are {vertices}"),
        )),
    };
    (0..accessor.count).map(read).collect()
}
