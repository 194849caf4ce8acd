//! Runs every decoder on its committed seeds, on every prefix of each, and on each with flipped bits and repeated
//! bytes.
//!
//! The encoders make the seeds (`DPM_UPDATE_SEEDS=1 cargo test -p dpm-tests --test laws corpora` writes them); others are
//! added by hand. Put anything that a fuzzer finds into the folder of its target.

use crate::common::{png, tetrahedra, with_image, Glb};
use dpm_device::cobs::{encode, encoded_bytes};
use dpm_device::link::{
    rle_encode, Area, Commit, Header, HostMessage, MessageType, Packet, Region, Tracks, MAX_CONTROL_BYTES,
};
use dpm_device::picture_stream::PictureHeader;
use dpm_device::planes::Raster;
use dpm_device::sensor::wire::{BlockHead, LevelBits, Levels, SensorMessage, MAX_FRAME};
use dpm_device::time::DeviceTicks;
use dpm_device::time::FrameRate;
use dpm_device::tracker::natnet::frame::{encode_frame, FrameContent, FrameInfo, RigidBody};
use dpm_device::tracker::natnet::messages::{encode_echo_response, encode_request};
use dpm_device::tracker::natnet::Version;
use dpm_device::tracker::record::SAMPLE_BYTES;
use dpm_device::tracker::serial::wire::SerialMessage;
use dpm_device::tracker::vrpn::wire as vrpn;
use dpm_dlpc900::command::{Command, Opcode};
use dpm_dlpc900::image::{self, Compression, PlaneOrder};
use dpm_pupil::zmtp::{put_message, put_subscription, put_words, SocketKind, ZmtpPeer};
use dpm_tests::decoders::ALL;
use hil_mock::pupil::messages::PupilConfig;
use hil_mock::usbip::wire as usbip;
use serde_json::json;
use std::path::PathBuf;

fn folder(target: &str) -> PathBuf {
    PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/corpus")).join(target)
}

/// The seeds that the encoders make: target, name, bytes.
fn made() -> Vec<(&'static str, &'static str, Vec<u8>)> {
    let mut seeds = Vec::new();
    let mut payload = [0; MAX_CONTROL_BYTES];
    let mut stream = Vec::new();
    for message in [HostMessage::Stop, HostMessage::Arm(3), HostMessage::Sync(7)] {
        let (kind, n) = message.write(&mut payload);
        stream.extend(Packet::new(Header::control(kind, 42, 0), &payload[..n]).to_vec());
    }
    let plane = Header { led_code: 7, frame: 1, ..Header::control(MessageType::Plane, 42, 0) };
    stream.extend(Packet::new(plane, &[0xf0, 0x0f, 0x80]).to_vec());
    let picture = PictureHeader {
        width: 64,
        height: 48,
        number: 7,
        begin_ns: 1_000_000_000,
        exposure_ns: 2_000_000,
        row_ns: 10_000,
    };
    seeds.push(("picture_header", "header", picture.encode().to_vec()));
    seeds.push(("link_stream", "messages", stream.clone()));
    let mut coded = vec![0; 256];
    let mut bits = [0u8; 64];
    bits[10..40].fill(0xff);
    (50..60).for_each(|i| bits[i] = i as u8);
    let n = rle_encode(&bits, &mut coded).expect("room");
    seeds.push(("link_rle", "runs", coded[..n].to_vec()));
    let mut tracks = Tracks::new(3, 1, DeviceTicks(1_000_000), 11_000);
    for (left, offset) in [(2, 300), (10, -700)] {
        let area = Area { left, top: 1, width: 20, height: 4 };
        let motion = [offset, -offset / 2];
        tracks.push(Region {
            area,
            clamp: 8,
            gate: 150,
            offset: motion,
            velocity: motion,
            ..Region::default()
        });
    }
    let (_, n) = HostMessage::Tracks(tracks).write(&mut payload);
    seeds.push(("link_tracks", "regions", [&[1, 8, 0x5a, 9], &payload[..n]].concat()));
    let mut cobs = vec![0; encoded_bytes(stream.len())];
    let n = encode(&[&stream[..100]], &mut cobs).expect("room");
    seeds.push(("cobs_stream", "packets", cobs[..n].to_vec()));
    let command = Command { flags: 0x40, sequence: 5, opcode: Opcode::START_STOP, data: &[2] };
    let reports: Vec<u8> = command.reports().expect("short").flatten().collect();
    seeds.push(("dlpc900_reports", "start", reports));
    let small = Raster::new(8, 4).expect("a raster");
    let planes: Vec<Vec<u8>> =
        (0..24u8).map(|k| (0..4).map(|y| k.wrapping_mul(31) ^ (y / 2)).collect()).collect();
    let slices: Vec<&[u8]> = planes.iter().map(Vec::as_slice).collect();
    for (name, how) in [("raw", Compression::Raw), ("rle", Compression::Rle), ("erle", Compression::Erle)] {
        let image =
            image::encode(&slices, small, 0..8, PlaneOrder::default(), Some(how)).expect("an image").bytes;
        seeds.push(("dlpc900_image", name, image));
    }
    let body = RigidBody {
        id: 1,
        position: [0.1, 0.2, 0.3],
        rotation_xyzw: [0.0, 0.0, 0.0, 1.0],
        mean_error: 0.001,
        params: 1,
    };
    for (name, version) in [("v3_0", Version::V3_0), ("v4_1", Version::V4_1)] {
        let mut out = Vec::new();
        let content = FrameContent { bodies: &[body; 2], ..FrameContent::default() };
        encode_frame(&mut out, version, &FrameInfo::default(), &content).expect("a frame");
        seeds.push(("natnet_datagram", name, out));
    }
    let mut echo = Vec::new();
    encode_echo_response(&mut echo, 1, 2);
    seeds.push(("natnet_datagram", "echo", echo));
    let mut request = Vec::new();
    encode_request(&mut request, "Bitstream,4.1");
    seeds.push(("natnet_datagram", "request", request));
    let mut out = Vec::new();
    vrpn::put_description(&mut out, -1, 0, "Tracker0");
    let pose = vrpn::encode_pos_quat(0, &dpm_device::pose::Pose::IDENTITY);
    let message =
        vrpn::Message { seconds: 1, microseconds: 2, sender: 0, kind: 3, sequence: 4, payload: &pose };
    vrpn::put(&mut out, &message);
    seeds.push(("vrpn_stream", "described", out));
    let mut out = Vec::new();
    SerialMessage::Hello { version: 1, bodies: 2, ticks_per_second: 1_000_000 }.encode(&mut out);
    let mut deframer = dpm_device::cobs::Deframer::new([0u8; 128]);
    deframer.push(&out, &mut |f| seeds.push(("serial_pose", "hello", f.to_vec())));
    let head = BlockHead {
        sequence: 3,
        first: 1000,
        period: 10 << 16,
        lost: 1,
        gain: 1,
        cut_below: false,
        cut_above: true,
    };
    let levels = [0, 5, 4095, 800, 17];
    let mut frame = [0; MAX_FRAME];
    for (name, bits) in [("twelve", LevelBits::Twelve), ("sixteen", LevelBits::Sixteen)] {
        let block = SensorMessage::Samples(head, Levels::Values(bits, &levels));
        let n = block.encode(&mut frame).expect("room");
        deframer.push(&frame[..n], &mut |f| seeds.push(("sensor_packet", name, f.to_vec())));
    }
    // Frames of a recording without their checksums: a header with one body, a frame of one sample.
    let header = [&7i64.to_le_bytes()[..], &1u16.to_le_bytes(), b"\x04hare"].concat();
    let sample: Vec<u8> = (0..SAMPLE_BYTES as u8).collect();
    let framed = |payload: &[u8]| [&(payload.len() as u16).to_le_bytes()[..], payload].concat();
    seeds.push(("recording", "one_sample", [framed(&header), framed(&sample)].concat()));
    seeds.push(("usbip_stream", "import", usbip::Operation::Import("1-1".into()).encode()));
    let unlink = usbip::Urb::Unlink { seqnum: 3, devid: 0x0001_0001, victim: 2 };
    let ended = usbip::Urb::Submitted { seqnum: 2, status: -104, actual: 7 };
    seeds.push(("usbip_stream", "urbs", [unlink.encode(), ended.encode()].concat()));
    // Kind, codec, plane, frame, target, how, wait, length: a raw plane, an RLE plane, a STOP, an ARM; a STATUS and
    // an ECHO for the host.
    let script = |kind: MessageType, codec: u8, payload: &[u8]| {
        [&[kind as u8, codec, 0, 9, 20, 0, 10, payload.len() as u8][..], payload].concat()
    };
    let plane = [script(MessageType::Plane, 0, &[1, 2, 3, 4]), script(MessageType::Plane, 1, &[0x83, 7])];
    let lz4 = script(MessageType::Plane, 3, &[0x14, 5, 1, 0]);
    let orders = [script(MessageType::Stop, 0, &[]), script(MessageType::Arm, 0, &[0; 4])].concat();
    seeds.push(("projector", "planes_and_orders", [plane.concat(), lz4, orders].concat()));
    // Frames that keep every plane of the third frame sent: dark from a later tick, and from one before their target.
    let commit = |dark_from: u64| {
        let commit =
            Commit { sent: 0, kept: 0xff, base_frame: 3, frames_sent: 4, dark_from: DeviceTicks(dark_from) };
        let mut payload = [0; MAX_CONTROL_BYTES];
        let (kind, n) = HostMessage::Commit(commit).write(&mut payload);
        script(kind, 0, &payload[..n])
    };
    seeds.push(("projector", "commits", [commit(1), commit(40_000_000)].concat()));
    let answers = [script(MessageType::Status, 0, &[3; 96]), script(MessageType::Echo, 0, &[1; 24])].concat();
    seeds.push(("host_link", "answers", answers));
    let rig = b"[projector]\nframe_rate = \"60000/1001\"\n[[scene.bodies]]\nname = \"a\"\n".to_vec();
    seeds.push(("texts", "rig.toml", rig));
    seeds.extend(gaze());
    seeds.extend(calibrations());
    seeds.extend(dpm_tests::conversations::recorded());
    seeds.extend(words());
    seeds.extend(files());
    // The first byte names the decoder: those of the kinds in their order.
    let of = |target: &str| seeds.iter().find(|seed| seed.0 == target).expect("made above").2.clone();
    let names = ["natnet_datagram", "vrpn_stream", "serial_pose", "recording"];
    let bytes = names.map(of);
    for (k, (name, bytes)) in (0u8..).zip(names.into_iter().zip(bytes)) {
        seeds.push(("tracker_kinds", name, [&[k][..], &bytes].concat()));
    }
    seeds
}

/// A dialogue of ZMTP by each end, and answers and messages of Pupil with a blink.
fn gaze() -> Vec<(&'static str, &'static str, Vec<u8>)> {
    let pupil = PupilConfig { rate: FrameRate::new(10, 1).expect("above 0"), ..PupilConfig::default() };
    let mut data = vec![4];
    let mut script = Vec::new();
    let mut step = |what: u8, ms: u8, bytes: &[u8]| {
        let bytes = &bytes[..bytes.len().min(255)];
        script.extend_from_slice(&[&[what, ms, bytes.len() as u8], bytes].concat());
    };
    for k in 100..104u64 {
        let time = format!("{:?}", pupil.clock_s(pupil.seen_ns(k)));
        step(0, 2, time.as_bytes());
        for (topic, payload) in pupil.messages(k, 0.0) {
            put_message(&[topic.as_bytes(), &payload], &mut data);
            step(1, 20, &payload);
        }
    }
    // A map of what is needed and nothing else: it fits into a step.
    let short =
        b"\x85\xa9timestamp\xcb\x40\xb3\x92\x80\0\0\0\0\xaaconfidence\x01\xadgaze_point_3d\x93\0\0\x7f\
        \xadeye_center_3d\x93\0\0\0\xaegaze_normal_3d\x93\0\0\x01";
    // Its clock is known by one answer, and the sample is used.
    let look = [&b"\0\x01\x065010.5\x01\x01"[..], &[short.len() as u8], short].concat();
    let mut asks = vec![7];
    put_words(b"SUB_PORT", &mut asks);
    put_words(b"t", &mut asks);
    let mut wants = vec![5];
    put_subscription(b"gaze", &mut wants);
    wants.extend_from_slice(b"\x04\x0e\x09SUBSCRIBEgaze\x04\x09\x04PING\0\x64hi");
    let mut greets = vec![0];
    ZmtpPeer::new(SocketKind::Pub, &mut greets);
    vec![
        ("pupil_stream", "data", data),
        ("pupil_stream", "asks", asks),
        ("pupil_stream", "wants", wants),
        ("pupil_stream", "greets", greets),
        ("pupil_gaze", "samples", script),
        ("pupil_gaze", "look", look),
    ]
}

/// Calibration files as OpenCV writes them, and one of MPCDI.
fn calibrations() -> Vec<(&'static str, &'static str, Vec<u8>)> {
    let of = |name| {
        let assets = PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/assets"));
        std::fs::read(assets.join(name)).expect("an asset")
    };
    vec![
        ("calibration", "opencv.xml", of("opencv/fisheye.xml")),
        ("calibration", "opencv.yml", of("opencv/tilted14.yml")),
        ("calibration", "opencv.json", of("opencv/brown5.json")),
        ("calibration", "mpcdi.xml", of("mpcdi/shader_lamp.mpcdi.xml")),
    ]
}

/// Words of other processes, settings, and the stamps of an honest clock and of one that steps.
fn words() -> Vec<(&'static str, &'static str, Vec<u8>)> {
    let mut seeds = Vec::new();
    for (name, word) in [("black", "black\n"), ("arm", "arm\r\n"), ("long", "frozen-frozen-frozen\n")] {
        seeds.push(("control_words", name, word.into()));
    }
    for (name, line) in [
        ("set", "set exposure=1.5\n"),
        ("set-body", "set body.bunny=1,-2.5,0,0,0,1e-3\n"),
        ("set-none", "set gaze=\n"),
        ("set-wrong", "set a=x\n"),
        ("undo", "undo\n"),
    ] {
        seeds.push(("control_words", name, line.into()));
    }
    for (name, bytes) in [
        ("black", &b"/dpm/black\0\0,\0\0\0"[..]),
        ("released", b"/dpm/safe\0\0\0,f\0\0\0\0\0\0"),
        ("arm", b"/dpm/arm\0\0\0\0"),
        ("exposure", b"/dpm/exposure\0\0\0,f\0\0\x3f\xc0\0\0"),
        ("mixed", b"/dpm/gaze\0\0\0,idhTs\0\0\0\0\0\x01\x40\0\0\0\0\0\0\0\0\0\0\0\0\0\0\x02a\0\0\0"),
        ("token-text", b"/dpm/exposure\0\0\0,fs\0\x3f\xc0\0\0abc-012345-XYZ\0\0"),
        ("token-address", b"/dpm/token/abc-012345-XYZ/freeze\0\0\0\0,\0\0\0"),
        ("bundle", b"#bundle\0\0\0\0\0\0\0\0\x01\0\0\0\x0c/dpm/freeze\0\0\0\0\x0c/dpm/arm\0\0\0\0"),
    ] {
        seeds.push(("osc_datagram", name, bytes.into()));
    }
    let line = "00000000000000000007 0000000000000000 none  \n";
    seeds.push(("control_words", "state", format!("{line}{line}heard /etc/dpm/rig.toml\n").into()));
    let order = r#"{"version":1,"order":"freeze","at":"2026-01-01T00:00:00Z","by":"a key","process":7,"projector":"x"}"#;
    seeds.push(("control_words", "order", format!("{order}\n").into()));
    seeds.push((
        "settings",
        "flags",
        b"render.spp=4\nprojector.width = 640\n$RENDER__SPP=8\nrun.frames=1".to_vec(),
    ));
    seeds.push(("settings", "plan", b"loss=0.1@2..5,jump@3,stall=0.2@1,seed=7".to_vec()));
    // Rate, bits, skew, how; then the time there, inside, back, and before.
    let honest: Vec<u8> = (0..40u8).flat_map(|k| [k % 7, 1, k % 5, 20]).collect();
    seeds.push(("clock_map", "honest", [&[2, 4, 200, 6][..], &honest].concat()));
    seeds.push(("clock_map", "wrapping", [&[2, 0, 100, 8][..], &honest].concat()));
    let stamps =
        |k: u64| [k * 2_000_000, k * 2_000_000 + 5 + (k / 6) * 90_000_000].map(u64::to_le_bytes).concat();
    let stepping: Vec<u8> = (0..12).flat_map(|k| [&[1, 1, 1, 6][..], &stamps(k)].concat()).collect();
    seeds.push(("clock_map", "any", [&[2, 4, 0, 1][..], &stepping].concat()));
    seeds
}

/// A node that turns on a node that slides by splines.
fn animated() -> Glb {
    let mut file = tetrahedra().set("/nodes/0/children", json!([2])).set("/nodes/2", json!({"mesh": 0}));
    let (zero, ahead) = ([0.0; 3], [0.1, 0.0, 0.0]);
    let times = file.push_numbers("SCALAR", &[0.0, 1.0]);
    let slide = file.push_numbers("VEC3", &[zero, zero, ahead, ahead, ahead, zero].concat());
    let turn = file.push_numbers("VEC4", &[0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0]);
    file.set(
        "/animations",
        json!([{"name": "a", "channels": [{"sampler": 0, "target": {"node": 1, "path": "translation"}},
            {"sampler": 1, "target": {"node": 2, "path": "rotation"}}],
            "samplers": [{"input": times, "output": slide, "interpolation": "CUBICSPLINE"}, {"input": times, "output": turn}]}]),
    )
}

/// The same with a skin on both nodes, of one piece each or bending, and a morph target.
fn skinned(is_rigid: bool) -> Glb {
    let mut file = animated();
    let joints = file.push_bytes("VEC4", &[0, 1, 0, 0].repeat(4));
    let shares = if is_rigid { [1.0, 0.0, 0.0, 0.0] } else { [0.75, 0.25, 0.0, 0.0] };
    let shares = file.push_numbers("VEC4", &shares.repeat(4));
    let target = file.push_numbers("VEC3", &[0.01; 12]);
    let primitive = "/meshes/0/primitives/0";
    file.set(&format!("{primitive}/attributes/JOINTS_0"), json!(joints))
        .set(&format!("{primitive}/attributes/WEIGHTS_0"), json!(shares))
        .set(&format!("{primitive}/targets"), json!([{"POSITION": target}]))
        .set("/meshes/0/weights", json!([0.5]))
        .set("/nodes/1/skin", json!(0))
        .set("/skins", json!([{"joints": [2, 1]}]))
}

/// The same, bending, with weights and a size that change.
fn deforming() -> Glb {
    let mut file = skinned(false);
    let times = file.push_numbers("SCALAR", &[0.0, 0.5, 1.0]);
    let weights = file.push_numbers("SCALAR", &[0.0, 1.0, 0.25]);
    let sizes = file.push_numbers("VEC3", &[1.0, 1.0, 1.0, 2.0, 1.0, 0.5, 0.0, 0.0, 0.0]);
    file.set("/animations/0/channels/2", json!({"sampler": 2, "target": {"node": 1, "path": "weights"}}))
        .set("/animations/0/channels/3", json!({"sampler": 3, "target": {"node": 2, "path": "scale"}}))
        .set("/animations/0/samplers/2", json!({"input": times, "output": weights}))
        .set("/animations/0/samplers/3", json!({"input": times, "output": sizes, "interpolation": "STEP"}))
}

/// A scene with a texture and an environment of each format, as small as they get.
fn files() -> Vec<(&'static str, &'static str, Vec<u8>)> {
    let mut seeds = Vec::new();
    let texels = [[200, 100, 50, 255]; 4];
    for (name, file) in [("plain", tetrahedra()), ("texture", with_image(&png(2, 2, &texels)))] {
        seeds.push(("gltf", name, file.bytes()));
        let text = serde_json::to_vec(&file.json).unwrap();
        seeds.push(("gltf_parts", name, [&text[..], &[0], &file.bin].concat()));
    }
    for (name, file) in [
        ("animated", animated()),
        ("skinned", skinned(false)),
        ("skinned_rigid", skinned(true)),
        ("deforming", deforming()),
    ] {
        let text = serde_json::to_vec(&file.json).unwrap();
        seeds.push(("gltf_parts", name, [&text[..], &[0], &file.bin].concat()));
    }
    for name in ["alpha_etc1s", "alpha_uastc", "chance_bc5", "chance_etc2_a8"] {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/assets/ktx2");
        let image = std::fs::read(PathBuf::from(path).join(name).with_extension("ktx2")).unwrap();
        let file = with_image(&image);
        let text = serde_json::to_vec(&file.json).unwrap();
        seeds.push(("gltf_parts", name, [&text[..], &[0], &file.bin].concat()));
    }
    let lit = r#"{"asset":{"version":"2.0"},"extensionsUsed":["KHR_lights_punctual"],"extensions":{"KHR_lights_punctual":
        {"lights":[{"type":"spot","spot":{"outerConeAngle":0.4},"intensity":7}]}},"scenes":[{"nodes":[0]}],"nodes":[{"children":[1,2],
        "scale":[1,2,1]},{"extensions":{"KHR_lights_punctual":{"light":0}}},{"mesh":0,"rotation":[0,0,0,1]}],"meshes":[{"primitives":
        [{"attributes":{"POSITION":0},"mode":5,"material":0}]}],"materials":[{"emissiveFactor":[1,1,1],"extensions":{
        "KHR_materials_transmission":{"transmissionFactor":0.5},"KHR_materials_ior":{"ior":1.4}}}],"accessors":[{"bufferView":0,
        "componentType":5126,"type":"VEC3","count":4}],"bufferViews":[{"buffer":0,"byteLength":48}],"buffers":[{"byteLength":48}]}"#;
    seeds.push(("gltf_parts", "lit", [lit.as_bytes(), &[0], &tetrahedra().bin[..48]].concat()));
    seeds.extend(meshes().into_iter().map(|(name, bytes)| ("mesh", name, bytes)));
    let floats = |v: &[f32]| v.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<_>>();
    let pfm = [&b"PF\n2 1\n-1.0\n"[..], &floats(&[0.5, 1.0, 2.0, 0.0, 3.0, 4.0])].concat();
    seeds.push(("environment", "pfm", pfm));
    let rgbe = [&b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 1 +X 2\n"[..], &[128, 64, 32, 129, 1, 2, 3, 120]]
        .concat();
    seeds.push(("environment", "hdr", rgbe));
    let runs: Vec<u8> = std::iter::once([2, 2, 0, 8])
        .chain([[136, 7, 0, 0]; 4].map(|r| [r[0], r[1], 136, 9]))
        .flatten()
        .collect();
    seeds.push((
        "environment",
        "hdr_runs",
        [&b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 8\n"[..], &runs].concat(),
    ));
    seeds.push(("environment", "png", png(2, 2, &texels)));
    let mut jpeg = std::io::Cursor::new(Vec::new());
    ::image::RgbImage::from_pixel(8, 8, ::image::Rgb([9, 80, 200]))
        .write_to(&mut jpeg, ::image::ImageFormat::Jpeg)
        .unwrap();
    seeds.push(("environment", "jpeg", jpeg.into_inner()));
    // Where the tests are built without OpenEXR, its seed stays as it is, and the decoder refuses it.
    if ::image::ImageFormat::OpenExr.writing_enabled() {
        let mut exr = std::io::Cursor::new(Vec::new());
        let picture = ::image::Rgb32FImage::from_pixel(2, 1, ::image::Rgb([0.5, 1.0, 2.0]));
        ::image::DynamicImage::ImageRgb32F(picture)
            .write_to(&mut exr, ::image::ImageFormat::OpenExr)
            .unwrap();
        seeds.push(("environment", "exr", exr.into_inner()));
    }
    for (name, format) in [
        ("png", ::image::ImageFormat::Png),
        ("tga", ::image::ImageFormat::Tga),
        ("bmp", ::image::ImageFormat::Bmp),
        ("webp", ::image::ImageFormat::WebP),
    ] {
        let mut file = std::io::Cursor::new(Vec::new());
        let picture = ::image::RgbImage::from_fn(3, 2, |x, y| ::image::Rgb([40 * x as u8, 90 * y as u8, 7]));
        picture.write_to(&mut file, format).unwrap();
        seeds.push(("picture", name, file.into_inner()));
    }
    for (name, file) in [
        ("sections", "c01-two-devices-procamcalib.yml"),
        ("nested", "c02-two-devices.json"),
        ("xml", "c04-slstudio-names.xml"),
        ("kalibr", "c05-kalibr.yaml"),
        ("mpcdi", "c10-mpcdi-zip-3d.mpcdi"),
        ("numpy", "c11-numpy.npz"),
        ("gzip", "c14-opencv.yml.gz"),
    ] {
        let folder = PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/assets/cases"));
        seeds.push(("calibration", name, std::fs::read(folder.join(file)).unwrap()));
    }
    seeds
}

/// A triangle in every format of meshes, after the byte that chooses it.
fn meshes() -> Vec<(&'static str, Vec<u8>)> {
    let obj = "mtllib a.mtl\no a\nv 0 0 0 1 0 0\nv 1 0 0 0 1 0\nv 0 1 0\nvt 0 1\nvn 0 0 1\nusemtl m\ns 1\nf 1/1/1 2//1 -1 -2/-1\nl 1 2\n";
    let header = |form: &str| {
        format!("ply\nformat {form} 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nproperty uchar red\n\
                 property uchar green\nproperty uchar blue\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n")
    };
    let text = header("ascii") + "0 0 0 255 0 0\n1 0 0 0 255 0\n0 1 0 0 0 255\n3 0 1 2\n";
    let binary = |big: bool| {
        let float = |x: f32| if big { x.to_be_bytes() } else { x.to_le_bytes() };
        let index = |i: i32| if big { i.to_be_bytes() } else { i.to_le_bytes() };
        let mut bytes = header(if big { "binary_big_endian" } else { "binary_little_endian" }).into_bytes();
        for [x, y] in [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]] {
            bytes.extend([x, y, 0.0].map(float).concat());
            bytes.extend([255, 0, 0]);
        }
        bytes.push(3);
        bytes.extend([0, 1, 2].map(index).concat());
        bytes
    };
    let stl = "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\nendsolid a\n";
    let corners = [[0.0f32, 0.0], [1.0, 0.0], [0.0, 1.0]]
        .map(|[x, y]| [x, y, 0.0].map(f32::to_le_bytes).concat())
        .concat();
    let stl_binary = [&[b' '; 80][..], &1u32.to_le_bytes(), &[0; 12], &corners, &[0; 2]].concat();
    let all = [
        ("obj", 0, obj.as_bytes().to_vec()),
        ("ply_text", 1, text.into_bytes()),
        ("ply_little", 1, binary(false)),
        ("ply_big", 1, binary(true)),
        ("stl_text", 2, stl.as_bytes().to_vec()),
        ("stl_binary", 2, stl_binary),
    ];
    all.into_iter().map(|(name, first, bytes)| (name, [&[first][..], &bytes].concat())).collect()
}

#[test]
fn no_seed_and_little_near_one_breaks_a_decoder() {
    decoders_bear_seeds_and_neighbours(7);
}

/// Everything near a seed.
mod breadth {
    use super::*;

    #[test]
    fn no_seed_and_nothing_near_one_breaks_a_decoder() {
        decoders_bear_seeds_and_neighbours(1);
    }
}

/// Every seed, and every `step`th of its beginnings and of its damaged neighbours.
fn decoders_bear_seeds_and_neighbours(step: usize) {
    if std::env::var_os("DPM_UPDATE_SEEDS").is_some() {
        for (target, name, bytes) in made() {
            std::fs::create_dir_all(folder(target)).unwrap();
            std::fs::write(folder(target).join(name), bytes).unwrap();
        }
    }
    for (target, entry) in ALL {
        let files = std::fs::read_dir(folder(target)).unwrap_or_else(|e| panic!("seeds of {target}: {e}"));
        let mut seeds = 0;
        for file in files {
            let path = file.unwrap().path();
            let seed = std::fs::read(&path).unwrap();
            println!("{}", path.display());
            entry(&seed);
            for end in (0..seed.len()).step_by(step) {
                entry(&seed[..end]);
            }
            for at in (0..seed.len().min(400)).step_by(step) {
                for bit in [0, 3, 7] {
                    let mut bad = seed.clone();
                    bad[at] ^= 1 << bit;
                    entry(&bad);
                }
                let mut longer = seed.clone();
                longer.insert(at, seed[at]);
                entry(&longer);
            }
            seeds += 1;
        }
        assert!(seeds > 0, "{target} has no seed");
    }
}

/// The seeds still exercise the decoders: the files contain what the encoders make today.
#[test]
fn the_seeds_are_what_the_encoders_make() {
    for (target, name, bytes) in made() {
        let kept =
            std::fs::read(folder(target).join(name)).unwrap_or_else(|e| panic!("{target}/{name}: {e}"));
        assert!(kept == bytes, "{target}/{name} is stale: DPM_UPDATE_SEEDS=1");
    }
}
