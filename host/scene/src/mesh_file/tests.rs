//! The readers of OBJ, PLY and STL, held to files that are written by hand here.

use super::*;
use glam::Vec3;

fn load(bytes: &[u8], format: MeshFormat) -> Result<Scene, SceneError> {
    load_with(bytes, format, LoadOptions::default())
}

fn load_with(bytes: &[u8], format: MeshFormat, options: LoadOptions) -> Result<Scene, SceneError> {
    read(bytes, format, None, &options, &Cancel::default())
}

/// As it lies in the file: metres, y up.
fn plain() -> LoadOptions {
    LoadOptions { scale: Some(1.0), up: Some(crate::UpAxis::Y), ..LoadOptions::default() }
}

fn refusal(bytes: &[u8], format: MeshFormat) -> String {
    load(bytes, format).expect_err("refused").to_string()
}

/// The corners of all triangles in the world, and their area.
fn corners(scene: &Scene) -> Vec<Vec3> {
    let of_body = |body: &crate::Body| {
        let at =
            |i: u32| body.world_from_body_rest.transform_point3(body.mesh.positions[i as usize].as_dvec3());
        body.mesh.triangles.iter().flatten().map(|&i| at(i).as_vec3()).collect::<Vec<_>>()
    };
    scene.bodies.iter().flat_map(of_body).collect()
}

fn told(scene: &Scene) -> String {
    scene.warnings.join("\n")
}

const QUAD: &str = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n";

#[test]
fn faces_of_an_obj_count_from_both_ends_and_polygons_are_cut() {
    let text = format!("# a comment\r\n{QUAD}vt 0.25 0.25\nvn 0 0 -1\nf 1/1/1 2/1/1 \\\n  3/1/1 4/1/1\nf -4//-1 -3//-1 -2//-1\n");
    let scene = load_with(text.as_bytes(), MeshFormat::Obj, plain()).unwrap();
    assert_eq!(corners(&scene).len(), 9);
    assert_eq!(corners(&scene)[..3], [Vec3::ZERO, Vec3::X, Vec3::new(1.0, 1.0, 0.0)]);
    let mesh = &scene.bodies[0].mesh;
    assert!(mesh.normals.iter().all(|n| *n == -Vec3::Z), "those of the file");
    assert!(mesh.uvs.iter().any(|uv| *uv == glam::Vec2::new(0.25, 0.75)), "v points down");
}

#[test]
fn objects_of_an_obj_are_bodies_and_colours_of_vertices_become_a_texture() {
    let text = "o left\nv 0 0 0 1 0 0\nv 1 0 0 0 1 0\nv 0 1 0 0 0 1\nf 1 2 3\no right\nv 2 0 0 1 1 1\nv 3 0 0 1 1 1\nv 2 1 0 1 1 1\nf 4 5 6\n";
    let scene = load_with(text.as_bytes(), MeshFormat::Obj, plain()).unwrap();
    let names: Vec<&str> = scene.bodies.iter().map(|b| b.name.as_str()).collect();
    assert_eq!(names, ["left", "right"]);
    let colour_at = |body: usize, corner: usize| {
        let mesh = &scene.bodies[body].mesh;
        let material = &scene.materials[mesh.materials[0] as usize];
        let used = material.base_color_texture?;
        let texture = &scene.textures[used.texture as usize];
        let uv = used.apply(mesh.uvs[mesh.triangles[0][corner] as usize]);
        let (x, y) = (uv.x * texture.width as f32, uv.y * texture.height as f32);
        assert!(
            (x.fract() - 0.5).abs() < 1e-3 && (y.fract() - 0.5).abs() < 1e-3,
            "the centre of a texel: {x}, {y}"
        );
        Some(texture.texels[y as usize * texture.width as usize + x as usize])
    };
    assert_eq!(
        [0, 1, 2].map(|c| colour_at(0, c).unwrap()),
        [[255, 0, 0, 255], [0, 255, 0, 255], [0, 0, 255, 255]]
    );
    assert_eq!(colour_at(1, 0), None, "white needs no texture");
}

#[test]
fn the_fourth_texel_makes_the_colours_linear_on_the_triangle() {
    let text = "v 0 0 0 0.5 0.5 0.5\nv 1 0 0 0.7 0.5 0.5\nv 0 1 0 0.5 0.6 0.5\nf 1 2 3\n";
    let scene = load_with(text.as_bytes(), MeshFormat::Obj, plain()).unwrap();
    let light =
        scene.textures[0].texels.iter().map(|t| [t[0], t[1], t[2]].map(|c| to_linear(f32::from(c) / 255.0)));
    let [a, b, c, d]: [[f32; 3]; 4] = light.collect::<Vec<_>>().try_into().unwrap();
    for k in 0..3 {
        assert!((d[k] - (b[k] + c[k] - a[k])).abs() < 0.01, "{d:?}");
    }
}

fn ply(form: &str, body: &[u8]) -> Vec<u8> {
    let header = format!(
        "ply\nformat {form} 1.0\nwritten by a program that forgot the comment\nelement vertex 3\nproperty float x\nproperty double y\nproperty float z\n\
         property uchar red\nproperty uchar green\nproperty uchar blue\nelement face 1\nproperty uchar flags\nproperty list uchar int vertex_indices\n\
         element edge 1\nproperty int a\nend_header\n"
    );
    [header.as_bytes(), body].concat()
}

fn ply_binary(big: bool) -> Vec<u8> {
    let mut body = vec![];
    let mut put = |bytes: &[u8]| {
        let mut bytes = bytes.to_vec();
        if big {
            bytes.reverse();
        }
        body.extend(bytes);
    };
    for [x, y] in [[0.0f32, 0.0], [1.0, 0.0], [0.0, 1.0]] {
        put(&x.to_le_bytes());
        put(&f64::from(y).to_le_bytes());
        put(&0.0f32.to_le_bytes());
        [255, 128, 0].iter().for_each(|c| put(&[*c]));
    }
    put(&[7]);
    put(&[3]);
    (0..3i32).for_each(|i| put(&i.to_le_bytes()));
    put(&9i32.to_le_bytes());
    ply(if big { "binary_big_endian" } else { "binary_little_endian" }, &body)
}

#[test]
fn a_ply_says_the_same_as_text_and_in_either_order_of_bytes() {
    let text = ply("ascii", b"0 0 0 255 128 0\n1 0 0 255 128 0\n0 1 0 255 128 0\n7 3 0 1 2\n9\n");
    let expected = [Vec3::ZERO, Vec3::X, Vec3::Y];
    for bytes in [text, ply_binary(false), ply_binary(true)] {
        let scene = load_with(&bytes, MeshFormat::Ply, plain()).unwrap();
        assert_eq!(corners(&scene), expected);
        assert_eq!(scene.textures[0].texels[0], [255, 128, 0, 255]);
        assert!(scene.bodies[0].mesh.normals.iter().all(|n| *n == Vec3::Z));
    }
}

/// As of MeshLab, which writes colours of corners without declaring them: the next element begins in the next line.
#[test]
fn what_a_line_of_a_ply_holds_beyond_its_element_is_ignored_and_told() {
    let text = ply(
        "ascii",
        b"0 0 0 255 128 0 8 8\n1 0 0 255 128 0\n0 1 0 255 128 0  \r\n7 3 0 1 2 9 1 1 1 1 1 1 1 1 1\n9\n",
    );
    let scene = load_with(&text, MeshFormat::Ply, plain()).unwrap();
    assert_eq!(corners(&scene), [Vec3::ZERO, Vec3::X, Vec3::Y]);
    assert!(
        scene.warnings.iter().any(|w| w.contains("2 lines hold more than the header declares")),
        "{:?}",
        scene.warnings
    );
    let usual = ply("ascii", b"0 0 0 255 128 0\n1 0 0 255 128 0\n0 1 0 255 128 0\n7 3 0 1 2\n9\n");
    let scene = load_with(&usual, MeshFormat::Ply, plain()).unwrap();
    assert!(!scene.warnings.iter().any(|w| w.contains("lines hold")), "{:?}", scene.warnings);
}

fn stl_binary(triangles: u32) -> Vec<u8> {
    let mut bytes = b"solid is what some binary files begin with".to_vec();
    bytes.resize(80, b' ');
    bytes.extend(triangles.to_le_bytes());
    for _ in 0..triangles {
        bytes.extend(
            [0.0f32, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0].map(f32::to_le_bytes).concat(),
        );
        bytes.extend([0; 2]);
    }
    bytes
}

const STL: &str = "solid one\n facet normal 0 0 1\n outer loop\n vertex 0 0 0\n VERTEX 1 0 0\n vertex 0 1 0\n endloop\n endfacet\nendsolid one\n";

#[test]
fn an_stl_says_the_same_as_text_and_as_bytes() {
    let expected = [Vec3::ZERO, Vec3::X, Vec3::Y];
    for bytes in [STL.as_bytes().to_vec(), stl_binary(1)] {
        assert_eq!(corners(&load_with(&bytes, MeshFormat::Stl, plain()).unwrap()), expected);
    }
    let two = STL.to_owned() + &STL.replace("one", "two");
    let names: Vec<String> =
        load(two.as_bytes(), MeshFormat::Stl).unwrap().bodies.into_iter().map(|b| b.name).collect();
    assert_eq!(names, ["one", "two"]);
}

#[test]
fn formats_are_told_by_bytes_and_ending() {
    let of = |name: &str, bytes: &[u8]| MeshFormat::of(Some(Path::new(name)), bytes);
    assert_eq!(of("a.obj", b"v 0 0 0"), Some(MeshFormat::Obj));
    assert_eq!(of("a.STL", b""), Some(MeshFormat::Stl));
    assert_eq!(of("a.bin", &stl_binary(2)), Some(MeshFormat::Stl));
    assert_eq!(of("a.obj", b"ply\nformat"), Some(MeshFormat::Ply), "the bytes win");
    assert_eq!(of("a.stl", b"glTF\x02\0\0\0"), None);
    assert_eq!(MeshFormat::of(None, b"{}"), None);
}

/// A cube's corner points far enough apart to have `size` as its longest side along z.
fn tall(size: f32) -> String {
    format!("v 0 0 0\nv 0.2 0 0\nv 0 0 {size}\nf 1 2 3\n")
}

#[test]
fn units_and_the_upward_axis_are_guessed_told_and_corrected() {
    let extent = |scene: &Scene| corners(scene).into_iter().fold(Vec3::ZERO, |most, p| most.max(p.abs()));
    let obj = |size: f32, options| load_with(tall(size).as_bytes(), MeshFormat::Obj, options).unwrap();
    for (size, metres) in [(0.3, 0.3), (30.0, 0.3), (1000.0, 1.0), (0.001, 0.001)] {
        let scene = obj(size, LoadOptions::default());
        assert!((extent(&scene).z - metres).abs() < 1e-5 * metres.max(0.2), "{size}: {}", extent(&scene));
        assert!(
            scene.warnings.iter().any(|w| w.contains("scene.scale") && w.contains("y is taken")),
            "{:?}",
            scene.warnings
        );
    }
    assert!(obj(0.001, LoadOptions { scale: Some(1.0), ..LoadOptions::default() }).warnings.len() == 1);
    let corrected =
        obj(30.0, LoadOptions { scale: Some(0.1), up: Some(crate::UpAxis::Z), ..LoadOptions::default() });
    assert!((extent(&corrected).y - 3.0).abs() < 1e-5, "z is up: {}", extent(&corrected));
    // The body's own axes are turned with it: at rest it is not rotated.
    let rest = corrected.bodies[0].world_from_body_rest;
    assert!(
        (rest.matrix3 - glam::DMat3::IDENTITY).to_cols_array().iter().all(|x| x.abs() < 1e-12),
        "{rest:?}"
    );
    // A printer's file: millimetres, z up.
    let stl = STL.replace("0 1 0", "0 0 80");
    let scene = load(stl.as_bytes(), MeshFormat::Stl).unwrap();
    assert!((extent(&scene).y - 0.08).abs() < 1e-6, "{}", extent(&scene));
}

#[test]
fn what_is_wrong_is_named_with_its_line() {
    use MeshFormat::{Obj, Ply, Stl};
    for (bytes, format, told) in [
        ("v 0 0\n", Obj, "has no faces"),
        ("v 0 0 0\n\nf 1 2 3\n", Obj, "no face whose vertices are there: 1 name others"),
        ("v 0 0 0\nf 1 1 0\n", Obj, "1 name others"),
        ("v 0 0 0\nf 1 1 -2\n", Obj, "1 name others"),
        ("v 0 0 0\nf 1 1 a\n", Obj, "1 name others"),
        ("v 0 0 0\n", Obj, "has no faces"),
        ("\u{feff}hello\n", Obj, "has no faces"),
        ("ply\nformat ascii 1.0\n", Ply, "end_header"),
        ("ply\nformat odd 1.0\nend_header\n", Ply, "the format 'odd'"),
        ("ply\nformat ascii 1.0\nelement vertex many\nend_header\n", Ply, "line 3 is no declaration"),
        ("ply\nformat ascii 1.0\nelement vertex 4000000000\nproperty float x\nproperty float y\nproperty float z\nend_header\n1 2 3", Ply, "cut off"),
        ("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n1 2 3\n", Ply, "a cloud of points"),
        ("ply\nformat ascii 1.0\nelement none 4000000000\nend_header\n", Ply, "is empty: it has no vertices"),
        ("solid\nfacet\nvertex 0 0 0\nendfacet\n", Stl, "no facet that is whole (1 are damaged or cut off)"),
        ("short", Stl, "too few for STL"),
    ] {
        let why = refusal(bytes.as_bytes(), format);
        assert!(why.contains(told), "{bytes:?}: {why}");
    }
    // What is there of a file that is cut off is shown, and the rest is counted.
    let cut = &stl_binary(3)[..150];
    let scene = load(&[b"binar", &cut[5..]].concat(), Stl).unwrap();
    assert!(corners(&scene).len() == 3 && told(&scene).contains("promises 3 triangles, 1 are there"));
}

#[test]
fn limits_hold_before_memory_is_taken() {
    let limits = crate::Limits { triangles: 1, ..crate::Limits::default() };
    let options = LoadOptions { limits, ..LoadOptions::default() };
    let two = STL.to_owned() + STL;
    for (bytes, format) in [
        (format!("{QUAD}f 1 2 3 4\n").into_bytes(), MeshFormat::Obj),
        (two.into_bytes(), MeshFormat::Stl),
        (stl_binary(2), MeshFormat::Stl),
    ] {
        let why = load_with(&bytes, format, options.clone()).unwrap_err().to_string();
        assert!(why.contains("the number of triangles"), "{why}");
    }
}

#[test]
fn materials_and_pictures_are_read_beside_the_file_and_what_is_missing_is_told_once() {
    let folder = std::env::temp_dir().join(format!("dpm-obj-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    image::RgbImage::from_pixel(2, 2, image::Rgb([9, 80, 200])).save(folder.join("a b.png")).unwrap();
    let mtl = "newmtl red thing\nKd 1 0 0\nKs 1 1 1\nNs 30\nnewmtl picture\nKd 0 0 0\nmap_Kd -s 1 1 1 gone.png\nmap_Kd C:\\old\\a b.png\nbump x.png\nnewmtl lamp\nKe 2 2 2\nd 0.5\n";
    std::fs::write(folder.join("a.mtl"), mtl).unwrap();
    let text = format!("mtllib a.mtl\nmtllib gone.mtl\n{QUAD}usemtl red thing\nf 1 2 3\nusemtl picture\nf 1 3 4\nusemtl lamp\nf 1 2 4\n");
    std::fs::write(folder.join("a.obj"), text).unwrap();
    let scene = crate::load(&folder.join("a.obj"), &plain()).unwrap();
    std::fs::remove_dir_all(&folder).unwrap();
    let named =
        |name: &str| scene.materials.iter().find(|m| m.name == name).unwrap_or_else(|| panic!("{name}"));
    let red = named("red thing");
    assert!(
        red.base_color == Vec3::X && red.metallic == 0.0 && (red.roughness - 0.5).abs() < 1e-3,
        "{red:?}"
    );
    let picture = named("picture");
    assert!(picture.base_color == Vec3::ONE && picture.base_color_texture.is_some(), "{picture:?}");
    assert_eq!(scene.textures[0].texels[0], [9, 80, 200, 255]);
    assert_eq!(named("lamp").emissive, Vec3::splat(2.0));
    assert_eq!(scene.bodies[0].name, "a", "the file's name");
    let told = scene.warnings.join("\n");
    assert!(told.contains("gone.png") && told.contains("and 1 more"), "{told}");
    assert!(told.contains("bump maps (1 times), transparency (d) (1 times)"), "{told}");
}

#[test]
fn damage_anywhere_is_a_refusal_or_a_scene() {
    let obj = format!("mtllib a\no a\n{QUAD}vt 0 0\nvn 0 0 1\ns 1\nusemtl b\nf 1/1/1 2/1/1 3/1/1 4/1/1\n");
    let text = ply("ascii", b"0 0 0 255 128 0\n1 0 0 255 128 0\n0 1 0 255 128 0\n7 3 0 1 2\n9\n");
    let files = [
        (obj.into_bytes(), MeshFormat::Obj),
        (text, MeshFormat::Ply),
        (ply_binary(true), MeshFormat::Ply),
        (STL.as_bytes().to_vec(), MeshFormat::Stl),
        (stl_binary(2), MeshFormat::Stl),
    ];
    for (bytes, format) in files {
        for at in 0..bytes.len() {
            let mut bad = bytes.clone();
            bad[at] ^= 1 << (at % 8);
            for damaged in [&bytes[..at], &bad] {
                if let Err(e) = load(damaged, format) {
                    assert!(!matches!(e, SceneError::Internal(_)), "{e}");
                }
            }
        }
    }
}

fn case(name: &str) -> std::path::PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/assets/cases").join(name)
}

/// Lengths of the sides of the box around all corners.
fn sides(scene: &Scene) -> Vec3 {
    let all = corners(scene);
    let low = all.iter().fold(Vec3::INFINITY, |low, p| low.min(*p));
    all.iter().fold(Vec3::NEG_INFINITY, |high, p| high.max(*p)) - low
}

/// The colour of the first corner of a triangle of the first body, as sRGB.
fn colour(scene: &Scene, triangle: usize) -> Option<[u8; 3]> {
    let mesh = &scene.bodies[0].mesh;
    let used = scene.materials[mesh.materials[triangle] as usize].base_color_texture?;
    let texture = &scene.textures[used.texture as usize];
    let uv = used.apply(mesh.uvs[mesh.triangles[triangle][0] as usize]);
    let (x, y) = ((uv.x * texture.width as f32) as usize, (uv.y * texture.height as f32) as usize);
    let [r, g, b, _] = texture.texels[y * texture.width as usize + x];
    Some([r, g, b])
}

/// Files that other programs write, each with what is right.
#[test]
fn files_of_other_programs_are_opened_and_what_is_left_out_is_told() {
    let solid = Vec3::new(0.6, 0.6, 0.4);
    let ball = Vec3::splat(0.6);
    for (name, triangles, size, note) in [
        ("a01-utm.obj", 36, solid, "(451234.5, 98.3, 5212345.25) of the file is its origin"),
        ("a06-bom.stl", 36, solid, ""),
        ("a07-solid-binary-trailing.stl", 36, solid, "bytes behind the last triangle"),
        ("a09-faces-before-vertices.ply", 36, solid, ""),
        ("a10-face-colours.ply", 36, solid, ""),
        ("a12-two-mtllibs.obj", 36, solid, "nothing.mtl"),
        ("a13-uv-and-normals-missing.obj", 1, Vec3::ZERO, "texture coordinates that are not there"),
        ("a15-tiff.obj", 36, solid, ""),
        ("a18-zbrush-mrgb.obj", 36, solid, ""),
        ("a24-tga-texture.glb", 36, solid, ""),
        ("a25-zero-scale-root.glb", 36, Vec3::ZERO, ""),
        ("a27-inside-out.stl", 528, ball, ""),
        ("a28-451-km.ply", 0, ball, "451.3 km from the origin"),
    ] {
        let options = LoadOptions { up: Some(crate::UpAxis::Y), ..LoadOptions::default() };
        let scene = crate::load(&case(name), &options).unwrap_or_else(|e| panic!("{name}: {e}"));
        let count = corners(&scene).len() / 3;
        assert!(triangles == 0 || count == triangles, "{name}: {count} triangles");
        let got = sides(&scene);
        assert!(size == Vec3::ZERO || (got - size).abs().max_element() < 2e-3, "{name}: {got}");
        assert!(told(&scene).contains(note), "{name}: {}", told(&scene));
    }
    let read = |name: &str| crate::load(&case(name), &LoadOptions::default()).unwrap();
    let reds = ["a10-face-colours.ply", "a18-zbrush-mrgb.obj"].map(|name| colour(&read(name), 0).unwrap());
    assert!(reds[0].iter().zip([220u8, 40, 40]).all(|(a, b)| a.abs_diff(b) < 2), "{reds:?}");
    assert!(reds[1][0] > 100 && reds[1][1] < 100, "{reds:?}");
    for name in ["a12-two-mtllibs.obj", "a15-tiff.obj"] {
        assert!(colour(&read(name), 0).is_some(), "{name}: {}", told(&read(name)));
    }
    // Formats without a side reflect on both.
    for name in
        ["a27-inside-out.stl", "a28-451-km.ply", "a10-face-colours.ply", "a13-uv-and-normals-missing.obj"]
    {
        let scene = read(name);
        let used = scene.bodies[0].mesh.materials[0];
        assert!(scene.materials[used as usize].double_sided, "{name}");
    }
    // The ball is round, 451 km away.
    let far = corners(&read("a28-451-km.ply"));
    let middle = far.iter().sum::<Vec3>() / far.len() as f32;
    let off = far.iter().map(|p| ((*p - middle).length() - 0.3).abs()).fold(0.0, f32::max);
    assert!(off < 2e-3, "{off}");
}

#[test]
fn nodes_are_found_by_their_letters_and_hidden_ones_are_left_out() {
    let named = |node: &str| LoadOptions {
        bodies: vec![crate::BodySelector { name: "hare".into(), node: Some(node.into()), projected: true }],
        ..LoadOptions::default()
    };
    assert!(crate::load(&case("a21-name-nfd.glb"), &named("K\u{f6}rper")).is_ok());
    let near = crate::load(&case("a21-name-nfd.glb"), &named("k\u{f6}rper ")).unwrap_err().to_string();
    assert!(near.contains("did you mean"), "{near}");
    let scene = crate::load(&case("a22-hidden-node.glb"), &LoadOptions::default()).unwrap();
    assert!(scene.bodies.len() == 1 && told(&scene).contains("hides"), "{}", told(&scene));
}

/// Damage of a part is left out and counted, and the order of lines does not matter.
#[test]
fn damaged_parts_are_left_out_and_counted() {
    let text = format!("usemtl a\nf 1 2 3\nf 1 2 9\nf 1 x 3\nvn a b\n{QUAD}v 0 0\nhello\n");
    let scene = load_with(text.as_bytes(), MeshFormat::Obj, plain()).unwrap();
    assert_eq!(corners(&scene), [Vec3::ZERO, Vec3::X, Vec3::new(1.0, 1.0, 0.0)]);
    for what in [
        "2 faces name vertices",
        "no word of the format (1 times)",
        "no three numbers (1 times)",
        "are white: a",
    ] {
        assert!(told(&scene).contains(what), "{what}: {}", told(&scene));
    }
    // A PLY with the texture of its corners, two faces of which one is damaged, and cut off in the third.
    let ply = "ply\nformat ascii 1.0\nelement vertex 3\nproperty double x\nproperty double y\nproperty double z\n\
               property float quality\nelement face 3\nproperty list uchar int vertex_indices\n\
               property list uchar float texcoord\nend_header\n0 0 0 1\n1 0 0 1\n0 1 0 1\n3 0 1 2 6 0 0 1 0 0 1\n\
               3 0 1 7 6 0 0 1 0 0 1\n3 0 1";
    let scene = load_with(ply.as_bytes(), MeshFormat::Ply, plain()).unwrap();
    let mesh = &scene.bodies[0].mesh;
    let uvs: Vec<glam::Vec2> = mesh.triangles[0].iter().map(|i| mesh.uvs[*i as usize]).collect();
    assert_eq!(uvs, [glam::Vec2::new(0.0, 1.0), glam::Vec2::new(1.0, 1.0), glam::Vec2::new(0.0, 0.0)]);
    for what in ["1 faces name vertices", "1 of 3 elements 'face'", "vertex quality"] {
        assert!(told(&scene).contains(what), "{what}: {}", told(&scene));
    }
}

/// The two bytes behind the triangles of a binary STL as VisCAM and as Magics write colours.
#[test]
fn colours_of_an_stl_are_read() {
    let with = |head: &[u8], words: [u16; 2]| {
        let mut bytes = stl_binary(2);
        bytes[..head.len()].copy_from_slice(head);
        for (i, word) in words.iter().enumerate() {
            bytes[84 + 50 * i + 48..84 + 50 * (i + 1)].copy_from_slice(&word.to_le_bytes());
        }
        load_with(&bytes, MeshFormat::Stl, plain()).unwrap()
    };
    let red_of_viscam = 1 << 15 | 31 << 10;
    assert_eq!(colour(&with(b"", [red_of_viscam; 2]), 0), Some([255, 0, 0]));
    assert_eq!(colour(&with(b"", [7, 9]), 0), None, "anything else is no colour");
    let magics = with(b"COLOR=\x00\xff\x00\xff", [31, 1 << 15]);
    assert_eq!((colour(&magics, 0), colour(&magics, 1)), (Some([255, 0, 0]), Some([0, 255, 0])));
}
