//! Reads an OpenEXR picture: of its layers the one with light, of half, single or whole numbers, with any of the usual
//! compressions, and with the primaries that it names. Its alpha is left out.

mod subsampled;

use super::super::primaries::Primaries;
use super::super::SceneError;
use super::{check_piece, check_size, collect, Read, MAX_TEXELS};
use exr::image::{AnyChannel, AnyChannels, FlatSamples, Layer};
use exr::prelude::{read, ReadChannels, ReadLayers};
use glam::{DVec2, Vec3};
use std::collections::BTreeMap;
use std::io::Cursor;

/// Bytes that all channels of all layers may take.
const MAX_BYTES: u64 = MAX_TEXELS * 32;
/// Words in the names of layers that hold the whole light of a picture.
const WHOLE: [&str; 5] = ["combined", "beauty", "rgba", "main", "composite"];

/// What the channels of one name in front are together.
#[derive(Clone, Copy)]
enum Colour {
    Rgb([usize; 3]),
    /// Luminance, and the differences of red and blue to it as shares of it.
    LumaChroma([usize; 3]),
    Grey(usize),
}

/// A group of channels with the same name in front of theirs.
struct Group {
    layer: usize,
    name: String,
    colour: Colour,
}

fn failed(e: exr::error::Error) -> SceneError {
    SceneError::broken("image", format!("cannot be decoded: {e}"))
}

/// The file without an attribute `type` that contradicts the bits of its version, which alone count in a file of one part.
/// `None`: there is none, or the header cannot be followed, which the reader says.
fn without_false_kind(bytes: &[u8]) -> Option<Vec<u8>> {
    const TILED: u8 = 2;
    const DEEP_OR_PARTS: u8 = 0x18;
    let bits = *bytes.get(5)?;
    let kind: &[u8] = if bits & TILED != 0 { b"tiledimage" } else { b"scanlineimage" };
    let mut at = 8usize;
    if bits & DEEP_OR_PARTS != 0 {
        return None;
    }
    loop {
        let text = |at: usize| bytes.get(at..)?.iter().take(256).position(|b| *b == 0);
        let name = at..at + text(at)?;
        if name.is_empty() {
            return None;
        }
        let size_at = name.end + 1 + text(name.end + 1)? + 1;
        let size = u32::from_le_bytes(bytes.get(size_at..size_at + 4)?.try_into().ok()?) as usize;
        at = (size_at + 4).checked_add(size)?;
        if &bytes[name.clone()] == b"type" {
            let is_true =
                bytes.get(size_at + 4..at)?.strip_suffix(b"\0").unwrap_or(&bytes[size_at + 4..at]) == kind;
            return (!is_true).then(|| {
                let mut mended = bytes.to_vec();
                mended[name].copy_from_slice(b"told");
                mended
            });
        }
    }
}

/// Reads a picture; its sides are checked before its texels are.
pub(super) fn read_exr(bytes: &[u8]) -> Result<Read, SceneError> {
    let file_bytes = bytes.len();
    let mended = without_false_kind(bytes);
    let bytes = mended.as_deref().unwrap_or(bytes);
    let coarse = subsampled::without_subsampling(bytes);
    let bytes = coarse.as_ref().map_or(bytes, |(whole, _)| whole);
    let meta = exr::meta::MetaData::read_from_buffered(Cursor::new(bytes), false).map_err(failed)?;
    let mut total = 0u64;
    for header in &meta.headers {
        let side = |n: usize| u32::try_from(n).unwrap_or(u32::MAX);
        let texels = check_size(side(header.layer_size.width()), side(header.layer_size.height()))?;
        // The largest sample; those that are interpolated have single precision.
        check_piece(texels, 4, file_bytes)?;
        let bytes =
            if coarse.is_some() { 4 * header.channels.list.len() } else { header.channels.bytes_per_pixel };
        total = total.saturating_add(texels as u64 * bytes as u64);
    }
    SceneError::check_limit(
        "the bytes of all layers of the environment",
        total,
        MAX_BYTES,
        "keep one layer",
    )?;
    let mut warnings = vec![];
    let (layers, attributes) = match &coarse {
        Some((whole, sampling)) => {
            let layers = subsampled::read_layers(whole, sampling)?;
            warnings.push(subsampled::told(&layers, sampling));
            let Some(first) = meta.headers.into_iter().next() else {
                return Err(SceneError::broken("image", "cannot be decoded: it has no header"));
            };
            (layers, first.shared_attributes)
        }
        None => {
            let picture = read()
                .no_deep_data()
                .largest_resolution_level()
                .all_channels()
                .all_layers()
                .all_attributes()
                .non_parallel()
                .from_buffered(Cursor::new(bytes))
                .map_err(failed)?;
            (picture.layer_data.into_vec(), picture.attributes)
        }
    };
    texels_of(&layers, &attributes, file_bytes, warnings)
}

/// The light of a picture's layers.
fn texels_of(
    layers: &Layers,
    attributes: &exr::meta::header::ImageAttributes,
    file_bytes: usize,
    mut warnings: Vec<String>,
) -> Result<Read, SceneError> {
    let window = attributes.display_window;
    let side = |n: usize| u32::try_from(n).unwrap_or(u32::MAX);
    let (width, height) = (side(window.size.width()), side(window.size.height()));
    check_size(width, height)?;
    let groups = groups(layers);
    let Some(chosen) = choose(&groups) else {
        let names: Vec<String> = channels(layers).take(12).collect();
        return Err(SceneError::broken(
            "image",
            format!(
                "cannot be decoded: no layer has R, G and B, or Y; it has the channels {}",
                names.join(", ")
            ),
        ));
    };
    if groups.len() > 1 {
        let others = groups.iter().filter(|g| !std::ptr::eq(*g, chosen)).map(|g| shown(&g.name));
        let others = others.take(12).collect::<Vec<_>>().join(", ");
        warnings.push(format!("of its layers {} is the light; {others} are not used", shown(&chosen.name)));
    }
    let primaries = attributes.chromaticities.map(|c| {
        let at = |v: exr::math::Vec2<f32>| DVec2::new(f64::from(v.x()), f64::from(v.y()));
        Primaries { rgb: [at(c.red), at(c.green), at(c.blue)], white: at(c.white) }
    });
    let weights = primaries.as_ref().unwrap_or(&Primaries::SRGB).luminance();
    let layer = &layers[chosen.layer];
    let list = &layer.channel_data.list;
    let value = |channel: usize, i: usize| number(&list[channel], i);
    let colour = |i: usize| match chosen.colour {
        Colour::Rgb(c) => Vec3::from(c.map(|c| value(c, i))),
        Colour::Grey(c) => Vec3::splat(value(c, i)),
        Colour::LumaChroma(c) => {
            let [y, ry, by] = c.map(|c| value(c, i));
            let (r, b) = ((ry + 1.0) * y, (by + 1.0) * y);
            Vec3::new(r, (y - weights.x * r - weights.z * b) / weights.y, b)
        }
    };
    // The picture is what the display window shows; data may lie anywhere.
    let offset = |axis: fn(exr::math::Vec2<i32>) -> i32| {
        i64::from(axis(layer.attributes.layer_position)) - i64::from(axis(window.position))
    };
    let (left, top) = (offset(|v| v.x()), offset(|v| v.y()));
    let (columns, rows) = (layer.size.width(), layer.size.height());
    let at = |x: u32, y: u32| {
        let (x, y) = (i64::from(x) - left, i64::from(y) - top);
        let is_there = (0..columns as i64).contains(&x) && (0..rows as i64).contains(&y);
        if is_there {
            colour(y as usize * columns + x as usize)
        } else {
            Vec3::ZERO
        }
    };
    // How much of the data's sides lies in the window.
    let inside = |begin: i64, count: usize, side: u32| {
        ((begin + count as i64).min(i64::from(side)) - begin.max(0)).max(0) as usize
    };
    let outside = columns * rows - inside(left, columns, width) * inside(top, rows, height);
    if outside > 0 {
        warnings.push(format!("{outside} texels outside of its display window are left out"));
    }
    let ((width, height, texels), told) = collect([width, height], file_bytes, at);
    warnings.extend(told);
    Ok(Read { width, height, texels, primaries, warnings })
}

fn shown(name: &str) -> String {
    if name.is_empty() {
        "the one without a name".into()
    } else {
        format!("'{name}'")
    }
}

fn number(channel: &AnyChannel<FlatSamples>, i: usize) -> f32 {
    match &channel.sample_data {
        FlatSamples::F16(list) => list.get(i).map_or(0.0, |v| v.to_f32()),
        FlatSamples::F32(list) => list.get(i).copied().unwrap_or(0.0),
        FlatSamples::U32(list) => list.get(i).map_or(0.0, |v| *v as f32),
    }
}

type Layers = [Layer<AnyChannels<FlatSamples>>];

/// The names of all channels, with that of their layer.
fn channels(layers: &Layers) -> impl Iterator<Item = String> + '_ {
    let of = |layer: &Layer<AnyChannels<FlatSamples>>| {
        layer.attributes.layer_name.as_ref().map_or(String::new(), |name| format!("{name}."))
    };
    layers.iter().flat_map(move |layer| {
        let front = of(layer);
        layer.channel_data.list.iter().map(move |c| format!("{front}{}", c.name))
    })
}

/// The groups of channels that are colours or grey.
fn groups(layers: &Layers) -> Vec<Group> {
    let mut out = vec![];
    for (i, layer) in layers.iter().enumerate() {
        let mut by_name = BTreeMap::<String, BTreeMap<String, usize>>::new();
        for (k, channel) in layer.channel_data.list.iter().enumerate() {
            let name = channel.name.to_string();
            let (front, own) = name.rsplit_once('.').unwrap_or(("", &name));
            by_name.entry(front.to_owned()).or_default().insert(own.to_ascii_uppercase(), k);
        }
        for (front, own) in by_name {
            let one = |names: &[&str]| names.iter().find_map(|n| own.get(*n).copied());
            let rgb = [one(&["R", "RED"]), one(&["G", "GREEN"]), one(&["B", "BLUE"])];
            let colour = match (rgb, own.get("Y"), own.get("RY"), own.get("BY")) {
                ([Some(r), Some(g), Some(b)], ..) => Colour::Rgb([r, g, b]),
                (_, Some(y), Some(ry), Some(by)) => Colour::LumaChroma([*y, *ry, *by]),
                (_, Some(y), ..) => Colour::Grey(*y),
                _ => match one(&["L", "I", "LUMINANCE", "GRAY", "GREY"]) {
                    Some(grey) => Colour::Grey(grey),
                    None => continue,
                },
            };
            let layer = layer.attributes.layer_name.as_ref().map_or(String::new(), ToString::to_string);
            let name =
                [layer, front].into_iter().filter(|part| !part.is_empty()).collect::<Vec<_>>().join(".");
            out.push(Group { layer: i, name, colour });
        }
    }
    out
}

/// The group with the light: colours before grey, then one without a name, then one whose name says that it is all of it.
fn choose(groups: &[Group]) -> Option<&Group> {
    let rank = |group: &&Group| {
        let name = group.name.to_lowercase();
        let is_whole = WHOLE.iter().any(|word| name.contains(word));
        (matches!(group.colour, Colour::Grey(_)), !name.is_empty(), !is_whole)
    };
    groups.iter().min_by_key(rank)
}

#[cfg(test)]
mod tests {
    use super::super::decode_environment;
    use super::*;

    /// An uncompressed file of single precision, written here byte by byte after the format's description, so that it does not
    /// come from the library that reads it.
    fn exr(channels: &[&str], width: u32, rows: &[Vec<Vec<f32>>]) -> Vec<u8> {
        let attribute = |name: &str, kind: &str, value: Vec<u8>| {
            [name.as_bytes(), b"\0", kind.as_bytes(), b"\0", &(value.len() as u32).to_le_bytes(), &value]
                .concat()
        };
        let channel = |name: &&str| {
            let about = [2u32, 0, 1, 1].map(u32::to_le_bytes).concat();
            [name.as_bytes(), b"\0", &about].concat()
        };
        let list = [channels.iter().flat_map(channel).collect(), vec![0]].concat();
        let window = [0, 0, width - 1, rows.len() as u32 - 1].map(u32::to_le_bytes).concat();
        let one = 1.0f32.to_le_bytes().to_vec();
        let mut out = [
            vec![0x76, 0x2f, 0x31, 0x01, 2, 0, 0, 0],
            attribute("channels", "chlist", list),
            attribute("compression", "compression", vec![0]),
            attribute("dataWindow", "box2i", window.clone()),
            attribute("displayWindow", "box2i", window),
            attribute("lineOrder", "lineOrder", vec![0]),
            attribute("pixelAspectRatio", "float", one.clone()),
            attribute("screenWindowCenter", "v2f", vec![0; 8]),
            attribute("screenWindowWidth", "float", one),
            vec![0],
        ]
        .concat();
        let row_bytes = 8 + 4 * channels.len() * width as usize;
        let first = out.len() + 8 * rows.len();
        (0..rows.len()).for_each(|y| out.extend(((first + y * row_bytes) as u64).to_le_bytes()));
        for (y, row) in rows.iter().enumerate() {
            out.extend((y as u32).to_le_bytes());
            out.extend(((row_bytes - 8) as u32).to_le_bytes());
            out.extend(row.concat().into_iter().flat_map(f32::to_le_bytes));
        }
        out
    }

    /// Two rows of two texels. Channels stand in the order of the alphabet.
    fn small() -> Vec<u8> {
        let row = |b: [f32; 2], g: [f32; 2], r: [f32; 2]| vec![b.to_vec(), g.to_vec(), r.to_vec()];
        let rows = [row([0.5, 1.0], [2.0, 3.0], [4.0, 70_000.0]), row([0.0, 8.0], [0.0, 9.0], [0.25, 10.0])];
        exr(&["B", "G", "R"], 2, &rows)
    }

    fn refused(bytes: &[u8]) -> String {
        decode_environment(bytes, 0.0, 1.0).unwrap_err().to_string()
    }

    #[test]
    fn golden_bytes_are_read_linear_and_from_the_top() {
        let Read { width, height, texels, .. } = read_exr(&small()).unwrap();
        let expected =
            [[4.0, 2.0, 0.5], [70_000.0, 3.0, 1.0], [0.25, 0.0, 0.0], [10.0, 9.0, 8.0]].map(Vec3::from_array);
        assert_eq!((width, height, texels.as_slice()), (2, 2, &expected[..]));
        decode_environment(&small(), 0.0, 1.0).unwrap();
    }

    #[test]
    fn a_kind_that_contradicts_the_version_does_not_count() {
        let plain = small();
        // Two rows of six numbers, with eight bytes in front of each; their offsets stand before them.
        let table = plain.len() - 2 * (8 + 24) - 16;
        for kind in ["scanlineimage", "tiledimage", "deepscanline", "deeptile"] {
            let told = [b"type\0string\0", &(kind.len() as u32).to_le_bytes()[..], kind.as_bytes()].concat();
            let mut bytes = [&plain[..8], &told, &plain[8..]].concat();
            for offset in bytes[table + told.len()..][..16].chunks_exact_mut(8) {
                let moved = u64::from_le_bytes(offset.try_into().unwrap()) + told.len() as u64;
                offset.copy_from_slice(&moved.to_le_bytes());
            }
            let read = read_exr(&bytes).unwrap();
            assert_eq!(read.texels, read_exr(&plain).unwrap().texels, "{kind}");
        }
    }

    #[test]
    fn compressed_half_floats_and_alpha_are_read() {
        use exr::prelude::*;
        let mut file = std::io::Cursor::new(vec![]);
        let texel = |at: Vec2<usize>| {
            let half = |x: f32| f16::from_f32(x);
            (half(at.x() as f32), half(at.y() as f32), half(0.5), half(0.25))
        };
        let encoding = Encoding::SMALL_LOSSLESS;
        let channels = SpecificChannels::rgba(texel);
        let layer = Layer::new((37, 5), LayerAttributes::named("light"), encoding, channels);
        Image::from_layer(layer).write().to_buffered(&mut file).unwrap();
        let Read { width, height, texels, .. } = read_exr(file.get_ref()).unwrap();
        assert_eq!((width, height, texels[37 + 3]), (37, 5, Vec3::new(3.0, 1.0, 0.5)));
    }

    /// Layers by name, grey and luminance with chroma; what is not used is told.
    #[test]
    fn layers_and_kinds_of_colour_are_read_by_their_names() {
        let one = |channels: &[&str], values: &[f32]| {
            exr(channels, 1, &[values.iter().map(|v| vec![*v]).collect::<Vec<_>>()])
        };
        let read = |bytes: &[u8]| read_exr(bytes).unwrap();
        assert_eq!(read(&one(&["Y"], &[0.5])).texels, [Vec3::splat(0.5)]);
        let layers = [
            "depth.Z",
            "diffuse.B",
            "diffuse.G",
            "diffuse.R",
            "sky.Combined.B",
            "sky.Combined.G",
            "sky.Combined.R",
        ];
        let several = read(&one(&layers, &[9.0, 1.0, 1.0, 1.0, 0.3, 0.2, 0.1]));
        assert_eq!(several.texels, [Vec3::new(0.1, 0.2, 0.3)]);
        assert!(
            several.warnings[0].contains("'diffuse'")
                && several.warnings[0].contains("'sky.Combined' is the light")
        );
        // Luminance 1 with red 1.5 and blue 0.5.
        let chroma = read(&one(&["BY", "RY", "Y"], &[-0.5, 0.5, 1.0])).texels[0];
        let green = (1.0 - 0.2126 * 1.5 - 0.0722 * 0.5) / 0.7152;
        assert!((chroma - Vec3::new(1.5, green, 0.5)).abs().max_element() < 1e-4, "{chroma}");
    }

    /// Pictures that OpenEXR itself wrote as luminance and chroma of a fourth of the samples, with what it reads of them again
    /// (`tests/assets/exr/make.cpp`). Where colours are strong it takes some of their saturation back, which is not done here.
    #[test]
    fn chroma_of_fewer_samples_is_interpolated_as_openexr_does() {
        let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/assets/exr");
        let table = std::fs::read_to_string(folder.join("luma.csv")).unwrap();
        for kind in ["zips", "zip", "piz", "pxr24", "b44"] {
            let bytes = std::fs::read(folder.join(format!("luma-{kind}.exr"))).unwrap();
            let Read { width, height, texels, warnings, .. } = read_exr(&bytes).unwrap();
            assert_eq!((width, height), (96, 64));
            assert!(warnings.iter().any(|w| w.contains("BY, RY have fewer samples")), "{warnings:?}");
            let rows = table.lines().filter_map(|line| line.strip_prefix(&format!("{kind},")));
            let (mut count, mut off) = (0, 0);
            for row in rows {
                let row: Vec<f32> = row.split(',').map(|number| number.parse().unwrap()).collect();
                let want = Vec3::new(row[2], row[3], row[4]);
                let got = texels[row[1] as usize * 96 + row[0] as usize];
                let wrong = (got - want).abs().max_element() / want.max_element();
                assert!(wrong < 0.1, "{kind} at {}, {}: {got} for {want}", row[0], row[1]);
                off += usize::from(wrong > 2e-3);
                count += 1;
            }
            assert!(count > 150 && off * 50 < count, "{kind}: {off} of {count} differ");
            for end in (0..bytes.len()).step_by(7) {
                let _ = read_exr(&bytes[..end]);
                let mut damaged = bytes.clone();
                damaged[end] ^= 0x81;
                let _ = read_exr(&damaged);
            }
        }
    }

    fn case(name: &str) -> Vec<u8> {
        let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/assets/cases");
        std::fs::read(folder.join(name)).unwrap()
    }

    #[test]
    fn single_texels_that_are_no_light_are_clamped_and_primaries_are_converted() {
        for (name, told) in
            [("e02-negative.exr", "negative"), ("e03-inf-sun.exr", "65504"), ("e08-aces.exr", "0.7347")]
        {
            let sky = decode_environment(&case(name), 0.0, 1.0).unwrap();
            assert!(sky.warnings.iter().any(|w| w.contains(told)), "{name}: {:?}", sky.warnings);
        }
    }

    #[test]
    fn hostile_pictures_are_refused_with_reasons() {
        let whole = small();
        for length in 4..whole.len() {
            let told = refused(&whole[..length]);
            assert!(told.contains("cannot be decoded"), "{length}: {told}");
        }
        for place in 0..whole.len() {
            for change in [1, 0x80, 0xff] {
                let mut damaged = whole.clone();
                damaged[place] ^= change;
                // It may still be a picture; it must not end the program.
                let _ = decode_environment(&damaged, 0.0, 1.0);
            }
        }
        // 70,000 columns and rows in the header.
        let mut huge = whole.clone();
        let side = 69_999u32.to_le_bytes();
        for name in ["dataWindow\0box2i\0", "displayWindow\0box2i\0"] {
            let at = huge.windows(name.len()).position(|w| w == name.as_bytes()).unwrap() + name.len() + 12;
            huge[at..at + 8].copy_from_slice(&[side, side].concat());
        }
        assert!(refused(&huge).contains("limit"), "{}", refused(&huge));
        let row = |v: f32| [vec![vec![v; 9], vec![1.0; 9], vec![1.0; 9]]];
        assert!(refused(&exr(&["B", "G", "R"], 9, &row(f32::NAN))).contains("texel 0, 0"));
        let depth = [vec![vec![1.0]]];
        assert!(refused(&exr(&["Z"], 1, &depth)).contains("cannot be decoded"));
    }
}
