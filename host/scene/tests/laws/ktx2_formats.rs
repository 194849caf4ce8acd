//! Every format of Vulkan that KTX2 images are read in has the texels that its definition gives, with and without
//! supercompression. Damaged images of these formats neither end the program nor fill its memory.

use crate::common::{chance, changed, ktx2, with_ktx2};
use dpm_scene::{load_bytes, load_bytes_here, Limits, LoadOptions, Scene, SceneError, Texture};
use flate2::{write::ZlibEncoder, Compression};
use half::f16;
use serde_json::json;
use std::io::Write;

/// The supercompression ZLIB.
const ZLIB: u32 = 3;

fn load(image: &[u8]) -> Result<Scene, SceneError> {
    load_bytes(&with_ktx2(image).bytes(), &LoadOptions::default())
}

/// The texels of an image, and whether it is told that something was cut off.
fn shown(image: &[u8]) -> (Vec<[u8; 4]>, bool) {
    let mut scene = load(image).unwrap();
    let told = scene.warnings.iter().filter(|w| w.contains("numbers outside of 0 to 1")).count();
    assert_eq!(scene.warnings.len(), told, "{:?}", scene.warnings);
    assert!(told <= 1, "{:?}", scene.warnings);
    (scene.textures.remove(0).texels, told == 1)
}

/// Why an image is refused, or left out.
fn refusal(image: &[u8]) -> String {
    load(image).map_or_else(|e| e.to_string(), |scene| scene.warnings.join("\n"))
}

fn zlib(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = ZlibEncoder::new(vec![], Compression::best());
    encoder.write_all(bytes).unwrap();
    encoder.finish().unwrap()
}

/// Four numbers as they are stored, as bytes of a texture, and whether something is cut off.
type Numbers = (Vec<Vec<u8>>, [u8; 4], bool);

/// Numbers of every kind, with the formats of one to four channels.
fn kinds() -> Vec<([u32; 4], Numbers)> {
    let bytes = |numbers: [i8; 4]| numbers.map(|n| n.to_le_bytes().to_vec()).to_vec();
    let words = |numbers: [u16; 4]| numbers.map(|n| n.to_le_bytes().to_vec()).to_vec();
    let signed = |numbers: [i16; 4]| numbers.map(|n| n.to_le_bytes().to_vec()).to_vec();
    let halves = |numbers: [f32; 4]| numbers.map(|n| f16::from_f32(n).to_le_bytes().to_vec()).to_vec();
    let singles = |numbers: [f32; 4]| numbers.map(|n| n.to_le_bytes().to_vec()).to_vec();
    vec![
        ([9, 16, 23, 37], (bytes([7, -1, 0, -128]), [7, 255, 0, 128], false)),
        ([10, 17, 24, 38], (bytes([0, 127, -127, -128]), [128, 255, 0, 0], false)),
        ([70, 77, 84, 91], (words([0, 65_535, 128, 129]), [0, 255, 0, 1], false)),
        ([71, 78, 85, 92], (signed([0, 32_767, -32_768, 16_384]), [128, 255, 0, 191], false)),
        ([76, 83, 90, 97], (halves([0.5, 1.0, 0.0, 0.2]), [128, 255, 0, 51], false)),
        ([76, 83, 90, 97], (halves([1.5, -0.25, f32::INFINITY, f32::NAN]), [255, 0, 255, 0], true)),
        ([100, 103, 106, 109], (singles([0.1, 0.75, 1.0, 1e-30]), [26, 191, 255, 0], false)),
        ([100, 103, 106, 109], (singles([f32::NAN, -1.0, f32::MAX, 2.0]), [0, 0, 255, 255], true)),
    ]
}

#[test]
fn texels_of_one_to_four_channels_of_every_kind_are_read() {
    for (formats, (stored, expected, cut_off)) in kinds() {
        for (channels, format) in (1..).zip(formats) {
            // Two texels: the first numbers, and the last ones.
            let data = [stored[..channels].concat(), stored[4 - channels..].concat()].concat();
            let texel = |numbers: &[u8]| {
                let mut texel = [0, 0, 0, 255];
                texel[..channels].copy_from_slice(numbers);
                texel
            };
            let texels = vec![texel(&expected[..channels]), texel(&expected[4 - channels..])];
            for image in [ktx2(format, 2, 1, 0, &data), ktx2(format, 2, 1, ZLIB, &zlib(&data))] {
                assert_eq!(shown(&image), (texels.clone(), cut_off), "format {format}");
            }
            let short = ktx2(format, 2, 1, 0, &data[1..]);
            assert!(refusal(&short).contains("the data is cut off"), "format {format}");
        }
    }
    // Blue first, with a sign; and one and two channels in sRGB.
    assert_eq!(shown(&ktx2(31, 1, 1, 0, &[127, 0, 129])).0, [[0, 128, 255, 255]]);
    assert_eq!(shown(&ktx2(45, 1, 1, 0, &[127, 0, 129, 0])).0, [[0, 128, 255, 128]]);
    assert_eq!(shown(&ktx2(15, 1, 1, 0, &[9])).0, [[9, 0, 0, 255]]);
    assert_eq!(shown(&ktx2(22, 1, 1, 0, &[9, 8])).0, [[9, 8, 0, 255]]);
}

/// A picture of one block.
fn one_block(format: u32, block: &[u8]) -> (Vec<[u8; 4]>, bool) {
    shown(&ktx2(format, 4, 4, 0, block))
}

/// A block of BC4 whose texels have the indices 0 to 7, row by row, twice.
fn bc4(first: u8, second: u8) -> [u8; 8] {
    let bits = (0..16).rev().fold(0_u64, |bits, i| (bits << 3) | (i % 8));
    (bits << 16 | u64::from(second) << 8 | u64::from(first)).to_le_bytes()
}

/// The eight values of a block of BC4 in sevenths or fifths, and what they are fractions of.
fn palette(first: i32, second: i32, least: i32, most: i32) -> [f64; 8] {
    let parts = if first > second { 7 } else { 5 };
    std::array::from_fn(|i| match i as i32 {
        0 => first.into(),
        1 => second.into(),
        6 if parts == 5 => least.into(),
        7 if parts == 5 => most.into(),
        i => f64::from(first * (parts + 1 - i) + second * (i - 1)) / f64::from(parts),
    })
}

#[test]
fn blocks_of_one_and_two_channels_lie_between_their_ends() {
    let unsigned = |a: u8, b: u8| palette(a.into(), b.into(), 0, 255).map(|v| v.round() as u8);
    let signed = |a: u8, b: u8| {
        let [a, b] = [a, b].map(|v| i32::from(v as i8).max(-127));
        palette(a, b, -127, 127).map(|v| ((v + 127.0) * 255.0 / 254.0).round() as u8)
    };
    for (a, b) in [(240, 30), (30, 240), (255, 0), (7, 7), (100, 206), (206, 100), (128, 127), (127, 128)] {
        for (format, expected) in [(139, unsigned(a, b)), (140, signed(a, b))] {
            let red: Vec<u8> = (0..16).map(|i| expected[i % 8]).collect();
            let texels: Vec<_> = red.iter().map(|r| [*r, 0, 0, 255]).collect();
            assert_eq!(one_block(format, &bc4(a, b)), (texels, false), "{format}: {a} to {b}");
            let green = if format == 139 { unsigned(90, 200) } else { signed(90, 200) };
            let texels: Vec<_> = (0..16).map(|i| [red[i], green[i % 8], 0, 255]).collect();
            let both = [bc4(a, b), bc4(90, 200)].concat();
            assert_eq!(one_block(format + 2, &both), (texels, false), "{format}: {a} to {b}");
        }
    }
}

/// A block of BC6H in mode 11: one region, ends of ten bits as they are, and the indices 0 to 15.
fn bc6h(first: [i32; 3], second: [i32; 3]) -> [u8; 16] {
    let mut bits = 3_u128;
    for (k, end) in first.iter().chain(&second).enumerate() {
        bits |= ((end & 1023) as u128) << (5 + 10 * k);
    }
    // The first index is 0, of three bits.
    (1..16).fold(bits, |bits, i| bits | i << (64 + 4 * i)).to_le_bytes()
}

/// The numbers of red, green and blue that the definition gives to such a block.
fn definition(first: [i32; 3], second: [i32; 3], signed: bool) -> Vec<[f32; 3]> {
    const WEIGHTS: [i32; 16] = [0, 4, 9, 13, 17, 21, 26, 30, 34, 38, 43, 47, 51, 55, 60, 64];
    let widened = |end: i32| match (end.abs(), signed) {
        (0, _) => 0,
        (1023, false) => 0xffff,
        (most, true) if most >= 511 => 0x7fff * end.signum(),
        (_, false) => ((end << 16) + 0x8000) >> 10,
        (size, true) => (((size << 15) + 0x4000) >> 9) * end.signum(),
    };
    let number = |v: i32| {
        let bits = if signed { (v.abs() * 31) >> 5 } else { (v * 31) >> 6 };
        f16::from_bits(bits as u16).to_f32() * if v < 0 { -1.0 } else { 1.0 }
    };
    let texel = |w: i32| {
        std::array::from_fn(|k| number((widened(first[k]) * (64 - w) + widened(second[k]) * w + 32) >> 6))
    };
    WEIGHTS.into_iter().map(texel).collect()
}

#[test]
fn light_in_blocks_is_cut_off_at_one() {
    let cases = [
        (143, [0, 495, 463], [463, 0, 495], false),
        (143, [0, 495, 463], [1023, 495, 600], true),
        (144, [0, 247, 100], [247, 30, 200], false),
        (144, [-511, 0, -100], [247, 511, 100], true),
    ];
    for (format, first, second, cut_off) in cases {
        let numbers = definition(first, second, format == 144);
        let byte = |v: f32| (v.clamp(0.0, 1.0) * 255.0).round() as u8;
        let texels: Vec<_> = numbers.iter().map(|t| [byte(t[0]), byte(t[1]), byte(t[2]), 255]).collect();
        assert_eq!(one_block(format, &bc6h(first, second)), (texels, cut_off), "{format}");
    }
    // 495 of 1023 is 1, and 463 is 0.515625; the greatest number is 65504.
    let numbers = definition([0, 495, 463], [1023, 0, 0], false);
    assert_eq!((numbers[0], numbers[15]), ([0.0, 1.0, 0.515_625], [65_504.0, 0.0, 0.0]));
    // A mode that does not exist is black.
    assert_eq!(one_block(143, &[0x13; 16]), (vec![[0, 0, 0, 255]; 16], false));
}

#[test]
fn blocks_of_etc_are_read_by_their_format() {
    // A solid colour of (3, 10, 15) of 15 each; alpha and channels of 11 bits at their base.
    let colours = [0x33, 0xaa, 0xff, 0, 0xff, 0xff, 0, 0];
    let base = |base: u8| [base, 0x1d, 0x92, 0x49, 0x24, 0x92, 0x49, 0x24];
    let both = [base(77), colours].concat();
    let cases = [
        (147, colours.to_vec(), [49, 168, 253, 255]),
        (148, colours.to_vec(), [49, 168, 253, 255]),
        (151, both.clone(), [49, 168, 253, 77]),
        (152, both, [49, 168, 253, 77]),
        // 8 x 77 + 4 of 2047; 8 x 77 of 1023, halfway up.
        (153, base(77).to_vec(), [77, 0, 0, 255]),
        (154, base(77).to_vec(), [204, 0, 0, 255]),
        (155, [base(77), base(200)].concat(), [77, 200, 0, 255]),
        (156, [base(77), base(200)].concat(), [204, 72, 0, 255]),
    ];
    for (format, block, texel) in cases {
        assert_eq!(one_block(format, &block), (vec![texel; 16], false), "format {format}");
        // Five by three texels lie in two blocks.
        let two = [&block[..], &block].concat();
        assert_eq!(shown(&ktx2(format, 5, 3, ZLIB, &zlib(&two))).0, [texel; 15], "format {format}");
        assert!(refusal(&ktx2(format, 5, 3, 0, &two[1..])).contains("the data is cut off"));
    }
    // Holes, in both names of the format.
    for format in [149, 150] {
        let block = [0x30, 0xa8, 0xf8, 0, 0xff, 0xff, 0, 0];
        assert_eq!(one_block(format, &block), (vec![[0; 4]; 16], false));
    }
}

#[test]
fn an_image_in_srgb_is_taken_for_one() {
    let block = [0x33, 0xaa, 0xff, 0, 0xff, 0xff, 0, 0];
    let srgb = ktx2(148, 4, 4, 0, &block);
    assert!(load(&srgb).unwrap().warnings.is_empty());
    // The third byte of the third word of the descriptor says so.
    let linear = changed(&ktx2(147, 4, 4, 0, &block), 104 + 12, 1 | 1 << 8 | 1 << 16);
    let scene = load(&linear).unwrap();
    assert!(scene.textures[0].srgb);
    assert!(scene.warnings[0].contains("it says that it is linear"), "{:?}", scene.warnings);
}

#[test]
fn two_channels_are_normals_where_gltf_wants_normals() {
    let data = [128, 128, 255, 128, 128, 0, 255, 255, 218, 128];
    let image = changed(&ktx2(16, 5, 1, 0, &data), 104 + 12, 1 | 1 << 8 | 1 << 16);
    let file = with_ktx2(&image)
        .set("/materials/0/pbrMetallicRoughness", json!({"metallicRoughnessTexture": {"index": 0}}))
        .set("/materials/0/normalTexture", json!({"index": 0}));
    let scene = load_bytes(&file.bytes(), &LoadOptions::default()).unwrap();
    let of = |r: Option<dpm_scene::TextureRef>| &scene.textures[r.unwrap().texture as usize].texels;
    let material = scene.materials.iter().find(|m| m.name == "paint").unwrap();
    let stored = [[128, 128], [255, 128], [128, 0], [255, 255], [218, 128]];
    assert_eq!(*of(material.metallic_roughness_texture), stored.map(|[r, g]| [r, g, 0, 255]));
    // Upwards, along the surface, and by 45 degrees.
    let heights = [255, 128, 128, 128, 217];
    let normals: Vec<_> = stored.iter().zip(heights).map(|([r, g], z)| [*r, *g, z, 255]).collect();
    assert_eq!(*of(material.normal_texture), normals);
    assert!(scene.warnings.is_empty(), "{:?}", scene.warnings);
}

#[test]
fn a_zlib_stream_that_lies_is_refused() {
    let data = vec![200; 16 * 16 * 4];
    let image = |packed: &[u8]| ktx2(37, 16, 16, ZLIB, packed);
    let packed = zlib(&data);
    assert_eq!(shown(&image(&packed)).0, [[200; 4]; 256]);
    // What the file says of its size without compression is not asked.
    for size in [0, u32::MAX] {
        let lie = changed(&changed(&image(&packed), 96, size), 100, size);
        assert_eq!(shown(&lie).0, [[200; 4]; 256]);
    }
    let mut wrong_sum = packed.clone();
    *wrong_sum.last_mut().unwrap() ^= 1;
    let cases = [
        (image(&zlib(&data[1..])), "cannot be decompressed"),
        (image(&zlib(&[&data[..], &[0]].concat())), "holds more than the 1024 bytes"),
        (image(&wrong_sum), "cannot be decompressed"),
        (image(&packed[..packed.len() - 5]), "cannot be decompressed"),
        (image(&data), "cannot be decompressed"),
        // 16 MB from a stream that holds at most 1032 bytes for each of its own.
        (ktx2(37, 2048, 2048, ZLIB, &packed), "the data is cut off"),
        (image(&[]), "cannot be decompressed"),
        (changed(&image(&packed), 44, 4), "with supercompression SupercompressionScheme(4)"),
    ];
    for (image, expected) in cases {
        let said = refusal(&image);
        assert!(said.contains(expected) && said.contains("image 0"), "{expected}: {said}");
    }
    // No level is one level, whose smaller ones would be computed.
    assert_eq!(shown(&changed(&image(&packed), 40, 0)).0, [[200; 4]; 256]);
}

#[test]
fn damaged_images_of_every_format_give_a_picture_or_an_error() {
    let mut chance = chance(0x9e37_79b9_7f4a_7c15);
    let options =
        LoadOptions { limits: Limits { texels: 1 << 16, ..Limits::default() }, ..LoadOptions::default() };
    for format in (9..=109).chain(131..=156) {
        let data: Vec<u8> = (0..9 * 7 * 16).map(|_| chance() as u8).collect();
        for (scheme, stored) in [(0, data.clone()), (ZLIB, zlib(&data))] {
            let image = ktx2(format, 9, 7, scheme, &stored);
            for round in 0..12 {
                let mut bad = image.clone();
                match round {
                    0 => {}
                    1..5 => bad.truncate(chance() % bad.len()),
                    _ => (0..1 + chance() % 3).for_each(|_| {
                        let at = chance() % if round < 9 { 148 } else { bad.len() };
                        bad[at] = chance() as u8;
                    }),
                }
                match load_bytes_here(&with_ktx2(&bad).bytes(), &options) {
                    Ok(scene) => {
                        let whole = |t: &Texture| t.texels.len() == (t.width * t.height) as usize;
                        assert!(scene.textures.iter().all(whole), "format {format}");
                        // One that is left out is told.
                        assert!(!scene.textures.is_empty() || !scene.warnings.is_empty());
                    }
                    Err(e) => {
                        assert!(!matches!(e, SceneError::Internal(_)), "format {format}: {e}");
                        assert!(!e.to_string().is_empty() && e.to_string().len() < 1000);
                    }
                }
            }
        }
    }
}
