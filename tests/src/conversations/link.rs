//! The bit-plane link: the host against any device and the mock projector against any host, from their first word and
//! from the middle of a stream. Session numbers and checksums are right.

use dpm_device::link::{
    Area, Codec, Epoch, Header, HostLink, LightLimits, LinkSettings, LinkState, MessageType, Packet, Region,
    SessionNumbers, Tracks, Underrun, MAX_TRACK_US,
};
use dpm_device::planes::{PlaneSchedule, Raster};
use dpm_device::time::{DeviceTicks, FrameRate, HostTime};
use dpm_device::transport::inproc::Direct;
use dpm_device::transport::{Lane, LinkDevice, SendError, Transport, TransportError};
use hil_mock::projector::{MockConfig, MockProjector};

/// A cable that records the session and what was sent, and that can be given replies.
struct Cable {
    /// `None` while its answers are played back.
    device: Option<Direct<MockProjector>>,
    session: u32,
    sent: Vec<MessageType>,
    /// Every packet, for seeds.
    kept: Option<(Vec<u8>, Vec<u8>)>,
    /// Replies that replace the device's own, if there are any.
    inbound: Option<Answers>,
}

/// What a device says to one poll.
type Answers = Vec<(Lane, Vec<u8>)>;

impl Transport for Cable {
    fn send(&mut self, now: HostTime, lane: Lane, packets: &[Packet<'_>]) -> Result<(), SendError> {
        for packet in packets {
            let head = packet.header();
            self.session = u32::from_le_bytes([head[8], head[9], head[10], head[11]]);
            self.sent.extend(MessageType::from_code(head[5]));
            if let Some((to_device, _)) = &mut self.kept {
                to_device.extend(packet.to_vec());
            }
        }
        self.device.as_mut().map_or(Ok(()), |device| device.send(now, lane, packets))
    }

    fn receive(
        &mut self,
        now: HostTime,
        sink: &mut dyn FnMut(Lane, HostTime, &[u8]),
    ) -> Result<(), TransportError> {
        let Self { device, kept, inbound, .. } = self;
        match (inbound, device) {
            (Some(answers), _) => answers.drain(..).for_each(|(lane, bytes)| sink(lane, now, &bytes)),
            (None, Some(device)) => device.receive(now, &mut |lane, at, bytes| {
                kept.iter_mut().for_each(|(_, to_host)| to_host.extend_from_slice(bytes));
                sink(lane, at, bytes);
            })?,
            (None, None) => {}
        }
        Ok(())
    }

    fn name(&self) -> &str {
        "a cable under test"
    }
}

const PLANES: usize = 3;

fn raster() -> Raster {
    Raster::new(16, 2).expect("a raster")
}

/// By how many mirrors the mock moves light at most.
const GREATEST_SHIFT: u8 = 3;

fn mock_config() -> MockConfig {
    let greatest_shift = Some(GREATEST_SHIFT);
    MockConfig { events_kept: 0, moves_kept: 2, greatest_shift, ..MockConfig::new(raster()) }
}

/// A link that has not said a word, and its cable, at whose other end is nothing yet.
fn silent() -> (HostLink, Cable) {
    let raster = raster();
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
    link.want_tracks();
    (link, Cable { device: None, session: 0, sent: Vec::new(), kept: None, inbound: None })
}

fn mock() -> Direct<MockProjector> {
    Direct::new(MockProjector::new(mock_config()))
}

/// Leads the link to where it streams, and returns its time then. `before` runs before each of its polls.
fn stream(link: &mut HostLink, cable: &mut Cable, mut before: impl FnMut(&mut Cable, HostTime)) -> HostTime {
    let (raster, schedule) = (raster(), PlaneSchedule::mono8());
    let mut now = HostTime(0);
    link.connect();
    while link.state() != LinkState::Streaming {
        now = now.plus_ns(1_000_000);
        before(cable, now);
        link.poll(now, cable).expect("the mock answers");
        if link.state() == LinkState::Ready {
            link.arm(0);
        }
    }
    for id in 1..=PLANES as u64 {
        let planes = vec![id as u8; raster.plane_bytes() * schedule.len()];
        let slots = link.slots().expect("slots");
        link.send_frame(now, id, slots.start(id + 4), slots.dark_from(id + 4, 0), &planes, cable);
    }
    let mut tracks = Tracks::new(1, 0, DeviceTicks(now.0 as u64), MAX_TRACK_US);
    let area = Area { left: 1, top: 0, width: 12, height: 2 };
    tracks.push(Region {
        area,
        clamp: GREATEST_SHIFT,
        offset: [256, 0],
        velocity: [64, 0],
        ..Region::default()
    });
    link.send_tracks(now, &tracks, cable).expect("room");
    now
}

/// A stream that a link and a mock have led to once: every conversation begins with it, and leading to it takes longer than
/// most conversations do.
struct Begun {
    mock: Direct<MockProjector>,
    session: u32,
    now: HostTime,
    /// What the mock said to each poll.
    answers: Vec<Answers>,
}

thread_local! {
    static BEGUN: Begun = Begun::new();
}

impl Begun {
    fn new() -> Self {
        let (mut link, mut cable) = silent();
        cable.device = Some(mock());
        let mut answers = Vec::new();
        let now = stream(&mut link, &mut cable, |cable, now| {
            let mut said = Answers::new();
            let device = cable.device.as_mut().expect("it was put there");
            device.receive(now, &mut |lane, _, bytes| said.push((lane, bytes.to_vec()))).expect("in memory");
            answers.push(said.clone());
            cable.inbound = Some(said);
        });
        Self { mock: cable.device.expect("still there"), session: cable.session, now, answers }
    }
}

/// A link that is streaming to a mock, and its time.
fn streaming() -> (HostLink, Cable, HostTime) {
    BEGUN.with(|begun| {
        let (mut link, mut cable) = silent();
        let mut answers = begun.answers.iter().cloned();
        let now = stream(&mut link, &mut cable, |cable, _| cable.inbound = answers.next());
        (cable.device, cable.inbound) = (Some(begun.mock.clone()), None);
        (link, cable, now)
    })
}

/// Makes packets from `bytes`, each with correct checksums: kind, codec, plane, frame, target, lane, elapsed time,
/// length, payload. `each` gets the wait, the lane, and what makes the packet of a session.
fn packets(mut bytes: &[u8], mut each: impl FnMut(i64, Lane, &dyn Fn(u32) -> Vec<u8>)) {
    while let Some((&[kind, codec, plane, frame, target, how, wait, n], rest)) =
        bytes.split_first_chunk::<8>()
    {
        let (payload, rest) = rest.split_at(usize::from(n).min(rest.len()));
        bytes = rest;
        let (Some(kind), Some(code)) = (MessageType::from_code(kind % 16), Codec::from_code(codec % 4))
        else {
            continue;
        };
        let plane_like = kind == MessageType::Plane;
        let make = |session: u32| {
            // One in eight codecs asks for another session.
            let session = if codec >> 5 == 7 { session.wrapping_add(1) } else { session };
            let header = Header {
                codec: if plane_like { code } else { Codec::Raw },
                plane: if plane_like { plane } else { 0 },
                led_code: if plane_like { plane & 0x37 } else { 0 },
                frame: u32::from(frame),
                target_at: DeviceTicks(u64::from(target) * 1_000_000),
                ..Header::control(kind, session, 0)
            };
            let mut wire = Packet::new(header, payload).to_vec();
            if let (true, Some(byte)) = (how & 2 != 0, wire.get_mut(usize::from(how >> 2))) {
                *byte ^= 0x10;
            }
            wire
        };
        each(i64::from(wait) * 100_000, if how & 1 == 0 { Lane::Data } else { Lane::Control }, &make);
    }
}

/// What holds for a projector after any packet: its counters stay consistent, its answers are bounded, its credit is kept,
/// and no light is moved further than it can.
fn answers(mock: &mut MockProjector, now: HostTime) {
    let mut answers = 0;
    mock.replies(now, &mut |_, _| answers += 1);
    assert!(answers <= 32, "{answers} answers to one packet");
    let s = mock.status();
    assert_eq!(s.slots, s.frames_lit + s.slots_repeated + s.slots_blank, "{s:?}");
    let ended = s.frames_lit + s.frames_incomplete + s.frames_late + s.frames_superseded + s.frames_refused;
    assert!((ended..=ended + 8).contains(&s.frames_seen), "{s:?}");
    assert!(s.buffers_free <= 4, "{s:?}");
    while let Some(slot) = mock.next_moves() {
        let shifts = slot.planes().iter().flat_map(|plane| plane.all()).flat_map(|one| one.shift);
        assert!(shifts.into_iter().all(|shift| shift.unsigned_abs() <= GREATEST_SHIFT), "{slot:?}");
    }
}

/// Sends arbitrary packets to an armed projector.
pub fn projector(bytes: &[u8]) {
    let (mut device, session, mut now) = BEGUN.with(|begun| (begun.mock.clone(), begun.session, begun.now));
    let mock = device.device_mut();
    packets(bytes, |wait, lane, make| {
        now = now.plus_ns(wait);
        mock.receive(now, lane, &make(session));
        answers(mock, now);
    });
}

/// Sends arbitrary packets to a projector that no host has greeted: it is dark until a host has armed it.
pub fn projector_hello(bytes: &[u8]) {
    let mut mock = MockProjector::new(mock_config());
    let (mut now, mut armed) = (HostTime(0), false);
    packets(bytes, |wait, lane, make| {
        now = now.plus_ns(wait);
        let packet = make(1);
        armed |= packet[5] == MessageType::Arm as u8;
        mock.receive(now, lane, &packet);
        answers(&mut mock, now);
        assert!(
            armed || !mock.status().lit && mock.status().frames_lit == 0,
            "light without the operator's word"
        );
    });
}

/// Sends arbitrary packets from the device to a streaming host: the host grants itself no credit and never requests
/// light by itself.
pub fn host_link(bytes: &[u8]) {
    let (mut link, mut cable, mut now) = streaming();
    let session = cable.session;
    cable.sent.clear();
    packets(bytes, |wait, _, make| {
        now = now.plus_ns(wait);
        cable.inbound = Some(vec![(Lane::Control, make(session))]);
        let _ = link.poll(now, &mut cable);
        assert!(link.credit() <= i32::MAX as u32);
        link.take_echoes(|_| ());
    });
    assert!(!cable.sent.contains(&MessageType::Arm), "light without the operator's word");
}

/// Sends arbitrary packets from the device to a host from its first word on: no light is requested before the operator
/// does, and no frame is sent before.
pub fn host_hello(bytes: &[u8]) {
    let (mut link, mut cable) = silent();
    cable.device = Some(mock());
    let (mut now, mut armed) = (HostTime(0), false);
    link.connect();
    packets(bytes, |wait, _, make| {
        now = now.plus_ns(wait);
        cable.inbound = Some(vec![(Lane::Control, make(cable.session))]);
        let _ = link.poll(now, &mut cable);
        if !armed {
            assert!(!cable.sent.contains(&MessageType::Arm), "light without the operator's word");
            assert!(link.state() != LinkState::Streaming);
        }
        if link.state() == LinkState::Ready {
            armed = true;
            link.arm(0);
        }
        if let (LinkState::Streaming, Some(slots)) = (link.state(), link.slots()) {
            let planes = vec![0x55; raster().plane_bytes() * PlaneSchedule::mono8().len()];
            let slot = u64::from(make(0)[12]);
            link.send_frame(
                now,
                slot,
                slots.start(slot + 4),
                slots.dark_from(slot + 4, 0),
                &planes,
                &mut cable,
            );
        }
        link.take_echoes(|_| ());
        cable.sent.retain(|kind| *kind == MessageType::Arm);
        cable.sent.truncate(1);
    });
}

/// The packets of a stream as a script; those that carry planes only as far as a script can say.
fn script(mut wire: &[u8]) -> Vec<u8> {
    let mut out = Vec::new();
    while let Some(head) = wire.first_chunk::<{ dpm_device::link::HEADER_BYTES }>() {
        let header = Header::decode(head).expect("its own packet");
        let n = header.payload_bytes as usize;
        let payload = &wire[head.len()..][..n];
        wire = &wire[dpm_device::link::packet_bytes(n)..];
        let target = (header.target_at.0 / 1_000_000) as u8;
        let first =
            [header.kind as u8, header.codec as u8, header.plane, header.frame as u8, target, 0, 10, n as u8];
        if n < 256 {
            out.extend([&first[..], payload].concat());
        }
    }
    out
}

pub(super) fn recorded() -> Vec<(&'static str, &'static str, Vec<u8>)> {
    let (mut link, mut cable) = silent();
    (cable.device, cable.kept) = (Some(mock()), Some(Default::default()));
    stream(&mut link, &mut cable, |_, _| ());
    let (to_device, to_host) = cable.kept.expect("kept");
    let (to_device, to_host) = (script(&to_device), script(&to_host));
    vec![
        ("projector_hello", "recorded", to_device[..to_device.len().min(700)].to_vec()),
        ("host_hello", "recorded", to_host[..to_host.len().min(700)].to_vec()),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What is played back leads to where the ends lead each other.
    #[test]
    fn a_stream_that_was_begun_is_the_stream_itself() {
        let (mut link, mut cable) = silent();
        cable.device = Some(mock());
        let now = stream(&mut link, &mut cable, |_, _| ());
        let (again, cable_again, then) = streaming();
        assert_eq!(
            (format!("{link:?}"), now, cable.session),
            (format!("{again:?}"), then, cable_again.session)
        );
        assert_eq!(format!("{:?}", cable.device), format!("{:?}", cable_again.device));
        assert_eq!(cable.sent, cable_again.sent);
    }
}
