//! A projector that follows tracks: when it takes them, which planes they move, and what can go wrong with them.

use super::*;
use crate::link::{move_plane, Area, Region, Tracks, MAX_TRACK_US};

const AREA: Area = Area { left: 2, top: 0, width: 12, height: 3 };

fn setup() -> FirmwareConfig {
    FirmwareConfig { greatest_shift: Some(3), moves_kept: 64, ..FirmwareConfig::new(raster()) }
}

/// A streaming host that wants tracks.
fn following(setup: FirmwareConfig) -> Rig<Direct<ProjectorFirmware>> {
    let mut rig = clean(settings(), setup);
    rig.link.want_tracks();
    rig.stream();
    rig
}

/// Tracks of `frame` from `begin` on that move by `mirrors` to the right.
fn tracks(frame: u64, begin: HostTime, mirrors: i16) -> Tracks {
    let mut tracks = Tracks::new(frame as u32, 0, DeviceTicks(begin.0 as u64), MAX_TRACK_US);
    assert!(tracks.push(Region { area: AREA, clamp: 8, offset: [256 * mirrors, 0], ..Region::default() }));
    tracks
}

impl Rig<Direct<ProjectorFirmware>> {
    fn follow(&mut self, at: HostTime, tracks: &Tracks) {
        self.link.send_tracks(at, tracks, &mut self.cable).expect("room");
    }

    /// The shift of mirror (5, 1) in each plane of the slots that are over, with their frames.
    fn shifts(&mut self) -> Vec<(u32, Vec<i8>)> {
        let device = self.cable.device_mut();
        std::iter::from_fn(|| device.next_moves())
            .map(|slot| (slot.frame, slot.planes().iter().map(|moves| moves.of_mirror(5, 1)[0]).collect()))
            .collect()
    }

    fn counts(&mut self) -> crate::link::TrackCounts {
        self.cable.device().status().tracks.expect("it follows")
    }
}

/// Tracks move the planes that begin after their arrival, of their own frame alone; the newest win. In a repeated slot they
/// still hold. The counters say all of it.
#[test]
fn tracks_move_the_planes_that_begin_after_them() {
    let mut rig = following(setup());
    rig.step(1);
    rig.step(2);
    rig.step(3); // Frame 1 is lit from here on.
    let slot = rig.now;
    let plane_ns = rig.link.settings().rate.slot_len_ns(0) / 24;
    rig.follow(slot.plus_ns(5 * plane_ns + 1000), &tracks(1, slot, 1));
    rig.follow(slot.plus_ns(9 * plane_ns + 1000), &tracks(1, slot, -2));
    rig.follow(slot.plus_ns(12 * plane_ns + 1000), &tracks(2, slot, 1));
    rig.follow(slot.plus_ns(20 * plane_ns + 1000), &tracks(1, slot, 9));
    rig.step(4);
    rig.idle(1);
    let shifts = rig.shifts();
    let own = [vec![0; 6], vec![1; 4], vec![-2; 11], vec![3; 3]].concat();
    assert_eq!(shifts, [(1, own), (2, vec![1; 24])]);
    let counts = rig.counts();
    assert_eq!((counts.taken, counts.refused, counts.planes_stale), (4, 0, 0));
    assert_eq!((counts.planes_moved, counts.planes_clamped), (18 + 24, 3));
    // The tracks of frame 2 were made a slot before its own; its last plane has its middle half a plane before the end.
    let expected = 2 * rig.link.settings().rate.slot_len_ns(0) - plane_ns / 2;
    assert!((i64::from(counts.greatest_age) - expected).abs() < 1000, "{} {expected}", counts.greatest_age);
}

/// A frame that stands for a second slot is moved on by the motion that its planes were drawn for.
#[test]
fn a_repeated_frame_is_moved_on() {
    let mut rig = following(setup());
    rig.step(1);
    rig.step(2);
    rig.idle(1);
    let begin = rig.now;
    let mut of = tracks(2, begin, 0);
    of = {
        let drawn = Region { drawn: [256, 0], ..of.regions()[0] };
        let mut with = Tracks::new(of.frame, 0, of.begin, of.lasts_us);
        with.push(drawn);
        with
    };
    rig.follow(begin, &of);
    rig.idle(4);
    // Slots of 1.056 ms, so 270 and 541 of 256 parts of a mirror.
    let first: Vec<(u32, i8)> = rig.shifts().into_iter().map(|(frame, all)| (frame, all[0])).collect();
    assert_eq!(first, [(1, 0), (2, 0), (2, 1), (2, 2)]);
}

/// Tracks that are stale, of another time, of another frame, of a session that is over, older than others, or of mirrors
/// that do not exist change nothing.
#[test]
fn tracks_that_do_not_hold_change_nothing() {
    let mut rig = following(setup());
    rig.step(1);
    rig.step(2);
    let now = rig.now;
    let late = Tracks::new(1, 0, DeviceTicks(now.0 as u64), 1);
    rig.follow(now, &tracks(77, now, 1));
    rig.follow(now, &late);
    rig.follow(now, &tracks(2, HostTime(i64::MAX), 1));
    let mut wide = Tracks::new(1, 0, DeviceTicks(now.0 as u64), MAX_TRACK_US);
    wide.push(Region { area: Area { width: 19, ..AREA }, clamp: 1, offset: [256, 0], ..Region::default() });
    rig.follow(now, &wide);
    let before = rig.cable.device().status();
    // Forged: a number from before, and another session.
    for (session, number) in [(rig.cable.device().core.session, 1), (12345, 1000)] {
        let mut payload = [0; MAX_CONTROL_BYTES];
        let message = crate::link::HostMessage::Tracks(tracks(1, now, 1).numbered(number));
        let (kind, n) = message.write(&mut payload);
        let packet = Packet::new(Header::control(kind, session, 0), &payload[..n]);
        rig.cable.send(now, Lane::Control, &[packet]).unwrap();
    }
    let after = rig.cable.device().status();
    assert_eq!(after.packets_ignored - before.packets_ignored, 2);
    rig.step(3);
    rig.step(4);
    rig.idle(1);
    assert!(rig.shifts().iter().all(|(_, shifts)| *shifts == [0; 24]));
    let counts = rig.counts();
    assert_eq!((counts.taken, counts.refused), (3, 2));
    assert_eq!((counts.planes_moved, counts.planes_stale), (0, 48));
    laws(&rig.cable.device().status(), rig.cable.device().in_flight());
}

/// When light ends, its tracks end: what was kept before STOP moves nothing after it.
#[test]
fn tracks_end_with_the_light() {
    let mut rig = following(setup());
    rig.step(1);
    rig.step(2);
    rig.follow(rig.now, &tracks(3, rig.now, 1));
    rig.link.command(rig.now, Verb::Stop, &mut rig.cable).unwrap();
    rig.until(LinkState::Ready);
    rig.link.arm(0);
    rig.until(LinkState::Streaming);
    rig.slot = rig.link.settings().rate.slot_at_ns(rig.now.0) + 1;
    let _ = rig.shifts();
    rig.step(3);
    rig.step(4);
    rig.idle(2);
    assert_eq!(rig.shifts()[0], (3, vec![0; 24]));
    assert_eq!(rig.counts().planes_stale, 0, "nothing is kept that could be stale");
}

/// Without the offer, or without the wish, nothing is sent, STATUS is short, and tracks that come all the same are counted
/// as ignored.
#[test]
fn ends_that_do_not_know_tracks_behave_as_before() {
    for (wanted, offered) in [(false, true), (true, false), (false, false)] {
        let mut rig = clean(settings(), FirmwareConfig { greatest_shift: offered.then_some(3), ..setup() });
        if wanted {
            rig.link.want_tracks();
        }
        rig.stream();
        rig.step(1);
        rig.step(2);
        let before = rig.cable.device().status();
        rig.follow(rig.now, &tracks(1, rig.now, 1));
        assert_eq!((rig.link.counters().tracks_sent, rig.link.greatest_shift()), (0, None));
        assert_eq!(rig.cable.device().status(), before);
        assert!(before.tracks.is_none() && rig.link.status().is_some_and(|s| s.tracks.is_none()));
        let mut payload = [0; MAX_CONTROL_BYTES];
        let message = crate::link::HostMessage::Tracks(tracks(1, rig.now, 1).numbered(1));
        let (kind, n) = message.write(&mut payload);
        let session = rig.cable.device().core.session;
        let packet = Packet::new(Header::control(kind, session, 0), &payload[..n]);
        rig.cable.send(rig.now, Lane::Control, &[packet]).unwrap();
        assert_eq!(rig.cable.device().status().packets_ignored, before.packets_ignored + 1);
        rig.step(3);
        rig.idle(1);
        assert!(rig.shifts().is_empty());
    }
}

/// The light of whole frames under random tracks: outside of the region every mirror is as it was sent, and no plane is
/// brighter than it was sent.
#[test]
fn light_outside_of_regions_is_the_light_that_was_sent() {
    let mut rig = following(FirmwareConfig { shown_kept: 64, ..setup() });
    let draws = Draws::new(3);
    let mut moved = 0;
    for id in 1..60u64 {
        rig.step(id);
        let now = rig.now;
        for k in 0..4 {
            let mirrors = (draws.bits(id * 4 + k) % 9) as i16 - 4;
            rig.follow(now.plus_ns(200_000 * k as i64), &tracks(id.saturating_sub(2), now, mirrors));
        }
        let device = rig.cable.device_mut();
        let bytes = raster().plane_bytes();
        while let (Some(shown), Some(slot)) = (device.next_shown(), device.next_moves()) {
            assert_eq!(shown.event.frame, Some(slot.frame));
            for (plane, moves) in shown.planes.chunks(bytes).zip(slot.planes()) {
                let mut light = vec![0; bytes];
                move_plane(raster(), plane, moves, &mut light);
                let ones = |p: &[u8]| p.iter().map(|b| b.count_ones()).sum::<u32>();
                assert!(ones(&light) <= ones(plane));
                for (sent, seen) in plane.chunks(3).zip(light.chunks(3)) {
                    let outside = |row: &[u8]| (row[0] & 0b1100_0000, row[1] & 0b0000_0011, row[2]);
                    assert_eq!(outside(sent), outside(seen));
                }
                moved += u32::from(light != plane);
            }
        }
    }
    assert!(moved > 500, "{moved} planes moved");
}

/// The TRACKS printed in docs/PROTOCOL.md, byte for byte, move the frame printed there as the document says.
#[test]
fn the_documents_tracks_move_the_documents_frame() {
    let packets = packets_of_the_document();
    let [hello, config, arm, plane, commit, _stop, tracks, _shift] = &packets[..] else {
        panic!("{} packets", packets.len())
    };
    let mut asks = config[32..32 + 41].to_vec();
    asks[19] = 2;
    let config = Packet::new(Header::control(MessageType::Config, 42, 0), &asks).to_vec();
    let panel = Raster::new(16, 1).unwrap();
    let mut mock = ProjectorFirmware::new(FirmwareConfig {
        greatest_shift: Some(8),
        moves_kept: 4,
        ..FirmwareConfig::new(panel)
    });
    for control in [hello, &config, arm, tracks] {
        mock.receive(HostTime(0), Lane::Control, control);
    }
    mock.receive(HostTime(1), Lane::Data, plane);
    mock.receive(HostTime(2), Lane::Data, commit);
    mock.advance_to(HostTime(2_111_932));
    let slot = mock.next_moves().expect("slot 1");
    let mut light = [0; 2];
    move_plane(panel, &[0xf0, 0x0f], &slot.planes()[0], &mut light);
    assert_eq!((slot.frame, light), (1, [0x3c, 0x0f]));
}
