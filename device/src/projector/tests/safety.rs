//! Flashing light and damaged packets end in the dark.

use super::*;

/// A picture that flashes: full light and darkness, each for `half_period` slots.
fn flashing(id: u64, half_period: u64) -> Vec<u8> {
    let lit = (id / half_period).is_multiple_of(2);
    let mut all = vec![if lit { 0xff } else { 0 }; raster().plane_bytes() * 24];
    for row in all.chunks_mut(3) {
        row[2] &= 0xf0;
    }
    all
}

#[test]
fn the_host_does_not_let_the_field_flash() {
    let s = LinkSettings { flash_limit: Some(3), watchdog_us: 3_000_000, ..settings() };
    let mut rig = clean(s, FirmwareConfig::new(raster()));
    rig.stream();
    // 10 Hz: half a period is 47 slots.
    let mut dark_since = None;
    let mut rests = 0;
    for id in 0..4000u64 {
        let outcome = rig.step_with(id, &flashing(id, 47));
        let lit = rig.cable.device().is_lit();
        match (outcome, dark_since) {
            (SendOutcome::Dropped { reason: DropReason::FlashLimit }, None) => {
                assert!(!lit, "dark at once");
                dark_since = Some(rig.now);
                rests += 1;
            }
            (SendOutcome::Dropped { reason: DropReason::FlashLimit }, _) => assert!(!lit),
            (_, Some(since)) if lit => {
                assert!(rig.now.ns_since(since) >= 2_000_000_000, "rested {} ns", rig.now.ns_since(since));
                dark_since = None;
            }
            _ => {}
        }
    }
    assert!(rests >= 2, "it strikes again after the rest: {rests}");
    let status = rig.cable.device().status();
    assert_eq!(status.faults, 0, "the host is before the device: {status:?}");
    // A picture that does not flash is never dropped.
    let s = LinkSettings { flash_limit: Some(3), ..settings() };
    let mut rig = clean(s, FirmwareConfig::new(raster()));
    rig.stream();
    for id in 0..3000 {
        assert_eq!(rig.step(id), SendOutcome::Sent);
    }
}

#[test]
fn a_device_does_not_trust_the_host_about_flashes() {
    let mut rig =
        clean(LinkSettings { watchdog_us: 10_000_000, ..settings() }, FirmwareConfig::new(raster()));
    rig.stream();
    let mut flashes = 0;
    let mut was_bright = false;
    for id in 0..2000u64 {
        rig.step_with(id, &flashing(id, 47));
        let bright = rig.cable.device_mut().light_of_frame().is_some_and(|l| l[0] == [255; 3]);
        flashes += u32::from(bright && !was_bright);
        was_bright = bright;
        if rig.cable.device().status().faults != 0 {
            break;
        }
    }
    assert_eq!(rig.cable.device().status().faults, faults::FLASH_LIMIT);
    assert!(flashes <= 5, "{flashes} flashes before it struck");
    assert!(!rig.cable.device().is_lit());
    let struck_at = rig.now;
    // ARM is refused within two seconds, even with acknowledgement.
    rig.until(LinkState::Faulted);
    rig.link.arm(faults::FLASH_LIMIT);
    rig.poll().unwrap();
    assert!(matches!(rig.poll(), Err(LinkError::ArmRefused { .. })));
    rig.now = struck_at.plus_ns(2_010_000_000);
    rig.link.arm(faults::FLASH_LIMIT);
    rig.until(LinkState::Streaming);
}

#[test]
fn a_storm_of_damage_ends_the_light() {
    let mut rig = clean(settings(), FirmwareConfig::new(raster()));
    rig.stream();
    for id in 0..10 {
        rig.step(id);
    }
    assert!(rig.cable.device().is_lit());
    let session = rig.cable.device().core.session;
    let mut bad = Packet::new(Header::control(MessageType::Sync, session, 0), &[0; 4]).to_vec();
    bad[34] ^= 1;
    for n in 0..1000 {
        assert!(rig.cable.device().is_lit(), "after {n}");
        let now = rig.now;
        rig.cable.device_mut().receive(now, Lane::Data, &bad);
    }
    assert!(!rig.cable.device().is_lit());
    assert_eq!(rig.cable.device().status().faults, faults::CHECKSUM_STORM);
}
