//! What a camera offers, and setting it to what the rig file asks: every refusal says what the camera has instead.

use super::abi::{
    Capability, Format, FormatEntry, FrameInterval, FrameSize, PixelFormat, StreamParameters, CAN_CAPTURE,
    CAN_CAPTURE_PLANES, CAN_SET_RATE, CAN_STREAM, CAPTURE, DISCRETE, FIELD_NONE, GET_RATE,
    HAS_DEVICE_CAPABILITIES, LIST_FORMAT, LIST_INTERVAL, LIST_SIZE, QUERY_CAPABILITY, SET_FORMAT, SET_RATE,
    TRY_FORMAT,
};
use super::kernel::Node;
use super::luma::{name_of, Layout, LAYOUTS};
use crate::source::{CameraDoubt, PictureRequest};
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::Path;

/// Most entries of a list that are read: a driver that lists on for ever is not believed.
const MOST_ENTRIES: u32 = 64;
/// Rates that differ by less are the same: cameras with 29.97 pictures a second say 30.
const SAME_RATE: f64 = 0.02;

/// A camera, as its driver names it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Identity {
    /// Its model.
    pub card: String,
    /// Its driver.
    pub driver: String,
    /// Where it is plugged in.
    pub bus: String,
}

/// How the pictures of a camera lie in its buffers.
#[derive(Clone, Copy, Debug)]
pub(super) struct PictureForm {
    /// Where the grey levels lie.
    pub layout: &'static Layout,
    /// Bytes from row to row.
    pub stride: usize,
    /// Columns and rows.
    pub size: [usize; 2],
}

/// Text of the kernel's, up to the first zero byte.
fn text(bytes: &[u8]) -> String {
    let end = bytes.iter().position(|b| *b == 0).unwrap_or(bytes.len());
    let shown = String::from_utf8_lossy(&bytes[..end]);
    shown.chars().map(|c| if c.is_control() { ' ' } else { c }).collect::<String>().trim().to_owned()
}

/// Why a request failed that another program's stream can hinder.
pub(super) fn failure(place: &str, what: &str, error: &io::Error) -> CameraDoubt {
    match error.raw_os_error() {
        Some(libc::EBUSY) => CameraDoubt::new(
            format!("{place} is in use by another program"),
            format!("end it; `fuser -v {place}` names it"),
        ),
        Some(libc::ENODEV | libc::ENXIO) => gone(place),
        _ => CameraDoubt::new(
            format!("{place}: the driver refuses {what}: {error}"),
            "plug the camera in again, and see `dmesg`",
        ),
    }
}

/// The camera was unplugged.
pub(super) fn gone(place: &str) -> CameraDoubt {
    CameraDoubt::new(format!("{place} was unplugged"), "check its cable; it is opened again when it is back")
}

/// Opens the camera at `place`.
///
/// # Errors
/// It is absent, closed to this user, or no camera that can stream.
pub(super) fn open(place: &str) -> Result<(Node, Identity), CameraDoubt> {
    let node = Node::open(Path::new(place)).map_err(|e| not_opened(place, &e))?;
    let mut told = Capability::default();
    node.call(&QUERY_CAPABILITY, &mut told).map_err(|e| match e.raw_os_error() {
        Some(libc::ENOTTY | libc::EINVAL) => no_camera(place, "it is no video device"),
        _ => failure(place, "to say what it is", &e),
    })?;
    let can = match told.capabilities & HAS_DEVICE_CAPABILITIES {
        0 => told.capabilities,
        _ => told.device_capabilities,
    };
    let identity = Identity { card: text(&told.card), driver: text(&told.driver), bus: text(&told.bus) };
    let card = &identity.card;
    if can & CAN_CAPTURE == 0 {
        let why = match can & CAN_CAPTURE_PLANES {
            0 => format!("this device file of {card:?} gives no pictures"),
            _ => format!("{card:?} gives pictures in several planes only, which is not supported"),
        };
        return Err(no_camera(place, &why));
    }
    if can & CAN_STREAM == 0 {
        return Err(no_camera(place, &format!("{card:?} cannot stream into memory")));
    }
    Ok((node, identity))
}

fn no_camera(place: &str, why: &str) -> CameraDoubt {
    CameraDoubt::new(
        format!("{place} is no camera: {why}"),
        "`ls -l /dev/v4l/by-id` names the cameras that are there; the file with -index0 gives the pictures",
    )
}

fn not_opened(place: &str, error: &io::Error) -> CameraDoubt {
    match error.kind() {
        io::ErrorKind::NotFound => CameraDoubt::new(
            format!("there is no {place}"),
            "is the camera plugged in? `ls -l /dev/v4l/by-id /dev/video*` names those that are there",
        ),
        io::ErrorKind::PermissionDenied => denied(place),
        io::ErrorKind::IsADirectory => no_camera(place, "it is a folder"),
        _ => failure(place, "to be opened", error),
    }
}

/// Names the group that may open the device file.
fn denied(place: &str) -> CameraDoubt {
    let group = std::fs::metadata(place).map(|file| dpm_common::unix::group_name(file.gid()));
    let remedy = match group {
        Ok(group) if group != "root" => {
            format!(
                "its group is {group}: `sudo usermod -aG {group} USER`, then log in again or restart the service"
            )
        }
        _ => {
            "its group, which `ls -l` shows, is video on most systems: add this user to it, then log in again"
                .into()
        }
    };
    CameraDoubt::new(format!("{place} may not be opened by this user"), remedy)
}

/// The codes of all formats that the camera lists.
fn codes(node: &Node) -> Vec<u32> {
    let entry = |index| {
        let mut entry = FormatEntry { index, kind: CAPTURE, ..FormatEntry::default() };
        node.call(&LIST_FORMAT, &mut entry).ok().map(|()| entry.code)
    };
    (0..MOST_ENTRIES).map_while(entry).collect()
}

/// The sizes of a format, for messages.
fn sizes(node: &Node, code: u32) -> Vec<String> {
    let entry = |index| {
        let mut entry = FrameSize { index, code, ..FrameSize::default() };
        node.call(&LIST_SIZE, &mut entry).ok().map(|()| entry)
    };
    let told = |size: FrameSize| match (size.kind, size.sizes) {
        (DISCRETE, [w, h, ..]) => format!("{w} x {h}"),
        (_, [w, most_w, _, h, most_h, _]) => format!("{w} x {h} to {most_w} x {most_h}"),
    };
    (0..MOST_ENTRIES).map_while(entry).map(told).collect()
}

/// What the camera offers, for messages: each format with its sizes.
pub(super) fn offers(node: &Node) -> String {
    let told = |code: u32| match sizes(node, code) {
        sizes if sizes.is_empty() => name_of(code),
        sizes => format!("{} {}", name_of(code), sizes.join(", ")),
    };
    let all: Vec<String> = codes(node).into_iter().map(told).collect();
    if all.is_empty() {
        return "no format".into();
    }
    all.join("; ")
}

/// The rates of a format at a size.
enum Rates {
    /// The driver lists none.
    Unlisted,
    /// Pictures per second, each.
    Each(Vec<f64>),
    /// From the first to the second.
    Within(f64, f64),
}

impl Rates {
    fn of(node: &Node, code: u32, [width, height]: [u32; 2]) -> Self {
        let entry = |index| {
            let mut entry = FrameInterval { index, code, width, height, ..FrameInterval::default() };
            node.call(&LIST_INTERVAL, &mut entry).ok().map(|()| entry)
        };
        let hz = |s: u32, of: u32| if s == 0 { 0.0 } else { f64::from(of) / f64::from(s) };
        let mut each = Vec::new();
        for entry in (0..MOST_ENTRIES).map_while(entry) {
            let [s, of, most_s, most_of, ..] = entry.intervals;
            if entry.kind != DISCRETE {
                return Self::Within(hz(most_s, most_of), hz(s, of));
            }
            each.push(hz(s, of));
        }
        if each.is_empty() {
            return Self::Unlisted;
        }
        Self::Each(each)
    }

    fn has(&self, hz: f64) -> bool {
        match self {
            Self::Unlisted => true,
            Self::Each(each) => each.iter().any(|rate| is_same(*rate, hz)),
            Self::Within(least, most) => {
                is_same(*least, hz) || is_same(*most, hz) || (*least..=*most).contains(&hz)
            }
        }
    }

    fn told(&self) -> String {
        match self {
            Self::Unlisted => "rates that its driver does not list".into(),
            Self::Each(each) => each.iter().map(|hz| rounded(*hz)).collect::<Vec<_>>().join(", "),
            Self::Within(least, most) => format!("{} to {}", rounded(*least), rounded(*most)),
        }
    }
}

fn is_same(a: f64, b: f64) -> bool {
    (a / b - 1.0).abs() <= SAME_RATE
}

fn rounded(hz: f64) -> String {
    let text = format!("{hz:.2}");
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}

/// The format at `size` that the driver would make of a request for it; `None` if it makes something else.
fn would_give(node: &Node, layout: &Layout, [width, height]: [u32; 2]) -> bool {
    let asked = PixelFormat { width, height, code: layout.code, field: FIELD_NONE, ..PixelFormat::default() };
    let mut format = Format::capture(asked);
    match node.call(&TRY_FORMAT, &mut format) {
        Ok(()) => {
            let p = &format.pixels;
            (p.code, p.width, p.height) == (layout.code, width, height)
        }
        // Drivers need not have this request; setting the format then shows it.
        Err(e) => e.raw_os_error() == Some(libc::ENOTTY),
    }
}

/// Chooses the format: one whose grey levels can be read, at the size and, if there is one, at the rate.
fn choose(node: &Node, place: &str, request: &PictureRequest) -> Result<&'static Layout, CameraDoubt> {
    let listed = codes(node);
    let readable: Vec<&Layout> = LAYOUTS.iter().filter(|l| listed.contains(&l.code)).collect();
    let [w, h] = request.size;
    if readable.is_empty() {
        let names: Vec<String> = LAYOUTS.iter().map(|l| name_of(l.code)).collect();
        return Err(CameraDoubt::new(
            format!("{place} gives no format that is read here; it offers {}", offers(node)),
            format!("use a camera with one of {}", names.join(", ")),
        ));
    }
    let fitting: Vec<&Layout> =
        readable.into_iter().filter(|layout| would_give(node, layout, request.size)).collect();
    if fitting.is_empty() {
        return Err(CameraDoubt::new(
            format!("{place} gives no pictures of {w} x {h}; it offers {}", offers(node)),
            "set tracker.size to what it offers in a format that is read",
        ));
    }
    let hz = f64::from(request.rate_hz);
    if let Some(found) = fitting.iter().find(|l| Rates::of(node, l.code, request.size).has(hz)) {
        return Ok(found);
    }
    let told = fitting
        .iter()
        .map(|l| format!("{} {}", name_of(l.code), Rates::of(node, l.code, request.size).told()));
    let told = told.collect::<Vec<_>>().join("; ");
    Err(CameraDoubt::new(
        format!(
            "{place} has no {} pictures a second at {w} x {h}; a second it offers {told}",
            request.rate_hz
        ),
        "set tracker.rate_hz, or a smaller tracker.size",
    ))
}

/// Sets format and rate. How the pictures lie in the buffers, and what is doubtful.
///
/// # Errors
/// The camera has not what is asked, or another program uses it.
pub(super) fn set(
    node: &Node,
    place: &str,
    request: &PictureRequest,
    doubts: &mut Vec<CameraDoubt>,
) -> Result<PictureForm, CameraDoubt> {
    let layout = choose(node, place, request)?;
    let [width, height] = request.size;
    let asked = PixelFormat { width, height, code: layout.code, field: FIELD_NONE, ..PixelFormat::default() };
    let mut format = Format::capture(asked);
    node.call(&SET_FORMAT, &mut format).map_err(|e| failure(place, "the format", &e))?;
    let p = &format.pixels;
    if (p.code, p.width, p.height) != (layout.code, width, height) {
        let given = format!("{} of {} x {}", name_of(p.code), p.width, p.height);
        let asked = format!("{} of {width} x {height}", name_of(layout.code));
        let found = format!("{place} makes {given} of a request for {asked}; it offers {}", offers(node));
        return Err(CameraDoubt::new(found, "set tracker.size to what it offers"));
    }
    if p.field > FIELD_NONE {
        let found = format!("{place} gives every second row at a time (field {})", p.field);
        return Err(CameraDoubt::new(found, "use a camera whose pictures are progressive"));
    }
    set_rate(node, place, request, doubts)?;
    let size = [width as usize, height as usize];
    let stride = (p.bytes_per_row as usize).max(layout.row_bytes(size[0]));
    Ok(PictureForm { layout, stride, size })
}

fn set_rate(
    node: &Node,
    place: &str,
    request: &PictureRequest,
    doubts: &mut Vec<CameraDoubt>,
) -> Result<(), CameraDoubt> {
    let hz = f64::from(request.rate_hz);
    let mut parameters = StreamParameters::capture([1, request.rate_hz]);
    match node.call(&SET_RATE, &mut parameters) {
        Ok(()) => {}
        Err(e) if matches!(e.raw_os_error(), Some(libc::ENOTTY | libc::EINVAL)) => {
            // Without the request the rate stands fixed, and may be told.
            parameters = StreamParameters::capture([0, 0]);
            let _ = node.call(&GET_RATE, &mut parameters);
        }
        Err(e) => return Err(failure(place, "the rate", &e)),
    }
    let [s, of] = parameters.interval;
    if s == 0 || of == 0 {
        let found = format!("{place} does not say how many pictures a second it gives");
        doubts.push(CameraDoubt::new(found, "see whether they are tracker.rate_hz, by the count below"));
        return Ok(());
    }
    let given = f64::from(of) / f64::from(s);
    if is_same(given, hz) {
        return Ok(());
    }
    let fixed = if parameters.capability & CAN_SET_RATE == 0 { ", and the rate cannot be set" } else { "" };
    Err(CameraDoubt::new(
        format!("{place} gives {} pictures a second and not {}{fixed}", rounded(given), request.rate_hz),
        format!("set tracker.rate_hz = {:.0}", given.max(1.0)),
    ))
}
