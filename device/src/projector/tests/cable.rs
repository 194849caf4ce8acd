//! A cable with every kind of fault, and arbitrary bytes: only frames that were sent are ever lit.

use super::*;

/// A cable that loses, damages, repeats and swaps packets.
struct BadCable {
    inner: Direct<ProjectorFirmware>,
    draws: Draws,
    sent: u64,
    per_mille: u64,
    held: Option<(Lane, Vec<u8>)>,
}

impl Transport for BadCable {
    fn send(&mut self, now: HostTime, lane: Lane, packets: &[Packet<'_>]) -> Result<(), SendError> {
        for packet in packets {
            let mut bytes = packet.to_vec();
            self.sent += 1;
            let draw = self.draws.bits(self.sent);
            let device = self.inner.device_mut();
            if draw % 1000 < self.per_mille {
                match draw >> 32 & 7 {
                    0 | 1 => continue,
                    2 | 3 => {
                        let bit = (draw >> 40) as usize % (bytes.len() * 8);
                        bytes[bit / 8] ^= 1 << (bit % 8);
                    }
                    4 => device.receive(now, lane, &bytes),
                    5 => {
                        self.held = Some((lane, bytes));
                        continue;
                    }
                    6 => bytes.truncate((draw >> 40) as usize % bytes.len()),
                    _ => device.receive(now, lane, &[0x44; 7][..(draw >> 40) as usize % 8]),
                }
            }
            device.receive(now, lane, &bytes);
            if let Some((lane, held)) = self.held.take() {
                device.receive(now, lane, &held);
            }
        }
        Ok(())
    }

    fn receive(
        &mut self,
        now: HostTime,
        sink: &mut dyn FnMut(Lane, HostTime, &[u8]),
    ) -> Result<(), TransportError> {
        // The other direction is as bad.
        self.inner.device_mut().advance_to(now);
        let (draws, per_mille) = (self.draws.stream(1), self.per_mille);
        let mut n = now.0 as u64 * 64;
        self.inner.device_mut().replies(now, &mut |lane, bytes| {
            n += 1;
            if draws.bits(n) % 1000 >= per_mille {
                sink(lane, now, bytes);
            }
        });
        Ok(())
    }

    fn name(&self) -> &str {
        "a bad cable"
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]

    /// Whatever the cable does: every lit frame was sent, bit for bit; laws and credits hold; light returns.
    #[test]
    fn a_bad_cable_never_lights_a_wrong_frame(seed in any::<u64>(), per_mille in 0u64..200, codecs in 0u32..16) {
        let r = Raster::new(64, 16).unwrap();
        let mock = ProjectorFirmware::new(FirmwareConfig::new(r));
        let cable =
            BadCable { inner: Direct::new(mock), draws: Draws::new(seed), sent: 0, per_mille: 0, held: None };
        let s = LinkSettings { raster: r, codecs, late_slots: 2, ..settings() };
        let mut rig = Rig { link: HostLink::new(s), cable, now: HostTime(0), slot: 0 };
        rig.stream();
        rig.cable.per_mille = per_mille;
        let mut last_lit = None;
        for id in 0..60u64 {
            rig.step_with(id, &structured(r, id));
            let mock = rig.cable.inner.device_mut();
            mock.check_laws();
            prop_assert_eq!(mock.credit_violations(), 0);
            while let Some(event) = mock.next_light() {
                if event.kind == LightKind::Lit {
                    let id = event.frame.unwrap();
                    prop_assert!(last_lit.is_none_or(|l| id > l), "light goes forward only");
                    last_lit = Some(id);
                }
            }
            if let Some(id) = mock.lit_frame() {
                let expected = structured(r, u64::from(id));
                prop_assert_eq!(mock.lit_planes().unwrap(), &expected[..]);
            }
        }
        // The cable heals: within 40 slots (credit repair included) every frame is lit again.
        rig.cable.per_mille = 0;
        for id in 60..100 {
            rig.step_with(id, &structured(r, id));
        }
        let before = rig.cable.inner.device().status().frames_lit;
        for id in 100..110 {
            prop_assert_eq!(rig.step_with(id, &structured(r, id)), SendOutcome::Sent);
        }
        prop_assert_eq!(rig.cable.inner.device().status().frames_lit, before + 10);
    }

    /// Any bytes on any lane, at any time, in any state.
    #[test]
    fn any_bytes_leave_it_standing(
        pieces in prop::collection::vec((any::<bool>(), prop::collection::vec(any::<u8>(), 0..64), 0i64..3_000_000), 0..60),
        messages in prop::collection::vec((1u8..14, any::<u32>(), prop::collection::vec(any::<u8>(), 0..70), any::<bool>()), 0..60),
        armed in any::<bool>(),
    ) {
        let mut rig = clean(settings(), FirmwareConfig::new(raster()));
        if armed {
            rig.stream();
        }
        let session = rig.cable.device().core.session;
        let mut now = rig.now;
        let mock = rig.cable.device_mut();
        for (i, (data, bytes, dt)) in pieces.iter().enumerate() {
            now = now.plus_ns(*dt);
            mock.receive(now, if *data { Lane::Data } else { Lane::Control }, bytes);
            mock.end_of_transfer(now, if *data { Lane::Data } else { Lane::Control });
            if let Some((kind, frame, payload, control)) = messages.get(i) {
                let kind = MessageType::from_code(*kind).unwrap();
                let codec = Codec::from_code((*frame >> 8) as u8 % 4).unwrap();
                let header = Header { frame: *frame, codec, plane: *frame as u8 % 30, led_code: 7, ..Header::control(kind, session, 0) };
                let packet = Packet::new(header, payload).to_vec();
                mock.receive(now, if *control { Lane::Control } else { Lane::Data }, &packet);
            }
            let mut replies = 0;
            mock.replies(now, &mut |_, _| replies += 1);
            prop_assert!(replies <= 3 + ECHOES_KEPT);
            mock.check_laws();
            prop_assert!(mock.lit_frame().is_none(), "no whole frame was ever sent");
        }
    }
}
