//! The clock, and everything that it moves: process, cable, projector, tracker, disk, service manager and person.

use crate::cable::{lock, Cable};
use crate::dice::Dice;
use crate::disk::Disk;
use crate::eyes::EyeLaw;
use crate::guard::{bare_arm, damage, first_packet, of_another_host, session, word_of_another_host, Guard};
use crate::kinds::{Kind, State};
use crate::laws::{Laws, BEGINS_WITHIN_NS};
use crate::line::SerialLine;
use crate::machine::{Beneath, SimMachine, Trap};
use crate::net::{Net, ServerKind};
use crate::plan::{Episode, Setup, TrackerSetup};
use crate::process::{Exit, Process, SimContact};
use crate::table::Table;
use crate::tracks::TrackLaws;
use dpm_device::link::{faults, DeviceState, Status};
use dpm_device::planes::Raster;
use dpm_device::time::HostTime;
use dpm_device::transport::{Lane, LinkDevice};
use dpm_rig::config::{Overrides, Restart, RigConfig};
use dpm_rig::control::osc::decode::OscRequest;
use dpm_rig::control::osc::Doorkeeper;
use dpm_rig::order::Order;
use dpm_rig::pipeline::stepped::RunPart;
use dpm_rig::rig::Rig;
use dpm_rig::telemetry::monitor::ProjectorHealth;
use dpm_rig::telemetry::projector::ProjectorReport;
use hil_mock::projector::serial::SerialEnd;
use hil_mock::projector::{DeviceClock, MockConfig, MockProjector, GREATEST_SHIFT};
use std::cmp::Reverse;
use std::collections::{BinaryHeap, VecDeque};
use std::net::{IpAddr, Ipv4Addr};
use std::path::Path;
use std::sync::atomic::{AtomicI64, Ordering};
use std::sync::{Arc, Mutex};

/// A millisecond in nanoseconds.
pub const MS: i64 = 1_000_000;
/// A second in nanoseconds.
pub const S: i64 = 1_000 * MS;
/// Interval of the checks that no event triggers.
const TICK_NS: i64 = 100 * MS;
/// The service manager starts a failed program again after this time.
const RESTART_NS: i64 = S;
/// It gives up after this many starts ...
const STARTS: usize = 5;
/// ... within this time.
const STARTS_WITHIN_NS: i64 = 60 * S;
/// How often a person who clears up looks again.
const PERSON_NS: i64 = 300 * MS;
/// How often a neighbour disturbs the cable, where one does ...
const DISTURB_NS: i64 = 7 * MS;
/// ... and for how long after the program has fallen silent: as many damaged packets as the projector bears.
const DISTURBS_NS: i64 = 2 * S;
/// Who may send OSC, and with which token more than darkness; and somebody else.
const OSC_DESK: IpAddr = IpAddr::V4(Ipv4Addr::new(10, 0, 0, 5));
const OSC_STRANGER: IpAddr = IpAddr::V4(Ipv4Addr::new(10, 0, 0, 6));
/// See [`OSC_DESK`].
pub(crate) const OSC_TOKEN: &str = "curtain";
/// Slots of which the shifts wait to be judged.
const MOVES_KEPT: usize = 64;

/// What happens at a planned instant.
#[derive(Clone, Debug)]
pub enum Action {
    /// A fault strikes.
    Strike(Kind, u64),
    /// A fault ends.
    End(usize),
    /// The person gives an order.
    Give(Order),
    /// The program is asked to stop.
    Stop,
    /// The program is killed.
    Kill,
    /// The person clears up.
    ClearUp,
    /// Another step of a fault that has several: the second host speaks, the plug wiggles.
    Again(Kind, u64, u32),
    /// The next episode begins.
    Episode,
    /// A neighbour disturbs the cable.
    Disturb,
    /// Somebody sends an ARM that acknowledges nothing.
    BareArm,
    /// The interlock's contact is in this state from now on.
    Contact(u8),
    /// The faults of the episode strike although its state was not reached.
    Overdue(u32),
}

/// How a fault is undone.
#[derive(Clone, Debug)]
pub enum Undo {
    /// It ends by itself.
    Nothing,
    /// The network is as it should be.
    Net,
    /// The tracker's adapter is plugged in, and its line is as it should be.
    TrackerPlug,
    /// The first server comes back.
    Server,
    /// The cable is as it should be.
    Cable,
    /// The plug is pushed in.
    Plug,
    /// The projector that belongs here is plugged in again.
    Projector,
    /// The causes of its faults are gone.
    Heat,
    /// The disk is as it should be.
    Disk,
    /// All calls succeed.
    Calls,
    /// Orders get through.
    Orders,
    /// The machine is as quick as before.
    Load,
    /// The caches hold all frames again.
    Queue,
    /// What no stage has met by now, none will meet.
    Traps,
    /// The rig file is right again.
    File,
}

/// A fault that lasts.
#[derive(Clone, Debug)]
pub struct Active {
    /// Which.
    pub kind: Kind,
    /// How it ends.
    pub undo: Undo,
    /// The state in which it struck, and what had been seen of its kind before; `None` for what only brings the rig into a
    /// state.
    pub struck: Option<Struck>,
}

/// A fault whose effect is looked for.
#[derive(Clone, Copy, Debug)]
pub struct Struck {
    state: State,
    seen_before: u64,
}

/// What the world has seen of faults of the process.
#[derive(Clone, Copy, Debug, Default)]
struct Met {
    kills: u64,
    stops: u64,
    orders: u64,
    refused_files: u64,
    /// Times that the program's machine or the program itself stood still, or had its clock set.
    stands: u64,
    steps: u64,
    /// Times that the interlock opened while the program ran, and datagrams of OSC that it heard.
    contacts: u64,
    datagrams: u64,
    /// Words that acknowledged nothing of what the projector had latched, and orders while the light rested.
    bare_arms: u64,
    rests: u64,
}

/// Everything.
pub struct World {
    /// True time, nanoseconds.
    pub t: i64,
    /// The rig.
    pub setup: Setup,
    pub(crate) rig: Arc<Rig>,
    /// The same, started by a person who acknowledges the projector's faults.
    rig_by_hand: Arc<Rig>,
    /// The next start is a person's.
    by_hand: bool,
    pub(crate) cable: Arc<Mutex<Cable>>,
    pub(crate) net: Arc<Mutex<Net>>,
    pub(crate) beneath: Arc<Mutex<Beneath>>,
    pub(crate) disk: Arc<Mutex<Disk>>,
    /// The interlock's contact, and who lets light return; `None` where there is no interlock.
    pub(crate) contact: Option<(SimContact, Restart)>,
    clock: Arc<AtomicI64>,
    lag: Arc<AtomicI64>,
    pub(crate) projector: MockProjector,
    /// Its end of a serial line.
    pub(crate) far: Option<SerialEnd>,
    /// The projector that belongs here, while another one is in its place.
    pub(crate) aside: Option<MockProjector>,
    pub(crate) process: Option<Process>,
    /// The process does not run until then (stopped, or the machine is suspended).
    pub(crate) frozen_until: i64,
    /// By when every frame that hangs on the GPU will have been found.
    pub(crate) gpu_hangs_until: i64,
    restart_at: i64,
    starts: VecDeque<i64>,
    /// Nobody starts the program but a person.
    pub(crate) needs_person: bool,
    /// The rig file, or a scene, is wrong.
    pub(crate) bad_file: bool,
    actions: BinaryHeap<Reverse<(i64, u64)>>,
    planned: Vec<Option<Action>>,
    free: Vec<usize>,
    next_action: u64,
    /// Faults that last, by number.
    pub(crate) active: Vec<Option<Active>>,
    episode: Option<(Episode, bool)>,
    episodes_begun: u32,
    /// When the last fault ended, or the person last did something.
    pub(crate) calm_since: i64,
    /// A person is clearing up since.
    clearing_since: Option<i64>,
    /// A person has ordered ARM again and again since.
    arming_since: Option<i64>,
    tick_at: i64,
    /// The laws.
    pub laws: Laws,
    /// Those of tracks, if the projector follows any.
    pub tracks: Option<TrackLaws>,
    /// Kinds by state.
    pub table: Table,
    /// Events so far.
    pub events: u64,
    /// A hash of all that happened.
    pub trace: u64,
    /// The last things that happened, for a person.
    pub story: VecDeque<String>,
    /// Print what happens.
    pub is_loud: bool,
    met: Met,
    striking: Option<Struck>,
    /// A packet that a neighbour has overheard, and its session.
    overheard: Vec<u8>,
    session: u32,
    neighbour: Dice,
}

/// The folder of the scene.
const ASSETS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/assets");

fn rig_of(setup: &Setup, acknowledges: bool) -> Result<Rig, String> {
    let tracks = if setup.follows { "tracks = \"auto\"\nhorizontal_fov_deg = 20\n" } else { "" };
    let predict = setup.predict_ms.map_or(String::new(), |ms| format!("predict_ms = {ms}\n"));
    let watchdog = setup.alone.and_then(Guard::watchdog_ms);
    let watchdog = watchdog.map_or(String::new(), |ms| format!("watchdog_ms = {ms}\n"));
    let keys = setup.alone.map_or(String::new(), |guard| guard.keys(setup.planes));
    let backend = match setup.serial {
        Some(line) => format!("kind = \"serial\", port = \"/dev/simulated\", baud = {}", line.baud),
        None => "kind = \"usb\"".into(),
    };
    let tracker = match setup.tracker {
        TrackerSetup::NatNet => "kind = \"natnet\"\nserver = \"10.0.0.2\"\nlocal = \"10.0.0.1\"".into(),
        TrackerSetup::Serial(line) => {
            format!("kind = \"serial\"\nport = \"/dev/tracker\"\nbaud = {}", line.baud)
        }
        TrackerSetup::Vrpn(_) => "kind = \"vrpn\"\nserver = \"10.0.0.2\"".into(),
    };
    let text = format!(
        "[tracker]\n{tracker}\nrate_hz = {}\n\
         [projector]\nwidth = {}\nheight = {}\nplanes = {}\nframe_rate = {}\nbackend = {{ {backend} }}\n{tracks}\
         [scene]\nfile = \"triangle.gltf\"\n[[scene.bodies]]\nname = \"a\"\n[safety]\nacknowledge_faults = {acknowledges}\n{predict}{watchdog}{keys}",
        setup.tracker_hz, setup.raster.0, setup.raster.1, setup.planes, setup.rate_hz
    );
    let config = RigConfig::parse("simulated.toml", &text, Path::new(ASSETS), &Overrides::default())
        .map_err(|e| e.to_string())?;
    Rig::build(&config, None).map_err(|e| e.to_string())
}

/// A projector as it left the factory.
pub(crate) fn projector_of(setup: &Setup, raster: Option<Raster>, now: i64) -> Result<MockProjector, String> {
    let own = Raster::new(setup.raster.0, setup.raster.1).ok_or("no raster")?;
    let mut config = MockConfig::new(raster.unwrap_or(own));
    config.events_kept = 64;
    if setup.follows {
        (config.greatest_shift, config.moves_kept) = (Some(GREATEST_SHIFT), MOVES_KEPT);
    }
    config.clock = DeviceClock {
        skew_ppb: setup.clock_ppb,
        power_on_at: HostTime(now),
        start_ticks: (setup.seed % 7) * 1_000_000_000,
        ..DeviceClock::IDEAL
    };
    Ok(MockProjector::new(config))
}

impl World {
    /// The world of `setup`, with the program about to be started.
    ///
    /// # Errors
    /// The rig cannot be built, which is a mistake in this program.
    pub fn new(setup: Setup) -> Result<Self, String> {
        let rig = Arc::new(rig_of(&setup, false)?);
        let rig_by_hand = Arc::new(rig_of(&setup, true)?);
        let kind = server_kind(&setup);
        let slot_ns = S / i64::from(setup.rate_hz);
        let seed = setup.seed;
        let mut cable = Cable::new(seed, setup.ns_per_byte, setup.travel_ns);
        cable.keeps_order = setup.follows;
        let stretch_ns = setup.alone.map_or(0, Guard::stretches_ns) as u64;
        cable.stretch = stretch_ns / 1000 * u64::from(DeviceClock::IDEAL.tick_hz) / 1_000_000;
        cable.line = setup.serial.map(|line| SerialLine::new(seed, line, setup.travel_ns));
        let mut laws = Laws::new(&rig, &setup);
        laws.eyes = (setup.alone == Some(Guard::Eyes)).then(|| EyeLaw::new(&rig)).transpose()?;
        let tracks = setup.follows.then(|| TrackLaws::new(&rig, &setup)).transpose()?;
        let projector = projector_of(&setup, None, 0)?;
        let mut beneath = Beneath::new(seed, slot_ns * setup.render_milli / 1000);
        beneath.link_late_ns = setup.alone.map_or(0, |guard| guard.link_late_ns(slot_ns));
        let mut world = Self {
            t: 0,
            far: setup.serial.map(|_| SerialEnd::new(&projector)),
            cable: Arc::new(Mutex::new(cable)),
            net: Arc::new(Mutex::new(Net::new(seed, kind, setup.tracker)?)),
            beneath: Arc::new(Mutex::new(beneath)),
            disk: Arc::default(),
            contact: (setup.alone == Some(Guard::Interlock)).then(|| {
                let reset = if seed.is_multiple_of(2) { Restart::ByHand } else { Restart::ByItself };
                (SimContact::default(), reset)
            }),
            clock: Arc::default(),
            lag: Arc::default(),
            projector,
            aside: None,
            process: None,
            frozen_until: 0,
            gpu_hangs_until: 0,
            restart_at: 10 * MS,
            starts: VecDeque::new(),
            needs_person: false,
            bad_file: false,
            actions: BinaryHeap::new(),
            planned: Vec::new(),
            free: Vec::new(),
            next_action: 0,
            active: Vec::new(),
            episode: None,
            episodes_begun: 0,
            calm_since: 0,
            clearing_since: None,
            arming_since: None,
            tick_at: TICK_NS,
            laws,
            tracks,
            table: Table::default(),
            events: 0,
            trace: seed,
            story: VecDeque::new(),
            is_loud: false,
            rig,
            rig_by_hand,
            by_hand: false,
            met: Met::default(),
            striking: None,
            overheard: Vec::new(),
            session: 0,
            neighbour: Dice::new(seed, 0xa10e8),
            setup,
        };
        if world.setup.alone == Some(Guard::Watchdog) {
            world.plan(DISTURB_NS, Action::Disturb);
        }
        Ok(world)
    }

    /// The host's clock now.
    pub fn host(&self) -> i64 {
        self.t - self.lag.load(Ordering::Relaxed)
    }

    pub(crate) fn lag_by(&mut self, more: i64) {
        let lag = self.lag.load(Ordering::Relaxed) + more;
        self.lag.store(lag, Ordering::Relaxed);
        lock(&self.cable).host_lag = lag;
        lock(&self.net).host_lag = lag;
    }

    /// What the rig is doing.
    pub fn state(&self) -> State {
        let Some(process) = &self.process else { return State::Dark };
        if process.is_stopping {
            return State::ShuttingDown;
        }
        if !process.run.is_running() {
            return if process.run.is_connecting() { State::Arming } else { State::Dark };
        }
        match process.health() {
            ProjectorHealth::Up => State::Running,
            ProjectorHealth::Lost => State::RePlugging,
            ProjectorHealth::Black | ProjectorHealth::Frozen | ProjectorHealth::InterlockOpen => {
                State::FrozenOrBlack
            }
            ProjectorHealth::Faulted(_)
            | ProjectorHealth::Resting(_)
            | ProjectorHealth::RestingAfterFlashes => State::Faulted,
            ProjectorHealth::Connecting | ProjectorHealth::Stopped => State::Arming,
        }
    }

    /// Records something in the trace's hash.
    pub fn fold(&mut self, what: u64, value: u64) {
        let x = (self.trace ^ what.wrapping_mul(0x9e37_79b9_7f4a_7c15)).wrapping_add(value);
        self.trace = (x ^ x >> 31).wrapping_mul(0xbf58_476d_1ce4_e5b9).rotate_left(17);
    }

    /// Notes something for a person.
    pub fn tell(&mut self, text: impl FnOnce() -> String) {
        let text = format!("{:>12.6} s  #{}  {}", self.t as f64 * 1e-9, self.events, text());
        if self.is_loud {
            println!("{text}");
        }
        if self.story.len() >= 400 {
            self.story.pop_front();
        }
        self.story.push_back(text);
    }

    /// Plans `action` for true time `at`.
    pub fn plan(&mut self, at: i64, action: Action) {
        let place = self.free.pop().unwrap_or_else(|| {
            self.planned.push(None);
            self.planned.len() - 1
        });
        self.planned[place] = Some(action);
        // Actions of one instant keep their order: the upper half counts them.
        self.next_action += 1;
        self.actions.push(Reverse((at, self.next_action << 24 | place as u64)));
    }

    /// The instant of the next event.
    fn due(&self) -> i64 {
        let process = self.process.as_ref().map_or(i64::MAX, |p| {
            p.due().saturating_add(self.lag.load(Ordering::Relaxed)).max(self.frozen_until)
        });
        let projector = self.projector.next_due().map_or(i64::MAX, |due| due.0);
        let action = self.actions.peek().map_or(i64::MAX, |Reverse((at, _))| *at);
        process
            .min(projector)
            .min(action)
            .min(lock(&self.cable).due())
            .min(lock(&self.net).due())
            .min(self.restart_at)
            .min(self.tick_at)
            .max(self.t)
    }

    /// Moves everything to the next event. Returns false when a law is broken.
    pub fn step(&mut self) -> bool {
        self.t = self.due();
        self.events += 1;
        let host = self.host();
        self.clock.store(host, Ordering::Relaxed);
        {
            let mut net = lock(&self.net);
            if net.is_wired() || net.due() <= self.t {
                net.advance(self.t);
            }
            net.now = self.t;
        }
        lock(&self.cable).advance(self.t);
        self.act();
        self.move_projector();
        self.move_process();
        self.compare_word();
        self.judge_armed();
        if self.restart_at <= self.t {
            self.start();
        }
        if self.tick_at <= self.t {
            self.tick();
        }
        self.watch_episode();
        self.laws.broken.is_none()
    }

    fn act(&mut self) {
        while let Some(Reverse((at, place))) = self.actions.peek().copied() {
            if at > self.t {
                break;
            }
            self.actions.pop();
            let place = (place & 0xff_ffff) as usize;
            let Some(action) = self.planned[place].take() else { continue };
            self.free.push(place);
            match action {
                Action::Strike(kind, seed) => self.strike_now(kind, seed),
                Action::End(number) => self.end(number),
                Action::Give(order) => self.give(order),
                Action::Stop => self.ask_to_stop(),
                Action::Kill => self.kill(),
                Action::ClearUp => self.clear_up(),
                Action::Again(kind, seed, round) => self.again(kind, seed, round),
                Action::Episode => {}
                Action::Disturb => self.disturb(),
                Action::BareArm => self.bare_arm(),
                Action::Contact(state) => self.set_contact(state),
                Action::Overdue(episode) => self.overdue(episode),
            }
        }
    }

    fn strike_now(&mut self, kind: Kind, seed: u64) {
        let state = self.state();
        let before = self.seen(kind);
        self.table.strikes(kind, state);
        self.fold(1, kind as u64 * 8 + state as u64);
        self.tell(|| format!("{kind:?} strikes while {}: {}", state.word(), kind.text()));
        self.laws.disturbed(self.t);
        if !kind.is_of_tracker() {
            self.laws.struck_elsewhere(self.t);
        }
        self.striking = Some(Struck { state, seen_before: before });
        self.strike(kind, seed);
        self.striking = None;
    }

    /// How often an effect of faults of `kind` was seen so far.
    fn seen(&self, kind: Kind) -> u64 {
        use Kind as K;
        let met = &self.met;
        let cable = || lock(&self.cable).met;
        match kind {
            K::T16 | K::N1 | K::N2 | K::N7 => lock(&self.net).met[0],
            K::N6 => lock(&self.net).met[1],
            K::U1 | K::U2 | K::U9 => cable().pulls,
            K::U14 | K::H10 => cable().denied,
            K::U3 | K::U4 | K::U5 | K::U6 | K::U7 | K::U10 | K::X9 | K::X10 | K::X11
                if self.setup.serial.is_some() =>
            {
                cable().on_line
            }
            K::U3 => cable().stalled,
            K::U4 => cable().slowed,
            K::U5 => cable().short,
            K::U6 => cable().babble,
            K::U7 => cable().spoiled,
            K::U10 => cable().stale,
            K::X8 => cable().late,
            K::X18 => cable().crawled,
            K::X17 => lock(&self.beneath).queued,
            K::U15 | K::H2 | K::X3 => met.kills,
            K::H6 | K::X4 => met.stops,
            K::X5 => met.orders,
            K::G1 | K::G2 => lock(&self.beneath).met[2],
            K::G4 | K::G5 | K::G6 | K::G7 | K::X7 => lock(&self.beneath).met[1],
            K::H4 | K::H5 | K::X1 | K::X2 => lock(&self.beneath).met[0],
            K::H8 | K::H9 => lock(&self.beneath).slowed,
            K::H1 => lock(&self.disk).met,
            K::X21 => lock(&self.disk).calls.met,
            K::X27 => lock(&self.net).calls.met,
            K::X28 => lock(&self.cable).calls.met,
            K::X19 => met.contacts,
            K::X20 => met.datagrams,
            K::X22 => cable().orders,
            K::X23 => met.bare_arms,
            K::X24 => met.rests,
            K::H7 => met.refused_files,
            K::H3 | K::X6 => met.stands,
            // The projector itself is struck, whoever looks.
            K::U8 | K::U11 | K::U12 | K::U13 => self.table.struck(kind),
            // The tracker or its network: the program runs while it lasts.
            _ => met.steps,
        }
    }

    /// The machine or the program is about to stand still, or a clock is set: an effect if there is a program.
    pub(crate) fn stands(&mut self) {
        self.met.stands += u64::from(self.process.is_some());
    }

    /// A fault begins that ends after `ns`.
    pub(crate) fn lasts(&mut self, kind: Kind, ns: i64, undo: Undo) {
        let number = self.active.iter().position(Option::is_none).unwrap_or_else(|| {
            self.active.push(None);
            self.active.len() - 1
        });
        self.active[number] = Some(Active { kind, undo, struck: self.striking.take() });
        self.plan(self.t + ns, Action::End(number));
    }

    fn end(&mut self, number: usize) {
        let Some(active) = self.active[number].take() else { return };
        self.tell(|| format!("{:?} is over", active.kind));
        if let Some(Struck { state, seen_before }) = active.struck {
            if self.seen(active.kind) > seen_before {
                self.table.takes_effect(active.kind, state);
            }
        }
        if active.kind.needs_strain() {
            self.laws.spell_is_over(self.t, self.table.total());
        }
        // Another fault of the same kind may still last.
        self.undo(&active.undo);
        self.calm_since = self.t;
        self.laws.disturbed(self.t);
    }

    /// No fault lasts.
    pub fn is_quiet(&self) -> bool {
        self.active.iter().all(Option::is_none)
    }

    fn move_projector(&mut self) {
        while let Some(due) = self.projector.next_due().filter(|due| due.0 <= self.t) {
            self.projector.advance_to(due);
            self.see_light();
        }
        loop {
            let arrived = lock(&self.cable).arrived();
            let Some(transfer) = arrived else { break };
            if self.far.is_some() {
                self.hear_piece(&transfer.bytes);
                lock(&self.cable).recycle(transfer.bytes);
                continue;
            }
            if transfer.lane == Lane::Control {
                if self.process.is_none() {
                    // It was on its way when the program died, and feeds the watchdog once more.
                    self.laws.heard_of_the_dead(self.t);
                }
                self.hear(&transfer.bytes, transfer.cut);
                if self.setup.alone == Some(Guard::Latch) {
                    self.session = session(&transfer.bytes).unwrap_or(self.session);
                }
            } else if self.setup.alone == Some(Guard::Watchdog) {
                self.laws.heard_of_the_silent(self.t);
                self.overheard = first_packet(&transfer.bytes).unwrap_or_default().to_vec();
            }
            self.projector.receive(HostTime(self.t), transfer.lane, &transfer.bytes);
            if transfer.cut {
                self.projector.end_of_transfer(HostTime(self.t), transfer.lane);
            }
            lock(&self.cable).recycle(transfer.bytes);
        }
        self.projector.advance_to(HostTime(self.t));
        self.see_light();
        if self.active.iter().flatten().any(|active| !active.kind.is_of_tracker()) {
            self.laws.struck_elsewhere(self.t);
        }
        self.laws.flashes(
            self.t,
            self.projector.status().faults & (faults::FLASH_LIMIT | faults::LIGHT_LIMIT) != 0,
        );
        if self.far.is_some() {
            return self.reply_on_the_line();
        }
        let mut cable = lock(&self.cable);
        if cable.plugged {
            self.projector.replies(HostTime(self.t), &mut |_, packet| cable.reply(packet));
        }
    }

    /// A neighbour sends damaged packets while the program is silent.
    fn disturb(&mut self) {
        self.plan(self.t + DISTURB_NS, Action::Disturb);
        let silent_since = self.laws.silent_since();
        let is_near = silent_since.is_some_and(|since| self.t - since < DISTURBS_NS);
        if !is_near || !lock(&self.cable).plugged || self.overheard.is_empty() {
            return;
        }
        let mut bytes = self.overheard.clone();
        match self.neighbour.between(0, 3) {
            0 => bytes = of_another_host(&bytes).unwrap_or_default(),
            1 => bytes = word_of_another_host(session(&bytes).unwrap_or_default()),
            _ => damage(&mut bytes, &mut self.neighbour),
        }
        self.projector.receive(HostTime(self.t), Lane::Data, &bytes);
        self.projector.end_of_transfer(HostTime(self.t), Lane::Data);
        self.see_light();
    }

    /// Somebody sends an ARM that acknowledges nothing to a projector that has latched something.
    fn bare_arm(&mut self) {
        if self.projector.status().faults == 0 || !lock(&self.cable).plugged {
            return;
        }
        self.met.bare_arms += 1;
        self.projector.receive(HostTime(self.t), Lane::Control, &bare_arm(self.session));
        self.see_light();
        if self.projector.status().faults == 0 {
            self.laws.fail(
                self.t,
                "the projector is armed, and nobody has acknowledged what it had latched".into(),
            );
        }
    }

    /// An order was given while the light rested.
    pub(crate) fn rests_met(&mut self) {
        self.met.rests += 1;
    }

    /// The laws of tracks read what is about to reach the projector on the control lane.
    pub(crate) fn hear(&mut self, bytes: &[u8], cut: bool) {
        if self.tracks.is_none() {
            return;
        }
        self.projector.advance_to(HostTime(self.t));
        self.see_light();
        self.laws.remember(&self.beneath);
        let moment = self.laws.moment(self.t, self.lag.load(Ordering::Relaxed));
        let Self { tracks, laws, projector, cable, .. } = self;
        let Some(tracks) = tracks else { return };
        if std::mem::take(&mut lock(cable).disturbed) {
            tracks.cable_disturbed();
        }
        let told = tracks.hear(bytes, cut, projector, &moment, &|frame| laws.sent(frame));
        if let Err(told) = told {
            self.laws.fail(self.t, told);
        }
    }

    /// Judges the light that the projector has made.
    pub(crate) fn see_light(&mut self) {
        while let Some(change) = self.projector.next_change() {
            self.fold(2, change.at.0 as u64 ^ u64::from(change.frame.unwrap_or(u32::MAX)) << 32);
            self.laws.change(&change, self.t);
            if let Some(tracks) = &mut self.tracks {
                tracks.change(&change, &self.projector);
            }
        }
        while let Some(event) = self.projector.next_light() {
            let lag = self.lag.load(Ordering::Relaxed);
            self.fold(3, event.slot ^ u64::from(event.frame.unwrap_or(u32::MAX)) << 32);
            let planes = self.projector.lit_planes();
            self.laws.light(&event, planes, lag, &self.beneath, self.projector.clock());
        }
        self.see_moves();
    }

    /// Judges what tracks made of the light of slots that are over.
    fn see_moves(&mut self) {
        let Some(mut tracks) = self.tracks.take() else { return };
        while let Some(moves) = self.projector.next_moves() {
            let sum = moves.planes().iter().flat_map(|plane| plane.all().iter().flat_map(|one| one.shift));
            let sum =
                sum.fold(moves.slot, |sum, shift| sum.wrapping_mul(31).wrapping_add_signed(shift.into()));
            self.fold(7, sum);
            let moment = self.laws.moment(self.t, self.lag.load(Ordering::Relaxed));
            let told = tracks.slot(&moves, &self.projector, self.laws.sent(moves.frame), &moment);
            if let Err(told) = told {
                self.laws.fail(self.t, told);
            }
        }
        self.tracks = Some(tracks);
    }

    /// What the projector reports of being armed, and what it was sent.
    fn judge_armed(&mut self) {
        let is_armed = self.projector.status().state == DeviceState::Armed;
        let runs = self.process.is_some() && self.t >= self.frozen_until;
        self.laws.armed(self.t, is_armed && runs);
        if self.setup.alone == Some(Guard::Clock) {
            if is_armed {
                let lag = self.lag.load(Ordering::Relaxed);
                self.laws.judge_sent(self.t, &self.beneath, self.projector.clock(), lag);
            }
            // Others were sent to whom they cannot reach.
            self.laws.remember(&self.beneath);
        }
    }

    /// The word for the light is compared with the light.
    fn compare_word(&mut self) {
        let lit = self.projector.lit_generation().zip(self.projector.lit_planes());
        self.laws.mirrors(self.t, lit);
        let is_awake = self.t >= self.frozen_until;
        let process = self.process.as_ref().filter(|process| is_awake && process.run.is_running());
        self.laws.word(self.t, process.map(|process| process.monitor.light()));
    }

    fn move_process(&mut self) {
        if self.t < self.frozen_until {
            return;
        }
        let host = self.host();
        let Some(process) = &mut self.process else { return };
        if process.due() > host {
            return;
        }
        self.met.steps += 1;
        process.step(host);
        if process.is_over(host) {
            self.exit();
        }
    }

    fn exit(&mut self) {
        let Some(process) = self.process.take() else { return };
        self.laws.order_at_exit(&process, self.t);
        let was_asked = process.is_stopping;
        let counts = process.monitor.counts();
        let (exit, end) = process.exit();
        self.laws.exited(&exit, &counts, end.as_deref(), self.t);
        self.fold(4, self.t as u64);
        self.tell(|| format!("the program ends: {exit:?}"));
        self.last_words();
        self.left_alone();
        match exit {
            // The service manager does not start it again; whoever asked for the stop does.
            Exit::InOrder => self.needs_person = true,
            Exit::ForGood(_) => self.needs_person = true,
            Exit::Again(_) if was_asked => self.needs_person = true,
            Exit::Again(_) => self.restart_at = self.t + RESTART_NS,
        }
    }

    /// The program is killed: nothing of it does anything any more.
    pub(crate) fn kill(&mut self) {
        let Some(process) = self.process.take() else { return };
        self.met.kills += 1;
        self.laws.order_at_exit(&process, self.t);
        self.laws.died(self.t);
        self.frozen_until = self.frozen_until.min(self.t);
        self.tell(|| "the program is killed".into());
        self.last_words();
        self.left_alone();
        self.restart_at = self.t + RESTART_NS;
    }

    /// The program has ended. Where its word stands alone, the projector keeps none of them.
    fn left_alone(&mut self) {
        if self.setup.alone.is_some_and(Guard::forgets) {
            self.lose_memory();
        }
    }

    fn start(&mut self) {
        self.restart_at = i64::MAX;
        if self.process.is_some() {
            return;
        }
        while self.starts.front().is_some_and(|at| self.t - at > STARTS_WITHIN_NS) {
            self.starts.pop_front();
        }
        if self.starts.len() >= STARTS {
            self.tell(|| "the service manager gives up: too many starts".into());
            self.needs_person = true;
            return;
        }
        self.starts.push_back(self.t);
        lock(&self.beneath).new_process();
        let by_hand = std::mem::take(&mut self.by_hand);
        self.laws.started(self.t, self.is_calm());
        if by_hand {
            self.laws.acknowledged();
        }
        if std::mem::take(&mut self.bad_file) {
            self.met.refused_files += 1;
            self.tell(|| "the program refuses the rig file".into());
            self.needs_person = true;
            return;
        }
        let machine = SimMachine {
            beneath: self.beneath.clone(),
            net: self.net.clone(),
            tracker: self.setup.tracker,
            has_glasses: self.setup.has_glasses(),
            clock: self.clock.clone(),
            lag: self.lag.clone(),
        };
        let host = self.host();
        let rig = if by_hand { self.rig_by_hand.clone() } else { self.rig.clone() };
        let contact = self.contact.as_ref().map(|(contact, reset)| (contact, *reset));
        match Process::start(&rig, &self.cable, &self.disk, machine, contact, host) {
            Ok(process) => {
                self.tell(|| "the program starts".into());
                self.laws.begins_with(process.orders.kept(), self.t);
                self.process = Some(process);
                if self.laws.has_standing_order() && self.clearing_since.is_none() {
                    // Whoever sees that it waits for a word comes and gives it.
                    self.clearing_since = Some(self.t);
                    self.plan(self.t + PERSON_NS, Action::ClearUp);
                }
            }
            Err(exit) => {
                self.tell(|| format!("the program does not start: {exit:?}"));
                match exit {
                    Exit::ForGood(_) => self.needs_person = true,
                    _ => self.restart_at = self.t + RESTART_NS,
                }
            }
        }
    }

    /// A person starts the program, whatever the service manager thinks of it.
    pub(crate) fn start_by_hand(&mut self) {
        self.starts.clear();
        (self.needs_person, self.by_hand) = (false, true);
        self.restart_at = self.t;
    }

    pub(crate) fn give(&mut self, order: Order) {
        let host = self.host();
        if self.t < self.frozen_until {
            return;
        }
        let Some(process) = &mut self.process else { return };
        let ticket = process.orders.give(order, dpm_rig::standing::By::Socket { uid: 1000 });
        process.wake_orders(host);
        self.met.orders += 1;
        self.laws.ordered(order, ticket, self.t);
        self.fold(5, order as u64);
        self.tell(|| format!("a person orders {}", order.word()));
    }

    /// The interlock's contact closes, opens, or does not answer any more.
    pub(crate) fn set_contact(&mut self, state: u8) {
        let Some((contact, reset)) = &self.contact else { return };
        contact.0.store(state, Ordering::Relaxed);
        let kept = self.process.as_ref().is_some_and(|process| process.monitor.interlock().is_some());
        self.met.contacts += u64::from(state != 0 && kept);
        self.laws.contact(self.t, state, *reset == Restart::ByHand && kept);
        self.fold(8, state.into());
        self.tell(|| {
            ["the interlock closes", "the interlock opens", "the interlock hangs"][usize::from(state)].into()
        });
    }

    /// A datagram of OSC arrives at the rig's door. Who may say what is the rig's own to judge, and judged here once more.
    pub(crate) fn hear_osc(&mut self, word: &str, token: Option<&str>, is_listed: bool) {
        let text = |text: &str| {
            let mut bytes = text.as_bytes().to_vec();
            bytes.resize((text.len() / 4 + 1) * 4, 0);
            bytes
        };
        let tags = if token.is_some() { ",s" } else { "," };
        let parts = [Some(format!("/dpm/{word}")), Some(tags.into()), token.map(str::to_owned)];
        let bytes: Vec<u8> = parts.into_iter().flatten().flat_map(|part| text(&part)).collect();
        let door = Doorkeeper { from: vec![OSC_DESK], token: Some(OSC_TOKEN.into()) };
        let heard = door.hear(&bytes, if is_listed { OSC_DESK } else { OSC_STRANGER });
        let orders = heard.into_iter().filter_map(|one| match one {
            Ok(OscRequest::Order(order)) => Some(order),
            _ => None,
        });
        let orders: Vec<Order> = orders.collect();
        let named = [Order::Black, Order::Freeze, Order::Safe].into_iter().find(|order| order.word() == word);
        let may = |order: &Order| is_listed && (order.is_dark() || token == Some(OSC_TOKEN));
        let wanted: Vec<Order> = named.into_iter().filter(may).collect();
        if orders != wanted {
            let told =
                format!("OSC says {word} (listed {is_listed}, token {token:?}), and {orders:?} is obeyed");
            self.laws.fail(self.t, told);
        }
        self.met.datagrams += u64::from(self.process.is_some());
        orders.into_iter().for_each(|order| self.give(order));
    }

    pub(crate) fn ask_to_stop(&mut self) {
        if self.t < self.frozen_until {
            return;
        }
        let host = self.host();
        if let Some(process) = &mut self.process {
            process.ask_to_stop(host);
            self.met.stops += 1;
            self.laws.asked_to_stop(self.t);
            self.tell(|| "the program is asked to stop".into());
        }
    }

    /// A person looks what is wrong, and does what only a person may do. Looks again until all is well.
    fn clear_up(&mut self) {
        if !self.is_quiet() || self.t < self.frozen_until {
            return self.plan(self.t + 50 * MS, Action::ClearUp);
        }
        self.clearing_since.get_or_insert(self.t);
        let latched = self.projector.status().faults;
        let wants_arm = match &self.process {
            None => {
                if self.needs_person {
                    self.tell(|| "a person starts the program".into());
                    self.start_by_hand();
                    self.calm_since = self.t;
                }
                false
            }
            Some(process) => match process.health() {
                ProjectorHealth::Black | ProjectorHealth::Frozen | ProjectorHealth::InterlockOpen => true,
                ProjectorHealth::Faulted(bits) => {
                    bits & faults::WATCHDOG == 0
                        || latched & !faults::WATCHDOG != 0
                        || self.laws.has_standing_order()
                }
                _ => self.laws.has_standing_order(),
            },
        };
        if wants_arm {
            self.give(Order::Arm);
            self.calm_since = self.t;
            let since = *self.arming_since.get_or_insert(self.t);
            if self.t - since > 8 * S {
                let health = self.process.as_ref().map(|p| p.health());
                self.laws.fail(self.t, format!("a person ordered ARM for 8 s and nothing helps: {health:?}"));
            }
        }
        if !wants_arm {
            self.arming_since = None;
        }
        let is_well = self.process.is_some() && !wants_arm && self.state() == State::Running;
        if is_well {
            self.clearing_since = None;
        } else {
            self.plan(self.t + PERSON_NS, Action::ClearUp);
        }
    }

    /// True when nobody but the program has to do anything, so that light is due soon.
    pub fn is_calm(&self) -> bool {
        self.is_quiet()
            && self.clearing_since.is_none()
            && !self.needs_person
            && !self.laws.has_standing_order()
            && self.t >= self.frozen_until
            && self.projector.status().faults & !(faults::WATCHDOG | faults::CHECKSUM_STORM) == 0
    }

    fn tick(&mut self) {
        self.tick_at = self.t + TICK_NS;
        if lock(&self.disk).lost_order {
            self.laws.fail(self.t, "an order was not kept because the disk is full".into());
        }
        let calm_for = if self.is_calm() && self.episode.is_none() { self.t - self.calm_since } else { -1 };
        if calm_for < 0 {
            self.calm_since = self.calm_since.max(self.t);
        }
        if !self.is_quiet() {
            self.laws.disturbed(self.t);
        }
        let (crew_ready, crews) = {
            let beneath = lock(&self.beneath);
            (beneath.crew_ready_at, beneath.crews)
        };
        let lag = self.lag.load(Ordering::Relaxed);
        // A trap may go off late, in a stage that had nothing to do while the GPU hung: then a start is still to come.
        let ends_late = self.restart_at != i64::MAX && self.restart_at - RESTART_NS - self.calm_since < 4 * S;
        let start_ready = if ends_late { self.restart_at + BEGINS_WITHIN_NS } else { 0 };
        let longest = lock(&self.cable).longest;
        let is_frozen = self.t < self.frozen_until;
        if let Some(tracks) = &mut self.tracks {
            let is_in_peace = self.laws.is_in_peace(self.t, calm_for, crew_ready + lag);
            if let Err(told) = tracks.tick(&self.projector, is_in_peace) {
                self.laws.fail(self.t, told);
            }
        }
        self.laws.tick(
            self.t,
            calm_for,
            self.process.as_mut(),
            ((crew_ready + lag).max(start_ready), crews),
            longest,
            is_frozen,
        );
        let host = self.host();
        self.fold(6, host as u64);
        if self.is_loud {
            self.tell_state();
        }
    }

    /// What the program tells about itself, for a person.
    fn tell_state(&mut self) {
        let device = self.projector.status();
        let Some(process) = &self.process else { return };
        let (health, counts, carried) = (process.health(), process.monitor.counts(), process.run.carried());
        let tracker = process.run.tracker_status();
        self.tell(|| {
            format!("  .. {health:?}, {counts:?}; device {:?}, lit {}, late {}, superseded {}, refused {}; {:?}; {tracker}",
                device.state, device.frames_lit, device.frames_late, device.frames_superseded, device.frames_refused,
                carried.map(|c| (c.not_sent, c.clock_bound_ns, c.travel_ms)))
        });
    }

    /// Brings the rig into the state of `episode`; its faults strike when it is there.
    pub fn begin(&mut self, episode: Episode) {
        use crate::kinds::State as St;
        let way = episode.way;
        let state = episode.state;
        self.episodes_begun += 1;
        let number = self.episodes_begun;
        self.laws.disturbed(self.t);
        match state {
            St::Running => {}
            St::Dark => {
                if way.is_multiple_of(3) {
                    self.ask_to_stop();
                } else {
                    self.kill();
                }
            }
            St::Arming => {
                self.kill();
                self.restart_at = self.t + 100 * MS;
            }
            St::RePlugging => self.strike(Kind::U1, way),
            // FREEZE holds its picture beyond `dark from`: what ends it is not that guard.
            // Where heads are guarded, FREEZE is BLACK.
            St::FrozenOrBlack
                if way.is_multiple_of(2)
                    || matches!(self.setup.alone, Some(Guard::DarkFrom | Guard::Eyes)) =>
            {
                self.give(Order::Black);
            }
            St::FrozenOrBlack => self.give(Order::Freeze),
            St::ShuttingDown => self.ask_to_stop(),
            St::Faulted => {
                if way.is_multiple_of(2) {
                    self.strike(Kind::U12, way);
                } else {
                    self.give(Order::Safe);
                }
            }
        }
        self.episode = Some((episode, false));
        self.plan(self.t + 4 * S, Action::Overdue(number));
    }

    /// The next step of `part` meets `trap`.
    pub fn set_trap(&self, part: RunPart, trap: Trap) {
        lock(&self.beneath).traps.push((part, trap));
    }

    /// What the link carried, as the program sees it; `None` while no link is up.
    pub fn carried(&self) -> Option<ProjectorReport> {
        self.process.as_ref()?.run.carried()
    }

    /// What the projector reports.
    pub fn status(&self) -> Status {
        self.projector.status()
    }

    /// True when the next episode may begin.
    pub fn is_ready(&self) -> bool {
        self.episode.is_none()
            && self.clearing_since.is_none()
            && self.is_calm()
            && self.state() == State::Running
            && self.laws.is_lit_well(self.t)
    }

    fn overdue(&mut self, number: u32) {
        if number == self.episodes_begun && matches!(self.episode, Some((_, false))) {
            self.begin_faults();
        }
    }

    fn watch_episode(&mut self) {
        if let Some((episode, false)) = &self.episode {
            if self.state() == episode.state {
                self.begin_faults();
            }
        }
    }

    fn begin_faults(&mut self) {
        let Some((episode, begun)) = &mut self.episode else { return };
        *begun = true;
        let faults = episode.faults.clone();
        let person_ns = episode.person_ns;
        let mut last = self.t;
        for fault in faults {
            let at = self.t + fault.after_ns;
            last = last.max(at);
            self.plan(at, Action::Strike(fault.kind, fault.seed));
        }
        self.episode = None;
        // Until the person has looked, nothing is called calm.
        self.clearing_since = Some(last + person_ns);
        self.plan(last + person_ns, Action::ClearUp);
    }
}

/// The server that belongs to the rig.
pub(crate) fn server_kind(setup: &Setup) -> ServerKind {
    ServerKind {
        rate_hz: setup.tracker_hz,
        name: "a".into(),
        number: 1,
        is_old: false,
        millimetres: false,
        motion: setup.motion,
        has_glasses: setup.has_glasses(),
    }
}
