//! Files: scenes of every format and environments. No bytes make the reader panic. The readers run in the thread of the caller, not in
//! the one that the program gives them, so that a panic and a loop without end are seen as such.

use dpm_scene::bvh::{BodyBvh, Refit};
use dpm_scene::mesh::MAX_COORDINATE_M;
use dpm_scene::{
    decode_environment, decode_picture_here, load_bytes_here, load_mesh_here, Deformed, DeformingMesh,
    LoadOptions, MeshFormat, Scene, SceneError, TriangleMesh,
};

/// A glTF file as it is.
pub fn gltf(bytes: &[u8]) {
    judge(load_bytes_here(bytes, &LoadOptions::default()));
}

/// A file of meshes; the first byte chooses the format.
pub fn mesh(bytes: &[u8]) {
    let Some((first, rest)) = bytes.split_first() else { return };
    let format = [MeshFormat::Obj, MeshFormat::Ply, MeshFormat::Stl][usize::from(first % 3)];
    judge(load_mesh_here(rest, format, &LoadOptions::default()));
}

/// A scene has a body with triangles that lie within it; a refusal says why.
fn judge(read: Result<Scene, SceneError>) {
    match read {
        Ok(scene) => {
            assert!(!scene.bodies.is_empty());
            for mesh in scene.bodies.iter().map(|body| &body.mesh) {
                let vertices = mesh.positions.len();
                assert!(mesh.triangles.iter().flatten().all(|i| (*i as usize) < vertices));
                assert!(mesh.materials.iter().all(|m| (*m as usize) < scene.materials.len()));
            }
            scene
                .bodies
                .iter()
                .filter_map(|body| body.deforms.as_ref().zip(Some(&body.mesh)))
                .for_each(|(deforms, mesh)| judge_shapes(deforms, mesh));
        }
        Err(e @ (SceneError::Internal(_) | SceneError::TimedOut(_))) => panic!("{e}"),
        Err(e) => assert!(!e.to_string().is_empty()),
    }
}

/// Whatever numbers deform a mesh, its vertices are such as a renderer can use, and its tree holds them.
fn judge_shapes(deforms: &DeformingMesh, mesh: &TriangleMesh) {
    let mut now = Deformed::default();
    let bvh = BodyBvh::build(mesh);
    let (mut nodes, mut refit) = (bvh.nodes.clone(), Refit::new(&bvh));
    for t_ns in [0, 1, 333_333_333, 500_000_000, i64::MAX, i64::MIN] {
        deforms.at(t_ns, &mut now);
        let n = mesh.positions.len();
        assert_eq!([now.positions.len(), now.normals.len(), now.tangents.len()], [n; 3]);
        assert!(now.positions.iter().all(|p| p.abs().max_element() <= MAX_COORDINATE_M));
        assert!(now.normals.iter().all(|n| (n.length() - 1.0).abs() < 1e-3), "{:?}", now.normals);
        assert!(
            now.tangents.iter().all(|t| (t.truncate().length() - 1.0).abs() < 1e-3),
            "{:?}",
            now.tangents
        );
        let corners =
            |place: usize| mesh.triangles[bvh.order[place] as usize].map(|i| now.positions[i as usize]);
        let [lower, upper] = refit.run(&mut nodes, corners);
        let holds = |i: &u32| {
            let p = now.positions[*i as usize];
            p.cmpge(lower).all() && p.cmple(upper).all()
        };
        assert!(mesh.triangles.iter().flatten().all(holds));
    }
}

/// A glTF file from its document and, after the first zero, its binary chunk: the container is right.
pub fn gltf_parts(bytes: &[u8]) {
    let (document, binary) = match bytes.iter().position(|b| *b == 0) {
        Some(at) => (&bytes[..at], &bytes[at + 1..]),
        None => (bytes, &[][..]),
    };
    gltf(&container(document, binary));
}

/// A GLB container around a document and a binary chunk.
pub fn container(document: &[u8], binary: &[u8]) -> Vec<u8> {
    let chunk = |kind: &[u8; 4], bytes: &[u8], pad: u8| {
        let mut padded = bytes.to_vec();
        padded.resize(bytes.len().next_multiple_of(4), pad);
        [&(padded.len() as u32).to_le_bytes()[..], kind, &padded].concat()
    };
    let mut body = chunk(b"JSON", document, b' ');
    if !binary.is_empty() {
        body.extend(chunk(b"BIN\0", binary, 0));
    }
    [&b"glTF\x02\0\0\0"[..], &(body.len() as u32 + 12).to_le_bytes(), &body].concat()
}

/// An image of any format that textures have: it has as many texels as it says.
pub fn picture(bytes: &[u8]) {
    match decode_picture_here(bytes) {
        Ok(texture) => {
            let pictures = texture.ends_ns.len().max(1);
            assert_eq!(texture.texels.len(), pictures * texture.picture_len());
        }
        Err(e @ (SceneError::Internal(_) | SceneError::TimedOut(_))) => panic!("{e}"),
        Err(e) => assert!(!e.to_string().is_empty()),
    }
}

/// An environment of any format: whatever is read has as many texels as it says, and light that is a number.
pub fn environment(bytes: &[u8]) {
    match decode_environment(bytes, 0.5, 2.0).map(|sky| sky.environment) {
        Ok(dpm_scene::Environment::Equirect { width, height, texels, .. }) => {
            assert_eq!(texels.len(), width as usize * height as usize);
            assert!(texels.iter().all(|t| t.is_finite() && t.min_element() >= 0.0));
        }
        Ok(_) => {}
        Err(e @ (SceneError::Internal(_) | SceneError::TimedOut(_))) => panic!("{e}"),
        Err(e) => assert!(!e.to_string().is_empty()),
    }
}
