//! Tests of the emulator with golden bytes, and of the driver against it.

use super::*;
use dpm_dlpc900::command::Command;
use dpm_dlpc900::driver::{Dlpc900, Dlpc900Error, HidPort, PortError};
use dpm_dlpc900::image::{encode, Compression};
use dpm_dlpc900::sequence::{BitPattern, LedSetup, PatternSequence, Repeat, SequenceBuilder};
use dpm_dlpc900::video::{Receiver, VideoPatterns};
use proptest::prelude::*;
use std::sync::{Arc, Mutex};
use std::time::Duration;

const T0: HostTime = HostTime(1_000_000_000);

fn small() -> Options {
    Options { dmd: Dmd::Dlp5500, ..Options::default() }
}

/// Sends one report that starts with `head` and returns the reply, if any.
fn send(m: &mut Dlpc900Model, head: &[u8]) -> Option<[u8; 64]> {
    let mut report = [0; 64];
    report[..head.len()].copy_from_slice(head);
    m.interrupt_out(T0, 0x01, &report);
    m.interrupt_in(0x81)
}

fn command(m: &mut Dlpc900Model, now: HostTime, opcode: Opcode, data: &[u8]) -> u8 {
    for r in Command::write(1, opcode, data, true).reports().unwrap() {
        m.interrupt_out(now, 0x01, &r);
    }
    let reply = m.interrupt_in(0x81).expect("an acknowledgement");
    assert_eq!(reply[1..4], [1, 0, 0]);
    assert_eq!(reply[0] & flag::NACK != 0, m.controller.error != 0);
    m.controller.error
}

#[test]
fn golden_read_write_and_refusal() {
    let mut m = Dlpc900Model::default();
    // Write the curtain colour without a reply, read it back (programmer's guide, tables 1-5 to 1-7).
    assert_eq!(send(&mut m, &[0x00, 0x12, 0x08, 0x00, 0x00, 0x11, 0xff, 0x01, 0xff, 0x01, 0xff, 0x01]), None);
    let reply = send(&mut m, &[0xc0, 0x11, 0x02, 0x00, 0x00, 0x11]).unwrap();
    assert_eq!(reply[..10], [0xc0, 0x11, 0x06, 0x00, 0xff, 0x01, 0xff, 0x01, 0xff, 0x01]);
    assert!(reply[10..].iter().all(|b| *b == 0));
    // A write that wants a reply gets an empty one; an unknown command a refusal with its sequence number.
    assert_eq!(
        send(&mut m, &[0x40, 0x33, 0x03, 0x00, 0x07, 0x1a, 0x08]).unwrap()[..5],
        [0x40, 0x33, 0, 0, 0]
    );
    assert_eq!(
        send(&mut m, &[0x40, 0x34, 0x03, 0x00, 0xef, 0xbe, 0x00]).unwrap()[..5],
        [0x60, 0x34, 0, 0, 0]
    );
    assert_eq!(send(&mut m, &[0xc0, 0x35, 0x02, 0x00, 0x00, 0x01]).unwrap()[..5], [0xc0, 0x35, 1, 0, 3]);
    let mut text = send(&mut m, &[0xc0, 0x36, 0x02, 0x00, 0x01, 0x01]).unwrap().to_vec();
    assert_eq!(text[..4], [0xc0, 0x36, 128, 0]);
    // 132 bytes are three reports.
    text.extend(m.interrupt_in(0x81).unwrap());
    text.extend(m.interrupt_in(0x81).unwrap());
    assert_eq!(m.interrupt_in(0x81), None);
    assert!(text[4..].starts_with(b"there is no command (0xBEEF) to write\0"));
    let version = send(&mut m, &[0xc0, 0, 2, 0, 0x05, 0x02]).unwrap();
    assert_eq!(version[..8], [0xc0, 0, 16, 0, 1, 0, 0, 6]);
    let hardware = send(&mut m, &[0xc0, 0, 2, 0, 0x06, 0x02]).unwrap();
    assert!(hardware[4..].starts_with(b"\x01DLPR900PROM-6500\0"));
}

#[test]
fn the_reply_slot_holds_one_reply_that_the_next_command_overwrites() {
    let mut m = Dlpc900Model::default();
    let mut report = [0; 64];
    for sequence in 0..5 {
        report[..6].copy_from_slice(&[0xc0, sequence, 2, 0, 0x0c, 0x1a]);
        m.interrupt_out(T0, 0x01, &report);
    }
    assert_eq!(m.interrupt_in(0x81).unwrap()[1], 4);
    assert_eq!(m.interrupt_in(0x81), None);
    assert_eq!(m.unread_replies(), 4);
    // A bus reset at the end of a session loses the unread reply, not the state.
    m.interrupt_out(T0, 0x01, &report);
    m.bus_reset(T0);
    assert_eq!(m.interrupt_in(0x81), None);
    assert_eq!(m.commands(), 6);
}

#[test]
fn the_guides_on_the_fly_example_runs_and_its_order_is_kept() {
    let mut m = Dlpc900Model::new(small());
    let raster = Dmd::Dlp5500.raster();
    let planes: Vec<Vec<u8>> = (0..3u8).map(|i| vec![0x11 << i; raster.plane_bytes()]).collect();
    let views: Vec<&[u8]> = planes.iter().map(|p| &p[..]).collect();
    let image = encode(&views, raster, 0..1024, PlaneOrder::default(), Some(Compression::Erle)).unwrap();
    let first = [0x00, 0x00, 0xc8, 0x00, 0x00, 0x11, 0, 0, 0, 0, 0, 0];
    let second = [0x01, 0x00, 0x90, 0x01, 0x00, 0x23, 0, 0, 0, 0, 0x00, 0x08];
    let size = (image.bytes.len() as u32).to_le_bytes();
    let init = [0, 0, size[0], size[1], size[2], size[3]];
    // No pattern commands in video mode, no image before the table, no start before either.
    assert_eq!(command(&mut m, T0, Opcode::LUT_DEFINITION, &first), 5);
    assert_eq!(command(&mut m, T0, Opcode::START_STOP, &[2]), 5);
    let early = HostTime(299_999_999);
    assert_eq!(command(&mut m, early, Opcode::DISPLAY_MODE, &[2]), 5, "the source has not locked yet");
    assert_eq!(command(&mut m, T0, Opcode::DISPLAY_MODE, &[3]), 0);
    assert_eq!(command(&mut m, T0, Opcode::START_STOP, &[2]), 15);
    assert_eq!(command(&mut m, T0, Opcode::BMP_INIT_PRIMARY, &init), 5);
    assert_eq!(command(&mut m, T0, Opcode::LUT_DEFINITION, &first), 0);
    assert_eq!(command(&mut m, T0, Opcode::LUT_CONFIG, &[2, 0, 0, 0, 0, 0]), 16, "entry 1 is missing");
    assert_eq!(command(&mut m, T0, Opcode::LUT_DEFINITION, &second), 0);
    assert_eq!(command(&mut m, T0, Opcode::LUT_CONFIG, &[2, 0, 0, 0, 0, 0]), 0);
    assert_eq!(command(&mut m, T0, Opcode::START_STOP, &[2]), 7, "no image yet");
    assert_eq!(command(&mut m, T0, Opcode::BMP_INIT_PRIMARY, &init), 0);
    for chunk in image.bytes.chunks(504) {
        let data = [&(chunk.len() as u16).to_le_bytes()[..], chunk].concat();
        assert_eq!(command(&mut m, T0, Opcode::BMP_DATA_PRIMARY, &data), 0);
    }
    assert_eq!(command(&mut m, T0, Opcode::START_STOP, &[2]), 0);
    assert!(m.projected_plane(0).unwrap() == planes[0]);
    assert!(m.projected_bit(1, 0).unwrap() == planes[1] && m.projected_bit(1, 1).unwrap() == planes[2]);
    assert_eq!((m.projected_plane(2), m.projected_bit(1, 2)), (None, None));
    // Grey of the 2-bit pattern: 0x22 and 0x44 give 0 and 1/3 and 2/3.
    assert_eq!(m.projected_grey(1).unwrap()[..4], [0, 170, 85, 0]);
    let pgm = m.projected_pgm(0).unwrap();
    assert!(pgm.starts_with(b"P5\n1024 768\n255\n") && pgm.len() == 16 + 1024 * 768);
    // 200 us red, 400 us green, repeatedly.
    let at = |m: &mut Dlpc900Model, us: i64| m.showing(T0.plus_ns(us * 1000)).map(|s| (s.0, s.1.leds));
    assert_eq!(
        [at(&mut m, 0), at(&mut m, 199), at(&mut m, 200), at(&mut m, 599), at(&mut m, 600)]
            .map(Option::unwrap),
        [(0, 1), (0, 1), (1, 2), (1, 2), (0, 1)]
    );
    assert_eq!(command(&mut m, T0, Opcode::LUT_DEFINITION, &first), 5, "stop first");
    assert_eq!(command(&mut m, T0, Opcode::DMD_PARK, &[1]), 5);
    assert_eq!(command(&mut m, T0, Opcode::START_STOP, &[0]), 0);
    assert_eq!(m.dark_because(), Some("sequencer stopped"));
    // Flips and inversion change the projection, not the stored data.
    assert_eq!(command(&mut m, T0, Opcode::FLIP_LONG, &[1]), 0);
    assert_eq!(m.projected_plane(0).unwrap()[0], 0x88);
    // Park: the table must be sent again; the image is still there.
    assert_eq!(command(&mut m, T0, Opcode::DMD_PARK, &[1]), 0);
    assert_eq!(m.dark_because(), Some("mirrors parked"));
    assert_eq!(command(&mut m, T0, Opcode::DMD_PARK, &[0]), 0);
    assert_eq!(command(&mut m, T0, Opcode::START_STOP, &[2]), 15);
}

#[test]
fn bad_streams_numbers_and_states_get_the_controllers_codes() {
    let mut m = Dlpc900Model::new(small());
    assert_eq!(command(&mut m, T0, Opcode::DISPLAY_MODE, &[4]), 6);
    assert_eq!(command(&mut m, T0, Opcode::TRIG_OUT1, &[0, 0x21, 0x4e, 0, 0]), 13, "20001 us");
    assert_eq!(command(&mut m, T0, Opcode::TRIG_OUT1, &[0, 0x20, 0x4e, 0xec, 0xff]), 0, "20000 and -20 us");
    assert_eq!(command(&mut m, T0, Opcode::RED_DELAY, &[0; 4]), 6, "5 bytes from firmware 6 on");
    assert_eq!(command(&mut m, T0, Opcode::DISPLAY_MODE, &[3]), 0);
    let mut e = LutEntry::one_bit(0, 0, 0, 10_000);
    assert_eq!(command(&mut m, T0, Opcode::LUT_DEFINITION, &e.encode()), 0);
    e.bit = 24;
    assert_eq!(command(&mut m, T0, Opcode::LUT_DEFINITION, &e.encode()), 10);
    e = LutEntry::one_bit(0, 18, 0, 10_000);
    assert_eq!(command(&mut m, T0, Opcode::LUT_DEFINITION, &e.encode()), 17);
    e = LutEntry::one_bit(960, 0, 0, 10_000);
    assert_eq!(command(&mut m, T0, Opcode::LUT_DEFINITION, &e.encode()), 15);
    assert_eq!(command(&mut m, T0, Opcode::LUT_CONFIG, &[0; 6]), 15);
    assert_eq!(command(&mut m, T0, Opcode::LUT_CONFIG, &[1, 0, 0, 0, 0, 0]), 0);
    assert_eq!(
        command(&mut m, T0, Opcode::BMP_INIT_SECONDARY, &[0, 0, 0, 1, 0, 0]),
        4,
        "one controller only"
    );
    assert_eq!(command(&mut m, T0, Opcode::BMP_INIT_PRIMARY, &[0, 0, 255, 255, 255, 255]), 8);
    assert_eq!(command(&mut m, T0, Opcode::BMP_DATA_PRIMARY, &[1, 0, 0]), 5, "no load begun");
    assert_eq!(command(&mut m, T0, Opcode::BMP_INIT_PRIMARY, &[0, 0, 100, 0, 0, 0]), 0);
    assert_eq!(command(&mut m, T0, Opcode::BMP_DATA_PRIMARY, &[9, 0, 0]), 6, "count beyond the data");
    let mut data = vec![48, 0];
    data.resize(50, 0x55);
    assert_eq!(command(&mut m, T0, Opcode::BMP_DATA_PRIMARY, &data), 9, "no header");
    assert!(m.controller.error_text.contains("Spld"));
    // Standby: only leaving it is allowed.
    assert_eq!(command(&mut m, T0, Opcode::POWER_MODE, &[1]), 0);
    assert_eq!(command(&mut m, T0, Opcode::DISPLAY_MODE, &[3]), 5);
    assert_eq!(m.dark_because(), Some("standby"));
    assert_eq!(command(&mut m, T0, Opcode::POWER_MODE, &[0]), 0);
    // Reset: the state after power-on.
    assert_eq!(command(&mut m, T0, Opcode::POWER_MODE, &[2]), 0);
    assert_eq!((m.mode(), m.table().len()), (DisplayMode::Video, 0));
}

#[test]
fn hid_class_requests_work_like_the_endpoints() {
    let mut m = Dlpc900Model::default();
    let request =
        |request_type, request, value, length| Setup { request_type, request, value, index: 0, length };
    let mut report = [0u8; 64];
    report[..6].copy_from_slice(&[0xc0, 9, 2, 0, 0x0c, 0x1a]);
    assert_eq!(m.control(T0, &request(0x21, 9, 0x0200, 64), &mut report), Progress::complete(64));
    let mut answer = [0u8; 64];
    assert_eq!(m.control(T0, &request(0xa1, 1, 0x0100, 64), &mut answer), Progress::complete(64));
    assert_eq!(answer[..4], [0xc0, 9, 1, 0]);
    assert_eq!(m.control(T0, &request(0x21, 0x0a, 0, 0), &mut []), Progress::complete(0));
    assert_eq!(m.control(T0, &request(0xc0, 1, 0, 1), &mut [0]).then, Then::Stall);
    assert_eq!(m.other_descriptor(0x22, 0, 0).map(<[u8]>::len), Some(25));
    assert_eq!(m.other_descriptor(0x22, 0, 1), None);
}

#[test]
fn reports_can_be_paced_as_the_cable_does() {
    let mut m = Dlpc900Model::new(Options { report_period_ns: 1_000_000, ..Options::default() });
    assert_eq!(m.transfer_out(T0, 1, &[0; 128]), Progress::nak(64));
    assert_eq!(m.transfer_out(T0.plus_ns(999_999), 1, &[0; 64]), Progress::nak(0));
    assert_eq!(m.transfer_out(T0.plus_ns(1_000_000), 1, &[0; 64]), Progress::complete(64));
}

fn driver(options: Options) -> (Arc<Mutex<Dlpc900Model>>, Dlpc900<VirtualHid>) {
    let model = Arc::new(Mutex::new(Dlpc900Model::new(options)));
    let driver = Dlpc900::new(VirtualHid::new(model.clone())).unwrap();
    (model, driver)
}

fn planes(dmd: Dmd, count: u8) -> Vec<Vec<u8>> {
    let raster = dmd.raster();
    let byte = |p: u8, i: usize| (i.wrapping_mul(2_654_435_761 + usize::from(p) * 40_503) >> 13) as u8;
    let padding = 0xffu8 << (raster.row_bytes() * 8 - raster.width() as usize);
    let last = |i: usize| (i + 1).is_multiple_of(raster.row_bytes());
    let cell = |p, i| if last(i) { byte(p, i) & padding } else { byte(p, i) };
    (0..count).map(|p| (0..raster.plane_bytes()).map(|i| cell(p, i)).collect()).collect()
}

fn sequence(
    dmd: Dmd,
    planes: &[Vec<u8>],
    repeat: Repeat,
    compression: Option<Compression>,
) -> PatternSequence {
    let mut b = SequenceBuilder::new(dmd);
    planes.iter().for_each(|p| b.push(&BitPattern::white(vec![p], 1000)));
    b.finish(repeat, PlaneOrder::default(), compression).unwrap()
}

/// Thirty noisy planes through every byte of the protocol, on one and two controllers, strictly checked, are projected
/// unchanged.
#[test]
fn the_driver_uploads_what_the_emulator_projects() {
    for (dmd, compression) in [
        (Dmd::Dlp5500, Some(Compression::Rle)),
        (Dmd::Dlp5500, Some(Compression::Erle)),
        (Dmd::Dlp5500, None),
        (Dmd::Dlp670s, Some(Compression::Erle)),
    ] {
        let locking = Version { major: 4, minor: 1, patch: 0 };
        let (model, mut d) = driver(Options { dmd, strict: true, firmware: locking, ..Options::default() });
        assert_eq!((d.dmd(), d.firmware()), (dmd, locking));
        let planes = planes(dmd, 30);
        let s = sequence(dmd, &planes, Repeat::Passes(2), compression);
        let mut last = 0;
        d.upload(&s, LedSetup { current: Some([1, 2, 3]), polarity: None }, &mut |p| {
            assert!(p.sent > last && p.total == s.image_bytes());
            last = p.sent;
        })
        .unwrap();
        assert_eq!(last, s.image_bytes());
        d.start().unwrap();
        let status = d.status().unwrap();
        assert!(status.is_running() && !status.is_parked() && status.complaint().is_none());
        assert_eq!(status.mode, Some(DisplayMode::OnTheFly));
        let port = d.into_port();
        let mut m = model.lock().unwrap();
        for (i, p) in planes.iter().enumerate() {
            assert!(m.projected_plane(i).unwrap() == *p, "{dmd:?} {compression:?} plane {i}");
        }
        assert_eq!(m.warnings(), [] as [String; 0]);
        assert!(m.showing(port.now()).is_some());
        // Two passes of thirty times 1 ms; then it stops by itself.
        let Sequencer::Running(since, 0) = m.sequencer(port.now()) else { panic!("running") };
        assert_eq!(m.showing(since.plus_ns(59_999_999)).unwrap().0, 29);
        assert_eq!(m.showing(since.plus_ns(60_000_000)), None);
        assert_eq!(m.sequencer(since.plus_ns(60_000_000)), Sequencer::Stopped);
    }
}

#[test]
fn every_bits_place_in_the_pixel_is_an_option_on_both_sides() {
    let dmd = Dmd::Dlp5500;
    let planes = planes(dmd, 24);
    for (ours, theirs, same) in [
        (PlaneOrder::Descending, PlaneOrder::Descending, true),
        (PlaneOrder::BlueGreenRed, PlaneOrder::BlueGreenRed, true),
        (PlaneOrder::BlueGreenRed, PlaneOrder::Descending, false),
    ] {
        let (model, mut d) = driver(Options { plane_order: theirs, ..small() });
        let mut b = SequenceBuilder::new(dmd);
        planes.iter().for_each(|p| b.push(&BitPattern::white(vec![p], 1000)));
        let s = b.finish(Repeat::Forever, ours, Some(Compression::Erle)).unwrap();
        d.upload(&s, LedSetup::default(), &mut |_| ()).unwrap();
        let m = model.lock().unwrap();
        let agree: Vec<_> = (0..24).filter(|i| m.projected_plane(*i).unwrap() == planes[*i]).collect();
        // If they differ, planes 16 to 23 still agree, and the other two groups are swapped.
        assert_eq!(agree, if same { (0..24).collect::<Vec<_>>() } else { (16..24).collect() });
        if !same {
            assert!(m.projected_plane(0).unwrap() == planes[8]);
        }
    }
}

#[test]
fn video_patterns_lock_or_say_that_they_do_not() {
    let entries: Vec<_> = (0..24).map(|i| LutEntry::one_bit(i, 0, i as u8, 300)).collect();
    let leds = LedSetup::default();
    let video = VideoPatterns {
        dmd: Dmd::Dlp6500,
        receiver: Receiver::Hdmi,
        ports: None,
        frame_hz: 60,
        entries,
        leds,
    };
    let (model, mut d) = driver(Options { strict: true, ..Options::default() });
    d.start_video_patterns(&video).unwrap();
    assert_eq!(model.lock().unwrap().mode(), DisplayMode::VideoPattern);
    let now = d.into_port().now();
    assert!(now >= HostTime(300_000_000), "it waited for the lock: {now:?}");
    assert!(model.lock().unwrap().showing(now).is_some());
    let (_, mut d) = driver(Options { source_present: false, ..Options::default() });
    let err = d.start_video_patterns(&video).unwrap_err();
    assert!(matches!(err, Dlpc900Error::NotLocked(_)), "{err}");
    // Patterns longer than the frame: the sequencer aborts, and the driver reports it.
    let (_, mut d) = driver(Options { video_frame_us: 7000, ..Options::default() });
    let err = d.start_video_patterns(&video).unwrap_err();
    assert!(err.to_string().contains("sequencer abort"), "{err}");
}

#[test]
fn rest_states_are_reached_dark_and_left_in_order() {
    let (model, mut d) = driver(Options { strict: true, ..small() });
    let planes = planes(Dmd::Dlp5500, 2);
    d.upload(&sequence(Dmd::Dlp5500, &planes, Repeat::Forever, None), LedSetup::default(), &mut |_| ())
        .unwrap();
    d.start().unwrap();
    d.idle().unwrap();
    let dark = |m: &Arc<Mutex<Dlpc900Model>>| m.lock().unwrap().dark_because();
    assert_eq!(dark(&model), Some("mirrors exercised"));
    assert_eq!(model.lock().unwrap().controller.setting_byte(Opcode::LED_ENABLE), 0);
    d.leave_idle().unwrap();
    d.start().unwrap();
    assert_eq!(dark(&model), None);
    d.park().unwrap();
    assert!(d.status().unwrap().is_parked());
    d.unpark().unwrap();
    let err = d.start().unwrap_err();
    assert!(matches!(err, Dlpc900Error::Refused { code: 15, .. }), "the table is gone: {err}");
    d.standby().unwrap();
    assert_eq!(dark(&model), Some("standby"));
    assert!(matches!(d.idle().unwrap_err(), Dlpc900Error::Refused { code: 5, .. }));
    d.wake().unwrap();
    assert_eq!(model.lock().unwrap().warnings().iter().filter(|w| w.contains("3 s")).count(), 0);
    // In video mode, idle first switches to a pattern mode.
    let (model, mut d) = driver(Options { strict: true, ..small() });
    d.idle().unwrap();
    assert_eq!(model.lock().unwrap().mode(), DisplayMode::OnTheFly);
}

#[test]
fn errors_name_the_command_the_rule_and_the_remedy() {
    let (model, mut d) = driver(small());
    let inject = |f| model.lock().unwrap().inject(f);
    inject(Dlpc900Fault::Refuse(Opcode::LUT_DEFINITION, 14));
    let planes = planes(Dmd::Dlp5500, 3);
    let s = sequence(Dmd::Dlp5500, &planes, Repeat::Forever, None);
    let err = d.upload(&s, LedSetup::default(), &mut |_| ()).unwrap_err().to_string();
    assert_eq!(
        err,
        "LUT entry 0: pattern display LUT definition (0x1A34): the controller refuses (error 14, \"pattern exposure time is out of \
         range\"): a longer exposure or fewer bits; the least exposure grows with the depth"
    );
    inject(Dlpc900Fault::Refuse(Opcode::BMP_DATA_PRIMARY, 9));
    let err = d.upload(&s, LedSetup::default(), &mut |_| ()).unwrap_err();
    assert!(matches!(&err, Dlpc900Error::Refused { doing, .. } if doing.starts_with("image 0: ")), "{err}");
    inject(Dlpc900Fault::StrayReply);
    assert!(d.status().is_ok());
    assert_eq!(d.counters().stale, 1);
    inject(Dlpc900Fault::LoseReply);
    let err = d.status().unwrap_err();
    assert!(matches!(err, Dlpc900Error::Port { source: PortError::Timeout, .. }), "{err}");
    assert!(d.status().is_ok(), "usable after a lost reply");
    inject(Dlpc900Fault::Hardware(0x04));
    let complaint = d.status().unwrap().complaint();
    assert_eq!(complaint.as_deref(), Some("a DMD reset controller error"));
    let other =
        sequence(Dmd::Dlp6500, &[vec![0; Dmd::Dlp6500.raster().plane_bytes()]], Repeat::Forever, None);
    let err = d.upload(&other, LedSetup::default(), &mut |_| ()).unwrap_err().to_string();
    assert_eq!(
        err,
        "the sequence was made for a DLP6500, the projector has a DLP5500: make it again for that DMD"
    );
}

/// Firmware with the block lock shows nothing until parked and unparked; the driver's upload does that by itself.
#[test]
fn locked_blocks_stay_dark_for_programs_that_do_not_know_the_erratum() {
    let firmware = Version { major: 5, minor: 0, patch: 0 };
    let mut m = Dlpc900Model::new(Options { firmware, ..small() });
    assert_eq!(command(&mut m, T0, Opcode::DISPLAY_MODE, &[3]), 0);
    assert_eq!(m.dark_because(), Some("mirror blocks locked (errata): park and unpark"));
    assert_eq!(command(&mut m, T0, Opcode::DMD_PARK, &[0]), 0);
    assert!(m.dark_because().unwrap().contains("locked"), "unpark alone does not help");
    assert_eq!(command(&mut m, T0, Opcode::DMD_PARK, &[1]), 0);
    assert_eq!(command(&mut m, T0, Opcode::DMD_PARK, &[0]), 0);
    assert_eq!(m.dark_because(), Some("sequencer stopped"));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]

    /// Any input: no panic, at most one reply waiting, memory within the images that the table can hold.
    #[test]
    fn any_reports_are_survived(
        commands in prop::collection::vec((any::<u8>(), prop::sample::select(OPCODES.to_vec()), prop::collection::vec(any::<u8>(), 0..520)), 0..60),
        raw in prop::collection::vec(prop::collection::vec(any::<u8>(), 0..200), 0..20), time in any::<i64>()
    ) {
        let mut m = Dlpc900Model::new(small());
        for (flags, opcode, data) in &commands {
            let c = Command { flags: *flags & 0xf8, sequence: 3, opcode: Opcode(*opcode), data: &data[..data.len().min(506)] };
            for r in c.reports().unwrap() { m.interrupt_out(T0, 0x01, &r); }
            prop_assert!(m.reply.len() <= 3);
        }
        for r in &raw { m.interrupt_out(HostTime(time), 0x01, r); }
        let _ = (m.showing(HostTime(time)), m.summary(HostTime(time)), m.projected_plane(0));
        prop_assert!(m.warnings().len() <= 256 && m.executed().len() <= 4096);
    }
}

/// Every opcode with a state, and one that does not exist.
const OPCODES: [u16; 22] = [
    0x0100, 0x0101, 0x0200, 0x0201, 0x0205, 0x0206, 0x0609, 0x1100, 0x1a00, 0x1a07, 0x1a0c, 0x1a1b, 0x1a1d,
    0x1a24, 0x1a2a, 0x1a2b, 0x1a2c, 0x1a30, 0x1a31, 0x1a32, 0x1a34, 0xbeef,
];

/// Sends a command as its reports and returns the first report of the reply.
fn talk(m: &mut Dlpc900Model, flags: u8, sequence: u8, opcode: u16, data: &[u8]) -> Option<[u8; 64]> {
    for r in (Command { flags, sequence, opcode: Opcode(opcode), data }).reports().unwrap() {
        m.interrupt_out(T0, 0x01, &r);
    }
    m.interrupt_in(0x81)
}

/// The dialogue of the pyusb programs: every write wants a reply and is followed by a query for the error code, also
/// for image data; sequence numbers are constants; an image that is a multiple of 504 bytes ends with an empty data
/// command; the header's byte count includes the header.
#[test]
fn programs_that_ask_after_every_command_are_served() {
    let mut m = Dlpc900Model::new(small());
    let mut ask = |opcode: u16, data: &[u8]| {
        let sequence = if opcode == 0x1a2b { 0x11 } else { 0x00 };
        let reply = talk(&mut m, 0x40, sequence, opcode, data).expect("a reply to every write");
        assert_eq!(reply[..4], [0x40, sequence, 0, 0], "{opcode:#06x}");
        let error = talk(&mut m, 0xc0, 0x22, 0x0100, &[]).expect("an error code");
        assert_eq!(error[..8], [0xc0, 0x22, 1, 0, 0, 0, 0, 0], "{opcode:#06x}");
    };
    ask(0x1a24, &[0]);
    ask(0x1a1b, &[3]);
    for i in 0..3u8 {
        // LEDs 7, 1 bit, clear; TRIG_OUT2 disabled.
        ask(0x1a34, &[i, 0, 0x40, 0x42, 0x0f, 0x71, 0, 0, 0, 1, 0, i << 3]);
    }
    ask(0x1a31, &[3, 0, 0, 0, 0, 0]);
    let planes = planes(Dmd::Dlp5500, 3);
    let views: Vec<&[u8]> = planes.iter().map(|p| &p[..]).collect();
    let mut bytes =
        encode(&views, Dmd::Dlp5500.raster(), 0..1024, PlaneOrder::Descending, Some(Compression::Erle))
            .unwrap()
            .bytes;
    bytes.resize(bytes.len().next_multiple_of(504), 0);
    let size = (bytes.len() as u32).to_le_bytes();
    bytes[8..12].copy_from_slice(&size);
    ask(0x1a2a, &[0, 0, size[0], size[1], size[2], size[3]]);
    for chunk in bytes.chunks(504) {
        ask(0x1a2b, &[&(chunk.len() as u16).to_le_bytes()[..], chunk].concat());
    }
    ask(0x1a2b, &[0, 0]);
    ask(0x1a24, &[2]);
    for (i, p) in planes.iter().enumerate() {
        assert!(m.projected_plane(i).unwrap() == *p);
    }
    assert_eq!(m.warnings().len(), 1, "only that image data should not be acknowledged: {:?}", m.warnings());
    assert_eq!(m.unread_replies(), 0);
}

/// The dialogue of the HID-library programs: image data without reply, patterns that are not cleared, the error code
/// queried by a write, stop sent twice, a second table configuration after the images, replies that nobody reads, and a
/// header with the pixel format byte set.
#[test]
fn programs_that_never_read_and_configure_twice_are_served() {
    let mut m = Dlpc900Model::new(small());
    let ok = |r: Option<[u8; 64]>| assert_eq!(r.expect("a reply")[0] & flag::NACK, 0);
    assert_eq!(talk(&mut m, 0x00, 0x05, 0x1a24, &[0]), None);
    ok(talk(&mut m, 0x40, 0, 0x1a1b, &[3]));
    assert_eq!(talk(&mut m, 0x00, 0x05, 0x1a24, &[0]), None);
    ok(talk(&mut m, 0x40, 0, 0x1a34, &[0, 0, 0x69, 0, 0, 0x10, 0, 0, 0, 0, 0, 0]));
    ok(talk(&mut m, 0x40, 0, 0x1a31, &[1, 0, 0, 0, 0, 0]));
    let planes = planes(Dmd::Dlp5500, 1);
    let mut bytes =
        encode(&[&planes[0]], Dmd::Dlp5500.raster(), 0..1024, PlaneOrder::Descending, Some(Compression::Rle))
            .unwrap()
            .bytes;
    (bytes[24], bytes[29]) = (1, 1);
    let size = (bytes.len() as u32).to_le_bytes();
    ok(talk(&mut m, 0x40, 0, 0x1a2a, &[0, 0, size[0], size[1], size[2], size[3]]));
    for chunk in bytes.chunks(504) {
        let data = [&(chunk.len() as u16).to_le_bytes()[..], chunk].concat();
        assert_eq!(talk(&mut m, 0x00, 0, 0x1a2b, &data), None);
    }
    ok(talk(&mut m, 0x40, 0, 0x1a31, &[1, 0, 0, 0, 0, 0]));
    // Three writes whose replies stay unread, then a query: only its own answer arrives.
    for _ in 0..3 {
        let wanted = Command { flags: 0x40, sequence: 9, opcode: Opcode::LED_ENABLE, data: &[8] };
        wanted.reports().unwrap().for_each(|r| m.interrupt_out(T0, 0x01, &r));
    }
    assert_eq!(talk(&mut m, 0x40, 7, 0x0100, &[]).unwrap()[..5], [0x40, 7, 1, 0, 0]);
    assert_eq!(talk(&mut m, 0x00, 0x08, 0x1a24, &[2]), None);
    assert!(m.projected_plane(0).unwrap() == planes[0]);
    assert!(m.showing(T0.plus_ns(1)).is_some());
    assert_eq!(m.warnings(), [] as [String; 0]);
}

/// A cable on which the controller answers so many reports and then nothing.
struct SilentCable {
    hid: VirtualHid,
    answers: u32,
}

impl HidPort for SilentCable {
    fn write_report(&mut self, report: &[u8; REPORT_BYTES], timeout: Duration) -> Result<(), PortError> {
        HidPort::write_report(&mut self.hid, report, timeout)
    }
    fn read_report(&mut self, report: &mut [u8; REPORT_BYTES], timeout: Duration) -> Result<(), PortError> {
        if self.answers == 0 {
            self.hid.pause(timeout);
            return Err(PortError::Timeout);
        }
        self.answers -= 1;
        self.hid.read_report(report, timeout)
    }
    fn pause(&mut self, time: Duration) {
        self.hid.pause(time);
    }
    fn now(&self) -> Duration {
        HidPort::now(&self.hid)
    }
}

/// A question that nobody answers takes a second of the five that waking may take.
#[test]
fn a_controller_that_falls_silent_as_it_wakes_is_given_up_in_time() {
    let hid = VirtualHid::new(Arc::new(Mutex::new(Dlpc900Model::default())));
    // The firmware, the DMD, and that the order to wake has arrived.
    let mut driver = Dlpc900::new(SilentCable { hid, answers: 3 }).unwrap();
    assert!(driver.wake().is_err());
    let took = HidPort::now(&driver.into_port());
    assert!(took > Duration::from_secs(1) && took < Duration::from_secs(15), "{took:?}");
}
