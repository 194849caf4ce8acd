//! The laws that hold whatever happens. They are judged from the light itself, and from what the person ordered; of
//! the program they believe only which frame it sent with which planes, and what it tells the operator.

use crate::cable::lock;
use crate::eyes::EyeLaw;
use crate::guard::Guard;
use crate::lag::Lag;
use crate::machine::{hash, Beneath, Sent};
use crate::plan::Setup;
use crate::process::{Exit, Process};
use crate::tracks::Moment;
use dpm_device::light::{LightEvent, LightKind};
use dpm_device::link::{frame_newer, DeviceState};
use dpm_rig::control::orders::Ticket;
use dpm_rig::interlock::SILENCE_NS;
use dpm_rig::order::Order;
use dpm_rig::pipeline::stepped::{SteppedEnd, StoredOrder};
use dpm_rig::rig::Rig;
use dpm_rig::telemetry::light_state::LightState;
use dpm_rig::telemetry::monitor::{ProjectorHealth, RunCounts};
use hil_mock::motion::Motion;
use hil_mock::projector::{DeviceClock, LightChange};
use std::collections::VecDeque;
use std::sync::{Arc, Mutex};

const MS: i64 = 1_000_000;
const S: i64 = 1_000 * MS;
/// Frames that are remembered after they were sent.
const REMEMBERED: usize = 1024;
/// An order to go dark is carried out within this time when nothing is wrong ...
const DARK_WITHIN_NS: i64 = 50 * MS;
/// ... and within this time otherwise: the watchdog has done it by then.
const DARK_AT_LAST_NS: i64 = 300 * MS;
/// A program that starts finds its devices within this time.
pub(crate) const BEGINS_WITHIN_NS: i64 = 300 * MS;
/// Light returns within this time after all causes are gone.
const LIT_WITHIN_NS: i64 = S;
/// A stage may stall for a second before the program can say that an order is the reason of darkness.
const ORDER_TOLD_NS: i64 = 1_500 * MS;
/// The map of a clock whose exchanges are stamped in time is no more wrong than this, besides their travel.
const CLOCK_NS: i64 = 300_000;
/// Who plans by a clock that the projector no longer has is wrong by more than this.
const FORMER_NS: i64 = 20 * MS;
/// The body's greatest speed, metres a second.
const SPEED: f64 = 0.3;

/// A broken law.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Broken {
    /// True time, nanoseconds.
    pub at: i64,
    /// Which, and how.
    pub told: String,
}

/// A time in which frames come at a steady rate although something is wrong.
#[derive(Clone, Copy, Debug)]
pub struct Spell {
    /// When it begins, and how far apart frames may be at least and in the mean, nanoseconds.
    from: i64,
    apart_ns: i64,
    /// The share of frames that must be there.
    share: f64,
    /// The light never goes off.
    is_steady: bool,
    frames: u64,
    dark_at: Option<i64>,
    /// Faults that had struck when it was announced.
    faults: u64,
}

impl Spell {
    /// From `from` on one frame each `apart_ns` is lit, or at least the share `share` of them; `is_steady`: and the light never
    /// goes off.
    pub fn new(from: i64, apart_ns: i64, share: f64, is_steady: bool) -> Self {
        Self { from, apart_ns, share, is_steady, frames: 0, dark_at: None, faults: 0 }
    }
}

/// An order that keeps the projector dark, or its picture still.
#[derive(Clone, Copy, Debug)]
struct Standing {
    order: Order,
    since: i64,
    ticket: Ticket,
    /// It is kept over restarts.
    kept: bool,
    /// The process that it was given to has ended.
    is_orphan: bool,
}

/// The law of a limit to the mean of the light.
struct Limit {
    /// Channel and weight of each plane.
    planes: Vec<(usize, f64)>,
    plane_bytes: usize,
    /// All mirrors, in every plane of the channel that has most.
    full: f64,
    level: f64,
    window_ns: i64,
    /// Instants of slots of the last window, and their light: nanoseconds of full white.
    slots: VecDeque<(i64, f64)>,
    sum: f64,
}

impl Limit {
    fn new(rig: &Rig) -> Self {
        let planes = rig.schedule.planes().iter();
        let planes: Vec<_> = planes.map(|p| (p.channel as usize, f64::from(1u32 << p.bit))).collect();
        let of =
            |channel| planes.iter().filter(|(of, _)| *of == channel).map(|(_, weight)| weight).sum::<f64>();
        let limits = &rig.config.safety.limits;
        Self {
            full: rig.camera.raster.pixel_count() as f64 * (0..4).map(of).fold(0.0, f64::max),
            planes,
            plane_bytes: rig.camera.raster.plane_bytes(),
            level: limits.mean_level,
            window_ns: (limits.mean_window_s * S as f64) as i64,
            slots: VecDeque::new(),
            sum: 0.0,
        }
    }

    /// A slot with these planes.
    fn see(&mut self, at: i64, planes: Option<&[u8]>, slot_ns: i64) -> Result<(), String> {
        let mut drive = [0.0; 4];
        let planes = planes.unwrap_or_default().chunks(self.plane_bytes);
        for (plane, (channel, weight)) in planes.zip(&self.planes) {
            drive[*channel] += weight * f64::from(plane.iter().map(|byte| byte.count_ones()).sum::<u32>());
        }
        let light = drive.into_iter().fold(0.0, f64::max) / self.full * slot_ns as f64;
        self.slots.push_back((at, light));
        self.sum += light;
        while self.slots.front().is_some_and(|(then, _)| at - then >= self.window_ns) {
            self.sum -= self.slots.pop_front().map_or(0.0, |(_, light)| light);
        }
        let mean = self.sum / self.window_ns as f64;
        // The window is rounded up to whole slots, and the level of a picture to what the limit counts in.
        let allowed = self.level * (1.0 + 2.0 * slot_ns as f64 / self.window_ns as f64) + 1e-3;
        if mean > allowed {
            return Err(format!("the mean level of a window is {mean:.3}; {allowed:.3} are allowed"));
        }
        Ok(())
    }
}

/// An order of greater strength replaces another one.
fn strength(order: Order) -> usize {
    [Order::Freeze, Order::Black, Order::Safe].iter().position(|one| *one == order).unwrap_or(0)
}

/// See the module's documentation. All instants are true time.
pub struct Laws {
    /// The first broken law.
    pub broken: Option<Broken>,
    slot_ns: i64,
    watchdog_ns: i64,
    /// The guard that stands alone.
    alone: Option<Guard>,
    /// What may be the error of the host's map of the projector's clock, where that is judged.
    clock_ns: i64,
    /// From when to when the program stands still, if its silence is judged.
    still: Option<(i64, i64)>,
    predict_ns: Option<i64>,
    rate_hz: u32,
    is_quick: bool,
    motion: Option<Motion>,
    lag: Lag,
    /// The body's greatest acceleration, m/s2.
    acceleration: f64,
    sent: Vec<Sent>,
    /// The greatest distance between slots of frames sent lately.
    stride_ns: i64,
    last_due: i64,
    process: u64,
    last_lit: Option<(u64, u32)>,
    /// The frame on the mirrors.
    showing: Option<Sent>,
    is_lit: bool,
    lit_since: i64,
    dark_since: i64,
    /// When a mirror was lit last, and when none was.
    mirrors: [i64; 2],
    /// What the program calls the light: lit or not, and since when.
    word: (Option<bool>, i64),
    /// Since when it is dark and an order is the reason, as the program should say.
    ordered_at: i64,
    /// The planes that were looked at last have light.
    looked: (u64, bool),
    /// When a frame with light on the body was lit last.
    good_at: i64,
    good_frames: u64,
    /// Good frames at each of the last ticks.
    ticks: [u64; 11],
    tick: usize,
    standing: Option<Standing>,
    /// The interlock's contact is not closed since, and whether it only does not answer.
    open: Option<(i64, bool)>,
    /// Since then an interlock that is reset by hand waits for ARM.
    awaits_reset: Option<i64>,
    armed_at: i64,
    /// The projector reports since then that it is armed.
    armed_since: Option<i64>,
    /// Every start waits for ARM, and this one does since.
    by_hand: bool,
    awaits_arm: Option<i64>,
    /// Where a head is guarded.
    pub eyes: Option<EyeLaw>,
    /// Where the mean of the light is limited.
    limit: Option<Limit>,
    stopped_at: Option<i64>,
    died_at: Option<i64>,
    /// When the projector last heard of a program that had ended: a serial line finishes what it was given.
    echoed_at: i64,
    /// The projector hangs on a serial line.
    is_line: bool,
    started_at: i64,
    starts_in_calm: u32,
    /// Crews of this process.
    crews: u64,
    crews_seen: u64,
    hot_since: Option<i64>,
    disturbed_at: i64,
    lies_until: i64,
    clock_moved_at: i64,
    /// When ARM was ordered after FREEZE. ARM reaches the light when the disk has forgotten the standing order.
    thawed_at: i64,
    slow_disk_until: i64,
    /// Until then frames may come at fewer than all slots.
    slow_until: i64,
    spell: Option<Spell>,
    rested_until: i64,
    /// A hang has been found by then.
    hidden_until: i64,
    /// When something other than the tracker was struck last, and whether the projector's flash limit is latched.
    elsewhere_at: i64,
    has_flashed: bool,
    /// The operator was told that the body is dark, and not yet that it has light again.
    is_told: bool,
    /// When the operator was told something last.
    word_at: i64,
    /// Since then the light has been gone without a word to the operator.
    wordless_since: i64,
    /// The worst age of a pose at its first photon, as a share of what is allowed, in thousandths.
    pub worst_age_milli: i64,
    /// The longest time from calm to light.
    pub slowest_return_ns: i64,
    /// Print how far the light of each frame is from the body.
    pub is_loud: bool,
}

impl Laws {
    /// The laws for `rig`.
    pub fn new(rig: &Arc<Rig>, setup: &Setup) -> Self {
        let slot_ns = S / i64::from(setup.rate_hz);
        Self {
            broken: None,
            slot_ns,
            watchdog_ns: i64::from(rig.config.watchdog_us()) * 1000,
            alone: setup.alone,
            clock_ns: 2 * setup.travel_ns + CLOCK_NS,
            still: None,
            predict_ns: setup.predict_ms.map(|ms| i64::from(ms) * MS),
            rate_hz: setup.rate_hz,
            is_quick: setup.render_milli < 800,
            motion: setup.motion.of(1.0).ok(),
            lag: Lag::new(setup, &rig.schedule),
            acceleration: setup.motion.acceleration(),
            sent: vec![Sent::default(); REMEMBERED],
            stride_ns: slot_ns,
            last_due: 0,
            process: 0,
            last_lit: None,
            showing: None,
            is_lit: false,
            lit_since: 0,
            dark_since: 0,
            mirrors: [0; 2],
            word: (None, 0),
            ordered_at: 0,
            looked: (u64::MAX, false),
            good_at: 0,
            good_frames: 0,
            ticks: [0; 11],
            tick: 0,
            standing: None,
            open: None,
            awaits_reset: None,
            armed_at: -S,
            armed_since: None,
            by_hand: setup.alone == Some(Guard::Hand),
            awaits_arm: None,
            eyes: None,
            limit: (setup.alone == Some(Guard::Limits)).then(|| Limit::new(rig)),
            stopped_at: None,
            died_at: None,
            echoed_at: 0,
            is_line: setup.serial.is_some(),
            started_at: 0,
            starts_in_calm: 0,
            crews: 0,
            crews_seen: 0,
            hot_since: None,
            disturbed_at: 0,
            lies_until: 0,
            clock_moved_at: -S,
            thawed_at: -S,
            slow_disk_until: 0,
            slow_until: 0,
            spell: None,
            rested_until: 0,
            hidden_until: 0,
            elsewhere_at: 0,
            has_flashed: false,
            is_told: false,
            word_at: 0,
            wordless_since: 0,
            worst_age_milli: 0,
            slowest_return_ns: 0,
            is_loud: false,
        }
    }

    /// A law is broken; the first one counts.
    pub fn fail(&mut self, at: i64, told: String) {
        self.broken.get_or_insert(Broken { at, told });
    }

    /// Something was disturbed: what follows is not judged as peace for a while.
    pub fn disturbed(&mut self, t: i64) {
        self.disturbed_at = t;
        self.starts_in_calm = 0;
    }

    /// Until then the tracker may report what is not true.
    pub fn lies_until(&mut self, t: i64) {
        self.lies_until = self.lies_until.max(t);
    }

    /// A fault that the program must find by itself has been found by then.
    pub fn hidden_until(&mut self, t: i64) {
        self.hidden_until = self.hidden_until.max(t);
    }

    /// The program may still have to find a fault at `t`, and end by it.
    pub fn is_hidden(&self, t: i64) -> bool {
        t <= self.hidden_until
    }

    /// Until then the disk may still be busy with an order.
    pub fn slow_disk_until(&mut self, t: i64) {
        self.slow_disk_until = self.slow_disk_until.max(t);
    }

    /// Until then frames may come at fewer than all slots.
    pub fn slow_until(&mut self, t: i64) {
        self.slow_until = self.slow_until.max(t);
    }

    /// Frames may come at fewer than all slots at `t`.
    pub fn is_slow(&self, t: i64) -> bool {
        t <= self.slow_until
    }

    /// Something is wrong that frames bear. `faults`: those that have struck.
    pub fn spell(&mut self, spell: Spell, faults: u64) {
        self.spell = Some(Spell { faults, ..spell });
    }

    /// It ends. If other faults have struck meanwhile, or the tracker is silent, nothing is said of the frames.
    pub fn spell_is_over(&mut self, t: i64, faults: u64) {
        let Some(spell) = self.spell.take() else { return };
        let due = ((t - spell.from) / spell.apart_ns) as f64;
        if spell.faults != faults || self.standing.is_some() {
            return;
        }
        if let Some(at) = spell.dark_at.filter(|_| spell.is_steady) {
            self.fail(
                at,
                "a cable that carries every n-th frame does not carry it steadily: the light goes off".into(),
            );
        }
        if (spell.frames as f64) < spell.share * due {
            let (frames, s) = (spell.frames, (t - spell.from) as f64 * 1e-9);
            self.fail(
                t,
                format!("{frames} good frames in {s:.2} s, in which frames have settled; {due} are possible"),
            );
        }
    }

    /// The program does not run for `ns`, so it finds everything that much later.
    pub fn pauses(&mut self, t: i64, ns: i64) {
        if self.hidden_until > t {
            self.hidden_until += ns;
        }
    }

    /// The projector's or the host's clock moved.
    pub fn clock_moved(&mut self, t: i64) {
        self.clock_moved_at = self.clock_moved_at.max(t);
    }

    /// Something other than the tracker is struck: frames may be lost, late or not drawn, and the projector may flash without
    /// the host.
    pub fn struck_elsewhere(&mut self, t: i64) {
        self.elsewhere_at = t;
    }

    /// Whatever the tracker does, the host acts on flashes before the projector's own limit latches.
    pub fn flashes(&mut self, t: i64, has_flashed: bool) {
        // The limit counts what was within a second, and soon after the fault all frames are drawn and sent as usual.
        if has_flashed && !self.has_flashed && t - self.elsewhere_at > 1_200 * MS {
            self.fail(t, "the projector latched a limit of its own before the host acted".into());
        }
        self.has_flashed = has_flashed;
    }

    /// The projector has a cause for a fault.
    pub fn hot(&mut self, t: i64) {
        self.hot_since = Some(t);
    }

    /// A person has acknowledged the projector's faults, or the projector has lost its memory.
    pub fn acknowledged(&mut self) {
        self.hot_since = None;
    }

    /// The program was asked to stop.
    pub fn asked_to_stop(&mut self, t: i64) {
        self.stopped_at.get_or_insert(t);
    }

    /// The program was killed.
    pub fn died(&mut self, t: i64) {
        self.died_at = Some(t);
    }

    /// Bytes of a program that has ended reach the projector.
    pub fn heard_of_the_dead(&mut self, t: i64) {
        self.echoed_at = t;
    }

    /// The program stands still from `t` until `until`.
    pub fn stands_still(&mut self, t: i64, until: i64) {
        let since = self.still.filter(|(_, end)| t < *end).map_or(t, |(since, _)| since);
        self.still = Some((since, until)).filter(|_| self.alone == Some(Guard::Watchdog));
    }

    /// Since when the program has said nothing, because it stands still or is no more.
    pub fn silent_since(&self) -> Option<i64> {
        self.died_at.or(self.still.map(|(since, _)| since))
    }

    /// A frame that was on its way reaches the projector.
    pub fn heard_of_the_silent(&mut self, t: i64) {
        if self.silent_since().is_some() {
            self.echoed_at = t;
        }
    }

    /// Silence after which the projector is dark by itself, as far as anything relies on it: where the watchdog is switched off,
    /// what it does elsewhere is asked of the others.
    fn usual_watchdog_ns(&self) -> i64 {
        self.watchdog_ns.min((50 * MS).max(3 * self.slot_ns + MS))
    }

    /// The program starts.
    pub fn started(&mut self, t: i64, is_calm: bool) {
        (self.stopped_at, self.died_at, self.still) = (None, None, None);
        self.started_at = t;
        (self.crews, self.is_told) = (1, false);
        self.awaits_arm = self.by_hand.then_some(t);
        self.starts_in_calm += u32::from(is_calm);
        self.process += 1;
        if self.starts_in_calm > 4 {
            self.fail(t, "the program was started four times although nothing is wrong".into());
        }
    }

    /// True while the person wants it dark, or still.
    pub fn has_standing_order(&self) -> bool {
        self.standing.is_some() || self.awaits_arm.is_some()
    }

    /// The interlock's contact closes (0), opens (1) or does not answer (2). `by_hand`: the program that asks it needs ARM after
    /// that.
    pub fn contact(&mut self, t: i64, state: u8, by_hand: bool) {
        if state != 0 {
            self.open.get_or_insert((t, state == 2));
            return;
        }
        let Some((since, hangs)) = self.open.take() else { return };
        // It is asked every 5 ms, and counts as silent after a tenth of a second.
        let found_ns = if hangs { SILENCE_NS + 30 * MS } else { 30 * MS };
        if by_hand && t - since.max(self.started_at) > found_ns && t - self.armed_at > S {
            self.awaits_reset.get_or_insert(since);
        }
    }

    /// The person ordered something.
    pub fn ordered(&mut self, order: Order, ticket: Ticket, t: i64) {
        if order == Order::Arm {
            (self.awaits_arm, self.armed_at) = (None, t);
            if self.open.is_none() {
                self.awaits_reset = None;
            }
            if self.is_frozen() {
                self.thawed_at = t;
            }
            (self.standing, self.hot_since) = (None, None);
            return;
        }
        if self.standing.is_some_and(|s| strength(s.order) > strength(order)) {
            return;
        }
        if self.is_frozen() {
            self.thawed_at = t;
        }
        let since = self.standing.filter(|s| s.order == order).map_or(t, |s| s.since);
        self.ordered_at = self.ordered_at.max(since);
        self.standing = Some(Standing { order, since, ticket, kept: false, is_orphan: false });
    }

    /// What stands when `process` ends, in whatever way.
    pub fn order_at_exit(&mut self, process: &Process, t: i64) {
        if self.is_frozen() {
            self.thawed_at = t;
        }
        if !matches!(process.orders.kept(), Some(Order::Black | Order::Safe)) {
            self.awaits_reset = None;
        }
        let Some(standing) = &mut self.standing else { return };
        standing.kept |= process.orders.outcome(standing.ticket) == Some(StoredOrder::Kept);
        standing.is_orphan = true;
        if standing.order == Order::Freeze {
            // No frame is left to hold: it stands as BLACK once the projector has noticed the end of the program.
            (standing.order, standing.since) = (Order::Black, t + self.watchdog_ns);
        }
        if !standing.kept {
            // Nobody promised that it outlives the program.
            self.standing = None;
        }
    }

    /// The program has ended by itself.
    pub fn exited(&mut self, exit: &Exit, counts: &RunCounts, end: Option<&SteppedEnd>, t: i64) {
        self.died_at = Some(t);
        if let (Exit::InOrder, Some(_)) = (exit, end) {
            // A frame that was begun is in one of the results, or was still being made.
            let open = counts.frames_planned.abs_diff(counts.frames_done());
            // Frames of a crew that was abandoned stay with its threads.
            if open > 8 * self.crews.max(1) {
                self.fail(t, format!("{open} frames have no result: {counts:?}"));
            }
        }
    }

    /// The person wants the picture held.
    pub(crate) fn is_frozen(&self) -> bool {
        self.standing.is_some_and(|s| s.order == Order::Freeze && !s.is_orphan)
    }

    /// The frame `frame` that this process has sent lately.
    pub(crate) fn sent(&self, frame: u32) -> Option<&Sent> {
        let sent = &self.sent[frame as usize % REMEMBERED];
        (sent.frame == frame && sent.process == self.process).then_some(sent)
    }

    /// What may be expected of light at `t`, if the host's clock lags by `lag`.
    pub(crate) fn moment(&self, t: i64, lag: i64) -> Moment {
        Moment {
            t,
            lag,
            is_peaceful: t - self.disturbed_at > 2 * S,
            is_true: t >= self.lies_until + S && t - self.started_at >= S,
            is_steady: t - self.clock_moved_at > 4 * S,
        }
    }

    /// True if a second of peace is over in which nearly every slot has its own frame. `crew_ready`: when the last crew was.
    pub(crate) fn is_in_peace(&self, t: i64, calm_for: i64, crew_ready: i64) -> bool {
        let is_calm = calm_for > 2 * S && t - self.good_at < S && t - self.disturbed_at > 3 * S;
        // The run may end when a hang is found.
        let is_whole = t > self.hidden_until + S && t > self.slow_until;
        let has_seen = self.eyes.as_ref().is_none_or(|eyes| t > eyes.blind_until(crew_ready) + 3 * S);
        is_calm
            && is_whole
            && self.is_quick
            && has_seen
            && self.limit.is_none()
            && t - crew_ready > 3 * S
            && t - self.started_at > 4 * S
    }

    pub(crate) fn remember(&mut self, beneath: &Arc<Mutex<Beneath>>) {
        let mut beneath = lock(beneath);
        while let Some(sent) = beneath.sent.pop_front() {
            let stride = (sent.due_at - self.last_due).clamp(self.slot_ns, S);
            self.last_due = sent.due_at;
            self.stride_ns = stride.max(self.stride_ns - self.stride_ns / 16);
            let place = sent.frame as usize % REMEMBERED;
            self.sent[place] = sent;
        }
    }

    /// Light went on or off.
    pub fn change(&mut self, change: &LightChange, _: i64) {
        let at = change.at.0;
        match (self.is_lit, change.frame.is_some()) {
            (false, true) => {
                (self.is_lit, self.lit_since) = (true, at);
                self.must_be_dark(at, "light goes on");
            }
            (true, false) => {
                self.must_be_dark(at - 1, "light goes off only now");
                if let Some(spell) = self.spell.as_mut().filter(|spell| at >= spell.from) {
                    spell.dark_at.get_or_insert(at);
                }
                (self.is_lit, self.dark_since) = (false, at);
                self.showing = None;
            }
            _ => {}
        }
        if change.state == DeviceState::Faulted {
            self.rested_until = self.rested_until.max(at);
        }
    }

    /// Whether the projector is armed, as it reports, while the program runs. Light may be far off, but who armed it did so
    /// against somebody's word.
    pub fn armed(&mut self, t: i64, is_armed: bool) {
        if !is_armed {
            self.armed_since = None;
            return;
        }
        let since = *self.armed_since.get_or_insert(t);
        // What was on its way when the word was given arrives, and what was lost is repeated. Where all words are lost, or none
        // is judged, this says nothing.
        let is_judged = !matches!(self.alone, Some(Guard::Session | Guard::Unconfirmed));
        if t - since < DARK_AT_LAST_NS || !is_judged {
            return;
        }
        let standing = self.standing.filter(|s| s.order != Order::Freeze);
        let open = self.open.map(|(since, hangs)| since + if hangs { SILENCE_NS } else { 0 });
        let against = [
            (standing.map(|s| s.since), standing.map_or("", |s| s.order.word())),
            (self.stopped_at, "a stop"),
            (self.awaits_arm, "a start by hand"),
            (self.hot_since, "a fault that waits for a person"),
            (open, "an open interlock"),
        ];
        if let Some((given, word)) =
            against.into_iter().find_map(|(given, word)| Some((given.filter(|given| *given < since)?, word)))
        {
            let ms = (since - given) / MS;
            self.fail(t, format!("the projector was armed {ms} ms after {word}, and nobody gave ARM"));
        }
    }

    /// What stands when a program begins: nothing weaker than what the one before had kept.
    pub fn begins_with(&mut self, kept: Option<Order>, t: i64) {
        let has_kept = self.standing.filter(|s| s.kept && s.order == Order::Safe);
        if has_kept.is_some() && kept != Some(Order::Safe) {
            self.fail(t, format!("SAFE was kept, and the program begins with {kept:?}"));
        }
    }

    /// Frames that were sent just now to a projector that is armed: their slots are slots of its clock, which it may have
    /// had anew since they were planned.
    pub fn judge_sent(&mut self, t: i64, beneath: &Arc<Mutex<Beneath>>, clock: DeviceClock, lag: i64) {
        if t - self.clock_moved_at > 4 * S {
            let off = |sent: &Sent| clock.instant_of(sent.target_at).0 - lag - sent.due_at;
            let wrong =
                lock(beneath).sent.iter().find(|sent| off(sent).abs() > FORMER_NS).map(|s| (s.frame, off(s)));
            if let Some((frame, off)) = wrong {
                self.fail(
                    t,
                    format!(
                        "frame {frame} is sent for a slot that is {} ms off by the projector's clock",
                        off / MS
                    ),
                );
            }
        }
    }

    /// Light at `at` is against the law if it was to be dark by then.
    fn must_be_dark(&mut self, at: i64, what: &str) {
        let peaceful = |since: i64, disturbed: i64| since - disturbed > 2 * S;
        let allowed = |since: i64, me: &Self| {
            if peaceful(since, me.disturbed_at.min(since)) && me.disturbed_at <= since {
                DARK_WITHIN_NS
            } else {
                DARK_AT_LAST_NS.max(me.usual_watchdog_ns() + 50 * MS)
            }
        };
        // What a program has not said before it ended, or greeted the projector, does not reach it: elsewhere the watchdog ends
        // that light.
        let orders_count = self.alone != Some(Guard::Session);
        if let Some(s) = self.standing.filter(|s| orders_count && s.order != Order::Freeze) {
            let late = at - s.since;
            if late > allowed(s.since, self) {
                let how = if s.is_orphan { ", which was kept over a restart" } else { "" };
                self.fail(
                    at,
                    format!("{what} {} ms after {}{how}", late / MS, s.order.word().to_uppercase()),
                );
            }
        }
        if let Some((since, hangs)) = self.open {
            let silence_ns = if hangs { SILENCE_NS } else { 0 };
            if at - since > allowed(since, self) + silence_ns {
                self.fail(at, format!("{what} {} ms after the interlock opened", (at - since) / MS));
            }
        } else if let Some(since) =
            self.awaits_reset.filter(|since| at - since > allowed(*since, self) + SILENCE_NS)
        {
            self.fail(
                at,
                format!(
                    "{what}, and nobody gave ARM since the interlock opened {} ms ago",
                    (at - since) / MS
                ),
            );
        }
        if let Some(since) = self.awaits_arm {
            if at - since > self.usual_watchdog_ns() + self.slot_ns {
                self.fail(
                    at,
                    format!("{what}, and nobody gave ARM since the start {} ms ago", (at - since) / MS),
                );
            }
        }
        if let Some(since) = self.stopped_at.filter(|_| orders_count) {
            if at - since > allowed(since, self) {
                self.fail(at, format!("{what} {} ms after a stop was asked for", (at - since) / MS));
            }
        }
        if let Some(since) = self.died_at {
            if at - since.max(self.echoed_at) > self.watchdog_ns + self.slot_ns + 2 * MS {
                self.fail(at, format!("{what} {} ms after the program died", (at - since) / MS));
            }
        }
        if let Some((since, _)) = self.still.filter(|(_, until)| at < *until) {
            if at - since.max(self.echoed_at) > self.watchdog_ns + self.slot_ns + 2 * MS {
                self.fail(at, format!("{what} {} ms after the program was stopped", (at - since) / MS));
            }
        }
        if let Some(since) = self.hot_since {
            if at - since > self.slot_ns + MS {
                self.fail(
                    at,
                    format!("{what} {} ms after a fault that waits for a person", (at - since) / MS),
                );
            }
        }
    }

    /// What the mirrors showed in a slot. `planes`: those on the mirrors.
    pub fn light(
        &mut self,
        event: &LightEvent,
        planes: Option<&[u8]>,
        lag: i64,
        beneath: &Arc<Mutex<Beneath>>,
        clock: DeviceClock,
    ) {
        let at = event.first_photon_at.0;
        if let Some(limit) = &mut self.limit {
            let planes = planes.filter(|_| event.kind != LightKind::Blank);
            if let Err(told) = limit.see(at, planes, self.slot_ns) {
                self.fail(at, told);
            }
        }
        if event.kind == LightKind::Blank {
            return;
        }
        self.must_be_dark(at, "a slot is lit");
        // While a clock jumps, several slots begin at one instant.
        let crew_ready = lock(beneath).crew_ready_at + lag;
        let is_known = |eyes: &&mut EyeLaw| at - self.clock_moved_at > S && at > eyes.blind_until(crew_ready);
        let eyes = self.eyes.as_mut().filter(is_known).zip(planes);
        if let Some(Err(told)) = eyes.map(|(eyes, planes)| eyes.see(planes, at, event.last_photon_at.0)) {
            self.fail(at, told);
        }
        if event.kind == LightKind::Repeated {
            return self.held_too_long(at, lag);
        }
        self.remember(beneath);
        let Some(frame) = event.frame else { return };
        let sent = self.sent[frame as usize % REMEMBERED].clone();
        // A frame of the process before may still wait in the projector until its watchdog bites.
        let is_old = sent.process + 1 == self.process
            && at - self.started_at < self.usual_watchdog_ns() + self.slot_ns;
        if sent.frame == frame && is_old {
            self.showing = Some(sent);
            return;
        }
        if sent.frame != frame || sent.process != self.process {
            return self.fail(at, format!("frame {frame} is lit, and this process has not sent it lately"));
        }
        if let Some((_, last)) = self.last_lit.filter(|(process, _)| *process == self.process) {
            if !frame_newer(frame, last) {
                return self.fail(at, format!("frame {frame} is lit after frame {last}"));
            }
        }
        self.last_lit = Some((self.process, frame));
        // While a clock jumps, several slots begin at one instant, and the mirrors show the last of them. Where the projector
        // finds in this slot that the field flashes too often, it is dark before a photon has left.
        if planes.is_some_and(|planes| hash(planes) != sent.hash) && at - self.clock_moved_at > S {
            return self.fail(at, format!("frame {frame} is lit with other planes than were sent"));
        }
        self.judge_clock(&sent, at, lag, clock);
        self.judge_pose(&sent, at, event.last_photon_at.0, lag);
        if sent.captured_at.is_some() {
            self.good_at = at;
            self.good_frames += 1;
            if let Some(spell) = self.spell.as_mut().filter(|spell| at >= spell.from) {
                spell.frames += 1;
            }
            self.wordless_since = at;
        }
        self.showing = Some(sent);
    }

    /// A frame is shown again.
    fn held_too_long(&mut self, at: i64, lag: i64) {
        if self.alone.is_some_and(|guard| guard.stretches_ns() > 0) {
            return;
        }
        // Where the disk refuses to forget FREEZE, a person orders ARM again, which takes a moment.
        if at < self.slow_disk_until + S {
            return;
        }
        let Some(sent) = &self.showing else { return };
        // A frame that is black because a head is lost lasts as long as it would with light.
        if self.eyes.is_some() && sent.captured_at.is_none() {
            return;
        }
        if self.is_frozen() || at - self.clock_moved_at < 4 * S || at - self.thawed_at < DARK_AT_LAST_NS {
            return;
        }
        let predict_ns = self.predict_ns.unwrap_or(sent.predict_ns);
        let held = at - lag - sent.due_at;
        // `dark from`: three slots after its own, or until its poses are older than prediction reaches and a slot. Where nothing
        // ages, prediction's reach after its own slots.
        let fresh = sent
            .captured_at
            .map_or(predict_ns, |captured_at| captured_at + predict_ns + self.slot_ns - sent.due_at);
        let allowed = fresh.max(3 * self.slot_ns) + self.stride_ns + 2 * self.slot_ns + 5 * MS;
        if held > allowed {
            let frame = sent.frame;
            self.fail(
                at,
                format!(
                    "frame {frame} is still lit {} ms after its slot; {} ms are allowed",
                    held / MS,
                    allowed / MS
                ),
            );
        }
    }

    /// The slot of a frame begins when the host has said, as well as its exchanges with the projector can tell. Only judged where
    /// the link is served late: that says nothing of when answers arrived.
    fn judge_clock(&mut self, sent: &Sent, at: i64, lag: i64, clock: DeviceClock) {
        if self.alone != Some(Guard::Clock) || at - self.clock_moved_at < 4 * S {
            return;
        }
        let off_ns = clock.instant_of(sent.target_at).0 - lag - sent.due_at;
        if off_ns.abs() > self.clock_ns {
            let (off_us, allowed_us) = (off_ns / 1000, self.clock_ns / 1000);
            let frame = sent.frame;
            self.fail(
                at,
                format!("frame {frame}: its slot begins {off_us} us later than the host thinks; {allowed_us} us are allowed"),
            );
        }
    }

    /// How old the poses are at the first photon, and how far the light is from the body.
    fn judge_pose(&mut self, sent: &Sent, at: i64, last: i64, lag: i64) {
        let Some(captured_at) = sent.captured_at else { return };
        if at - self.clock_moved_at < 4 * S {
            return;
        }
        let age = at - lag - captured_at;
        let predict_ns = self.predict_ns.unwrap_or(sent.predict_ns);
        // The clocks are known to a fraction of a millisecond only.
        let mut allowed = predict_ns + self.slot_ns + MS;
        // The host knows how long frames took on a line, or on a cable that has become slow, not how long the next one takes: the line may stall, or the last ones
        // were smaller. It does not trust the port's rate either, which many adapters ignore. `dark from` bounds the light: for
        // three slots after its own a frame may be lit, whatever its age. The clock is known to a few milliseconds only.
        if self.is_line || at <= self.slow_until {
            allowed = allowed.max(sent.due_at + self.stride_ns + 3 * self.slot_ns + 4 * MS - captured_at);
        }
        self.worst_age_milli = self.worst_age_milli.max(age * 1000 / allowed);
        if age > allowed {
            let frame = sent.frame;
            return self.fail(
                at,
                format!(
                    "frame {frame}: poses are {:.2} ms old at the first photon; {:.2} ms are allowed; its slot began {:.2} ms \
                     after it was sent, its light {:.2} ms",
                    age as f64 * 1e-6,
                    allowed as f64 * 1e-6,
                    (sent.due_at - sent.sent_at) as f64 * 1e-6,
                    (at - lag - sent.sent_at) as f64 * 1e-6
                ),
            );
        }
        if at < self.lies_until + S || at - self.started_at < S {
            return;
        }
        let Some(motion) = &self.motion else { return };
        let truth = motion.pose_at((at + last) / 2).position_m;
        let off = truth.iter().zip(sent.position).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt();
        let (age_s, late_s) = (age as f64 * 1e-9, (at - lag - sent.due_at).max(0) as f64 * 1e-9);
        if self.is_loud {
            println!(
                "{:>12.6} s      frame {}: {:.2} mm off, poses {:.1} ms old",
                at as f64 * 1e-9,
                sent.frame,
                off * 1e3,
                age_s * 1e3
            );
        }
        self.lag.see(motion, sent.position, [at, last], age_s);
        let peace = at - self.disturbed_at > 2 * S;
        // The filter's error: noise in peace; a wrong speed after a gap.
        let slack = if peace { 0.002 } else { 0.004 + 2.0 * SPEED * age_s };
        // At its worst the filter takes noise for an acceleration of 40 m/s^2, for the 12 ms that it carries one on.
        // Poses are predicted to the middle of the light, which is half an exposure after the first photon.
        let clock_s = self.lag.clock_s();
        let far_s = age_s + 0.5 * (last - at) as f64 * 1e-9 + clock_s;
        let slack = slack + 40.0 * 0.012 * far_s;
        let allowed = slack + 0.5 * self.acceleration * far_s * far_s + SPEED * (late_s + clock_s);
        if off > allowed {
            let frame = sent.frame;
            self.fail(
                at,
                format!(
                    "frame {frame}: the light is {:.1} mm off the body; {:.1} mm are allowed; poses are {:.1} ms old, light \
                     is {:.1} ms after its slot; x is {:.4} and should be {:.4}, slots {:.3}",
                    off * 1e3,
                    allowed * 1e3,
                    age_s * 1e3,
                    late_s * 1e3,
                    sent.position[0],
                    truth[0],
                    self.slot_ns as f64 * 1e-6
                ),
            );
        }
    }

    /// The greatest lag of a quiet second, as a share of what is allowed, in thousandths.
    pub fn worst_lag_milli(&self) -> i64 {
        self.lag.worst_milli
    }

    /// The planes on the mirrors at `t`; `None` while the light is off.
    pub fn mirrors(&mut self, t: i64, planes: Option<(u64, &[u8])>) {
        let is_lit = planes.is_some_and(|(generation, planes)| {
            if self.looked.0 != generation {
                self.looked = (generation, planes.iter().any(|byte| *byte != 0));
            }
            self.looked.1
        });
        self.mirrors[usize::from(!is_lit)] = t;
    }

    /// What the program calls the light at `t` is not wrong for longer than a second; `None` while it says nothing.
    pub fn word(&mut self, t: i64, word: Option<LightState>) {
        // A clock that is wrong makes the last second longer or shorter, and who is told another `dark from` than was said is lit
        // for longer.
        let is_told = self.alone.is_none_or(|guard| guard.stretches_ns() == 0);
        let word = word.filter(|_| is_told && t - self.clock_moved_at > S);
        let says_lit = word.map(LightState::is_lit);
        if self.word.0 != says_lit {
            self.word = (says_lit, t);
        }
        let Some(word) = word else {
            self.ordered_at = t;
            return;
        };
        let is_ordered = self.standing.is_some() && self.stopped_at.is_none();
        if !is_ordered || word.is_lit() || t < self.hidden_until + S {
            self.ordered_at = t;
        }
        // Of several orders the strongest counts, also after a restart.
        let ordered = self.standing.map_or(0, |standing| strength(standing.order));
        let is_named = matches!(word, LightState::DarkByOrder(order) if strength(order) >= ordered);
        if t - self.ordered_at > ORDER_TOLD_NS && !is_named {
            self.fail(
                t,
                format!("it has been dark by order for {} ms, and is called {word:?}", ORDER_TOLD_NS / MS),
            );
        }
        let [lit_at, dark_at] = self.mirrors;
        let since = t - self.word.1.max(if word.is_lit() { lit_at } else { dark_at });
        if since > S {
            let light = if word.is_lit() { "no mirror has been lit" } else { "mirrors have been lit" };
            self.fail(
                t,
                format!("the light is called {} ({word:?}), and {light} for {} ms", word.word(), since / MS),
            );
        }
    }

    /// True when the light has been steady lately.
    pub fn is_lit_well(&self, t: i64) -> bool {
        t - self.good_at < 2 * self.stride_ns + 30 * MS
    }

    /// What no event triggers. `calm_for`: how long nothing has been wrong, negative if something is. `crew`: when the
    /// last crew was ready, and how many there were.
    pub fn tick(
        &mut self,
        t: i64,
        calm_for: i64,
        process: Option<&mut Process>,
        crew: (i64, u64),
        longest: usize,
        is_frozen: bool,
    ) {
        if self.is_lit {
            self.must_be_dark(t, "it is lit");
        }
        if longest > 400 {
            self.fail(t, format!("{longest} transfers wait on the cable"));
        }
        self.crews += crew.1 - std::mem::replace(&mut self.crews_seen, crew.1);
        self.tick = (self.tick + 1) % self.ticks.len();
        let before = std::mem::replace(&mut self.ticks[self.tick], self.good_frames);
        if self.is_in_peace(t, calm_for, crew.0) {
            let frames = self.good_frames - before;
            // Ten ticks are a second, and the window is eleven; a tenth may be missing.
            if frames * 10 < u64::from(self.rate_hz) * 9 {
                self.fail(
                    t,
                    format!("{frames} good frames in 1.1 s of peace at {} per second", self.rate_hz),
                );
            }
        }
        if let Err(told) = self.lag.tick(self.is_in_peace(t, calm_for, crew.0)) {
            self.fail(t, told);
        }
        let health = process.as_ref().map(|p| p.health());
        if matches!(health, Some(ProjectorHealth::Resting(_) | ProjectorHealth::RestingAfterFlashes)) {
            self.rested_until = t;
        }
        self.words(t, process, is_frozen);
        self.light_is_due(t, calm_for, crew.0, health);
    }

    /// Every second of darkness has its reason.
    fn words(&mut self, t: i64, process: Option<&mut Process>, is_frozen: bool) {
        let Some(process) = process else {
            self.wordless_since = t;
            return;
        };
        if is_frozen {
            // It cannot say anything.
            self.wordless_since = t;
        }
        let notes = process.monitor.take_notes();
        for note in &notes {
            self.is_told = note.contains("is dark:") || self.is_told && !note.contains("has light again");
        }
        if !notes.is_empty() {
            self.word_at = t;
        }
        let has_word = !notes.is_empty()
            || self.is_told
            || process.health() != ProjectorHealth::Up
            || !process.run.is_running()
            || process.is_stopping;
        if has_word || process.monitor.tracker().is_some() {
            // A word stands until there is light again.
            self.wordless_since = i64::MAX;
        }
        if self.wordless_since == i64::MAX && t - self.good_at < 200 * MS && self.good_at > self.word_at {
            self.wordless_since = t;
        }
        if self.wordless_since != i64::MAX
            && t > self.hidden_until + 500 * MS
            && t - self.wordless_since.max(self.good_at) > 1_500 * MS
        {
            self.fail(t, "no light for 1.5 s, the projector is called up, and no note says why".into());
        }
    }

    /// Light must be back soon after all causes are gone.
    fn light_is_due(&mut self, t: i64, calm_for: i64, crew_ready: i64, health: Option<ProjectorHealth>) {
        if calm_for < 0 || t - self.good_at < 200 * MS {
            if calm_for >= 0 && t - self.good_at < 200 * MS {
                self.starts_in_calm = 0;
            }
            return;
        }
        let calm_since = t - calm_for;
        // What the law does not count: the GPU's own time, the service manager's second, a rest after flashes.
        let begin = calm_since.max(crew_ready).max(self.rested_until + 2 * S);
        let begin = begin.max(self.started_at + BEGINS_WITHIN_NS).max(self.hidden_until);
        let begin = self.eyes.as_ref().map_or(begin, |eyes| begin.max(eyes.blind_until(crew_ready)));
        let slow = 4 * self.stride_ns + 12 * self.slot_ns;
        let late = t - begin;
        self.slowest_return_ns = self.slowest_return_ns.max(late);
        if late > LIT_WITHIN_NS + slow {
            self.fail(
                t,
                format!(
                    "no light {:.1} s after all causes were gone; the projector is {health:?}",
                    calm_for as f64 * 1e-9
                ),
            );
        }
    }
}
