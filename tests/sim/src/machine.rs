//! The host's machine: how long its stages take, and what its GPU does.

use crate::cable::lock;
use crate::dice::Dice;
use crate::eyes::{GLASSES, GLASSES_NUMBER};
use crate::net::{Net, SimSocket};
use crate::plan::TrackerSetup;
use crate::tracker_line::PortOpener;
use crate::tracker_stream::{ServerOpener, TRACKER};
use dpm_device::time::{DeviceTicks, HostClock, HostTime};
use dpm_device::tracker::natnet::client::{NatNetClient, NatNetConfig};
use dpm_device::tracker::serial::client::{SerialTracker, SerialTrackerConfig};
use dpm_device::tracker::vrpn::client::{VrpnClient, VrpnConfig};
use dpm_device::tracker::{BodyKey, Tracker};
use dpm_render::gpu::{GpuError, MemoryPool};
use dpm_rig::pipeline::stepped::{GpuWork, Machine, RunPart, SentFrame, Takes};
use glam::DAffine3;
use std::collections::VecDeque;
use std::net::Ipv4Addr;
use std::sync::atomic::{AtomicI64, Ordering};
use std::sync::{Arc, Mutex};

/// Quantiles of a stage's time in microseconds: of 50, 99 and 99.9 percent of the steps, and the greatest. Those of
/// plan, pack and link were measured by `dpm profile --no-render`, see docs/lab/SIMULATOR.md; those of tracking and of
/// the collector, which the profile does not have, are assumed.
type Quantiles = [i64; 4];

const PLAN_US: Quantiles = [2, 21, 85, 177];
const PACK_US: Quantiles = [166, 418, 2_816, 5_600];
const LINK_US: Quantiles = [169, 496, 3_355, 6_700];
const TRACKING_US: Quantiles = [6, 40, 120, 600];
const COLLECTOR_US: Quantiles = [20, 300, 2_000, 9_000];

/// Draws a time from quantiles, in nanoseconds.
fn drawn(dice: &mut Dice, quantiles: Quantiles) -> i64 {
    let at = dice.between(0, 999_999);
    let steps = [(0, 500_000), (500_000, 990_000), (990_000, 999_000), (999_000, 1_000_000)];
    let mut low = quantiles[0] / 2;
    for ((from, to), high) in steps.into_iter().zip(quantiles) {
        if at < to {
            return 1000 * low + 1000 * (high - low) * (at - from) / (to - from);
        }
        low = high;
    }
    1000 * low
}

/// A fault that the next step of a stage meets.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Trap {
    /// It stalls for so many nanoseconds.
    Stalls(i64),
    /// It never returns.
    Hangs,
    /// It panics.
    Panics,
}

/// Memory that is too slow for every slot for a moment, and caches that do not hold several frames: stages are slower the more
/// frames are under way, so that a queue keeps itself standing.
#[derive(Clone, Copy, Debug)]
pub struct Queue {
    /// Until then packing and the link take longer by `slow_ns`. Host's clock.
    pub until: HostTime,
    /// See `until`.
    pub slow_ns: i64,
    /// Both take so much longer for each frame beyond the first, of three at most.
    pub crowd_ns: i64,
}

/// As many frames under way are a queue.
const QUEUE: i64 = 3;

/// A fault that the next frame meets on the GPU.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum GpuTrap {
    /// The frame takes so many nanoseconds longer.
    Late(i64),
    /// It never finishes.
    Hangs,
    /// The device is lost.
    Lost,
}

/// A fault that the next opening of the GPU meets.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OpenTrap {
    /// There is no device.
    Absent,
    /// Its memory does not suffice.
    OutOfMemory,
}

/// What the link accepted, for the oracles.
#[derive(Clone, Debug, Default)]
pub struct Sent {
    /// Low 32 bits of its number.
    pub frame: u32,
    /// Which process sent it.
    pub process: u64,
    /// Instants of the host's clock.
    pub sent_at: i64,
    /// Begin of its slot on the host's clock.
    pub due_at: i64,
    /// Mid-exposure of its oldest pose; `None` if it is dark.
    pub captured_at: Option<i64>,
    /// The prediction that it was allowed.
    pub predict_ns: i64,
    /// Position of the body for which it was drawn.
    pub position: [f64; 3],
    /// Begin of its slot on the projector's clock.
    pub target_at: DeviceTicks,
    /// From then on there is no light of it, on the projector's clock.
    pub dark_from: DeviceTicks,
    /// Pose of the body for which it was drawn, as a whole, and its instant on the host's clock.
    pub pose: DAffine3,
    /// See `pose`.
    pub centre_at: HostTime,
    /// Poses for which its first and last planes were drawn, and their instants.
    pub swept: [DAffine3; 2],
    /// See `swept`.
    pub ends: [HostTime; 2],
    /// A hash of its planes.
    pub hash: u64,
}

impl Sent {
    /// Pose of the body for which planes are drawn that are lit at `at` of the host's clock.
    pub fn pose_at(&self, at: HostTime) -> DAffine3 {
        let exposure_ns = self.ends[1].ns_since(self.ends[0]).max(1);
        let share = at.ns_since(self.centre_at) as f64 / exposure_ns as f64;
        let [first, last] = self.swept;
        DAffine3 {
            matrix3: self.pose.matrix3 + (last.matrix3 - first.matrix3) * share,
            translation: self.pose.translation + (last.translation - first.translation) * share,
        }
    }
}

/// A hash of planes that is cheap enough for every frame.
pub fn hash(planes: &[u8]) -> u64 {
    planes.chunks(8).fold(0x9e37_79b9_7f4a_7c15, |h: u64, chunk| {
        let mut word = [0; 8];
        word[..chunk.len()].copy_from_slice(chunk);
        let h = (h ^ u64::from_le_bytes(word)).wrapping_mul(0xff51_afd7_ed55_8ccd);
        h ^ h >> 29
    })
}

/// State of the machine, shared by the world and the run.
#[derive(Debug)]
pub struct Beneath {
    dice: Dice,
    /// Traps by stage.
    pub traps: Vec<(RunPart, Trap)>,
    /// Traps of the GPU's next frames.
    pub gpu_traps: VecDeque<GpuTrap>,
    /// Traps of the GPU's next openings.
    pub open_traps: VecDeque<OpenTrap>,
    /// Number of the process.
    pub process: u64,
    /// Stages take longer by this factor, in thousandths.
    pub load_milli: i64,
    /// Steps of the link take so much longer, nanoseconds.
    pub link_late_ns: i64,
    /// How often a stage met a trap, a frame one of the GPU, and an opening of it one.
    pub met: [u64; 3],
    /// Steps that took longer because the machine was busy.
    pub slowed: u64,
    /// What lets a queue stand.
    pub queue: Option<Queue>,
    /// The newest frames that planning and the link have worked on: those between them are under way.
    newest: [u64; 2],
    /// Steps that met a queue whose cause was over.
    pub queued: u64,
    /// The GPU's time of a usual frame, nanoseconds.
    pub frame_ns: i64,
    /// Frames that were sent and not looked at yet.
    pub sent: VecDeque<Sent>,
    /// When the last crew was ready, host's clock.
    pub crew_ready_at: i64,
    /// How often a crew was made.
    pub crews: u64,
}

impl Beneath {
    /// A machine whose GPU takes `frame_ns` for a frame.
    pub fn new(seed: u64, frame_ns: i64) -> Self {
        Self {
            dice: Dice::new(seed, 0x6d61),
            traps: Vec::new(),
            gpu_traps: VecDeque::new(),
            open_traps: VecDeque::new(),
            process: 0,
            load_milli: 1000,
            link_late_ns: 0,
            met: [0; 3],
            slowed: 0,
            queue: None,
            newest: [0; 2],
            queued: 0,
            frame_ns,
            sent: VecDeque::new(),
            crew_ready_at: 0,
            crews: 0,
        }
    }

    /// How much longer a step of `part` takes that works on `frame`, where a queue can stand.
    fn crowded_ns(&mut self, part: RunPart, frame: u64, now: HostTime) -> i64 {
        match part {
            RunPart::Plan => self.newest[0] = frame,
            RunPart::Link if frame > 0 => self.newest[1] = frame,
            _ => {}
        }
        let (Some(queue), RunPart::Pack | RunPart::Link) = (self.queue, part) else { return 0 };
        if frame == 0 {
            return 0;
        }
        let under_way = self.newest[0].saturating_sub(self.newest[1]) as i64;
        let is_slow = now < queue.until;
        self.queued += u64::from(!is_slow && under_way >= QUEUE);
        queue.crowd_ns * (under_way - 1).clamp(0, 3) + if is_slow { queue.slow_ns } else { 0 }
    }

    /// A new process does not meet the traps of the old one.
    pub fn new_process(&mut self) {
        self.process += 1;
        self.traps.clear();
        self.gpu_traps.clear();
        self.newest = [0; 2];
    }
}

/// The run's view of the machine.
pub struct SimMachine {
    /// The machine.
    pub beneath: Arc<Mutex<Beneath>>,
    /// The tracker's network.
    pub net: Arc<Mutex<Net>>,
    /// What the tracker speaks.
    pub tracker: TrackerSetup,
    /// Somebody with glasses is tracked, too.
    pub has_glasses: bool,
    /// Host's clock now.
    pub clock: Arc<AtomicI64>,
    /// True time minus the host's clock.
    pub lag: Arc<AtomicI64>,
}

fn device() -> Arc<str> {
    "simulated GPU".into()
}

impl Machine for SimMachine {
    fn takes(&mut self, part: RunPart, frame: u64, now: HostTime) -> Takes {
        let mut beneath = lock(&self.beneath);
        let quantiles = match part {
            RunPart::Tracking => TRACKING_US,
            RunPart::Plan => PLAN_US,
            RunPart::Pack => PACK_US,
            RunPart::Link => LINK_US,
            RunPart::Collector => COLLECTOR_US,
        };
        let load_milli = beneath.load_milli;
        let late_ns = if part == RunPart::Link { beneath.link_late_ns } else { 0 };
        let crowded_ns = beneath.crowded_ns(part, frame, now);
        let ns = drawn(&mut beneath.dice, quantiles) * load_milli / 1000 + late_ns + crowded_ns;
        beneath.slowed += u64::from(load_milli != 1000);
        if !beneath.traps.is_empty() {
            if let Some(i) = beneath.traps.iter().position(|(of, _)| *of == part) {
                beneath.met[0] += 1;
                return match beneath.traps.remove(i).1 {
                    Trap::Stalls(more) => Takes::Ns(ns + more),
                    Trap::Hangs => Takes::Forever,
                    Trap::Panics => Takes::Panics,
                };
            }
        }
        Takes::Ns(ns)
    }

    fn renders(&mut self, _: u64, _: HostTime) -> GpuWork {
        let mut beneath = lock(&self.beneath);
        let spread = beneath.dice.between(900, 1_100);
        let ns = beneath.frame_ns * spread / 1000 * beneath.load_milli.min(2_000) / 1000;
        let trap = beneath.gpu_traps.pop_front();
        beneath.met[1] += u64::from(trap.is_some());
        match trap {
            None => GpuWork::After(ns),
            Some(GpuTrap::Late(more)) => GpuWork::After(ns + more),
            Some(GpuTrap::Hangs) => GpuWork::Never,
            Some(GpuTrap::Lost) => {
                GpuWork::Lost(ns, GpuError::DeviceLost { operation: "rendering", device: device() })
            }
        }
    }

    fn makes_crew(&mut self, with_gpu: bool, now: HostTime) -> (i64, Result<i64, GpuError>) {
        let mut beneath = lock(&self.beneath);
        let takes_ns = if with_gpu { beneath.dice.between(80, 700) } else { beneath.dice.between(5, 40) };
        let takes_ns = takes_ns * 1_000_000;
        beneath.crew_ready_at = now.0 + takes_ns;
        beneath.crews += 1;
        let trap = with_gpu.then(|| beneath.open_traps.pop_front()).flatten();
        beneath.met[2] += u64::from(trap.is_some());
        let made = match trap {
            None => Ok(beneath.frame_ns),
            Some(OpenTrap::Absent) => Err(GpuError::NoDevice { found: "none".into(), needed: "one".into() }),
            Some(OpenTrap::OutOfMemory) => Err(GpuError::OutOfMemory {
                operation: "making a buffer".into(),
                device: device(),
                pool: MemoryPool::Device,
                needed_mib: Some(1),
                heap_mib: 1,
            }),
        };
        (takes_ns, made)
    }

    fn opens_tracker(&mut self, _: HostTime) -> Box<dyn Tracker> {
        lock(&self.net).new_socket();
        let clock = self.clock.clone();
        let clock: Arc<dyn HostClock> = Arc::new(move || HostTime(clock.load(Ordering::Relaxed)));
        match self.tracker {
            TrackerSetup::NatNet => self.natnet(clock),
            TrackerSetup::Serial(line) => {
                let (port, bodies) = ("/dev/tracker".into(), vec![BodyKey { name: "a".into(), id: None }]);
                let config = SerialTrackerConfig { port, baud: line.baud, bodies };
                let opener = Box::new(PortOpener(self.net.clone()));
                Box::new(SerialTracker::open_through(config, clock, opener).expect("the port has a name"))
            }
            TrackerSetup::Vrpn(_) => {
                let bodies = vec![BodyKey { name: "a".into(), id: None }];
                let config = VrpnConfig { server: "10.0.0.2".into(), tracker: TRACKER.into(), bodies };
                let opener = Box::new(ServerOpener(self.net.clone()));
                Box::new(VrpnClient::open_through(config, clock, opener).expect("the server has a name"))
            }
        }
    }

    fn next_sample_at(&self, _: HostTime) -> HostTime {
        HostTime(lock(&self.net).next_arrival().saturating_sub(self.lag.load(Ordering::Relaxed)))
    }

    fn sent(&mut self, frame: &SentFrame<'_>) {
        let mut beneath = lock(&self.beneath);
        let process = beneath.process;
        let pose = frame.poses.first().copied().unwrap_or(DAffine3::IDENTITY);
        let swept = frame.swept.map(|poses| poses.first().copied().unwrap_or(pose));
        let position = pose.translation.to_array();
        beneath.sent.push_back(Sent {
            frame: frame.frame,
            process,
            sent_at: frame.sent_at.0,
            due_at: frame.due_at.0,
            captured_at: frame.captured_at.map(|at| at.0),
            predict_ns: frame.predict_ns,
            position,
            target_at: frame.target_at,
            dark_from: frame.dark_from,
            pose,
            centre_at: frame.centre_at,
            swept,
            ends: frame.swept_at,
            hash: hash(frame.planes),
        });
    }
}

impl SimMachine {
    fn natnet(&self, clock: Arc<dyn HostClock>) -> Box<dyn Tracker> {
        let glasses = BodyKey { name: GLASSES.into(), id: Some(GLASSES_NUMBER.into()) };
        let glasses = self.has_glasses.then_some(glasses);
        let bodies = [BodyKey { name: "a".into(), id: Some(1) }].into_iter().chain(glasses).collect();
        let config = NatNetConfig {
            local: Ipv4Addr::new(10, 0, 0, 1),
            ..NatNetConfig::unicast(Ipv4Addr::new(10, 0, 0, 2), bodies)
        };
        Box::new(NatNetClient::with_ports(config, clock, Box::new(SimSocket(self.net.clone())), None))
    }
}
