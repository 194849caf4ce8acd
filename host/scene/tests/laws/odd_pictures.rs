//! Pictures that few programs write and all read: JPEG with a scan for each colour or a coarse first colour, BMP of OS/2, TIFF that
//! hold a JPEG file, and pictures that leave no room for others.

use crate::common::{png, tetrahedra, with_image};
use dpm_scene::{decode_environment, load_bytes, Environment, Limits, LoadOptions, Scene};
use glam::Vec3;
use serde_json::json;

fn load(bytes: &[u8]) -> Scene {
    load_bytes(bytes, &LoadOptions::default()).unwrap()
}

/// The texels of a picture as a texture.
fn texels(picture: &[u8]) -> (u32, Vec<[u8; 4]>) {
    let scene = load(&with_image(picture).bytes());
    let [texture] = &scene.textures[..] else { panic!("{:?}", scene.warnings) };
    (texture.width, texture.texels.clone())
}

/// A JPEG of flat blocks of 8 x 8: 32 x 16 texels of luma in 4 x 2 blocks, and two chroma of the same blocks or of half as many
/// across and down. `scans` are the colours of each scan, which are not interleaved with others if there is one alone.
fn jpeg(levels: [&[i32]; 3], sampling: [u8; 3], scans: &[&[usize]]) -> Vec<u8> {
    let mut out = vec![0xff, 0xd8];
    let segment = |out: &mut Vec<u8>, mark: u8, content: &[u8]| {
        out.extend([0xff, mark]);
        out.extend((content.len() as u16 + 2).to_be_bytes());
        out.extend(content);
    };
    // Steps of 8, so that the first number of a block is its level.
    segment(&mut out, 0xdb, &[vec![0], vec![8; 64]].concat());
    let frame: Vec<u8> = (0..3).flat_map(|c| [c as u8 + 1, sampling[c], 0]).collect();
    segment(&mut out, 0xc0, &[vec![8, 0, 16, 0, 32, 3], frame].concat());
    // Nine lengths of differences with codes of 4 bits, and one code of 1 bit for the end of a block.
    let lengths =
        |at: usize, count: u8| (1..=16).map(|i| if i == at { count } else { 0 }).collect::<Vec<u8>>();
    segment(&mut out, 0xc4, &[vec![0], lengths(4, 9), (0..9).collect()].concat());
    segment(&mut out, 0xc4, &[vec![0x10], lengths(1, 1), vec![0]].concat());
    for scan in scans {
        let colours: Vec<u8> = scan.iter().flat_map(|c| [*c as u8 + 1, 0]).collect();
        segment(&mut out, 0xda, &[vec![scan.len() as u8], colours, vec![0, 63, 0]].concat());
        let mut bits = String::new();
        let mut before = [0; 3];
        let mut block = |c: usize, at: usize| {
            let step = levels[c][at] - 128 - before[c];
            before[c] = levels[c][at] - 128;
            let length = (32 - step.unsigned_abs().leading_zeros()) as usize;
            bits += &format!("{length:04b}");
            let code = if step < 0 { step + (1 << length) - 1 } else { step };
            bits += &format!("{code:0length$b}")[..length];
            bits += "0";
        };
        let most = sampling.iter().map(|s| s >> 4).max().unwrap();
        if let [c] = scan[..] {
            (0..levels[c].len()).for_each(|at| block(c, at));
        } else {
            // Steps of the coarsest colour, each with all blocks of the finer ones.
            let across = 4 / usize::from(most);
            for unit in 0..across * 2 / usize::from(most) {
                for &c in *scan {
                    let side = usize::from(sampling[c] >> 4);
                    let row = across * side;
                    for at in 0..side * side {
                        let [x, y] = [unit % across * side + at % side, unit / across * side + at / side];
                        block(c, y * row + x);
                    }
                }
            }
        }
        bits += &"1".repeat((8 - bits.len() % 8) % 8);
        for byte in bits.as_bytes().chunks(8) {
            let byte = u8::from_str_radix(std::str::from_utf8(byte).unwrap(), 2).unwrap();
            out.push(byte);
            out.extend((byte == 255).then_some(0));
        }
    }
    [out, vec![0xff, 0xd9]].concat()
}

const FINE: [i32; 8] = [40, 90, 140, 190, 60, 110, 160, 210];
const COARSE: [i32; 2] = [100, 150];

fn assert_levels(file: &[u8], luma: impl Fn(usize, usize) -> i32, chroma: impl Fn(usize, usize) -> i32) {
    let (width, texels) = texels(file);
    assert_eq!((width, texels.len()), (32, 512));
    // In the middle of each block, where no chroma is spread from a neighbour.
    for (x, y) in [4, 12, 20, 28].into_iter().flat_map(|x| [(x, 4), (x, 12)]) {
        let (l, b) = (luma(x / 8, y / 8) as f32, chroma(x / 8, y / 8) as f32 - 128.0);
        let want = [l, l - 0.344 * b, l + 1.772 * b].map(|c| c.clamp(0.0, 255.0));
        let got = texels[y * 32 + x];
        let off = (0..3).map(|c| (f32::from(got[c]) - want[c]).abs()).fold(0.0, f32::max);
        // Chroma of other widths is spread in several ways, also into the middle of a block.
        assert!(off <= 12.0, "({x}, {y}): {got:?} for {want:?}");
    }
}

#[test]
fn a_jpeg_is_the_same_in_one_scan_and_in_one_for_each_colour() {
    let flat = [128; 2];
    let file = |scans: &[&[usize]]| jpeg([&FINE, &COARSE, &flat], [0x22, 0x11, 0x11], scans);
    let one = texels(&file(&[&[0, 1, 2]]));
    for scans in [&[&[0][..], &[1], &[2]][..], &[&[0], &[1, 2]]] {
        let split = file(scans);
        let off = one.1.iter().zip(texels(&split).1).map(|(a, b)| (0..3).map(|c| a[c].abs_diff(b[c])).max());
        let off: Vec<u8> = off.flatten().collect();
        let mean = off.iter().map(|o| f64::from(*o)).sum::<f64>() / off.len() as f64;
        assert!(mean < 2.0, "{scans:?}: {mean}");
        assert_levels(&split, |x, y| FINE[y * 4 + x], |x, _| COARSE[x / 2]);
    }
}

#[test]
fn a_jpeg_whose_luma_is_coarser_than_its_chroma_is_read() {
    let chroma = [100, 110, 120, 130, 140, 150, 160, 170];
    let file = jpeg([&[80, 180], &chroma, &[128; 8]], [0x11, 0x22, 0x22], &[&[0, 1, 2]]);
    assert_levels(&file, |x, _| [80, 180][x / 2], |x, y| chroma[y * 4 + x]);
}

/// Texels that do not fit into memory are not decoded, but halves, quarters or eighths of the sides.
#[test]
fn a_jpeg_too_large_for_its_file_is_read_at_half_its_sides() {
    let row: Vec<u8> = (0..6000).flat_map(|x| [if x < 3000 { 200 } else { 40 }, 90, 30]).collect();
    let mut file = vec![];
    let writer = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut file, 90);
    image::ImageEncoder::write_image(writer, &row.repeat(6000), 6000, 6000, image::ExtendedColorType::Rgb8)
        .unwrap();
    assert!(file.len() < 2_000_000, "{} bytes", file.len());
    let scene = load(&with_image(&file).bytes());
    let texture = &scene.textures[0];
    assert_eq!((texture.width, texture.height), (3000, 3000), "{:?}", scene.warnings);
    let at = |x: usize| texture.texels[1000 * 3000 + x];
    assert!(at(500)[0].abs_diff(200) < 4 && at(2500)[0].abs_diff(40) < 4, "{:?} {:?}", at(500), at(2500));
    assert!(scene.warnings.join("\n").contains("3000 x 3000 of its 6000 x 6000"), "{:?}", scene.warnings);
}

/// The head of a TIFF of 32 x 16 texels, packed in this way and of this kind of colours; what is behind it is named by a tag.
fn directory([packing, colours]: [u32; 2], place: u16) -> Vec<u8> {
    let mut tags = vec![
        (256, 32),
        (257, 16),
        (258, 8),
        (259, packing),
        (262, colours),
        (277, 3),
        (278, 16),
        (place, 110),
    ];
    tags.sort_unstable();
    let mut tiff = b"II*\0\x08\0\0\0\x08\0".to_vec();
    for (tag, value) in tags {
        tiff.extend([tag.to_le_bytes(), 4u16.to_le_bytes()].concat());
        tiff.extend([1u32.to_le_bytes(), value.to_le_bytes()].concat());
    }
    tiff.extend([0; 4]);
    assert_eq!(tiff.len(), 110);
    tiff
}

/// A strip that is a JPEG has colours in the order of the directory, whatever the order of its scans.
#[test]
fn a_jpeg_in_a_tiff_is_the_same_in_one_scan_and_in_one_for_each_colour() {
    let file = |scans: &[&[usize]]| {
        let picture = jpeg([&FINE, &COARSE, &[100, 180]], [0x22, 0x11, 0x11], scans);
        texels(&[directory([7, 6], 273), picture].concat()).1
    };
    let off: Vec<f64> = file(&[&[0, 1, 2]])
        .iter()
        .zip(file(&[&[0], &[1], &[2]]))
        .flat_map(|(a, b)| (0..3).map(move |c| f64::from(a[c].abs_diff(b[c]))))
        .collect();
    let mean = off.iter().sum::<f64>() / off.len() as f64;
    assert!(mean < 2.0, "{mean}");
}

/// A TIFF of the time before JPEG had a number of its own there.
#[test]
fn a_jpeg_file_in_a_tiff_is_read_by_its_own_marks() {
    let file = jpeg([&FINE, &COARSE, &[128; 2]], [0x22, 0x11, 0x11], &[&[0, 1, 2]]);
    // The directory says that the colours are RGB, and the JPEG that they are not.
    let tiff = directory([6, 2], 513);
    assert_eq!(texels(&[&tiff[..], &file].concat()), texels(&file));
    // Tables without a picture are refused by name, and are not read as something else.
    let tables = file.windows(2).position(|mark| mark == [0xff, 0xda]).unwrap();
    let told = load(&with_image(&[&tiff[..], &file[..tables]].concat()).bytes()).warnings.join("\n");
    assert!(told.contains("JPEG of the kind before 1995"), "{told}");
}

#[test]
fn a_bmp_of_os2_is_read_like_one_of_windows() {
    let mut windows = std::io::Cursor::new(vec![]);
    let picture = image::RgbImage::from_fn(5, 3, |x, y| image::Rgb([x as u8 * 50, y as u8 * 80, 7]));
    picture.write_to(&mut windows, image::ImageFormat::Bmp).unwrap();
    let windows = windows.into_inner();
    let place = u32::from_le_bytes(windows[10..14].try_into().unwrap()) as usize;
    for length in [16u32, 24, 64] {
        let mut header = windows[14..14 + length.min(40) as usize].to_vec();
        header.resize(length as usize, 3);
        header[..4].copy_from_slice(&length.to_le_bytes());
        let behind = 14 + length;
        let file = [&windows[..10], &behind.to_le_bytes(), &header, &windows[place..]].concat();
        assert_eq!(texels(&file), texels(&windows), "a header of {length} bytes");
    }
}

/// Runs of places in a list of four colours; damage costs what is behind it or beside it.
#[test]
fn a_bmp_of_runs_is_read_as_far_as_it_is_there() {
    let file = |bits: u32, packed: &[u8]| {
        let packing = if bits == 8 { 1 } else { 2 };
        let head = [70 + packed.len() as u32, 0, 70, 40, 6, 3, 1 | bits << 16, packing, 0, 0, 0, 4, 0];
        let colours = [[0, 0, 0, 0], [10, 20, 30, 0], [40, 50, 60, 0], [70, 80, 90, 0]].concat();
        [b"BM".to_vec(), head.map(u32::to_le_bytes).concat(), colours, packed.to_vec()].concat()
    };
    // From the lowest row up; red stands last.
    let shown = |file: &[u8]| {
        let (width, texels) = texels(file);
        assert_eq!((width, texels.len()), (6, 18));
        let place = |t: &[u8; 4]| u32::from(t[0]).div_ceil(30).to_string();
        texels
            .chunks(6)
            .rev()
            .map(|row| row.iter().map(place).collect::<String>())
            .collect::<Vec<_>>()
            .join(" ")
    };
    let whole = [3, 1, 3, 2, 0, 0, 0, 5, 1, 2, 3, 2, 1, 0, 0, 0, 0, 2, 2, 0, 2, 3, 0, 1];
    assert_eq!(shown(&file(8, &whole)), "111222 123210 003300");
    let fours = [3, 0x11, 3, 0x22, 0, 0, 0, 5, 0x12, 0x32, 0x10, 0, 0, 0, 4, 0x12, 0, 1];
    assert_eq!(shown(&file(4, &fours)), "111222 123210 121200");
    // Cut off within codes, a run that leaves its row, and a step out of the picture.
    assert_eq!(shown(&file(8, &whole[..11])), "111222 123000 000000");
    assert_eq!(shown(&file(8, &[9, 1, 0, 0, 6, 2, 0, 0, 6, 3])), "111111 222222 333333");
    let outside = file(8, &[6, 1, 0, 2, 0, 200, 6, 2, 0, 1]);
    assert_eq!(shown(&outside), "111111 000000 000000");
    let told = |file: &[u8]| load(&with_image(file).bytes()).warnings.join("\n");
    assert!(told(&outside).contains("its end is missing"), "{}", told(&outside));
    let wide = told(&file(8, &[9, 1, 0, 0, 6, 2, 0, 0, 6, 3]));
    assert!(wide.contains("3 texels of its runs lie outside of the picture: the BMP"), "{wide}");
    assert!(told(&file(8, &whole[..11])).contains("its end is missing"), "{}", told(&file(8, &whole[..11])));
    assert_eq!(told(&file(8, &whole)), "");
}

/// Large pictures cost detail, and not the scene.
#[test]
fn pictures_beyond_the_texels_of_a_scene_are_read_as_means() {
    let picture = png(64, 64, &[[200, 100, 50, 255]; 4096]);
    let mut file = tetrahedra();
    let views: Vec<usize> = (0..3).map(|_| file.push_view(&picture)).collect();
    let of = |key: &str| {
        json!(views
            .iter()
            .enumerate()
            .map(|(i, v)| json!({key: if key == "source" { i } else { *v }}))
            .collect::<Vec<_>>())
    };
    let use_of = |i: usize| json!({"pbrMetallicRoughness": {"baseColorTexture": {"index": i}}});
    let file = file
        .set("/images", of("bufferView"))
        .set("/textures", of("source"))
        .set("/materials", json!([use_of(0), use_of(1), use_of(2)]));
    let read = |limits: Limits| {
        load_bytes(&file.bytes(), &LoadOptions { limits, ..LoadOptions::default() }).unwrap()
    };
    let sides = |scene: &Scene| scene.textures.iter().map(|t| [t.width, t.height]).collect::<Vec<_>>();
    let colours =
        |scene: &Scene| scene.textures.iter().all(|t| t.texels.iter().all(|t| *t == [200, 100, 50, 255]));

    let scene = read(Limits { texels: 5200, ..Limits::default() });
    // All of 4096, the mean of four of the next, which is left 1104, and what 80 have room for.
    assert_eq!(sides(&scene), [[64, 64], [32, 32], [8, 8]]);
    assert!(
        colours(&scene) && scene.warnings.join("\n").contains("32 x 32 of its 64 x 64"),
        "{:?}",
        scene.warnings
    );

    let scene = read(Limits { texture_side: 16, ..Limits::default() });
    assert_eq!(sides(&scene), [[16, 16]; 3]);

    let scene = read(Limits { texels: 4096, ..Limits::default() });
    assert_eq!(sides(&scene), [[64, 64]]);
    let told = scene.warnings.join("\n");
    assert!(told.contains("image 1: has no room") && told.contains("left out"), "{told}");
}

/// FreeImage writes an exposure of 0 where a picture has none.
#[test]
fn an_exposure_that_is_none_is_left_out_of_a_sky() {
    for (line, gain) in
        [("EXPOSURE=0", 1.0), ("EXPOSURE=-2", 1.0), ("EXPOSURE=much", 1.0), ("EXPOSURE=2", 0.5)]
    {
        let head = format!("#?RADIANCE\n{line}\n\n-Y 1 +X 1\n");
        let file = [head.as_bytes(), &[128, 128, 128, 129]].concat();
        let sky = decode_environment(&file, 0.0, 1.0).unwrap();
        let Environment::Equirect { texels, .. } = &sky.environment else { panic!("{line}") };
        assert!(texels[0].distance(Vec3::splat(gain)) < 0.01, "{line}: {}", texels[0]);
        let told = sky.warnings.iter().any(|told| told.contains("EXPOSURE"));
        assert_eq!(told, gain == 1.0, "{line}: {:?}", sky.warnings);
    }
}

/// Each texel that a file claims costs time, also where it has no byte for it.
#[test]
fn a_short_file_of_a_huge_picture_is_left_out() {
    // Found by a fuzzer: 20,866 x 12,800 texels of a fax in 136 bytes.
    let file = include_bytes!("../../../../tests/corpus/picture/found-a2f64463");
    let told = load(&with_image(file).bytes()).warnings.join("\n");
    assert!(told.contains("the limit of so short a file is 64000000") && told.contains("left out"), "{told}");
}
