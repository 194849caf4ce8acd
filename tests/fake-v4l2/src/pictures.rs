//! The sensor of a fake camera: pictures of a socket into buffers.

use std::io::{ErrorKind, Read};
use std::net::TcpStream;
use std::sync::atomic::Ordering;
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use dpm_device::picture_stream::{PictureHeader, HEADER_BYTES};

use crate::device::{Form, OpenFile};
use crate::settings::Stamp;
use crate::world::lock;
use crate::Settings;

/// Bytes of a row of `width` pixels, without padding.
pub(crate) fn row_bytes(code: &str, width: u32) -> u32 {
    match code {
        "GREY" | "NV12" => width,
        _ => 2 * width,
    }
}

/// Streams until the file is closed, the stream ended or the camera is gone.
pub(crate) fn start(file: Arc<OpenFile>) {
    let run = move || {
        let mut link: Option<TcpStream> = None;
        let mut numbers = Numbers::default();
        while is_on(&file) {
            if link.is_none() {
                link = TcpStream::connect(file.camera.settings().from).ok();
                let limit = Some(Duration::from_millis(100));
                if let Some(stream) = &link {
                    stream.set_read_timeout(limit).expect("a limit");
                } else {
                    std::thread::sleep(Duration::from_millis(20));
                    continue;
                }
            }
            let picture = link.as_mut().and_then(|stream| picture(stream, &file));
            match picture {
                Some((header, pixels)) => hand_out(&file, &header, &pixels, &mut numbers),
                None => link = None,
            }
        }
        if file.camera.is_gone() {
            file.hang_up();
        }
    };
    std::thread::Builder::new().name("fake-v4l2".into()).spawn(run).expect("a thread");
}

fn is_on(file: &OpenFile) -> bool {
    !file.is_closed.load(Ordering::Acquire) && !file.camera.is_gone() && lock(&file.state).is_streaming
}

/// The next picture of the socket; `None` if there is no more, or nobody wants it.
fn picture(stream: &mut TcpStream, file: &OpenFile) -> Option<(PictureHeader, Vec<u8>)> {
    let mut head = [0; HEADER_BYTES];
    read_all(stream, &mut head, file)?;
    let header = PictureHeader::decode(&head)?;
    let mut pixels = vec![0; header.pixel_bytes()];
    read_all(stream, &mut pixels, file)?;
    Some((header, pixels))
}

fn read_all(stream: &mut TcpStream, mut into: &mut [u8], file: &OpenFile) -> Option<()> {
    while !into.is_empty() {
        match stream.read(into) {
            Ok(0) => return None,
            Ok(n) => into = &mut into[n..],
            Err(e) if [ErrorKind::WouldBlock, ErrorKind::TimedOut].contains(&e.kind()) => {
                is_on(file).then_some(())?
            }
            Err(_) => return None,
        }
    }
    Some(())
}

/// How the driver numbers pictures: from 0, without those that the socket lost.
#[derive(Default)]
struct Numbers {
    first: Option<u32>,
    count: u32,
}

fn hand_out(file: &OpenFile, header: &PictureHeader, pixels: &[u8], numbers: &mut Numbers) {
    let settings = file.camera.settings();
    let sequence = header.number.wrapping_sub(*numbers.first.get_or_insert(header.number));
    numbers.count += 1;
    let mut state = lock(&file.state);
    let Some(form) = state.form.clone().filter(|_| state.is_streaming && !settings.is_silent) else { return };
    if [header.width, header.height] != form.size {
        eprintln!("fake-v4l2: the socket sends {} x {}", header.width, header.height);
        return;
    }
    let is_every = |n: u32| n > 0 && numbers.count.is_multiple_of(n);
    let mut bytes = formed(&form, pixels);
    if is_every(settings.short_every) {
        bytes.truncate(bytes.len() - form.stride as usize - bytes.len() / 3);
    }
    let (mut flags, stamp_ns) = stamped(header, &settings);
    if is_every(settings.damaged_every) {
        flags |= 0x40;
        bytes.iter_mut().for_each(|b| *b ^= 0xa5);
    }
    if state.buffers.fill(&bytes, flags, stamp_ns, sequence) {
        file.ring();
    } else {
        lock(&file.camera.witness).without_buffer += 1;
    }
}

/// Grey levels in the camera's format: rows are padded, and colours say nothing of the grey.
fn formed(form: &Form, pixels: &[u8]) -> Vec<u8> {
    if form.code == "MJPG" {
        return jpeg(form, pixels);
    }
    let mut out = Vec::with_capacity(form.bytes as usize);
    let colour = |i: usize| (i * 37 % 251) as u8;
    for (y, row) in pixels.chunks_exact(form.size[0] as usize).enumerate() {
        for (x, grey) in row.iter().enumerate() {
            let wide = |bits: u32| ((u32::from(*grey) << (bits - 8)) as u16).to_le_bytes();
            match form.code.as_str() {
                "GREY" | "NV12" => out.push(*grey),
                "YUYV" => out.extend([*grey, colour(x + y)]),
                "UYVY" => out.extend([colour(x + y), *grey]),
                "Y10 " => out.extend(wide(10)),
                _ => out.extend(wide(16)),
            }
        }
        out.resize((y + 1) * form.stride as usize, 0xee);
    }
    if form.code == "NV12" {
        let colours = (0..form.bytes as usize - out.len()).map(colour);
        out.extend(colours);
    }
    out
}

/// As USB cameras send it: in colours that are grey, without Huffman tables.
fn jpeg(form: &Form, pixels: &[u8]) -> Vec<u8> {
    let colours: Vec<u8> = pixels.iter().flat_map(|grey| [*grey; 3]).collect();
    let mut whole = Vec::new();
    let mut encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut whole, 90);
    let coded = encoder.encode(&colours, form.size[0], form.size[1], image::ExtendedColorType::Rgb8);
    coded.expect("a picture of this size");
    let (mut out, mut at) = (whole[..2].to_vec(), 2);
    while whole[at + 1] != 0xda {
        let end = at + 2 + usize::from(u16::from_be_bytes([whole[at + 2], whole[at + 3]]));
        if whole[at + 1] != 0xc4 {
            out.extend(&whole[at..end]);
        }
        at = end;
    }
    out.extend(&whole[at..]);
    out
}

/// Flags and stamp of a picture.
fn stamped(header: &PictureHeader, settings: &Settings) -> (u32, i64) {
    let end_ns = header.begin_ns + header.exposure_ns + header.row_ns * i64::from(header.height);
    match settings.stamp {
        Stamp::Begin => (0x1_2000, header.begin_ns),
        Stamp::End => (0x2000, end_ns),
        Stamp::OddMoment => (0x3_2000, header.begin_ns),
        Stamp::NoClock => (0x1_0000, header.begin_ns),
        Stamp::Copied => (0x1_4000, header.begin_ns),
        Stamp::WallClock => {
            let now = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_nanos() as i64);
            (0x1_2000, now)
        }
    }
}
