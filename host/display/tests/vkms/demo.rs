//! Frames that the demo packed for each encoding, as `demo_frames` of the package `dpm-tests` wrote them on the host.

use dpm_device::planes::{Channel, PlaneSchedule, PlaneSpec, Raster};
use dpm_display::encoding::Encoding;

/// Where `tests/hil/run` puts them.
const FOLDER: &str = "/frames";
/// The fewest of each.
const ENOUGH: usize = 8;

/// A way to send frames, and frames of the demo that were packed for it.
pub(crate) struct DemoCase {
    /// The encoding by its word in a rig file, with what is behind the display.
    pub(crate) name: String,
    /// What the bits of a pixel mean.
    pub(crate) encoding: Encoding,
    /// The planes of a frame.
    pub(crate) schedule: PlaneSchedule,
    /// The planes of each frame, one after the other.
    pub(crate) frames: Vec<Vec<u8>>,
}

/// All cases, by name.
///
/// # Panics
/// There are none, or they are of another raster, or too few, dark or alike: then they could prove nothing.
pub(crate) fn cases(raster: Raster) -> Vec<DemoCase> {
    let listed =
        std::fs::read_dir(FOLDER).unwrap_or_else(|e| panic!("{FOLDER}: {e}; tests/hil/run makes it"));
    let mut names: Vec<String> =
        listed.map(|entry| entry.unwrap().file_name().to_string_lossy().into_owned()).collect();
    names.sort();
    let cases: Vec<DemoCase> = names.into_iter().map(|name| case(name, raster)).collect();
    for encoding in [Encoding::Rgb8, Encoding::Planes24] {
        assert!(cases.iter().any(|case| case.encoding == encoding), "no frames for {encoding:?}");
    }
    cases
}

fn case(name: String, raster: Raster) -> DemoCase {
    let bytes = std::fs::read(format!("{FOLDER}/{name}")).unwrap();
    let end = bytes.iter().position(|b| *b == b'\n').expect("a line that says what it is");
    let head = String::from_utf8_lossy(&bytes[..end]).into_owned();
    let size = format!("{} x {}", raster.width(), raster.height());
    let parts: Vec<&str> = head.split(", ").collect();
    let ["dpm demo frames", of, encoding, light, planes] = parts[..] else { panic!("{name}: {head}") };
    assert_eq!(of, size, "{name}");
    let encoding = match encoding {
        "Rgb8" => Encoding::Rgb8,
        "Planes24" => Encoding::Planes24,
        other => panic!("{name}: {other} is no encoding"),
    };
    let planes: Vec<PlaneSpec> = planes.split(' ').map(plane).collect();
    let schedule = match light {
        "filling" => PlaneSchedule::filling(&planes),
        _ => PlaneSchedule::with_repeats(&planes),
    };
    let schedule = schedule.unwrap_or_else(|| panic!("{name}: {head}"));
    let frames = bytes[end + 1..].chunks(raster.plane_bytes() * planes.len()).map(Vec::from).collect();
    let case = DemoCase { name, encoding, schedule, frames };
    check(&case, raster);
    case
}

/// A plane by its word, for example "Green3".
fn plane(word: &str) -> PlaneSpec {
    let (channel, bit) = word.split_at(word.len() - 1);
    let channel = match channel {
        "Red" => Channel::Red,
        "Green" => Channel::Green,
        "Blue" => Channel::Blue,
        "White" => Channel::White,
        other => panic!("{other} is no channel"),
    };
    PlaneSpec { channel, bit: bit.parse().expect("the number of a bit") }
}

fn check(case: &DemoCase, raster: Raster) {
    let DemoCase { name, schedule, frames, .. } = case;
    let bytes = raster.plane_bytes() * schedule.len();
    assert!(frames.len() >= ENOUGH && frames.iter().all(|f| f.len() == bytes), "{name}: {}", frames.len());
    for (i, frame) in frames.iter().enumerate() {
        let lit: u32 = frame.iter().map(|b| b.count_ones()).sum();
        assert!(lit > 1000, "{name}: frame {i} has {lit} lit bits");
        assert!(frames[..i].iter().all(|other| other != frame), "{name}: frame {i} was there before");
    }
    for k in 0..schedule.len() {
        let plane =
            |f: &Vec<u8>| f.chunks(raster.plane_bytes()).nth(k).is_some_and(|p| p.iter().any(|b| *b != 0));
        assert!(frames.iter().any(plane), "{name}: plane {k} is dark in every frame");
    }
}
