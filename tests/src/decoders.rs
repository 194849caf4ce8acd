//! Feeds arbitrary bytes to every decoder of external input. Each decoder has one entry, with the laws that hold for
//! all bytes. The fuzz targets in `fuzz/` and the test over the committed seeds call the same entries.

use crate::conversations::{gaze, link, sensor, trackers, usb};
use dpm_camera_files::{self as camera_files, LengthUnit, LensKind, ReadOptions, StorageError, StorageForm};
use dpm_device::clock_map::{ClockMap, ExchangeOutcome};
use dpm_device::cobs::{encode, encoded_bytes, Deframer};
use dpm_device::link::crc32c;
use dpm_device::link::{
    move_plane, rle_encode, Assembly, Decoder, DeviceMessage, Header, HostMessage, MessageType, PacketSink,
    RleDecoder, MAX_CONTROL_BYTES, MAX_SHIFT,
};
use dpm_device::planes::Raster;
use dpm_device::sensor::wire::{SensorMessage, MAX_FRAME, MAX_PACKET, MAX_SAMPLES};
use dpm_device::time::{DeviceTicks, HostTime};
use dpm_dlpc900::command::{CommandAssembler, ReplyAssembler, REPORT_BYTES};
use dpm_dlpc900::image;
use dpm_rig::config::{Overrides, RigConfig};
use dpm_rig::control::osc::decode as osc;
use dpm_rig::control::{server, status_file, ClientRequest};
use dpm_rig::order::Order;
use dpm_rig::parameters::command::{ParameterCommand, MAX_LINE};
use dpm_rig::standing;
use dpm_rig::trackers::kinds;
use hil_mock::faults::FaultPlan;
use hil_mock::usbip::wire as usbip;
use std::io::{self, Read, Write};
use std::path::Path;

/// The entry of a decoder.
pub type Entry = fn(&[u8]);

/// Every entry with the name of its fuzz target, which is also the name of its folder of seeds.
pub const ALL: [(&str, Entry); 43] = [
    ("link_stream", link_stream),
    ("link_rle", link_rle),
    ("link_tracks", link_tracks),
    ("cobs_stream", cobs_stream),
    ("dlpc900_reports", dlpc900_reports),
    ("dlpc900_image", dlpc900_image),
    ("natnet_datagram", natnet_datagram),
    ("vrpn_stream", vrpn_stream),
    ("serial_pose", serial_pose),
    ("picture_header", picture_header),
    ("motion_jpeg", motion_jpeg),
    ("sensor_packet", sensor_packet),
    ("texts", texts),
    ("recording", recording),
    ("tracker_kinds", tracker_kinds),
    ("usbip_stream", usbip_stream),
    ("clock_map", clock_map),
    ("control_words", control_words),
    ("osc_datagram", osc_datagram),
    ("settings", settings),
    ("projector", link::projector),
    ("projector_hello", link::projector_hello),
    ("host_link", link::host_link),
    ("host_hello", link::host_hello),
    ("natnet_client", trackers::natnet_client),
    ("natnet_server", trackers::natnet_server),
    ("vrpn_client", trackers::vrpn_client),
    ("vrpn_server", trackers::vrpn_server),
    ("pupil_stream", gaze::pupil_stream),
    ("pupil_gaze", gaze::pupil_gaze),
    ("serial_client", trackers::serial_client),
    ("serial_device", trackers::serial_device),
    ("sensor_client", sensor::sensor_client),
    ("sensor_device", sensor::sensor_device),
    ("dlpc900_driver", usb::dlpc900_driver),
    ("dlpc900_controller", usb::dlpc900_controller),
    ("usbip_server", usb::usbip_server),
    ("gltf", crate::files::gltf),
    ("gltf_parts", crate::files::gltf_parts),
    ("mesh", crate::files::mesh),
    ("environment", crate::files::environment),
    ("picture", crate::files::picture),
    ("calibration", calibration),
];

#[derive(Default)]
struct Heard {
    assembly: Option<Assembly>,
    packets: Vec<(Header, Option<Vec<u8>>, bool)>,
}

impl PacketSink for Heard {
    fn begin(&mut self, header: &Header) -> bool {
        self.assembly = Assembly::new(header);
        if self.assembly.is_none() {
            self.packets.push((*header, None, false));
        }
        self.assembly.is_some()
    }

    fn payload(&mut self, bytes: &[u8]) {
        if let Some(a) = &mut self.assembly {
            a.push(bytes);
        }
    }

    fn end(&mut self, intact: bool) {
        let Some(a) = self.assembly.take() else { return };
        if intact {
            let _ = HostMessage::parse(a.header().kind, a.payload());
            let _ = DeviceMessage::parse(a.header().kind, a.payload());
        }
        self.packets.push((*a.header(), Some(a.payload().to_vec()), intact));
    }
}

/// The stream of the bit-plane link: what is found does not depend on how the stream is split.
pub fn link_stream(bytes: &[u8]) {
    let (mut whole, mut cut) = (Heard::default(), Heard::default());
    let (mut a, mut b) = (Decoder::new(), Decoder::new());
    a.push(bytes, &mut whole);
    bytes.chunks(7).for_each(|c| b.push(c, &mut cut));
    assert_eq!(whole.packets, cut.packets);
    assert_eq!(a.counters(), b.counters());
}

/// A plane of 64 bytes in RLE: however it is split, it decodes to the same bytes, and decoded bytes can be encoded
/// again.
pub fn link_rle(bytes: &[u8]) {
    let (mut plane, mut again) = ([0u8; 64], [0u8; 64]);
    let (mut whole, mut cut) = (RleDecoder::new(), RleDecoder::new());
    let first = whole.push(bytes, &mut plane);
    let second = bytes.chunks(3).try_for_each(|c| cut.push(c, &mut again));
    assert_eq!(first.is_ok(), second.is_ok());
    if first.is_ok() && whole.finish(plane.len()).is_ok() {
        assert_eq!(plane, again);
        let mut coded = [0u8; 256];
        let n = rle_encode(&plane, &mut coded).expect("64 bytes always fit");
        let (mut back, mut decoder) = ([0u8; 64], RleDecoder::new());
        decoder.push(&coded[..n], &mut back).expect("own code");
        assert!(decoder.finish(back.len()).is_ok() && back == plane);
    }
}

/// Any instant, any lateness and any device of the tracks in `bytes`: no plane gets brighter, nothing changes outside of the
/// regions, and no shift passes the device's greatest.
pub fn link_tracks(bytes: &[u8]) {
    let Some((&[late, most, seed, after], payload)) = bytes.split_first_chunk::<4>() else { return };
    let Ok(HostMessage::Tracks(tracks)) = HostMessage::parse(MessageType::Tracks, payload) else { return };
    let raster = Raster::new(40, 6).expect("a raster");
    let mut again = [0; MAX_CONTROL_BYTES];
    let (kind, n) = HostMessage::Tracks(tracks).write(&mut again);
    assert_eq!(HostMessage::parse(kind, &again[..n]), Ok(HostMessage::Tracks(tracks)));
    let instant = DeviceTicks(tracks.begin.0.saturating_add(u64::from(after) * 100));
    let Some(moves) = tracks.moves_at(instant, 1_000_000, u32::from(late) << (late % 24), most) else {
        assert!(!tracks.holds_at(instant, 1_000_000));
        return;
    };
    let greatest = most.min(MAX_SHIFT);
    assert!(moves.all().iter().flat_map(|one| one.shift).all(|shift| shift.unsigned_abs() <= greatest));
    if !tracks.fits(raster) {
        return;
    }
    let plane: Vec<u8> = (0..30u8).map(|i| seed.wrapping_mul(i | 1).rotate_left(3) ^ i).collect();
    let mut light = vec![0; plane.len()];
    move_plane(raster, &plane, &moves, &mut light);
    let lit = |plane: &[u8]| plane.iter().map(|byte| byte.count_ones()).sum::<u32>();
    assert!(lit(&light) <= lit(&plane));
    for (x, y) in (0..40usize).flat_map(|x| (0..6usize).map(move |y| (x, y))) {
        let (at, mask) = (y * 5 + x / 8, 0x80 >> (x % 8));
        let is_outside = !moves.all().iter().any(|one| one.area.contains(x as i64, y as i64));
        assert!(!is_outside || plane[at] & mask == light[at] & mask, "mirror {x}, {y}");
    }
}

/// COBS frames: the same however they are split, and each is recovered from its own encoding.
pub fn cobs_stream(bytes: &[u8]) {
    let frames = |step: usize| {
        let mut deframer = Deframer::new([0u8; 128]);
        let mut all: Vec<Vec<u8>> = Vec::new();
        bytes.chunks(step.max(1)).for_each(|c| deframer.push(c, &mut |f| all.push(f.to_vec())));
        all
    };
    let whole = frames(bytes.len());
    assert_eq!(whole, frames(1));
    for frame in whole {
        assert!(frame.len() <= 128);
        let mut coded = vec![0; encoded_bytes(frame.len())];
        let n = encode(&[&frame], &mut coded).expect("room as promised");
        let mut deframer = Deframer::new([0u8; 128]);
        let mut back = None;
        deframer.push(&coded[..n], &mut |f| back = Some(f.to_vec()));
        assert_eq!(back, Some(frame));
    }
}

/// HID reports of a DLPC900, in both directions.
pub fn dlpc900_reports(bytes: &[u8]) {
    let (mut commands, mut replies) = (CommandAssembler::default(), ReplyAssembler::default());
    for report in bytes.chunks(REPORT_BYTES) {
        let _ = commands.push(report);
        let _ = replies.push(report);
    }
}

/// A DLPC900 image of 8 x 4 pixels: whatever decodes has exactly the bytes of that many pixels.
pub fn dlpc900_image(bytes: &[u8]) {
    if let Ok(pixels) = image::decode(bytes, 8, 4) {
        assert_eq!(pixels.len(), 8 * 4 * 3);
    }
}

/// Any bytes into the decoder `name` of a kind of trackers.
fn tracker(name: &str, bytes: &[u8]) {
    let decoder = kinds().iter().flat_map(|kind| kind.decoders).find(|(known, _)| *known == name);
    decoder.unwrap_or_else(|| panic!("no kind of trackers has the decoder {name:?}")).1(bytes);
}

/// A NatNet datagram.
pub fn natnet_datagram(bytes: &[u8]) {
    tracker("natnet_datagram", bytes);
}

/// A VRPN stream.
pub fn vrpn_stream(bytes: &[u8]) {
    tracker("vrpn_stream", bytes);
}

/// The header of a camera's picture.
pub fn picture_header(bytes: &[u8]) {
    tracker("picture_header", bytes);
}

/// A picture of a USB camera.
pub fn motion_jpeg(bytes: &[u8]) {
    tracker("motion_jpeg", bytes);
}

/// A packet of the serial pose stream.
pub fn serial_pose(bytes: &[u8]) {
    tracker("serial_pose", bytes);
}

/// A tracker's recording.
pub fn recording(bytes: &[u8]) {
    tracker("recording", bytes);
}

/// Any bytes into the decoders of all kinds of trackers: the first byte names one. A new kind needs no target of its own.
pub fn tracker_kinds(bytes: &[u8]) {
    let Some((&first, rest)) = bytes.split_first() else { return };
    let all: Vec<_> = kinds().iter().flat_map(|kind| kind.decoders).collect();
    all[usize::from(first) % all.len()].1(rest);
}

/// A packet of a light sensor, as it is and with its checksum corrected: a block has as many levels as it says, none above
/// what its bits hold, and its own encoding is read as the same message.
pub fn sensor_packet(bytes: &[u8]) {
    let sealed = [bytes, &crc32c(bytes).to_le_bytes()].concat();
    for packet in [bytes, &sealed] {
        let Ok(message) = SensorMessage::decode(packet) else { continue };
        if let SensorMessage::Samples(head, levels) = &message {
            assert!((1..=MAX_SAMPLES).contains(&levels.len()) && levels.iter().count() == levels.len());
            assert!(levels.iter().all(|level| level <= levels.bits().highest()));
            assert!(head.ticks_of(levels.len() - 1).1 < 1 << 16);
        }
        let mut frame = [0; MAX_FRAME];
        let n = message.encode(&mut frame).expect("room for every message");
        let mut deframer = Deframer::new([0u8; MAX_PACKET]);
        let mut back = None;
        deframer.push(&frame[..n], &mut |f| back = Some(f.to_vec()));
        let again = back.expect("one frame");
        let mut second = [0; MAX_FRAME];
        let m = SensorMessage::decode(&again).expect("own encoding").encode(&mut second).expect("room");
        assert_eq!(frame[..n], second[..m]);
    }
}

/// USB/IP, both ends: whatever is read is recovered from its own encoding.
pub fn usbip_stream(bytes: &[u8]) {
    if let Ok(operation) = usbip::Operation::read(&mut &bytes[..]) {
        // A name that is not text, or that fills its 32 bytes without a terminator, is accepted and names no device.
        let is_text = !matches!(&operation, usbip::Operation::Import(id) if !id.is_ascii() || id.len() > 31);
        let again = usbip::Operation::read(&mut &operation.encode()[..]).ok();
        assert!(again == Some(operation) || !is_text);
    }
    if let Ok(devices) = usbip::read_list_reply(&mut &bytes[..]) {
        assert!(devices.len() * usbip::DEVICE_RECORD <= bytes.len());
    }
    let _ = usbip::read_import_reply(&mut &bytes[..]);
    for header in bytes.as_chunks::<{ usbip::URB_HEADER }>().0 {
        if let Ok(urb) = usbip::Urb::decode(header) {
            assert_eq!(usbip::Urb::decode(&urb.encode()).ok(), Some(urb));
        }
    }
}

/// A rig file.
pub fn texts(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    dpm_dlpc900_rig::register();
    if let Err(errors) = RigConfig::parse("seed.toml", text, Path::new("/nonexistent"), &Overrides::default())
    {
        assert!(!errors.to_string().is_empty());
    }
}

/// A calibration file in any dialect, plain or in an archive. What it yields is finite, and its export has no fault of form.
pub fn calibration(bytes: &[u8]) {
    let raster = Raster::new(64, 48).expect("not zero");
    for lens in [LensKind::Auto, LensKind::Fisheye] {
        let options = ReadOptions { raster, unit: LengthUnit::Metre, lens, region: None, device: None };
        let stored = match camera_files::read(bytes, &options) {
            Ok(stored) => stored,
            Err(refused) => {
                assert!(!refused.to_string().is_empty());
                continue;
            }
        };
        let camera = stored.camera;
        assert!(camera.world_from_projector.is_finite() && camera.fx > 0.0 && camera.fy > 0.0);
        for form in [StorageForm::Xml, StorageForm::Yaml, StorageForm::Json] {
            let text = camera_files::export(&camera, form);
            let again = camera_files::read(text.as_bytes(), &ReadOptions { lens: LensKind::Auto, ..options });
            use StorageError::{Matrix, Missing, Syntax, UnknownForm};
            let bad_form = matches!(again, Err(Matrix { .. } | Missing { .. } | Syntax { .. } | UnknownForm));
            assert!(!bad_form, "{again:?} of {text}");
        }
    }
}

/// The environment and the flags that set keys, and the plans of faults. A plan is recovered from its own text.
pub fn settings(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    if let Ok(plan) = text.parse::<FaultPlan>() {
        assert_eq!(plan.to_string().parse::<FaultPlan>(), Ok(plan));
    }
    let mut overrides = Overrides::default();
    for line in text.lines() {
        match line.strip_prefix('$').and_then(|line| line.split_once('=')) {
            Some((name, value)) => overrides.variables.push((format!("DPM_SET_{name}"), value.into())),
            None => overrides.flags.push(line.into()),
        }
    }
    dpm_dlpc900_rig::register();
    if let Err(errors) = RigConfig::parse("seed.toml", "", Path::new("/nonexistent"), &overrides) {
        assert!(!errors.to_string().is_empty());
    }
}

/// A client of the control socket, whose bytes come in pieces of a length and are read as they come.
struct Client<'a> {
    rest: &'a [u8],
    piece: usize,
    is_dry: bool,
    told: usize,
}

impl Read for Client<'_> {
    fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
        self.is_dry = !self.is_dry;
        if self.is_dry && self.piece < 8 {
            return Err(io::ErrorKind::WouldBlock.into());
        }
        let n = self.rest.len().min(self.piece).min(into.len());
        into[..n].copy_from_slice(&self.rest[..n]);
        self.rest = &self.rest[n..];
        Ok(n)
    }
}

impl Write for Client<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.told += bytes.len();
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// What other processes say of a projector: an order on the control socket, a state file, and the file of a standing
/// order. An order is one of the four words and nothing else, however it is split, and a command about the parameters
/// is what its line says; whatever a standing order's file holds, it stands for darkness, and for SAFE unless it is
/// whole.
pub fn control_words(bytes: &[u8]) {
    for piece in [1, 3, 16] {
        let mut client = Client { rest: bytes, piece, is_dry: false, told: 0 };
        let mut word = Vec::new();
        let order = loop {
            match server::read_word(&mut client, &mut word) {
                Ok(None) => {}
                Ok(Some(order)) => break Some(order),
                Err(_) => break None,
            }
        };
        assert!(word.len() <= MAX_LINE && client.told <= 1000);
        let line =
            bytes[..bytes.len().min(MAX_LINE)].split_inclusive(|b| *b == b'\n').next().unwrap_or_default();
        // A word is read by pieces, and what came with its line feed is part of it.
        if let Some(ClientRequest::Parameters(command)) = &order {
            let again = ParameterCommand::parse(&command.line());
            assert!(
                matches!(&again, Ok(Some(back)) if format!("{back:?}") == format!("{command:?}")),
                "{again:?}"
            );
        } else if let Some(ClientRequest::Order(order)) = order {
            assert!(word.starts_with(order.word().as_bytes()), "{order:?} from {word:?}");
        } else if let Some(exact) = Order::ALL.iter().find(|(_, w)| line == format!("{w}\n").as_bytes()) {
            assert!(bytes.len() > line.len(), "{} was not heard", exact.1);
        }
    }
    if let Some(said) = status_file::parse(&String::from_utf8_lossy(bytes)) {
        assert!(said.rig.len() <= 3 * bytes.len() && !said.health.to_string().is_empty());
    }
    let stands = standing::stands_in_bytes(bytes);
    assert!(matches!(stands.order, Order::Black | Order::Safe), "{stands:?}");
    assert!(stands.order == Order::Safe || bytes.trim_ascii().ends_with(b"}"), "{stands:?}");
    assert!(!stands.told.contains('\n') || stands.told.starts_with("counts as SAFE"));
}

/// A datagram of OSC: it gives messages or a fault, never ARM, and the same messages inside a bundle.
pub fn osc_datagram(bytes: &[u8]) {
    let heard = |bytes: &[u8]| {
        let mut all = Vec::new();
        let end = osc::decode(bytes, &mut |one| all.push(format!("{one:?}")));
        (all, end.is_ok())
    };
    let _ = osc::decode(bytes, &mut |one| {
        let one = one.map(|said| {
            assert!(said.token.is_none_or(|token| token.len() <= bytes.len()));
            said.heard
        });
        assert_ne!(one, Ok(osc::OscRequest::Order(Order::Arm)));
        if let Ok(osc::OscRequest::Set { name, numbers }) = one {
            assert!(numbers.len() <= osc::MOST_NUMBERS && name.len() <= bytes.len());
        }
    });
    let plain = heard(bytes);
    let is_bundle = bytes.starts_with(b"#bundle\0");
    if bytes.len().is_multiple_of(4) && !bytes.is_empty() && !is_bundle {
        let mut inside = b"#bundle\0\0\0\0\0\0\0\0\x01".to_vec();
        inside.extend((bytes.len() as u32).to_be_bytes());
        inside.extend(bytes);
        assert_eq!(heard(&inside), plain);
    }
}

/// The map of a device's clock: stamps of any device give instants in order and a bound that is none below 0, and where
/// the device's clock is honest (a rate within 200 ppm and delays of any length), the true error lies inside the bound.
pub fn clock_map(bytes: &[u8]) {
    let Some((&[rate, bits, skew, how], mut rest)) = bytes.split_first_chunk::<4>() else { return };
    let ticks_per_second =
        [1, 1000, 1_000_000, 10_000_000, 1_000_000_000, 1_000_000_000_000][usize::from(rate % 6)];
    let bits = [16, 24, 32, 48, 64][usize::from(bits % 5)];
    let mut map = ClockMap::with_bits(ticks_per_second, bits).expect("a clock");
    let mut now: i64 = 1_000_000_000_000;
    let mut last = HostTime(i64::MIN);
    // Ticks of an honest device at host time `t`; its clock began some time before.
    let began = u128::from(how) << 40;
    let ppb = (i128::from(skew) - 128) * 1500;
    let ticks_at = |t: i64| {
        let device = i128::from(t) + i128::from(t) * ppb / 1_000_000_000;
        DeviceTicks(
            (began as i128 + device * i128::from(ticks_per_second) / 1_000_000_000) as u64
                & (u64::MAX >> (64 - bits)),
        )
    };
    let is_honest = how & 1 == 0;
    while let Some((&[a, b, c, wait], after)) = rest.split_first_chunk::<4>() {
        // A wrap of the counter must not pass between two exchanges.
        let half_wrap = (1u128 << (bits - 1)) * 1_000_000_000 / u128::from(ticks_per_second);
        let step = i64::from(wait) * i64::from(wait) * 50_000 + 1;
        now += step.min(i64::try_from(half_wrap / 4).unwrap_or(i64::MAX)).max(1);
        rest = after;
        let unit = i64::try_from(half_wrap / 4096).unwrap_or(i64::MAX).clamp(1, 20_000);
        // No cable is without delay: the drift of the clocks while the device answers is shorter.
        let [there, back] = [a, c].map(|n| (i64::from(n) + 1) * unit);
        let inside = i64::from(b) * unit / 8;
        let t4 = now + there + inside + back;
        if is_honest {
            // A counter that wraps within a round trip tells nothing.
            if half_wrap < 10_000_000 {
                break;
            }
            let outcome = map.add_exchange(
                HostTime(now),
                ticks_at(now + there),
                ticks_at(now + there + inside),
                HostTime(t4),
            );
            // A counter of whole ticks, slower than the delays, is honest too.
            let tick_ns = 1_000_000_000 / ticks_per_second as i64 + 1;
            assert!(tick_ns > 1000 || outcome == ExchangeOutcome::Used, "{outcome:?}");
            if let (true, Some(mapped)) = (tick_ns <= 1000, map.to_host(ticks_at(now + there))) {
                let error = mapped.at.0 - (now + there);
                assert!(error.abs() <= mapped.uncertainty_ns + tick_ns, "{error} ns, bound {mapped:?}");
            }
        } else {
            let stamp = rest.split_first_chunk::<16>();
            let Some((stamps, after)) = stamp else { break };
            rest = after;
            let [rx, tx] = [&stamps[..8], &stamps[8..]]
                .map(|s| DeviceTicks(u64::from_le_bytes([s[0], s[1], s[2], s[3], s[4], s[5], s[6], s[7]])));
            let steps = map.steps();
            let outcome = map.add_exchange(HostTime(now), rx, tx, HostTime(t4));
            assert_eq!(map.steps() != steps, outcome == ExchangeOutcome::Stepped);
            for ticks in [rx, tx, DeviceTicks(0)] {
                if let Some(mapped) = map.map_forward(ticks) {
                    assert!(mapped.at >= last && mapped.uncertainty_ns >= 0, "{mapped:?}");
                    last = mapped.at;
                }
            }
        }
        assert!(map.exchanges() <= 64 && map.is_ready() == map.to_device(HostTime(now)).is_some());
        assert!(map.min_round_trip_ns().is_none_or(|ns| ns >= 0));
        now = t4;
    }
}
