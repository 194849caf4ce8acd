//! Textures in KTX2 have the texels that other programs read from the same files (`tests/assets/ktx2/make.py`), and what
//! cannot be shown is refused by name. Files that are cut off or damaged neither end the program nor fill its memory.

use crate::common::{chance, changed, ktx2, png, with_image, with_ktx2, Glb};
use counting_allocator::{Counting, Request};
use dpm_scene::{load_bytes, load_bytes_here, Limits, LoadOptions, Scene, SceneError};
use serde_json::json;
use std::cell::Cell;
use std::path::PathBuf;

thread_local! {
    /// The greatest piece of memory that this thread has asked for.
    static GREATEST: Cell<usize> = const { Cell::new(0) };
}

/// The greatest piece of memory that `work` asks for in this thread, bytes.
pub(crate) fn greatest_in(work: impl FnOnce()) -> usize {
    GREATEST.set(0);
    work();
    GREATEST.get()
}

#[global_allocator]
static ALLOCATOR: Counting = Counting::telling(|request| {
    if let Request::Allocation(bytes) | Request::Reallocation(bytes) = request {
        // During a thread's end there is nothing to note.
        let _ = GREATEST.try_with(|greatest| greatest.set(greatest.get().max(bytes)));
    }
});

fn folder() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../tests/assets/ktx2")
}

fn asset(name: &str) -> Vec<u8> {
    std::fs::read(folder().join(name)).unwrap()
}

/// Every image of the folder: its name without the ending, and its bytes.
fn images() -> Vec<(String, Vec<u8>)> {
    let mut all: Vec<_> = std::fs::read_dir(folder())
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|e| e == "ktx2"))
        .map(|path| (path.file_stem().unwrap().to_string_lossy().into_owned(), std::fs::read(path).unwrap()))
        .collect();
    all.sort();
    all
}

fn load(file: &Glb) -> Result<Scene, SceneError> {
    load_bytes(&file.bytes(), &LoadOptions::default())
}

/// Sides and texels of the only texture.
fn shown(file: &Glb) -> (u32, u32, Vec<[u8; 4]>) {
    let mut scene = load(file).unwrap();
    assert_eq!(scene.textures.len(), 1);
    let texture = scene.textures.remove(0);
    (texture.width, texture.height, texture.texels)
}

/// Why the image is refused, or left out.
fn refusal(bytes: &[u8]) -> String {
    load(&with_ktx2(bytes)).map_or_else(|e| e.to_string(), |scene| scene.warnings.join("\n"))
}

#[test]
fn texels_are_those_that_other_programs_read() {
    let images = images();
    assert!(images.len() >= 25, "{} images", images.len());
    for (name, bytes) in images {
        let expected = image::open(folder().join(format!("{name}.png"))).unwrap().into_rgba8();
        let (width, height, texels) = shown(&with_ktx2(&bytes));
        assert_eq!((width, height), expected.dimensions(), "{name}");
        let pairs = texels.iter().flatten().zip(expected.as_raw());
        let greatest = pairs.map(|(a, b)| a.abs_diff(*b)).max().unwrap();
        // Between two colours of BC1 lie thirds, which this program rounds and the other one cuts off. So it is with all
        // of these.
        let rounded =
            ["blocks_bc1", "blocks_bc3", "chance_bc4", "chance_bc5", "chance_eac_r", "chance_eac_rg"];
        let allowed = u8::from(rounded.contains(&name.as_str()));
        assert!(greatest <= allowed, "{name}: a channel differs by {greatest}");
    }
}

#[test]
fn a_file_by_gltf_transform_has_its_textures_where_they_belong() {
    let scene = load_bytes(&asset("web.glb"), &LoadOptions::default()).unwrap();
    assert!(scene.warnings.is_empty(), "{:?}", scene.warnings);
    let material = scene.materials.iter().find(|m| m.name == "painted").unwrap();
    let cases = [
        (material.base_color_texture, "web_etc1s.png", true),
        (material.normal_texture, "web_uastc.png", false),
    ];
    for (reference, name, srgb) in cases {
        let texture = &scene.textures[reference.unwrap().texture as usize];
        let expected = image::open(folder().join(name)).unwrap().into_rgba8();
        assert_eq!((texture.width, texture.height, texture.srgb), (32, 32, srgb), "{name}");
        assert!(texture.texels.iter().eq(expected.pixels().map(|p| &p.0)), "{name}");
    }
}

#[test]
fn plain_texels_are_read_in_the_order_of_their_format() {
    let texels =
        [[1, 2, 3, 4], [50, 60, 70, 80], [255, 0, 128, 9], [7, 7, 0, 255], [90, 1, 1, 0], [3, 2, 1, 0]];
    let opaque = texels.map(|[r, g, b, _]| [r, g, b, 255]);
    let cases = [
        (37, [0, 1, 2, 3], 4),
        (43, [0, 1, 2, 3], 4),
        (44, [2, 1, 0, 3], 4),
        (50, [2, 1, 0, 3], 4),
        (23, [0, 1, 2, 3], 3),
        (29, [0, 1, 2, 3], 3),
        (30, [2, 1, 0, 3], 3),
        (36, [2, 1, 0, 3], 3),
    ];
    for (format, order, channels) in cases {
        let stored: Vec<u8> = texels.iter().flat_map(|t| order[..channels].iter().map(|k| t[*k])).collect();
        let packed =
            ruzstd::encoding::compress_to_vec(&stored[..], ruzstd::encoding::CompressionLevel::Fastest);
        let expected = if channels == 4 { texels } else { opaque };
        for file in [ktx2(format, 3, 2, 0, &stored), ktx2(format, 3, 2, 2, &packed)] {
            assert_eq!(shown(&with_ktx2(&file)), (3, 2, expected.to_vec()), "format {format}");
        }
    }
}

#[test]
fn the_image_of_the_extension_is_shown_before_the_one_for_other_programs() {
    let bytes = asset("gradient_uastc.ktx2");
    let mut file = with_ktx2(&bytes);
    let view = file.push_view(&png(1, 1, &[[9, 9, 9, 255]]));
    let file = file
        .set("/images/1", json!({"bufferView": view, "mimeType": "image/png"}))
        .set("/textures/0/source", json!(1))
        .set("/extensionsRequired", json!([]));
    assert_eq!(shown(&file), shown(&with_ktx2(&bytes)));
    assert_eq!(load(&file).unwrap().warnings, Vec::<String>::new());
    let nowhere = file.set("/textures/0/extensions/KHR_texture_basisu/source", json!(2));
    assert_eq!(shown(&nowhere), (1, 1, vec![[9, 9, 9, 255]]));
    let told = load(&nowhere).unwrap().warnings.join("\n");
    assert!(told.contains("texture 0, KHR_texture_basisu: 'source' is 2 and is left out"), "{told}");
}

#[test]
fn an_image_is_known_by_its_bytes() {
    let bytes = asset("grey_etc1s.ktx2");
    assert_eq!(shown(&with_image(&bytes)), shown(&with_ktx2(&bytes)));
}

#[test]
fn a_texture_is_read_as_gltf_uses_it_and_a_contradiction_is_told_once() {
    let bytes = asset("gradient_etc1s.ktx2");
    let scene = load(&with_ktx2(&bytes)).unwrap();
    assert!(scene.textures[0].srgb && scene.warnings.is_empty());
    let file = with_ktx2(&bytes)
        .set("/materials/0/normalTexture", json!({"index": 0}))
        .set("/materials/0/pbrMetallicRoughness/metallicRoughnessTexture", json!({"index": 0}));
    let scene = load(&file).unwrap();
    assert_eq!(scene.textures.iter().map(|t| t.srgb).collect::<Vec<_>>(), [true, false]);
    let told: Vec<_> = scene.warnings.iter().filter(|w| w.contains("it says that it is sRGB")).collect();
    assert_eq!(told.len(), 1, "{:?}", scene.warnings);
    assert!(told[0].starts_with("image 0"), "{told:?}");
}

#[test]
fn what_is_no_flat_picture_of_a_known_format_is_refused_by_name() {
    let good = ktx2(37, 2, 2, 0, &[5; 16]);
    load(&with_ktx2(&good)).unwrap();
    let two_channels = changed(&asset("mixed_uastc.ktx2"), 104 + 28, 63 << 16 | 5 << 24);
    let premultiplied = changed(&good, 104 + 12, 1 | 1 << 8 | 2 << 16 | 1 << 24);
    let cases = [
        (changed(&good, 28, 2), "a volume, an array or a cube map"),
        (changed(&good, 24, 0), "a volume, an array or a cube map"),
        (changed(&good, 32, 2), "a volume, an array or a cube map"),
        (changed(&good, 36, 6), "a volume, an array or a cube map"),
        (changed(&good, 44, 3), "cannot be decompressed"),
        (changed(&good, 44, 1), "with supercompression BasisLZ"),
        (changed(&good, 12, 13), "in R8_UINT"),
        (changed(&good, 12, 122), "in B10G11R11_UFLOAT_PACK32"),
        (changed(&good, 12, 1_000_054_001), "in PVRTC1_4BPP_UNORM_BLOCK"),
        (changed(&good, 12, 0), "of the colour model Some(RGBSDA)"),
        (changed(&good, 20, 3), "the data is cut off"),
        (changed(&good, 20, 20_000), "the longer side of image 0 comes to 20000"),
        (changed(&changed(&good, 20, 16_000), 24, 16_000), "the number of texels in all textures"),
        (two_channels, "of two channels"),
        (premultiplied, "multiplied by alpha"),
        (good[..90].to_vec(), "a KTX2 image that is cut off or damaged"),
    ];
    for (bytes, expected) in cases {
        let said = refusal(&bytes);
        assert!(said.contains("image 0") || expected.contains("all textures"), "{said}");
        assert!(said.contains(expected), "{expected}: {said}");
    }
}

#[test]
fn channels_go_where_the_image_wants_them_and_another_orientation_is_refused() {
    let good = ktx2(37, 1, 1, 0, &[1, 2, 3, 4]);
    let with_note = |note: &[u8]| {
        let notes =
            [&(note.len() as u32).to_le_bytes()[..], note, &[0; 4][..(4 - note.len() % 4) % 4]].concat();
        // The texels stay last: the notes go between the descriptor and them.
        let mut out = [&good[..148], &notes, &good[148..]].concat();
        out = changed(&changed(&out, 56, 148), 60, notes.len() as u32);
        changed(&out, 80, 148 + notes.len() as u32)
    };
    for (note, texel) in [
        (&b"KTXorientation\0rd\0"[..], [1, 2, 3, 4]),
        (b"KTXswizzle\0rgba\0", [1, 2, 3, 4]),
        (b"KTXwriter\0a\0", [1, 2, 3, 4]),
        (b"KTXswizzle\0rrr1\0", [1, 1, 1, 255]),
        (b"KTXswizzle\0ab0g", [4, 3, 0, 2]),
    ] {
        assert_eq!(shown(&with_ktx2(&with_note(note))).2, [texel]);
    }
    assert!(refusal(&with_note(b"KTXorientation\0ru\0")).contains("its KTXorientation is 'ru'"));
    for bad in [&b"KTXswizzle\0rgb\0"[..], b"KTXswizzle\0rgbax\0", b"KTXswizzle\0rgbx\0"] {
        assert!(refusal(&with_note(bad)).contains("its KTXswizzle is 'rgb"));
    }
}

/// Options under which one piece of memory may have [`BOUND`] bytes.
fn tight() -> LoadOptions {
    LoadOptions { limits: Limits { texels: 1 << 16, ..Limits::default() }, ..LoadOptions::default() }
}

/// The window that any Zstandard stream may ask for, twice, since the decoder keeps it in a ring that doubles.
const BOUND: usize = (16 << 20) + 4096;

/// Loads a file that may be damaged: a texture, or an error that says something.
fn survive(name: &str, bytes: &[u8]) {
    let file = with_ktx2(bytes).bytes();
    let mut read = None;
    let greatest = greatest_in(|| read = Some(load_bytes_here(&file, &tight())));
    match read {
        Some(Ok(scene)) => {
            // One that is left out is told.
            assert!(!scene.textures.is_empty() || !scene.warnings.is_empty(), "{name}");
            for texture in &scene.textures {
                assert_eq!(texture.texels.len(), (texture.width * texture.height) as usize, "{name}");
            }
        }
        Some(Err(e)) => assert!(!e.to_string().is_empty() && e.to_string().len() < 1000, "{name}"),
        None => unreachable!("the work is done"),
    }
    assert!(greatest <= BOUND, "{name}: something asked for {greatest} bytes");
}

/// Everything near a file.
mod breadth {
    use super::*;

    #[test]
    fn files_that_are_cut_off_or_damaged_give_a_picture_or_an_error() {
        let mut chance = chance(0x2545_f491_4f6c_dd1d);
        // A descriptor whose blocks have 256 texels along a side, which one byte does not hold.
        survive("blocks of 256", &changed(&asset("alpha_uastc.ktx2"), 104 + 16, u32::MAX));
        for (name, bytes) in images() {
            for end in (0..bytes.len()).step_by(1 + bytes.len() / 400) {
                survive(&name, &bytes[..end]);
            }
            for at in 0..104 + 60 {
                for bit in [0, 3, 7] {
                    let mut bad = bytes.clone();
                    bad[at] ^= 1 << bit;
                    survive(&name, &bad);
                }
            }
            for _ in 0..600 {
                let mut bad = bytes.clone();
                for _ in 0..1 + chance() % 4 {
                    let at = chance() % bad.len();
                    bad[at] = if chance().is_multiple_of(2) {
                        bad[at] ^ 1 << (chance() % 8)
                    } else {
                        chance() as u8
                    };
                }
                survive(&name, &bad);
            }
        }
    }
}
