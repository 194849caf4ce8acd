//! `dpm link-test`: a rig's own pictures over its link as fast as it takes them, into the frame rate that the link allows.

use super::conformance::{self, Extent, Judgement, Medium, MediumKind};
use super::sequence::{draw, poses_at};
use dpm_common::clock::{Clock, MonotonicClock};
use dpm_device::link::{measure, Codec, HostLink, LinkMeasurement, LinkSettings, LinkState, Verb};
use dpm_device::planes::Raster;
use dpm_device::time::HostTime;
use dpm_device::transport::inproc::{threaded, HostEnd};
use dpm_device::transport::{LinkDevice, Transport};
use dpm_handoff::wake::WaitPolicy;
use dpm_mock::projector::{serve_cable, EmulatedProjector, MockConfig, GREATEST_SHIFT};
use dpm_render::gpu::Gpu;
use dpm_render::pack::{pack, BitPlaneFrame, Kernel};
use dpm_render::{RenderError, Renderer};
use dpm_rig::config::RigConfig;
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::pack::prepared::PreparedFrames;
use dpm_rig::pipeline::projector::{self, Surroundings};
use dpm_rig::pipeline::{connect, renderer_settings, PipelineError, ENDED_WITH_THE_LAST_RUN};
use dpm_rig::projectors::{Cable, Compaction};
use dpm_rig::rig::Rig;
use dpm_rig::standing::{standing_for_device, Stands};
use dpm_rig::telemetry::monitor::RunMonitor;
use std::sync::Arc;
use std::time::Duration;

/// Time that the link rests when it takes nothing.
const REST: Duration = Duration::from_micros(50);
/// A projector that does not go dark within this long is left to its watchdog.
const DARK_WITHIN_NS: i64 = 300_000_000;
/// A projector that says no HELLO within this long is told of by the test itself.
const HELLO_WITHIN_NS: i64 = 2_000_000_000;

/// What `dpm link-test` tells.
#[derive(Clone, Debug, serde::Serialize)]
pub struct LinkTestReport {
    /// Name of the medium.
    pub medium: String,
    /// Mirrors, columns and rows.
    pub raster: [u32; 2],
    /// Bit planes in a frame.
    pub planes: usize,
    /// Rate of the rig file, frames a second: no projector shows more, so no more is measured.
    pub frame_rate_hz: f64,
    /// "rendered": pictures of the rig's scene in motion; "prepared": a moving pattern.
    pub content: &'static str,
    /// Raw and, where the rig file allows codecs, compacted.
    pub ways: Vec<LinkWay>,
    /// True when it was told to stop before its time: the last way is shorter, others may be missing.
    pub stopped: bool,
}

/// One way to send.
#[derive(Clone, Debug, serde::Serialize)]
pub struct LinkWay {
    /// Codecs that were allowed.
    pub compaction: String,
    /// Frames a second that arrived whole.
    pub frames_per_s: f64,
    /// Bytes of a frame on the wire, mean.
    pub bytes_per_frame: f64,
    /// 10^6 bytes a second.
    pub mb_per_s: f64,
    /// Planes sent as they are, by a codec, and not at all.
    pub planes: [u64; 3],
    /// Shortest clock exchange, us.
    pub round_trip_us: Option<f64>,
    /// "frame rate": the rig's rate is carried; "medium": the cable or the device took no more; "host": compacting took longer.
    pub limited_by: &'static str,
    /// Frame rate to set: the rig's where it is carried, else what was measured, in whole frames.
    pub allows_hz: f64,
}

/// Frames to send, over and over, there and back so that neighbours stay neighbours.
pub struct TestFrames {
    name: &'static str,
    frames: Vec<BitPlaneFrame>,
}

impl TestFrames {
    /// `count` successive pictures of the rig's scene, at least one; fewer when `stop` says so.
    ///
    /// # Errors
    /// The renderer's.
    pub fn rendered(
        rig: &Rig,
        gpu: &Arc<Gpu>,
        count: u32,
        stop: &dyn Fn() -> bool,
    ) -> Result<Self, PipelineError> {
        let mut renderer = Renderer::new(gpu, &rig.scene, renderer_settings(rig))?;
        let mut slot = renderer.create_slot(false).map_err(RenderError::from)?;
        let spp = rig.config.render.spp;
        let kernel = Kernel::best();
        let mut frames = Vec::new();
        for k in 0..count.max(1) {
            let poses = poses_at(rig, u64::from(k));
            draw(rig, &mut renderer, &mut slot, &poses, k, spp as f32).map_err(RenderError::from)?;
            let mut frame = BitPlaneFrame::new(rig.camera.raster, rig.config.projector.schedule());
            pack(kernel, slot.codes(), &mut frame);
            frames.push(frame);
            if stop() {
                break;
            }
        }
        Ok(Self { name: "rendered", frames })
    }

    /// `count` frames of the moving pattern, at least one.
    pub fn prepared(rig: &Rig, count: u32) -> Self {
        let mut prepared = PreparedFrames::new(rig.camera.raster);
        let frames = (0..u64::from(count.max(1))).map(|k| {
            let mut frame = BitPlaneFrame::new(rig.camera.raster, rig.config.projector.schedule());
            prepared.pack(Kernel::best(), k, &mut frame);
            frame
        });
        Self { name: "prepared", frames: frames.collect() }
    }

    /// "rendered" or "prepared".
    pub fn name(&self) -> &'static str {
        self.name
    }

    /// Writes the planes of the `n`th frame to send.
    ///
    /// # Panics
    /// When `planes` has not a frame's size.
    pub fn fill(&self, n: u64, planes: &mut [u8]) {
        let last = self.frames.len() as u64 - 1;
        let at = if last == 0 { 0 } else { n % (2 * last) };
        let at = if at > last { 2 * last - at } else { at };
        planes.copy_from_slice(self.frames[at as usize].bytes());
    }
}

/// The rig's projector, to be measured.
enum Far {
    Outside(Box<dyn Transport>),
    /// The mock, on a thread that ends with this end of the cable.
    Inside(HostEnd),
}

impl Far {
    fn open(config: &RigConfig, raster: Raster, clock: MonotonicClock) -> Result<Self, Failure> {
        let clock_of = || std::sync::Arc::new(move || clock.now());
        let around = Surroundings::plain(clock_of());
        if let Some(mut medium) = projector::open(config, raster, &around).map_err(PipelineError::from)? {
            medium.transport.set_clock(clock_of());
            return Ok(Self::Outside(medium.transport));
        }
        let Some(mock) = config.projector.backend.as_mock() else {
            let word = config.projector.backend.word();
            let told = format!("projector.backend.kind = {word:?} takes no frames over a link");
            return Err(Failure::new(FailureKind::BadInput, told));
        };
        let setup = MockConfig {
            frame_buffers: mock.buffer_frames.min(64) as u8,
            events_kept: 0,
            greatest_shift: Some(GREATEST_SHIFT),
            shifts_slots: true,
            exceeds: true,
            ..MockConfig::new(raster)
        };
        let frame_buffers = usize::from(setup.frame_buffers);
        let mut mock = EmulatedProjector::new(setup, &mock.faults, config.render.seed, clock.now())
            .map_err(|e| Failure::new(FailureKind::BadInput, format!("projector.backend.faults: {e}")))?;
        let bytes = projector::frame_bytes(raster, config.projector.schedule().len());
        let (host, device) = threaded(bytes, frame_buffers + 1, WaitPolicy::Park);
        std::thread::Builder::new()
            .name("dpm-mock".into())
            .spawn(move || {
                serve_cable(&mut mock, device, || clock.now(), |mock, now| mock.advance_to(now));
            })
            .map_err(|e| Failure::new(FailureKind::Device, format!("cannot start a thread: {e}")))?;
        Ok(Self::Inside(host))
    }

    fn transport(&mut self) -> &mut dyn Transport {
        match self {
            Self::Outside(transport) => transport.as_mut(),
            Self::Inside(host) => host,
        }
    }

    /// Fails if an order stands for this projector, whatever port it was at when the order was given.
    fn refuse_held(
        &mut self,
        settings: LinkSettings,
        clock: MonotonicClock,
        stop: &dyn Fn() -> bool,
    ) -> Result<(), Failure> {
        match self {
            Self::Outside(transport) => {
                let mut now = || {
                    std::thread::sleep(Duration::from_micros(200));
                    clock.now()
                };
                refuse_held(settings, transport.as_mut(), &mut now, stop, &standing_for_device)
            }
            Self::Inside(_) => Ok(()),
        }
    }
}

/// Hears who is at the other end, without arming it. Fails if by `stands` an order stands for who says HELLO with that
/// serial number. Who says nothing is left to the test itself.
fn refuse_held(
    settings: LinkSettings,
    transport: &mut dyn Transport,
    now: &mut dyn FnMut() -> HostTime,
    stop: &dyn Fn() -> bool,
    stands: &dyn Fn(u64) -> Option<Stands>,
) -> Result<(), Failure> {
    let mut link = HostLink::new(settings);
    link.connect();
    let begin = now();
    let serial = loop {
        let at = now();
        let is_over = link.poll(at, transport).is_err() || at.ns_since(begin) > HELLO_WITHIN_NS || stop();
        match link.device() {
            Some(hello) => break hello.serial,
            None if is_over => return Ok(()),
            None => {}
        }
    };
    let Some(Stands { order, told, .. }) = stands(serial) else { return Ok(()) };
    let (name, word) = (transport.name(), order.word().to_uppercase());
    let told = format!(
        "{name}: {word} stands {told} for the projector with this serial number; run its rig and say `dpm arm`"
    );
    Err(Failure::new(FailureKind::Device, told))
}

/// Judges the projector of `config` by docs/PROTOCOL.md, less of it when `stop` says so. It is dark afterwards.
///
/// # Errors
/// The projector is missing, or is of a kind without a link.
pub fn judge_projector(
    config: &RigConfig,
    extent: Extent<'_>,
    stop: &dyn Fn() -> bool,
) -> Result<Judgement, Failure> {
    let clock = MonotonicClock::new(0);
    let raster = config.projector.raster();
    let mut far = Far::open(config, raster, clock)?;
    far.refuse_held(projector::link_settings(config, raster), clock, stop)?;
    let (kind, bytes_per_s) = match config.projector.backend.cable() {
        Cable::Usb => (MediumKind::Usb, None),
        Cable::Serial { bytes_per_s } => (MediumKind::Serial, Some(bytes_per_s)),
        Cable::InProcess => (MediumKind::InProcess, None),
    };
    let medium = Medium { transport: far.transport(), kind, bytes_per_s, clock: &|| clock.now(), stop };
    Ok(conformance::judge(medium, extent))
}

/// Measures the link of `rig` for `seconds` each way, less when `stop` says so. The projector shows the frames meanwhile, and is dark
/// afterwards.
///
/// # Errors
/// The projector is missing, refuses or goes away.
pub fn link_test(
    rig: &Rig,
    content: &TestFrames,
    seconds: f64,
    stop: &dyn Fn() -> bool,
) -> Result<LinkTestReport, Failure> {
    let clock = MonotonicClock::new(0);
    let mut far = Far::open(&rig.config, rig.camera.raster, clock)?;
    let settings = projector::link_settings(&rig.config, rig.camera.raster);
    far.refuse_held(settings.clone(), clock, stop)?;
    let mut ways = vec![("raw".to_owned(), Codec::Raw.mask())];
    let backend = &rig.config.projector.backend;
    let allowed = backend.compaction().filter(|_| !backend.is_mock());
    // The mock is measured both ways, too: its default is raw.
    let word = match allowed {
        Some(Compaction::RAW) => None,
        Some(Compaction::Only(_)) => Some(("as the rig file says".to_owned(), settings.codecs)),
        Some(Compaction::Auto) | None => Some(("auto".to_owned(), Codec::ALL)),
    };
    ways.extend(word);
    let mut report = LinkTestReport {
        medium: far.transport().name().to_owned(),
        raster: [rig.camera.raster.width(), rig.camera.raster.height()],
        planes: settings.schedule.len(),
        frame_rate_hz: settings.rate.hz(),
        content: content.name,
        ways: Vec::new(),
        stopped: false,
    };
    for (compaction, codecs) in ways {
        if stop() {
            break;
        }
        // Each way is a session of its own: an answer to the way before is not taken for one to this.
        let settings = LinkSettings { codecs, ..settings.clone() };
        let way = way(settings, compaction, far.transport(), clock, content, seconds, stop)?;
        report.ways.push(way);
    }
    report.stopped = stop();
    Ok(report)
}

fn way(
    settings: LinkSettings,
    compaction: String,
    transport: &mut dyn Transport,
    clock: MonotonicClock,
    content: &TestFrames,
    seconds: f64,
    stop: &dyn Fn() -> bool,
) -> Result<LinkWay, Failure> {
    let rate_hz = settings.rate.hz();
    let mut link = HostLink::new(settings);
    let mut now = || {
        std::thread::sleep(Duration::from_micros(200));
        clock.now()
    };
    let monitor = RunMonitor::default();
    connect(&mut link, transport, ENDED_WITH_THE_LAST_RUN, &monitor, &mut now, stop)
        .map_err(PipelineError::from)?;
    if monitor.take_found_safe() {
        let told = "the projector has latched SAFE; run its rig and say `dpm arm`";
        return Err(Failure::new(FailureKind::Device, format!("{}: {told}", transport.name())));
    }
    let duration_ns = (seconds * 1e9) as i64;
    let measured = measure(
        &mut link,
        transport,
        &|| clock.now(),
        &mut || std::thread::sleep(REST),
        &mut |n, planes| content.fill(n, planes),
        stop,
        duration_ns,
    );
    let mut shortest = None;
    link.take_echoes(|e| {
        let ns = e.host_received_at.ns_since(e.host_sent_at);
        shortest = Some(shortest.map_or(ns, |s: i64| s.min(ns)));
    });
    go_dark(&mut link, transport, clock);
    let m = measured.map_err(|e| Failure::from(PipelineError::Connect(e.into())))?;
    Ok(judge(compaction, rate_hz, &m, shortest))
}

/// STOP until the projector is dark, or its watchdog must do it.
fn go_dark(link: &mut HostLink, transport: &mut dyn Transport, clock: MonotonicClock) {
    let begin: HostTime = clock.now();
    let _ = link.command(begin, Verb::Stop, transport);
    while clock.now().ns_since(begin) < DARK_WITHIN_NS {
        let _ = link.poll(clock.now(), transport);
        if link.state() != LinkState::Streaming {
            break;
        }
        std::thread::sleep(Duration::from_millis(1));
    }
}

fn judge(compaction: String, rate_hz: f64, m: &LinkMeasurement, shortest_ns: Option<i64>) -> LinkWay {
    // Within a twentieth of the rig's rate is the rig's rate.
    let carried = m.frames_per_s >= 0.95 * rate_hz;
    let limited_by = match (carried, m.link_busy + m.no_credit) {
        (true, _) => "frame rate",
        (false, 0) => "host",
        (false, _) => "medium",
    };
    LinkWay {
        compaction,
        frames_per_s: m.frames_per_s,
        bytes_per_frame: m.bytes_per_frame,
        mb_per_s: m.bytes_per_frame * m.frames_per_s / 1e6,
        planes: m.planes,
        round_trip_us: shortest_ns.map(|ns| ns as f64 / 1e3),
        limited_by,
        allows_hz: if carried { rate_hz } else { m.frames_per_s.floor() },
    }
}

impl LinkTestReport {
    /// A table for people, with the advice that follows from it.
    pub fn to_table(&self) -> String {
        let mut out = format!(
            "{}: {} x {}, {} planes, {:.3} frames/s asked for, {} frames\n",
            self.medium, self.raster[0], self.raster[1], self.planes, self.frame_rate_hz, self.content
        );
        out += "compaction            frames/s  bytes/frame      MB/s  planes raw / coded / not sent\n";
        for w in &self.ways {
            let [raw, coded, kept] = w.planes;
            out += &format!(
                "{:<20} {:>9.1} {:>12.0} {:>9.1}  {raw} / {coded} / {kept}\n",
                w.compaction, w.frames_per_s, w.bytes_per_frame, w.mb_per_s
            );
        }
        for w in &self.ways {
            let said = if w.limited_by == "frame rate" {
                format!("carries the rig's {:.3} frames/s", self.frame_rate_hz)
            } else if w.allows_hz >= 1.0 {
                format!(
                    "allows projector.frame_rate = {:.0}; above it whole frames are dropped, newest wins",
                    w.allows_hz
                )
            } else {
                "carries less than a frame a second".into()
            };
            let host = if w.limited_by == "host" { " (the host's compaction is the limit)" } else { "" };
            out += &format!("{}: the link {said}{host}\n", w.compaction);
        }
        if self.stopped {
            out += "stopped before its time: the last figures stand for less\n";
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_device::link::DeviceState;
    use dpm_device::transport::inproc::Direct;
    use dpm_mock::projector::MockProjector;
    use dpm_rig::config::Overrides;
    use dpm_rig::order::Order;

    fn measured(frames_per_s: f64, link_busy: u64, no_credit: u64) -> LinkMeasurement {
        LinkMeasurement {
            duration_ns: 1_000_000_000,
            frames_sent: frames_per_s as u64,
            frames_whole: frames_per_s as u64,
            frames_per_s,
            bytes_per_frame: 1e6,
            planes: [1, 2, 3],
            link_busy,
            no_credit,
        }
    }

    #[test]
    fn a_busy_medium_sets_the_rate_and_a_full_device_does_not() {
        let slow = judge("raw".into(), 947.0, &measured(151.7, 900, 3), Some(80_000));
        assert_eq!((slow.limited_by, slow.allows_hz, slow.mb_per_s), ("medium", 151.0, 151.7));
        assert_eq!(slow.round_trip_us, Some(80.0));
        let fast = judge("auto".into(), 947.0, &measured(946.0, 2, 4000), None);
        assert_eq!((fast.limited_by, fast.allows_hz), ("frame rate", 947.0));
        // Nothing refused and yet too slow: the time went into compacting.
        let busy = judge("auto".into(), 947.0, &measured(666.6, 0, 0), None);
        assert_eq!((busy.limited_by, busy.allows_hz), ("host", 666.0));
    }

    /// Who was made dark at another port is not lit by a test either, and is not armed to be asked who it is.
    #[test]
    fn a_projector_for_which_an_order_stands_is_refused_by_its_serial_number() {
        let config = RigConfig::demo(&Overrides::default()).unwrap_or_else(|e| panic!("{e}"));
        let raster = Raster::new(16, 16).expect("a raster");
        let mock = MockConfig { serial: 7, ..MockConfig::new(raster) };
        let mut direct = Direct::new(MockProjector::new(mock));
        let mut asked = |held: u64| {
            let stands = |serial: u64| {
                let told = "since yesterday".to_owned();
                (serial == held).then_some(Stands { order: Order::Black, told, is_on_disk: true })
            };
            let mut at = 0;
            let mut now = || {
                at += 200_000;
                HostTime(at)
            };
            let settings = projector::link_settings(&config, raster);
            let answer = refuse_held(settings, &mut direct, &mut now, &|| false, &stands);
            assert!(!direct.device_mut().status().state.eq(&DeviceState::Armed), "nobody arms it");
            answer
        };
        let told = asked(7).expect_err("BLACK stands").to_string();
        assert!(told.contains("BLACK stands since yesterday") && told.contains("`dpm arm`"), "{told}");
        assert!(asked(8).is_ok());
    }

    #[test]
    fn content_goes_there_and_back() {
        let raster = dpm_device::planes::Raster::new(8, 1).unwrap();
        let schedule = dpm_device::planes::PlaneSchedule::mono8();
        let frames = (1..=3u8).map(|v| {
            let mut f = BitPlaneFrame::new(raster, schedule);
            f.bytes_mut().fill(v);
            f
        });
        let content = TestFrames { name: "prepared", frames: frames.collect() };
        let shown: Vec<u8> = (0..9)
            .map(|n| {
                let mut planes = [0; 8];
                content.fill(n, &mut planes);
                planes[0]
            })
            .collect();
        assert_eq!(shown, [1, 2, 3, 2, 1, 2, 3, 2, 1]);
        let one = TestFrames { frames: content.frames[..1].to_vec(), ..content };
        let mut planes = [0; 8];
        one.fill(77, &mut planes);
        assert_eq!(planes, [1; 8]);
    }
}
