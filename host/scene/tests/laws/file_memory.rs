//! No file makes the readers ask for more memory at once than 64 MB and sixteen times its bytes, however much it promises.

use crate::common::{chance, tetrahedra, with_image};
use crate::ktx2_textures::greatest_in;
use dpm_camera_files::{self as camera_files, LengthUnit, LensKind, ReadOptions};
use dpm_scene::{
    decode_environment, decode_picture_here, load_bytes_here, load_linear_picture, load_mesh_here,
    LoadOptions, MeshFormat,
};
use flate2::write::{GzEncoder, ZlibEncoder};
use flate2::Compression;
use serde_json::json;
use std::io::{Cursor, Write};
use std::path::Path;

/// Every reader of files, with the greatest piece of memory that it asked for.
fn greatest(bytes: &[u8]) -> [(&'static str, usize); 8] {
    let options = || LoadOptions::default();
    let mesh = |format| drop(load_mesh_here(bytes, format, &options()));
    let raster = dpm_device::planes::Raster::new(1024, 768).unwrap();
    let calibration =
        ReadOptions { raster, unit: LengthUnit::Metre, lens: LensKind::Auto, region: None, device: None };
    let readers: [(&'static str, &dyn Fn()); 8] = [
        ("glTF", &|| drop(load_bytes_here(bytes, &options()))),
        ("OBJ", &|| mesh(MeshFormat::Obj)),
        ("PLY", &|| mesh(MeshFormat::Ply)),
        ("STL", &|| mesh(MeshFormat::Stl)),
        ("environment", &|| drop(decode_environment(bytes, 0.0, 1.0))),
        ("texture", &|| drop(decode_picture_here(bytes))),
        ("flat field", &|| drop(load_linear_picture(bytes))),
        ("calibration", &|| drop(camera_files::read(bytes, &calibration))),
    ];
    readers.map(|(name, read)| (name, greatest_in(read)))
}

fn check(what: &str, bytes: &[u8]) {
    let allowed = 64_000_000 + 16 * bytes.len();
    for (reader, asked) in greatest(bytes) {
        assert!(asked <= allowed, "{what} of {} bytes, read as {reader}: {asked} bytes at once", bytes.len());
    }
}

fn png(width: u32, height: u32, deep: bool) -> Vec<u8> {
    let mut out = Cursor::new(vec![]);
    let picture = if deep {
        image::DynamicImage::new_rgba16(width, height)
    } else {
        image::DynamicImage::new_rgb8(width, height)
    };
    picture.write_to(&mut out, image::ImageFormat::Png).unwrap();
    out.into_inner()
}

/// A Radiance picture of black runs.
fn radiance(width: usize, height: usize) -> Vec<u8> {
    let mut out = format!("#?RADIANCE\n\n-Y {height} +X {width}\n").into_bytes();
    let runs: Vec<u8> =
        (0..width.div_ceil(127)).flat_map(|i| [128 + (width - 127 * i).min(127) as u8, 0]).collect();
    let row = [vec![2, 2, (width >> 8) as u8, width as u8], runs.repeat(4)].concat();
    out.extend(row.repeat(height));
    out
}

/// A PNG of one texel whose profile of colours unpacks to 200 MB.
fn png_with_long_profile() -> Vec<u8> {
    let mut packed = ZlibEncoder::new(vec![], Compression::best());
    packed.write_all(&vec![0; 200_000_000]).unwrap();
    let content = [b"iCCPa\0\0".to_vec(), packed.finish().unwrap()].concat();
    let mut crc = flate2::Crc::new();
    crc.update(&content);
    let chunk = [&(content.len() as u32 - 4).to_be_bytes()[..], &content, &crc.sum().to_be_bytes()].concat();
    let whole = png(1, 1, false);
    // Behind the signature and the header.
    [&whole[..33], &chunk, &whole[33..]].concat()
}

/// A black and white BMP, of which a texel is a bit.
fn bmp_of_bits(side: u32) -> Vec<u8> {
    let rows = vec![0; (side.div_ceil(32) * 4 * side) as usize];
    let mut out = b"BM".to_vec();
    for number in [62 + rows.len() as u32, 0, 62, 40, side, side, 1 | 1 << 16, 0, 0, 1, 1, 2, 0, 0, u32::MAX]
    {
        out.extend(number.to_le_bytes());
    }
    [out, rows].concat()
}

/// A TIFF whose strips, or tiles of these sides, are all the same zeros in a few bytes.
fn tiff([width, height]: [u32; 2], [bits, samples]: [u32; 2], [wide, high]: [u32; 2]) -> Vec<u8> {
    let is_tile = wide != width;
    let mut packed = ZlibEncoder::new(vec![], Compression::best());
    let texels = u64::from(wide) * u64::from(high);
    let unpacked = texels.saturating_mul(u64::from(bits * samples) / 8).min(20_000_000);
    packed.write_all(&vec![0; unpacked as usize]).unwrap();
    let packed = packed.finish().unwrap();
    let count = width.div_ceil(wide) * height.div_ceil(high);
    let (place, length) = if is_tile { (324, 325) } else { (273, 279) };
    let mut tags =
        vec![(256, width), (257, height), (258, bits), (259, 8), (262, 1 + u32::from(samples > 2))];
    tags.extend([(277, samples), (place, 0), (length, 0)]);
    tags.extend(if is_tile { vec![(322, wide), (323, high)] } else { vec![(278, high)] });
    tags.sort_unstable();
    let behind = 14 + 12 * tags.len() as u32;
    let mut out = [&b"II*\0\x08\0\0\0"[..], &(tags.len() as u16).to_le_bytes()].concat();
    for (tag, value) in tags {
        let (numbers, value) = match tag {
            tag if tag == place => (count, if count == 1 { behind + 8 } else { behind }),
            tag if tag == length => {
                (count, if count == 1 { packed.len() as u32 } else { behind + 4 * count })
            }
            _ => (1, value),
        };
        out.extend([(tag as u16).to_le_bytes(), 4u16.to_le_bytes()].concat());
        out.extend([numbers.to_le_bytes(), value.to_le_bytes()].concat());
    }
    out.extend([0; 4]);
    out.extend((behind + 8 * count).to_le_bytes().repeat(count as usize));
    out.extend((packed.len() as u32).to_le_bytes().repeat(count as usize));
    [out, packed].concat()
}

/// 400 triangles in 2,490 places: a list of their corners that doubles would be longer than allowed.
fn instances() -> Vec<u8> {
    let mut file = tetrahedra();
    let places: Vec<f32> = (0..3 * 2490).map(|i| i as f32 * 1e-4).collect();
    let at = file.push_numbers("VEC3", &places);
    let corners: Vec<f32> = (0..3 * 1200).map(|i| (i * i % 251) as f32).collect();
    let corners = file.push_numbers("VEC3", &corners);
    file.set("/meshes/1", json!({"primitives": [{"attributes": {"POSITION": corners}}]}))
        .set("/nodes/0/mesh", json!(1))
        .set("/nodes/0/extensions", json!({"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": at}}}))
        .bytes()
}

/// Files that promise much in few bytes.
fn bombs() -> Vec<(&'static str, Vec<u8>)> {
    let text = |text: String| text.into_bytes();
    let zeros = vec![0u8; 32 << 20];
    let mut gzip = GzEncoder::new(vec![], Compression::fast());
    gzip.write_all(&zeros).unwrap();
    let mut zlib = ZlibEncoder::new(vec![], Compression::fast());
    zlib.write_all(&zeros).unwrap();
    let ply = |form: &str, element: &str, count: u64, property: &str| {
        format!("ply\nformat {form} 1.0\nelement {element} {count}\n{property}\nend_header\n").into_bytes()
    };
    let ply_lists = [
        ply("binary_little_endian", "face", 4_000_000_000, "property list uint uint vertex_indices"),
        u32::MAX.to_le_bytes().repeat(64),
    ];
    let stl = [vec![0; 80], u32::MAX.to_le_bytes().to_vec(), vec![0; 500]].concat();
    let accessor = |count: u64| {
        let document = format!(
            "{{\"asset\":{{\"version\":\"2.0\"}},\"scenes\":[{{\"nodes\":[0]}}],\"nodes\":[{{\"mesh\":0}}],\"meshes\":[{{\"primitives\":\
             [{{\"attributes\":{{\"POSITION\":0}}}}]}}],\"accessors\":[{{\"componentType\":5126,\"type\":\"VEC3\",\"count\":{count}}}]}}"
        );
        document.into_bytes()
    };
    vec![
        ("PNG of 8192 x 4096", png(8192, 4096, false)),
        ("deep PNG of 4096 x 3000", png(4096, 3000, true)),
        ("PNG of 1500 x 1000", png(1500, 1000, true)),
        ("Radiance of 8192 x 4096", radiance(8192, 4096)),
        ("Radiance of 4096 x 2048", radiance(4096, 2048)),
        ("PFM", text("PF\n8192 4096\n-1\n".into())),
        ("gzip", gzip.finish().unwrap()),
        ("zlib", zlib.finish().unwrap()),
        ("PLY with vertices", ply("binary_little_endian", "vertex", 4_000_000_000, "property double x")),
        ("PLY with faces", ply("ascii", "face", 4_000_000_000, "property list uchar int vertex_indices")),
        ("PLY with lists", ply_lists.concat()),
        ("PLY with properties", ply("ascii", "vertex", 1, &"property double x\n".repeat(40_000))),
        ("STL", stl),
        (
            "OBJ with one long face",
            text(format!("v 0 0 0\nv 1 0 0\nv 0 1 0\nf{}\n", " 1 2 3".repeat(400_000))),
        ),
        ("OBJ with objects", text("o a\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf -1 -2 -3\n".repeat(60_000))),
        ("OBJ with far indices", text("f 2000000000 1999999999 4000000000\n".repeat(1000))),
        ("accessor", accessor(2_000_000_000)),
        ("accessor within the limits", accessor(3_000_000)),
        ("instances", instances()),
        (
            "JSON of numbers",
            text(format!("{{\"asset\":{{\"version\":\"2.0\"}},\"extras\":[{}0]}}", "0,".repeat(1_500_000))),
        ),
        ("YAML of rows", text(format!("%YAML:1.0\nK: [{}0]\n", "0,".repeat(400_000)))),
        ("glTF with a picture of 8192 x 4096", with_image(&png(8192, 4096, false)).bytes()),
        ("PNG with a long profile", png_with_long_profile()),
        ("glTF with a long profile", with_image(&png_with_long_profile()).bytes()),
        ("glTF with a BMP of bits", with_image(&bmp_of_bits(7000)).bytes()),
        ("TIFF in one strip", with_image(&tiff([8000, 8000], [8, 3], [8000, 8000])).bytes()),
        ("TIFF in strips", with_image(&tiff([8000, 4000], [8, 3], [8000, 100])).bytes()),
        ("TIFF of wide numbers", with_image(&tiff([8000, 4000], [64, 3], [8000, 10])).bytes()),
        ("TIFF of a column in wide tiles", with_image(&tiff([1, 9000], [8, 1], [16_000_000, 1])).bytes()),
        ("TIFF of one huge tile", with_image(&tiff([16, 16], [8, 1], [u32::MAX, u32::MAX])).bytes()),
        ("TIFF of a sky", tiff([8000, 4000], [32, 3], [8000, 100])),
        ("STL of solids", STL_SOLID.repeat(20_000)),
    ]
}

const STL_SOLID: &[u8] =
    b"solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\nendsolid\n";

/// Names cost a look into those before, parts an accessor and a node: none of it may grow with their square.
#[test]
fn a_hundred_thousand_names_and_parts_are_read_in_a_moment_or_refused() {
    let corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\n".to_owned();
    let many = |line: &dyn Fn(usize) -> String| (0..100_000).map(line).collect::<String>();
    let materials = corners.clone() + &many(&|i| format!("usemtl M{i}\nf 1 2 3\n"));
    let objects = corners.clone() + &many(&|i| format!("o b{i}\nf 1 2 3\n"));
    let libraries = corners + "f 1 2 3\n" + &many(&|i| format!("mtllib c{i}.mtl\n"));
    let begin = std::time::Instant::now();
    let load = |text: String| load_mesh_here(text.as_bytes(), MeshFormat::Obj, &LoadOptions::default());
    let told = load(materials).unwrap_err().to_string();
    assert!(told.contains("materials that faces use comes to 100000"), "{told}");
    let told = load(libraries).unwrap_err().to_string();
    assert!(told.contains("files of materials"), "{told}");
    let scene = load(objects).unwrap();
    let triangles: usize = scene.bodies.iter().map(|b| b.mesh.triangles.len()).sum();
    assert!(triangles == 100_000 && scene.warnings.join("").contains("100000 objects"), "{triangles}");
    // Some three seconds without optimisation; with their square it was half a minute with it.
    assert!(begin.elapsed().as_secs() < 60, "{:?}", begin.elapsed());
}

#[test]
fn short_files_ask_for_little_memory_at_once() {
    bombs().into_iter().for_each(|(what, bytes)| check(what, &bytes));
}

#[test]
fn the_files_of_the_repository_ask_for_little_memory_at_once() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let folders = ["mesh", "picture", "environment", "calibration", "gltf"]
        .map(|name| root.join("tests/corpus").join(name));
    let folders = folders
        .into_iter()
        .chain(["cases", "dialects", "exr", "opencv"].map(|name| root.join("tests/assets").join(name)));
    let mut count = 0;
    for entry in folders.flat_map(|folder| std::fs::read_dir(folder).unwrap()) {
        let path = entry.unwrap().path();
        if path.is_file() {
            check(&path.display().to_string(), &std::fs::read(&path).unwrap());
            count += 1;
        }
    }
    assert!(count > 100, "{count} files");
}

/// The same files with bytes that are changed where sizes and counts stand.
mod breadth {
    use super::*;

    #[test]
    fn damaged_files_ask_for_little_memory_at_once() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/assets/cases");
        let mut chance = chance(0x53_53_53_53);
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            let whole = std::fs::read(&path).unwrap();
            for _ in 0..60 {
                let mut damaged = whole.clone();
                for _ in 0..1 + chance() % 4 {
                    let place = chance() % whole.len().min(4096);
                    damaged[place] = [0, 0x7f, 0xff, chance() as u8][chance() % 4];
                }
                check(&path.display().to_string(), &damaged);
            }
        }
    }
}
