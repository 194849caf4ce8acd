//! Sends arbitrary bytes to both ends of a bit-plane link that is up. The bytes become packets with correct
//! checksums, which a fuzzer would not guess, so that the code behind the checksums is reached.

use dpm_device::link::{
    Codec, Epoch, Header, HostLink, LightLimits, LinkSettings, LinkState, MessageType, Packet,
    SessionNumbers, Underrun,
};
use dpm_device::planes::{PlaneSchedule, Raster};
use dpm_device::time::{DeviceTicks, FrameRate, HostTime};
use dpm_device::transport::inproc::Direct;
use dpm_device::transport::{Lane, LinkDevice, SendError, Transport, TransportError};
use hil_mock::projector::{MockConfig, MockProjector};

/// A cable that records the session and what was sent, and that can be given replies.
struct Cable {
    device: Direct<MockProjector>,
    session: u32,
    sent: Vec<MessageType>,
    /// Replies that replace the device's own, if there are any.
    inbound: Option<Vec<u8>>,
}

impl Transport for Cable {
    fn send(&mut self, now: HostTime, lane: Lane, packets: &[Packet<'_>]) -> Result<(), SendError> {
        for packet in packets {
            let head = packet.parts()[0];
            self.session = u32::from_le_bytes([head[8], head[9], head[10], head[11]]);
            self.sent.extend(MessageType::from_code(head[5]));
        }
        self.device.send(now, lane, packets)
    }

    fn receive(
        &mut self,
        now: HostTime,
        sink: &mut dyn FnMut(Lane, HostTime, &[u8]),
    ) -> Result<(), TransportError> {
        match &mut self.inbound {
            Some(bytes) => sink(Lane::Control, now, &std::mem::take(bytes)),
            None => self.device.receive(now, sink)?,
        }
        Ok(())
    }

    fn name(&self) -> &str {
        "a cable under test"
    }
}

const PLANES: usize = 3;

/// A link that is streaming, and its clock.
fn streaming() -> (HostLink, Cable, HostTime) {
    let raster = Raster::new(16, 2).expect("a raster");
    let schedule = PlaneSchedule::mono8();
    let settings = LinkSettings {
        raster,
        schedule,
        rate: FrameRate::new(947, 1).expect("a rate"),
        watchdog_us: 1_000_000,
        underrun: Underrun::Repeat,
        late_slots: 10,
        epoch: Epoch::At(DeviceTicks(0)),
        codecs: Codec::ALL,
        flash_limit: None,
        limits: LightLimits::OFF,
    };
    // Always the same session, because a fuzzer's findings must be reproducible.
    let mut link = HostLink::with_sessions(settings, SessionNumbers::from_source(|| 1));
    let mock = MockProjector::new(MockConfig { events_kept: 0, ..MockConfig::new(raster) });
    let mut cable = Cable { device: Direct::new(mock), session: 0, sent: Vec::new(), inbound: None };
    let mut now = HostTime(0);
    link.connect();
    while link.state() != LinkState::Streaming {
        now = now.plus_ns(1_000_000);
        link.poll(now, &mut cable).expect("the mock answers");
        if link.state() == LinkState::Ready {
            link.arm(0);
        }
    }
    for id in 1..=PLANES as u64 {
        let planes = vec![id as u8; raster.plane_bytes() * schedule.len()];
        let slots = link.slots().expect("slots");
        link.send_frame(now, id, slots.start(id + 4), slots.dark_from(id + 4, 0), &planes, &mut cable);
    }
    (link, cable, now)
}

/// Makes packets from `bytes`, each with correct checksums: kind, codec, plane, frame, target, lane, elapsed time,
/// length, payload.
fn packets(mut bytes: &[u8], session: u32, mut each: impl FnMut(i64, Lane, Vec<u8>)) {
    while let Some((&[kind, codec, plane, frame, target, how, wait, n], rest)) =
        bytes.split_first_chunk::<8>()
    {
        let (payload, rest) = rest.split_at(usize::from(n).min(rest.len()));
        bytes = rest;
        let (Some(kind), Some(codec)) = (MessageType::from_code(kind % 16), Codec::from_code(codec % 4))
        else {
            continue;
        };
        let plane_like = kind == MessageType::Plane;
        let header = Header {
            codec: if plane_like { codec } else { Codec::Raw },
            plane: if plane_like { plane } else { 0 },
            led_code: if plane_like { plane & 0x37 } else { 0 },
            frame: u32::from(frame),
            target_at: DeviceTicks(u64::from(target) * 1_000_000),
            ..Header::control(kind, session, 0)
        };
        let lane = if how & 1 == 0 { Lane::Data } else { Lane::Control };
        let mut wire = Packet::new(header, payload).parts().concat();
        if let (true, Some(byte)) = (how & 2 != 0, wire.get_mut(usize::from(how >> 2))) {
            *byte ^= 0x10;
        }
        each(i64::from(wait) * 100_000, lane, wire);
    }
}

/// Sends arbitrary packets to an armed projector: its counters stay consistent, its answers are bounded, and its
/// credit is kept.
pub fn projector(bytes: &[u8]) {
    let (_, mut cable, mut now) = streaming();
    let session = cable.session;
    let mock = cable.device.device_mut();
    packets(bytes, session, |wait, lane, wire| {
        now = now.plus_ns(wait);
        mock.receive(now, lane, &wire);
        let mut answers = 0;
        mock.replies(now, &mut |_, _| answers += 1);
        assert!(answers <= 32, "{answers} answers to one packet");
        let s = mock.status();
        assert_eq!(s.slots, s.frames_lit + s.slots_repeated + s.slots_blank, "{s:?}");
        let ended =
            s.frames_lit + s.frames_incomplete + s.frames_late + s.frames_superseded + s.frames_refused;
        assert!((ended..=ended + 8).contains(&s.frames_seen), "{s:?}");
        assert!(s.buffers_free <= 4, "{s:?}");
    });
}

/// Sends arbitrary packets from the device to a streaming host: the host grants itself no credit and never requests
/// light by itself.
pub fn host_link(bytes: &[u8]) {
    let (mut link, mut cable, mut now) = streaming();
    let session = cable.session;
    cable.sent.clear();
    packets(bytes, session, |wait, _, wire| {
        now = now.plus_ns(wait);
        cable.inbound = Some(wire);
        let _ = link.poll(now, &mut cable);
        assert!(link.credit() <= i32::MAX as u32);
        link.take_echoes(|_| ());
    });
    assert!(!cable.sent.contains(&MessageType::Arm), "light without the operator's word");
}
