//! What a seed plans: the rig, and one episode of faults after the other.

use crate::dice::Dice;
use crate::guard::Guard;
use crate::kinds::{Kind, State};
use crate::line::SerialSetup;
use crate::net::BodyMotion;
use crate::tracker_line::{LineSetup, POSE_BYTES};
use crate::tracker_stream::StreamSetup;
use dpm_device::cobs::encoded_bytes;
use dpm_device::link::{packet_bytes, COMMIT_BYTES};

/// The rates at which rigs run, frames per second.
pub const RATES: [u32; 6] = [24, 60, 120, 240, 947, 2000];

/// What a tracker speaks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TrackerKind {
    /// NatNet, by datagrams.
    NatNet,
    /// The serial pose stream.
    Serial,
    /// VRPN, by a connection.
    Vrpn,
}

impl TrackerKind {
    /// As given on the command line.
    pub fn word(self) -> &'static str {
        match self {
            Self::NatNet => "natnet",
            Self::Serial => "serial",
            Self::Vrpn => "vrpn",
        }
    }
}

/// The tracker of one life.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TrackerSetup {
    /// See [`TrackerKind::NatNet`].
    NatNet,
    /// See [`TrackerKind::Serial`].
    Serial(LineSetup),
    /// See [`TrackerKind::Vrpn`].
    Vrpn(StreamSetup),
}

impl TrackerSetup {
    /// What it speaks.
    pub fn kind(&self) -> TrackerKind {
        match self {
            Self::NatNet => TrackerKind::NatNet,
            Self::Serial(_) => TrackerKind::Serial,
            Self::Vrpn(_) => TrackerKind::Vrpn,
        }
    }
}

/// The shares of lives whose tracker hangs on a serial line, and of those whose tracker is a VRPN server.
const OTHER_TRACKERS: f64 = 1.0 / 5.0;
/// The bits per second at which trackers run.
const TRACKER_BAUDS: [u32; 5] = [115_200, 230_400, 921_600, 921_600, 3_000_000];

/// The tracker of `seed`, from a row of its own, so that a life with NatNet is what it was before there were others.
fn tracker_of(seed: u64, tracker_hz: u32, kind: Option<TrackerKind>) -> TrackerSetup {
    let mut dice = Dice::new(seed, 0x7ac3e);
    let share = dice.unit();
    let drawn = match share {
        _ if share < OTHER_TRACKERS => TrackerKind::Serial,
        _ if share < 2.0 * OTHER_TRACKERS => TrackerKind::Vrpn,
        _ => TrackerKind::NatNet,
    };
    let skew_ppb = dice.between(-80_000, 80_000) as i32;
    match kind.unwrap_or(drawn) {
        TrackerKind::NatNet => TrackerSetup::NatNet,
        TrackerKind::Serial => {
            // With a quarter to spare for what else is told.
            let needed = POSE_BYTES * 10 * i64::from(tracker_hz) * 5 / 4;
            let first = TRACKER_BAUDS.iter().position(|baud| i64::from(*baud) >= needed).unwrap_or(2);
            TrackerSetup::Serial(LineSetup {
                baud: dice.one_of(&TRACKER_BAUDS[first..]),
                timer_ns: dice.one_of(&[0, 0, 1_000_000, 1_000_000, 16_000_000]),
                skew_ppb,
                is_bus_powered: dice.happens(0.5),
            })
        }
        TrackerKind::Vrpn => TrackerSetup::Vrpn(StreamSetup { skew_ppb, each_body: dice.happens(0.5) }),
    }
}

/// The rig of one life.
#[derive(Clone, Debug)]
pub struct Setup {
    /// The seed of everything.
    pub seed: u64,
    /// Frames per second.
    pub rate_hz: u32,
    /// Planes of a frame.
    pub planes: u32,
    /// Samples of the tracker per second.
    pub tracker_hz: u32,
    /// What it speaks, over what.
    pub tracker: TrackerSetup,
    /// `safety.predict_ms`, if the rig file sets it.
    pub predict_ms: Option<u32>,
    /// GPU time of a frame in thousandths of a slot.
    pub render_milli: i64,
    /// Error of the projector's clock, parts per billion.
    pub clock_ppb: i32,
    /// Nanoseconds for a byte on the cable.
    pub ns_per_byte: i64,
    /// Travel time of the cable.
    pub travel_ns: i64,
    /// The projector follows tracks, and the host sends some.
    pub follows: bool,
    /// The projector hangs on a serial line.
    pub serial: Option<SerialSetup>,
    /// Mirrors in a row, and rows.
    pub raster: (u32, u32),
    /// How the body moves.
    pub motion: BodyMotion,
    /// The guard of the light that stands alone.
    pub alone: Option<Guard>,
    /// A machine on which a queue can keep itself standing, and a cable that can be too slow for every slot.
    pub strained: bool,
    /// Single calls to the tracker's and the projector's media fail.
    pub flaky: bool,
}

/// The share of lives whose projector follows tracks.
const FOLLOWING: f64 = 1.0 / 3.0;

/// The share of lives whose projector hangs on a serial line.
const ON_A_LINE: f64 = 1.0 / 5.0;
/// The rates that such a life draws from: a line is for few and small frames.
const LINE_RATES: [u32; 6] = [24, 24, 60, 60, 120, 240];
/// The bits per second that adapters run at.
const BAUDS: [u32; 6] = [115_200, 230_400, 460_800, 921_600, 3_000_000, 12_000_000];

/// The share of the other lives that are strained, and the highest rate of such a life: with shorter slots two frames are under
/// way at any time.
const STRAINED: f64 = 1.0 / 8.0;
const STRAINED_MOST_HZ: u32 = 1_000;

/// The share of lives without a guard that stands alone in which single calls fail.
const FLAKY: f64 = 1.0 / 4.0;

/// Bytes of a frame of `planes` planes on a serial line, if none of them can be compacted.
fn frame_bytes(raster: (u32, u32), planes: u32) -> u64 {
    let plane = (raster.0.div_ceil(8) * raster.1) as usize;
    let bytes =
        planes as usize * encoded_bytes(packet_bytes(plane)) + encoded_bytes(packet_bytes(COMMIT_BYTES));
    bytes as u64
}

/// What is drawn of a life on a serial line, from a row of its own, so that other lives are what they were before there
/// were any such lines.
struct OnALine {
    dice: Dice,
    rate_hz: u32,
    raster: (u32, u32),
}

impl OnALine {
    /// `None` for the other lives. Nobody sends tracks on a serial line, so a life that has to have tracks is none of
    /// these, and neither is one whose rate no line carries.
    fn drawn(seed: u64, rate_hz: Option<u32>, follows: Option<bool>, serial: Option<bool>) -> Option<Self> {
        let mut dice = Dice::new(seed, 0x5e71a);
        let is_drawn = dice.happens(ON_A_LINE);
        let drawn = dice.one_of(&LINE_RATES);
        let raster = dice.one_of(&[(16, 12), (16, 12), (8, 6)]);
        let is_one =
            serial.unwrap_or(is_drawn && follows != Some(true)) && rate_hz.is_none_or(|hz| hz <= 1_000);
        is_one.then(|| Self { dice, rate_hz: rate_hz.unwrap_or(drawn), raster })
    }

    /// A line that carries every frame of `planes` planes, with a tenth to spare for what else is told.
    fn line(&mut self, planes: u32) -> SerialSetup {
        let needed = frame_bytes(self.raster, planes) * 10 * u64::from(self.rate_hz) * 11 / 10;
        let first = BAUDS.iter().position(|baud| u64::from(*baud) >= needed).unwrap_or(BAUDS.len() - 1);
        let baud = BAUDS[(first + usize::from(self.dice.happens(0.5))).min(BAUDS.len() - 1)];
        SerialSetup {
            baud,
            can_flush: self.dice.happens(0.7),
            reply_late_ns: self.dice.one_of(&[0, 0, 1_000_000]),
        }
    }
}

impl Setup {
    /// The rig that `seed` describes. Others may decide its rate, whether its projector follows tracks, whether it hangs
    /// on a serial line, and what its tracker speaks.
    pub fn of(
        seed: u64,
        rate_hz: Option<u32>,
        follows: Option<bool>,
        serial: Option<bool>,
        tracker: Option<TrackerKind>,
    ) -> Self {
        let mut on_a_line = OnALine::drawn(seed, rate_hz, follows, serial);
        let rate_hz = on_a_line.as_ref().map_or(rate_hz, |line| Some(line.rate_hz));
        let mut dice = Dice::new(seed, 0x5e7);
        let drawn = dice.one_of(&RATES);
        let rate_hz = rate_hz.unwrap_or(drawn);
        let slot_us = 1_000_000 / i64::from(rate_hz);
        let tracker_hz = dice.one_of(&[120, 120, 120, 60, 240]);
        // A renderer of most rigs keeps up; that of every fourth needs up to three slots.
        let is_slow = dice.happens(0.25) && rate_hz <= 240;
        let render_milli = if is_slow { dice.between(950, 3_000) } else { dice.between(100, 700) };
        let planes = if rate_hz > 947 || dice.happens(0.7) { 8 } else { 24 };
        let serial = on_a_line.as_mut().map(|line| line.line(planes));
        let raster = on_a_line.as_ref().map_or((16, 12), |line| line.raster);
        let tracker = tracker_of(seed, tracker_hz, tracker);
        let sample_ms = match tracker {
            TrackerSetup::Serial(line) => line.pose_ns() / 1_000_000 + 1,
            TrackerSetup::NatNet | TrackerSetup::Vrpn(_) => 0,
        };
        let line_ms = serial.map_or(0, |line| {
            (frame_bytes(raster, planes) * 10_000 / u64::from(line.baud)) as i64
                + line.reply_late_ns / 1_000_000
        });
        // What a frame needs from sample to light, twice; else the rig would be dark by its own file.
        let needed_ms = (2 * (3 + 2_000 / i64::from(tracker_hz)) + 8 * slot_us / 1000 + 20)
            + slot_us * render_milli / 1_000_000 * 4
            + 2 * line_ms
            + 2 * sample_ms;
        let predict_ms = dice.happens(0.3).then(|| dice.between(needed_ms, 2 * needed_ms).min(1_000) as u32);
        // These have a row of their own, so that a life without tracks is what it was before there were any.
        let mut late = Dice::new(seed, 0x7ac);
        let drawn = late.happens(FOLLOWING);
        let turns = late.one_of(&[None, Some(10), Some(40)]);
        let follows = serial.is_none() && follows.unwrap_or(drawn);
        // Mirrors are small enough that a body can be elsewhere by some of them.
        let (raster, motion) = match turns {
            Some(acceleration) if follows => ((64, 48), BodyMotion::Turns(acceleration)),
            None if follows => ((64, 48), BodyMotion::Swings),
            _ => (raster, BodyMotion::Swings),
        };
        Self {
            follows,
            alone: None,
            strained: false,
            flaky: false,
            serial,
            raster,
            motion,
            seed,
            rate_hz,
            planes,
            tracker_hz,
            tracker,
            predict_ms,
            render_milli,
            clock_ppb: dice.between(-80_000, 80_000) as i32,
            ns_per_byte: dice.between(2, 40),
            travel_ns: dice.between(30, 250) * 1_000,
        }
    }
}

impl Setup {
    /// The same rig, strained if that is wanted or drawn, and if it can be: on a USB cable, without tracks, with a renderer that
    /// keeps up, and with the reach of prediction that follows from the rig. Others are what they were before there were any.
    pub fn strained(self, wanted: Option<bool>) -> Self {
        let drawn = Dice::new(self.seed, 0x57a1).happens(STRAINED);
        let can_be = !self.follows && self.serial.is_none() && self.rate_hz <= STRAINED_MOST_HZ;
        if !(can_be && wanted.unwrap_or(drawn)) {
            return self;
        }
        Self { strained: true, predict_ms: None, render_milli: self.render_milli.min(500), ..self }
    }

    /// The same rig, with single calls that fail if that is wanted or drawn. Others are what they were before there were any.
    pub fn flaky(self, wanted: Option<bool>) -> Self {
        let drawn = Dice::new(self.seed, 0xf1a4).happens(FLAKY);
        Self { flaky: wanted.unwrap_or(drawn), ..self }
    }

    /// Somebody with glasses stands in the beam, and is tracked.
    pub fn has_glasses(&self) -> bool {
        self.alone == Some(Guard::Eyes)
    }

    /// Bytes of a frame on the cable, if no plane is compacted.
    pub fn frame_bytes(&self) -> i64 {
        let plane = (self.raster.0.div_ceil(8) * self.raster.1) as usize;
        (self.planes as usize * packet_bytes(plane) + packet_bytes(COMMIT_BYTES)) as i64
    }
}

/// The rates of lives in which one guard stands alone: short slots would only be slower to simulate.
const ALONE_RATES: [u32; 3] = [60, 120, 240];

impl Setup {
    /// The rig of `seed` if `guard` stands alone: on a USB cable, without tracks, with a renderer that keeps up, and with the
    /// reach of prediction that follows from the rig.
    pub fn alone(seed: u64, rate_hz: Option<u32>, tracker: Option<TrackerKind>, guard: Guard) -> Self {
        let drawn = Dice::new(seed, 0xa10e7).one_of(&ALONE_RATES);
        // The head and the body come from one server, and the head covers a part of the picture only.
        let tracker = if guard == Guard::Eyes { Some(TrackerKind::NatNet) } else { tracker };
        let setup = Self::of(seed, rate_hz.or(Some(drawn)), Some(false), Some(false), tracker);
        let raster = if guard == Guard::Eyes { (96, 72) } else { setup.raster };
        let render_milli = setup.render_milli.min(700);
        Self { alone: Some(guard), predict_ms: None, render_milli, raster, ..setup }
    }
}

/// One fault of an episode.
#[derive(Clone, Copy, Debug)]
pub struct Planned {
    /// Its number in the life: what shrinking names.
    pub number: u32,
    /// Which.
    pub kind: Kind,
    /// How long after the state was reached, nanoseconds.
    pub after_ns: i64,
    /// Seed of its details.
    pub seed: u64,
}

/// Some faults in one state.
#[derive(Clone, Debug)]
pub struct Episode {
    /// The state in which they strike.
    pub state: State,
    /// How the rig is brought there.
    pub way: u64,
    /// The faults, one to four.
    pub faults: Vec<Planned>,
    /// How long the rig runs in peace before it, nanoseconds.
    pub rest_ns: i64,
    /// How long after the last fault a person clears up, nanoseconds.
    pub person_ns: i64,
}

/// The endless row of a life's episodes.
pub struct Episodes {
    dice: Dice,
    cells: Vec<(State, Kind)>,
    kinds: Vec<Kind>,
    /// Those that strike first in an episode.
    first: Vec<Kind>,
    tracker: TrackerKind,
    /// Now and then a long rest comes before an episode, in which the laws of peace are judged.
    rests: Option<Dice>,
    next: u32,
}

/// The long rest, and its share of episodes.
const REST_NS: i64 = 6_000_000_000;
/// See [`REST_NS`].
const RESTING: f64 = 0.03;

impl Episodes {
    /// The episodes of a life. Each begins with one of the kinds `first`, of which those count that can strike this life;
    /// if none can, with one of all kinds.
    pub fn new(setup: &Setup, first: &[Kind]) -> Self {
        let tracker = setup.tracker.kind();
        let all = Kind::ALL.iter().copied();
        let kinds = all
            .filter(|kind| setup.follows || !kind.needs_tracks())
            .filter(|kind| setup.serial.is_some() || !kind.needs_line())
            .filter(|kind| setup.strained || !kind.needs_strain())
            .filter(|kind| setup.flaky || !kind.needs_flakiness())
            .filter(|kind| tracker == TrackerKind::Vrpn || !kind.needs_connection())
            .filter(|kind| setup.alone.map_or(!kind.needs_guard(), |guard| guard.kinds().contains(kind)))
            .collect::<Vec<_>>();
        let wanted = |kind: &Kind| first.contains(kind) && kind.strikes(tracker);
        let mut first: Vec<Kind> = kinds.iter().copied().filter(wanted).collect();
        if first.is_empty() {
            first.clone_from(&kinds);
        }
        let dice = Dice::new(setup.seed, 0xe915);
        let rests = setup.follows.then(|| Dice::new(setup.seed, 0x4e57));
        Self { dice, cells: Vec::new(), kinds, first, tracker, rests, next: 0 }
    }

    /// Whether a kind can strike this life in `state`.
    fn can_strike(&self, kind: Kind, state: State) -> bool {
        kind.impossible(state).is_none() && kind.strikes(self.tracker)
    }

    /// The next pair of state and kind: each comes once before any comes again.
    fn cell(&mut self) -> (State, Kind) {
        if self.cells.is_empty() {
            for state in State::ALL {
                let possible = self.first.iter().filter(|kind| self.can_strike(**kind, state));
                let possible: Vec<(State, Kind)> = possible.map(|kind| (state, *kind)).collect();
                self.cells.extend(possible);
            }
            for i in (1..self.cells.len()).rev() {
                let j = self.dice.bits() as usize % (i + 1);
                self.cells.swap(i, j);
            }
        }
        self.cells.pop().unwrap_or((State::Running, Kind::T1))
    }

    /// The next episode.
    pub fn next_episode(&mut self) -> Episode {
        let (state, first) = self.cell();
        let count = [1, 1, 1, 2, 2, 3, 4][self.dice.bits() as usize % 7];
        // States that pass quickly are struck quickly.
        let longest = match state {
            State::Arming => 6_000_000,
            State::ShuttingDown => 4_000_000,
            State::RePlugging | State::Dark => 60_000_000,
            _ => 150_000_000,
        };
        let mut faults = Vec::new();
        for i in 0..count {
            let mut kind = first;
            if i > 0 {
                kind = self.dice.one_of(&self.kinds);
                if !self.can_strike(kind, state) {
                    continue;
                }
            }
            let after_ns = if i == 0 { longest / 20 } else { self.dice.between(0, longest) };
            faults.push(Planned { number: self.next, kind, after_ns, seed: self.dice.bits() });
            self.next += 1;
        }
        let mut episode = Episode {
            state,
            way: self.dice.bits(),
            faults,
            rest_ns: self.dice.between(20, 250) * 1_000_000,
            person_ns: self.dice.between(5, 200) * 1_000_000,
        };
        if self.rests.as_mut().is_some_and(|dice| dice.happens(RESTING)) {
            episode.rest_ns = REST_NS;
        }
        episode
    }
}
