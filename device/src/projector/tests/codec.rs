//! Compacted planes light the same frames as raw ones, and save the expected bytes.

use super::*;
use crate::link::COMMIT_BYTES;

#[test]
fn every_codec_saves_and_lights_the_same_frame() {
    let r = Raster::new(64, 16).unwrap();
    let raw_frame = (24 * (32 + r.plane_bytes() + 4) + 32 + COMMIT_BYTES + 4) as u64;
    for codecs in [0, Codec::Rle.mask(), Codec::XorRle.mask(), Codec::Lz4.mask(), Codec::ALL] {
        let mut rig = clean(LinkSettings { raster: r, codecs, ..settings() }, FirmwareConfig::new(r));
        rig.stream();
        let before = rig.link.counters().bytes_sent;
        for id in 0..40 {
            assert_eq!(rig.step_with(id, &structured(r, id)), SendOutcome::Sent);
            if let Some(lit) = rig.cable.device().lit_frame() {
                assert_eq!(rig.cable.device().lit_planes().unwrap(), structured(r, u64::from(lit)));
            }
        }
        let c = rig.link.counters();
        let s = rig.cable.device().status();
        assert_eq!((s.frames_incomplete, s.packets_ignored, s.frames_lit), (0, 0, 38), "{codecs:#b} {s:?}");
        let bytes = c.bytes_sent - before;
        if codecs == 0 {
            assert_eq!((c.planes_raw, c.planes_coded, c.planes_kept), (40 * 24, 0, 0));
            assert!((40 * raw_frame..40 * raw_frame + 5000).contains(&bytes), "{bytes}");
            continue;
        }
        // A quarter of the planes never changes: sent once each. A quarter is noise and stays raw.
        assert_eq!(c.planes_kept, 39 * 6);
        assert!(c.planes_raw >= 40 * 6);
        assert_eq!(c.key_frames, 1);
        if codecs != Codec::Rle.mask() {
            assert!(c.planes_coded > 39 * 6 / 2, "{codecs:#b}: {c:?}");
        }
        assert!(bytes < 40 * raw_frame * 3 / 4 + 5000, "{codecs:#b}: {bytes} of {}", 40 * raw_frame);
        if codecs == Codec::ALL {
            // A cable that always has room is not worth LZ4's time: the quarter that only LZ4 shortens stays raw, too.
            assert!(bytes < 40 * raw_frame * 60 / 100, "{bytes} of {}", 40 * raw_frame);
            // A frame equal to the previous one is only a FRAME_COMMIT.
            let planes = structured(r, 39);
            rig.step_with(40, &planes);
            let at = rig.link.counters().bytes_sent;
            rig.poll().unwrap();
            let (target, dark_from) = rig.times(rig.slot + 3);
            rig.link.send_frame(rig.now, 41, target, dark_from, &planes, &mut rig.cable);
            assert_eq!(rig.link.counters().bytes_sent - at, (32 + COMMIT_BYTES + 4) as u64);
            rig.idle(4);
            assert_eq!(rig.cable.device().lit_frame(), Some(41));
            assert_eq!(rig.cable.device().lit_planes().unwrap(), planes);
        }
    }
}

/// A device that decodes only raw planes gets only raw planes.
#[test]
fn codecs_are_what_both_sides_know() {
    let r = Raster::new(64, 16).unwrap();
    let mut rig = clean(
        LinkSettings { raster: r, codecs: Codec::ALL, ..settings() },
        FirmwareConfig { codecs: 0, ..FirmwareConfig::new(r) },
    );
    rig.stream();
    for id in 0..20 {
        rig.step_with(id, &structured(r, id));
    }
    assert_eq!(rig.link.counters().planes_coded, 0);
    assert!(rig.link.counters().planes_kept > 0, "keeping a plane needs no codec");
    assert_eq!(rig.cable.device().status().packets_ignored, 0);
}
