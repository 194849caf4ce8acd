//! Counters that a running pipeline maintains and an observing thread reads, and in the other direction the
//! operator's requests: a stop, and orders for the projector.

use super::light_gauge::LightGauge;
use super::light_state::LightState;
use super::link_gauges::LinkGauges;
use super::live::Live;
use super::ordered::DarkLog;
use super::projector::ProjectorReport;
use crate::gaze::GazeDesk;
use crate::interlock::Interlock;
use crate::order::Order;
use crate::parameters::ParameterDesk;
use crate::plan::dark::DarkCause;
use crate::tracks::gauges::{TrackerGauges, TrackerReport};
use crate::tracks::BlindBodies;
use dpm_common::stopping;
use dpm_device::link::{faults, LimitReached};
use dpm_handoff::path::Lock;
use std::collections::{BTreeMap, VecDeque};
use std::fmt;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicU8, Ordering};
use std::sync::{OnceLock, PoisonError};

/// Notes that wait for the observing thread; further ones are only counted.
const NOTES: usize = 64;

/// The projector's state, as the link knows it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ProjectorHealth {
    /// The handshake is in progress.
    #[default]
    Connecting,
    /// It takes frames.
    Up,
    /// The medium is gone; the link tries to reopen it ten times a second.
    Lost,
    /// Dark; these faults (bits of [`faults`]) are latched.
    Faulted(u32),
    /// Dark by order of the operator.
    Black,
    /// Holds a frame by order of the operator.
    Frozen,
    /// Dark at the end of the run.
    Stopped,
    /// Dark because the interlock is open.
    InterlockOpen,
    /// Dark for a while because a limit on light was reached.
    Resting(LimitReached),
    /// Dark for two seconds because the field flashed too often.
    RestingAfterFlashes,
}

impl ProjectorHealth {
    /// The state as a number, for an atomic or a file.
    pub(crate) const fn encode(self) -> u64 {
        match self {
            Self::Connecting => 0,
            Self::Up => 1,
            Self::Lost => 2,
            Self::Black => 3,
            Self::Frozen => 4,
            Self::Stopped => 5,
            Self::Faulted(mask) => 6 | (mask as u64) << 8,
            Self::InterlockOpen => 7,
            Self::Resting(LimitReached::Mean) => 8,
            Self::Resting(LimitReached::FullWhite) => 9,
            Self::RestingAfterFlashes => 10,
        }
    }

    /// Reverses [`ProjectorHealth::encode`].
    pub(crate) const fn decode(code: u64) -> Self {
        match code & 0xff {
            1 => Self::Up,
            2 => Self::Lost,
            3 => Self::Black,
            4 => Self::Frozen,
            5 => Self::Stopped,
            6 => Self::Faulted((code >> 8) as u32),
            7 => Self::InterlockOpen,
            8 => Self::Resting(LimitReached::Mean),
            9 => Self::Resting(LimitReached::FullWhite),
            10 => Self::RestingAfterFlashes,
            _ => Self::Connecting,
        }
    }
}

impl ProjectorHealth {
    /// The state as one word of at most ten letters. It is in capitals if the picture does not move although frames
    /// are made.
    pub const fn word(self) -> &'static str {
        match self {
            Self::Connecting => "connecting",
            Self::Up => "up",
            Self::Lost => "LOST",
            Self::Faulted(_) => "FAULTED",
            Self::Black => "BLACK",
            Self::Frozen => "FROZEN",
            Self::Stopped => "dark",
            Self::InterlockOpen => "INTERLOCK",
            Self::Resting(_) | Self::RestingAfterFlashes => "RESTING",
        }
    }
}

/// What brings light back after latched faults.
const fn remedy(mask: u32) -> &'static str {
    if mask & !faults::PASSING != 0 {
        "`dpm arm` acknowledges them"
    } else if mask & faults::WATCHDOG != 0 {
        "no frame came in safety.watchdog_ms; light comes back by itself"
    } else {
        "packets were damaged; light comes back by itself"
    }
}

impl fmt::Display for ProjectorHealth {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Connecting => write!(f, "connecting"),
            Self::Up => write!(f, "up"),
            Self::Lost => write!(f, "lost, dark; plug it in again and the run goes on"),
            Self::Faulted(0) => write!(f, "dark, and it names no fault"),
            Self::Faulted(mask) => {
                let kind = if mask & !faults::PASSING != 0 { "latched" } else { "passing" };
                write!(f, "dark, {kind} faults: {}; {}", faults::names(*mask), remedy(*mask))
            }
            Self::Black => write!(f, "black; `dpm arm` shows the picture again"),
            Self::Frozen => write!(f, "frozen; `dpm arm` lets the picture move again"),
            Self::Stopped => write!(f, "dark"),
            Self::InterlockOpen => {
                write!(
                    f,
                    "dark by safety.interlock; light comes back when it closes, unless black, freeze or safe was ordered; where \
                     its reset is \"by hand\", after it has closed and `dpm arm`"
                )
            }
            Self::Resting(LimitReached::Mean) => write!(
                f,
                "dark, the mean light reached safety.limits.mean_level; light comes back after safety.limits.mean_window_s"
            ),
            Self::Resting(LimitReached::FullWhite) => write!(
                f,
                "dark, full white lasted for safety.limits.full_white_s; light comes back after as long"
            ),
            Self::RestingAfterFlashes => write!(
                f,
                "dark, the field flashed more often than safety.flashes_per_second; light comes back after 2 s"
            ),
        }
    }
}

/// Projectors that may be held by their serial numbers at once.
const MOST_HELD: usize = 32;

/// Shared between a run and its observers. Accesses to numbers and flags are relaxed: the numbers are for display,
/// and the stop flag guards no data.
#[derive(Debug, Default)]
pub struct RunMonitor {
    stop: AtomicBool,
    /// The run compiles shaders or builds its scene: nothing is lit, and it may be abandoned.
    sets_up: AtomicBool,
    /// The newest order that was not yet taken; 0 for none. The upper half of an ARM contains the number of orders
    /// that had come as signals when the ARM was requested, so that it does not undo a later BLACK or SAFE.
    order: AtomicU64,
    /// The projector had SAFE latched when the link came up.
    found_safe: AtomicBool,
    /// The serial number that the projector gave in HELLO; 0 before.
    device: AtomicU64,
    /// Orders that stand for projectors by their serial numbers: the number, 0 for none, and the order as a code. Written by
    /// the thread that keeps orders, read by the link's.
    held: [(AtomicU64, AtomicU8); MOST_HELD],
    /// More orders stood than there is room for: every projector with a serial number is held.
    held_all: AtomicBool,
    /// The order that was found for the projector's serial number, as a code.
    found_held: AtomicU8,
    projector: AtomicU64,
    /// What is seen of the light: written by the link's thread and the supervisor.
    light: LightGauge,
    /// Written at most once.
    tracker: OnceLock<BlindBodies>,
    /// Why the run will never return; written at most once.
    gave_up: OnceLock<String>,
    /// Written at most once, before there is light.
    interlock: OnceLock<Interlock>,
    frames_planned: AtomicU64,
    frames_lit: AtomicU64,
    frames_dark: AtomicU64,
    frames_dropped: AtomicU64,
    frames_withheld: AtomicU64,
    frames_unrecorded: AtomicU64,
    frames_late: AtomicU64,
    slots: AtomicU64,
    slots_missed: AtomicU64,
    /// When no new picture was wanted, and why.
    dark: DarkLog,
    /// The collector's messages for the operator. Neither the threads of the frame path nor those that make orders
    /// take this lock.
    notes: Lock<Notes>,
    /// What the link carries: written by its thread.
    link: LinkGauges,
    /// What became of the tracker's samples: written by its thread.
    samples: TrackerGauges,
    /// What observers see of the run.
    live: Live,
    /// What operators may change while it goes on.
    parameters: ParameterDesk,
    /// Where a device sees the observer look.
    gaze: GazeDesk,
}

#[derive(Debug, Default)]
struct Notes {
    waiting: VecDeque<String>,
    left_out: u64,
}

/// The counters at one moment.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct RunCounts {
    /// Frames planned.
    pub frames_planned: u64,
    /// Frames lit, with light on at least one body.
    pub frames_lit: u64,
    /// Frames that the projector lit in which every body was dark.
    pub frames_dark: u64,
    /// Frames dropped.
    pub frames_dropped: u64,
    /// Frames that were not lit because no new picture was wanted.
    pub frames_withheld: u64,
    /// Frames of which the collector learnt nothing, because it had no time: lit or not, they are in no other count.
    pub frames_unrecorded: u64,
    /// Frames lit late.
    pub frames_late: u64,
    /// Slots in which a frame of their own was wanted.
    pub slots: u64,
    /// Of these, slots without one.
    pub slots_missed: u64,
}

impl RunCounts {
    /// Planned frames whose result is known.
    pub fn frames_done(&self) -> u64 {
        self.frames_lit
            + self.frames_dark
            + self.frames_dropped
            + self.frames_withheld
            + self.frames_unrecorded
    }
}

/// A run that sets up, until this is dropped or its projector is about to be opened.
#[derive(Debug)]
pub struct SettingUp<'a>(&'a RunMonitor);

impl Drop for SettingUp<'_> {
    fn drop(&mut self) {
        self.0.end_set_up();
    }
}

impl RunMonitor {
    /// Declares that the run sets up: it has opened no projector, holds nothing that must be given back, and whoever stops
    /// it may abandon it.
    pub fn begin_set_up(&self) -> SettingUp<'_> {
        self.sets_up.store(true, Ordering::SeqCst);
        SettingUp(self)
    }

    /// Declares that the projector is about to be opened: from now on the run ends in order.
    pub(crate) fn end_set_up(&self) {
        self.sets_up.store(false, Ordering::SeqCst);
    }

    /// True while the run sets up.
    pub fn sets_up(&self) -> bool {
        self.sets_up.load(Ordering::SeqCst)
    }

    /// Requests an orderly stop of the run: dark, flush, report.
    pub fn request_stop(&self) {
        self.stop.store(true, Ordering::Relaxed);
    }

    /// True when a stop was requested, through this monitor, by a signal or by a panic. The frame path polls this
    /// once per frame.
    pub fn stop_requested(&self) -> bool {
        self.stop.load(Ordering::Relaxed) || stopping::is_stopping()
    }

    /// Gives the projector an order, which replaces one that was not yet taken, unless that one is stronger. ARM
    /// replaces every order.
    pub fn give_order(&self, order: Order) {
        match order {
            Order::Arm => self.arm_unless_darkened(stopping::orders()),
            _ => drop(self.order.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |waiting| {
                let stays = Order::from_code(waiting as u8).is_some_and(|w| w.strength() > order.strength());
                (!stays).then_some(order as u64)
            })),
        }
    }

    /// Gives ARM. It has no effect if more than `since` orders have come as signals by the time it is taken, because
    /// they are newer than the request for light.
    pub(crate) fn arm_unless_darkened(&self, since: u32) {
        self.order.store(Order::Arm as u64 | u64::from(since) << 32, Ordering::Relaxed);
    }

    /// Takes the newest order, once; of two waiting orders, the darker one. The link thread asks with every poll.
    /// After a stop request there is no ARM and no FREEZE.
    pub fn take_order(&self) -> Option<Order> {
        let signalled = Order::from_code(stopping::take_order());
        let own = match self.order.load(Ordering::Relaxed) {
            0 => None,
            _ => Some(self.order.swap(0, Ordering::Relaxed)),
        };
        let own = own.and_then(|code| {
            let order = Order::from_code(code as u8)?;
            let overtaken = order == Order::Arm && stopping::orders() != (code >> 32) as u32;
            (!overtaken).then_some(order)
        });
        let order = signalled.into_iter().chain(own).max_by_key(|order| order.strength())?;
        (order.is_dark() || !self.stop_requested()).then_some(order)
    }

    /// True when a stop was requested, or BLACK or SAFE was ordered and not yet taken: a link that comes up then does
    /// not arm.
    pub fn dark_is_ordered(&self) -> bool {
        let waiting = |code: u8| Order::from_code(code).is_some_and(Order::is_dark);
        self.stop_requested()
            || waiting(stopping::waiting_order())
            || waiting(self.order.load(Ordering::Relaxed) as u8)
    }

    /// Records that the projector had SAFE latched when the link came up. It stands until ARM, like a SAFE that was
    /// ordered here.
    pub(crate) fn find_safe(&self) {
        self.found_safe.store(true, Ordering::Relaxed);
        self.give_order(Order::Safe);
    }

    /// True once after [`RunMonitor::find_safe`].
    pub fn take_found_safe(&self) -> bool {
        self.found_safe.swap(false, Ordering::Relaxed)
    }

    /// Orders that stand for projectors with these serial numbers, wherever they are plugged in.
    pub(crate) fn hold_devices(&self, held: Vec<(u64, Order)>) {
        held.into_iter().for_each(|(device, order)| self.hold_device(device, order));
    }

    /// An order stands for the projector with this serial number, until [`RunMonitor::lift_held`].
    pub(crate) fn hold_device(&self, device: u64, order: Order) {
        let of = |device| self.held.iter().find(|(of, _)| of.load(Ordering::Relaxed) == device);
        match of(device).or_else(|| of(0)) {
            Some((of, code)) => {
                let before = Order::from_code(code.load(Ordering::Relaxed)).map_or(0, Order::strength);
                if of.load(Ordering::Relaxed) != device || before < order.strength() {
                    code.store(order as u8, Ordering::Relaxed);
                }
                // The order is there before its number is.
                of.store(device, Ordering::Release);
            }
            None => self.held_all.store(true, Ordering::Relaxed),
        }
    }

    /// The projector has said HELLO with this serial number. An order that stands for it is given, before anything arms it.
    /// 0, and 1, which is that of mocks and of firmware that has drawn none, name no projector.
    pub(crate) fn meet_device(&self, serial: u64) {
        let serial = if serial > 1 { serial } else { 0 };
        if self.device.swap(serial, Ordering::Relaxed) == serial || serial == 0 {
            return;
        }
        let held = self.held.iter().find(|(device, _)| device.load(Ordering::Acquire) == serial);
        let order = held.and_then(|(_, code)| Order::from_code(code.load(Ordering::Relaxed)));
        let all = self.held_all.load(Ordering::Relaxed).then_some(Order::Black);
        if let Some(order) = order.or(all) {
            self.found_held.store(order as u8, Ordering::Relaxed);
            self.give_order(order);
        }
    }

    /// The serial number of the projector, if it has given one that names it.
    pub(crate) fn device(&self) -> Option<u64> {
        Some(self.device.load(Ordering::Relaxed)).filter(|serial| *serial != 0)
    }

    /// Once: the order that was found for the projector's serial number.
    pub(crate) fn take_found_held(&self) -> Option<Order> {
        Order::from_code(self.found_held.swap(0, Ordering::Relaxed))
    }

    /// A person has armed the projector with this serial number.
    pub(crate) fn lift_held(&self, device: u64) {
        for (of, _) in self.held.iter().filter(|(of, _)| of.load(Ordering::Relaxed) == device) {
            of.store(0, Ordering::Relaxed);
        }
    }

    /// Sets the projector's state.
    pub fn set_projector(&self, health: ProjectorHealth) {
        self.projector.store(health.encode(), Ordering::Relaxed);
    }

    /// The projector's state.
    pub fn projector(&self) -> ProjectorHealth {
        ProjectorHealth::decode(self.projector.load(Ordering::Relaxed))
    }

    /// The state of the light now.
    pub fn light(&self) -> LightState {
        LightState::of(&self.light.evidence(self.projector()))
    }

    /// Per tracked body of the rig: its name, and why no light has fallen on it for a second; `None` while light falls
    /// on it wherever the projector has any. Empty before the rig is built.
    pub fn bodies(&self) -> Vec<(&str, Option<DarkCause>)> {
        let bodies = self.live.rig().into_iter().flat_map(|rig| &rig.bodies);
        bodies.enumerate().map(|(k, body)| (body.name.as_str(), self.light.body(k))).collect()
    }

    /// The state of the light as a sentence behind its word: the reason, and the bodies without light with theirs. Empty
    /// where the word says everything.
    pub fn light_told(&self) -> String {
        let state = self.light();
        let bodies = self.bodies();
        let dark =
            bodies.iter().filter_map(|(name, dark)| dark.map(|cause| format!("{name}: {}", cause.told())));
        // What keeps every mirror dark is the reason for every body.
        let dark = dark.filter(|_| state.is_lit() || state.reason().is_none());
        state.reason().into_iter().chain(dark).collect::<Vec<_>>().join("; ")
    }

    /// Seconds in each state of the light, by its name.
    pub fn light_times_s(&self) -> BTreeMap<String, f64> {
        let name = |word: &&str| LightState::name_of(word);
        LightState::WORDS.iter().map(name).zip(self.light.times_s()).collect()
    }

    /// What is seen of the light.
    pub(crate) fn light_gauge(&self) -> &LightGauge {
        &self.light
    }

    /// The run was started by hand, and waits for its first ARM.
    pub fn await_first_arm(&self) {
        self.light.await_first_arm();
    }

    /// Tells the light of a projector that shows what it was given without frames of this program: it is lit while it is
    /// up or held.
    pub fn set_projector_and_light(&self, health: ProjectorHealth) {
        self.set_projector(health);
        let is_lit = matches!(health, ProjectorHealth::Up | ProjectorHealth::Frozen);
        self.light.tell_shown(health, is_lit);
    }

    /// Makes light depend on `interlock` for the whole run. A second interlock is dropped. Set it before the run
    /// begins.
    pub fn set_interlock(&self, interlock: Interlock) {
        let _ = self.interlock.set(interlock);
    }

    /// The interlock, if light depends on one.
    pub fn interlock(&self) -> Option<&Interlock> {
        self.interlock.get()
    }

    /// True while light is permitted: there is no interlock, or it is closed. Never waits; the link thread asks with
    /// every poll.
    pub fn light_allowed(&self) -> bool {
        self.interlock.get().is_none_or(Interlock::is_closed)
    }

    /// True if the interlock has opened, and permits no light until [`RunMonitor::reset_interlock`].
    pub(crate) fn interlock_awaits_reset(&self) -> bool {
        self.interlock.get().is_some_and(Interlock::awaits_reset)
    }

    /// A person wants light again.
    pub(crate) fn reset_interlock(&self) {
        self.interlock.get().into_iter().for_each(Interlock::reset);
    }

    /// Reports, once per run, which bodies the tracker has not seen one second after its start, why, and what to do.
    /// Not for the frame path.
    pub(crate) fn tell_of_tracker(&self, unseen: BlindBodies) {
        let _ = self.tracker.set(unseen);
    }

    /// The message about the tracker, as long as it holds.
    pub fn tracker(&self) -> Option<&str> {
        self.tracker.get().filter(|unseen| unseen.holds()).map(|unseen| unseen.told.as_str())
    }

    /// Records that the thread that would return from the run hangs, so nobody should wait for it. The projector was
    /// ordered to go dark.
    pub(crate) fn give_up(&self, why: String) {
        let _ = self.gave_up.set(why);
    }

    /// Why the run will never return; `None` while it may.
    pub fn gave_up(&self) -> Option<&str> {
        self.gave_up.get().map(String::as_str)
    }

    /// What the link carries: written by its thread.
    pub(crate) fn link(&self) -> &LinkGauges {
        &self.link
    }

    /// What the link has carried so far, and what the projector has counted.
    pub fn carried(&self) -> ProjectorReport {
        self.link.report(self.live.rig().map_or("", |rig| rig.config.projector.backend.word()))
    }

    /// What observers see of the run while it goes on.
    pub fn live(&self) -> &Live {
        &self.live
    }

    /// What operators may change while the run goes on.
    pub fn parameters(&self) -> &ParameterDesk {
        &self.parameters
    }

    /// Where a device sees the observer look.
    pub fn gaze(&self) -> &GazeDesk {
        &self.gaze
    }

    /// Counts a planned frame.
    pub fn count_planned(&self) {
        self.frames_planned.fetch_add(1, Ordering::Relaxed);
    }

    /// When no new picture was wanted: written by the link's thread, read by the collector.
    pub(crate) fn dark(&self) -> &DarkLog {
        &self.dark
    }

    /// Sends the operator a message. Not for the frame path: it takes a lock.
    pub fn note(&self, text: String) {
        let mut notes = self.notes.lock().unwrap_or_else(PoisonError::into_inner);
        if notes.waiting.len() < NOTES {
            notes.waiting.push_back(text);
        } else {
            notes.left_out += 1;
        }
    }

    /// Takes the messages for the operator, oldest first. Each is returned once.
    pub fn take_notes(&self) -> Vec<String> {
        let mut notes = self.notes.lock().unwrap_or_else(PoisonError::into_inner);
        let mut all: Vec<String> = notes.waiting.drain(..).collect();
        match std::mem::take(&mut notes.left_out) {
            0 => {}
            n => all.push(format!("{n} more notes were left out")),
        }
        all
    }

    /// Sets how many of the slots decided so far wanted a frame, and how many of these were missed.
    pub(crate) fn set_slots(&self, wanted: u64, missed: u64) {
        self.slots.store(wanted, Ordering::Relaxed);
        self.slots_missed.store(missed, Ordering::Relaxed);
    }

    /// Counts a frame whose light left the projector. `dark`: every body was dark in it. `late`: it came after its
    /// slot.
    pub(crate) fn count_lit(&self, dark: bool, late: bool) {
        let frames = if dark { &self.frames_dark } else { &self.frames_lit };
        frames.fetch_add(1, Ordering::Relaxed);
        if late {
            self.frames_late.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Counts a frame that will never be lit.
    pub(crate) fn count_dropped(&self) {
        self.frames_dropped.fetch_add(1, Ordering::Relaxed);
    }

    /// Counts a frame that was not lit because no new picture was wanted.
    pub(crate) fn count_withheld(&self) {
        self.frames_withheld.fetch_add(1, Ordering::Relaxed);
    }

    /// What has become of the tracker's samples so far; `None` before the first ones.
    pub fn sample_counts(&self) -> Option<TrackerReport> {
        let rig = self.live.rig();
        self.samples.report(rig.into_iter().flat_map(|rig| rig.tracked().map(|body| body.name.as_str())))
    }

    /// What became of the tracker's samples.
    pub(crate) fn samples(&self) -> &TrackerGauges {
        &self.samples
    }

    /// Counts a frame of which the collector learns nothing.
    pub(crate) fn count_unrecorded(&self) {
        self.frames_unrecorded.fetch_add(1, Ordering::Relaxed);
    }

    /// The counters now. Each is exact, but they are not read at the same instant.
    pub fn counts(&self) -> RunCounts {
        RunCounts {
            frames_planned: self.frames_planned.load(Ordering::Relaxed),
            frames_lit: self.frames_lit.load(Ordering::Relaxed),
            frames_dark: self.frames_dark.load(Ordering::Relaxed),
            frames_withheld: self.frames_withheld.load(Ordering::Relaxed),
            frames_unrecorded: self.frames_unrecorded.load(Ordering::Relaxed),
            slots: self.slots.load(Ordering::Relaxed),
            slots_missed: self.slots_missed.load(Ordering::Relaxed),
            frames_dropped: self.frames_dropped.load(Ordering::Relaxed),
            frames_late: self.frames_late.load(Ordering::Relaxed),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What comes back by itself needs no order, and what needs one is told so.
    #[test]
    fn a_fault_says_what_brings_light_back() {
        for (mask, part) in [
            (0, "names no fault"),
            (
                faults::WATCHDOG,
                "passing faults: watchdog; no frame came in safety.watchdog_ms; light comes back by itself",
            ),
            (faults::CHECKSUM_STORM, "packets were damaged; light comes back by itself"),
            (faults::WATCHDOG | faults::LAMP, "latched faults: watchdog, lamp; `dpm arm` acknowledges them"),
            (faults::HOST_SAFE, "`dpm arm`"),
        ] {
            let told = ProjectorHealth::Faulted(mask).to_string();
            assert!(told.starts_with("dark, ") && told.contains(part), "{told}");
        }
    }

    #[test]
    fn an_order_is_taken_once_the_newest_wins_and_nothing_but_arm_takes_safe_back() {
        let monitor = RunMonitor::default();
        assert_eq!(monitor.take_order(), None);
        for (order, word) in Order::ALL {
            assert_eq!((Order::from_word(word), order.word()), (Some(order), word));
            monitor.give_order(order);
            assert_eq!((monitor.take_order(), monitor.take_order()), (Some(order), None));
        }
        // Found by the simulator: FREEZE right after BLACK left the light on.
        monitor.give_order(Order::Black);
        monitor.give_order(Order::Freeze);
        assert_eq!(monitor.take_order(), Some(Order::Black));
        monitor.give_order(Order::Arm);
        monitor.give_order(Order::Freeze);
        assert_eq!(monitor.take_order(), Some(Order::Freeze));
        monitor.give_order(Order::Safe);
        monitor.give_order(Order::Black);
        assert_eq!(monitor.take_order(), Some(Order::Safe));
        monitor.give_order(Order::Safe);
        monitor.give_order(Order::Arm);
        assert_eq!(monitor.take_order(), Some(Order::Arm));
    }

    /// Found in use, R2: the projector was armed again three times after a stop had been requested.
    #[test]
    fn r2_nothing_arms_or_holds_light_after_a_stop_was_asked_for() {
        let monitor = RunMonitor::default();
        monitor.give_order(Order::Arm);
        assert!(!monitor.dark_is_ordered());
        monitor.request_stop();
        assert!(monitor.dark_is_ordered());
        assert_eq!(monitor.take_order(), None);
        for (order, _) in Order::ALL {
            monitor.give_order(order);
            assert_eq!(monitor.take_order(), Some(order).filter(|o| o.is_dark()));
        }
    }

    #[test]
    fn a_link_that_comes_up_sees_the_dark_that_waits_and_an_overtaken_arm_is_none() {
        let monitor = RunMonitor::default();
        for (order, _) in Order::ALL {
            monitor.give_order(order);
            assert_eq!(monitor.dark_is_ordered(), matches!(order, Order::Black | Order::Safe));
            assert_eq!(monitor.take_order(), Some(order));
        }
        assert!(!monitor.take_found_safe());
        monitor.find_safe();
        assert_eq!((monitor.take_found_safe(), monitor.take_found_safe()), (true, false));
        assert_eq!(monitor.take_order(), Some(Order::Safe));
        // As if one more order had come as a signal since this ARM was requested.
        monitor.arm_unless_darkened(stopping::orders().wrapping_sub(1));
        assert_eq!(monitor.take_order(), None);
    }

    #[test]
    fn notes_are_told_once_and_do_not_pile_up() {
        let monitor = RunMonitor::default();
        assert!(monitor.take_notes().is_empty());
        (0..NOTES + 7).for_each(|k| monitor.note(k.to_string()));
        let told = monitor.take_notes();
        assert_eq!((told.len(), told[0].as_str()), (NOTES + 1, "0"));
        assert_eq!(told[NOTES], "7 more notes were left out");
        assert!(monitor.take_notes().is_empty());
    }

    #[test]
    fn the_projectors_health_crosses_the_atomic_whole() {
        use ProjectorHealth as H;
        let all = [
            H::Connecting,
            H::Up,
            H::Lost,
            H::Black,
            H::Frozen,
            H::Stopped,
            H::InterlockOpen,
            H::Resting(LimitReached::Mean),
            H::Resting(LimitReached::FullWhite),
            H::RestingAfterFlashes,
            H::Faulted(0),
            H::Faulted(u32::MAX),
        ];
        let monitor = RunMonitor::default();
        for health in all {
            monitor.set_projector(health);
            assert_eq!(monitor.projector(), health);
        }
        assert!(all.iter().all(|h| h.word().len() <= 10));
        assert!(H::Faulted(faults::LAMP).to_string().contains("lamp"));
    }
}
