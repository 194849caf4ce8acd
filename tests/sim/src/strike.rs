//! What a fault of each kind does to the world, and how it is undone.

use crate::cable::{lock, CableFaults};
use crate::dice::Dice;
use crate::guard::Guard;
use crate::kinds::{Kind, State};
use crate::laws::Spell;
use crate::machine::{GpuTrap, OpenTrap, Queue, Trap};
use crate::net::{NetFaults, ServerKind};
use crate::process::SimContact;
use crate::world::{projector_of, server_kind, Action, Undo, World, MS, OSC_TOKEN, S};
use dpm_device::link::Packet;
use dpm_device::link::{faults, HostLink, SessionNumbers};
use dpm_device::planes::Raster;
use dpm_device::time::HostTime;
use dpm_device::transport::{Lane, LinkDevice, SendError, Transport, TransportError};
use dpm_rig::order::Order;
use dpm_rig::pipeline::projector::link_settings;
use dpm_rig::pipeline::stepped::RunPart;
use dpm_rig::telemetry::monitor::ProjectorHealth;

/// A transport that keeps what is sent: the words of a second host.
#[derive(Default)]
struct Words(Vec<Vec<u8>>);

impl Transport for Words {
    fn send(&mut self, _: HostTime, _: Lane, packets: &[Packet<'_>]) -> Result<(), SendError> {
        self.0.extend(packets.iter().map(|packet| packet.to_vec()));
        Ok(())
    }

    fn receive(
        &mut self,
        _: HostTime,
        _: &mut dyn FnMut(Lane, HostTime, &[u8]),
    ) -> Result<(), TransportError> {
        Ok(())
    }

    fn name(&self) -> &str {
        "second host"
    }
}

/// A GPU that does not finish is given up after this time at the latest: two seconds after the frames before it, of which one may have taken two.
const GPU_FOUND_NS: i64 = 4_000 * MS;
/// The same for a frame of the next crew: the time in which that crew is made, and two seconds.
const GPU_AGAIN_NS: i64 = 3_000 * MS;
const STAGES: [RunPart; 5] =
    [RunPart::Tracking, RunPart::Plan, RunPart::Pack, RunPart::Link, RunPart::Collector];

impl World {
    /// A fault of `kind` strikes; `seed` decides its details.
    pub(crate) fn strike(&mut self, kind: Kind, seed: u64) {
        let mut dice = Dice::new(seed, 0x57);
        use Kind as K;
        match kind {
            K::T1 | K::T2 | K::T3 | K::T4 | K::T5 | K::T6 | K::T7 | K::T8 | K::T9 | K::T10 => {
                self.strike_samples(kind, &mut dice);
            }
            K::T11 | K::T12 | K::T14 | K::T15 | K::T17 => self.strike_server(kind, &mut dice),
            K::T13 | K::T16 | K::N1 | K::N2 | K::N6 | K::N7 => self.strike_net(kind, &mut dice),
            K::U1 | K::U2 | K::U9 | K::U14 => self.strike_plug(kind, &mut dice),
            K::U3 | K::U4 | K::U5 | K::U6 | K::U7 | K::U10 => self.strike_cable(kind, &mut dice),
            K::U8 | K::U11 | K::U12 | K::U13 => self.strike_projector(kind, &mut dice),
            K::G1 | K::G2 | K::G4 | K::G5 | K::G6 | K::G7 | K::G8 => self.strike_gpu(kind, &mut dice),
            K::U15
            | K::H2
            | K::H6
            | K::X2
            | K::X3
            | K::X4
            | K::X5
            | K::X6
            | K::H3
            | K::H5
            | K::X1
            | K::X7 => {
                self.strike_process(kind, &mut dice);
            }
            K::H1 | K::H4 | K::H8 | K::H9 | K::H10 | K::H11 | K::N3 | K::N4 | K::N5 => {
                self.strike_host(kind, &mut dice);
            }
            K::H7 | K::F1 | K::F2 | K::F3 | K::F4 | K::F5 | K::F6 | K::F7 | K::F8 | K::F9 | K::F10 => {
                self.bad_file = true;
                self.lasts(kind, dice.between(100, 1_500) * MS, Undo::File);
            }
            K::X8 => {
                lock(&self.cable).faults.control_late_ns = dice.decades(200_000, 30_000_000);
                self.lasts(kind, dice.decades(2, 1_500) * MS, Undo::Cable);
            }
            K::X9 | K::X10 | K::X11 => self.strike_line(kind, &mut dice),
            K::X17 | K::X18 => self.strike_flow(kind, &mut dice),
            K::T18 => self.strike_tracker_line(&mut dice),
            K::X12 | K::X13 | K::X14 | K::X15 | K::X16 => self.strike_connection(kind, &mut dice),
            K::X19 => self.strike_interlock(&mut dice),
            K::X20 => {
                let word = dice.one_of(&["arm", "arm", "freeze", "black", "safe"]);
                let token = dice.one_of(&[None, None, Some(OSC_TOKEN), Some("curtainx"), Some("c")]);
                self.hear_osc(word, token, dice.happens(0.6));
                self.lasts(kind, MS, Undo::Nothing);
            }
            K::X21 => {
                lock(&self.disk).calls.fail_in(dice.between(0, 5) as u32);
                self.give(dice.one_of(&[Order::Safe, Order::Black, Order::Freeze]));
                if dice.happens(0.3) {
                    self.plan(self.t + dice.between(1, 60) * MS, Action::Kill);
                }
                let until = dice.decades(50, 500) * MS;
                self.laws.slow_disk_until(self.t + until);
                self.lasts(kind, until, Undo::Disk);
            }
            K::X25 | K::X26 => self.strike_head(kind, &mut dice),
            K::X27 => {
                lock(&self.net).calls.fail_in(dice.between(0, 20) as u32);
                self.lasts(kind, 500 * MS, Undo::Calls);
            }
            K::X28 => {
                lock(&self.cable).calls.fail_in(dice.between(0, 20) as u32);
                self.lasts(kind, 500 * MS, Undo::Calls);
            }
            K::X22 => self.lose_orders(&mut dice),
            K::X23 => self.strike_latch(&mut dice),
            K::X24 => {
                // The rest ends while the order stands: two seconds after it began at the latest.
                self.again(kind, dice.bits(), 60);
                self.lasts(kind, 3_500 * MS, Undo::Nothing);
            }
            K::G3 | K::G9 => self.lasts(kind, MS, Undo::Nothing),
        }
    }

    fn strike_samples(&mut self, kind: Kind, dice: &mut Dice) {
        use Kind as K;
        let period_us = 1_000_000 / i64::from(self.setup.tracker_hz);
        let at = self.t / 1000;
        let long_us = dice.decades(20, 1_500) * 1000;
        let (fault, us) = match kind {
            K::T1 => ("dropout", dice.between(1, 3) * period_us),
            K::T2 => ("dropout", 100_000 + long_us),
            K::T3 => ("dropout", dice.between(10, 60) * 1000),
            K::T4 => ("stuck", long_us),
            K::T5 => ("invalid=1", long_us),
            K::T6 => ("jump=3", 0),
            K::T7 => ("nan=0.5", long_us),
            K::T8 => (dice.one_of(&["norm=0.5", "flip=0.5"]), long_us),
            K::T9 => ("duplicate=0.5", long_us),
            _ => (dice.one_of(&["reorder=0.5", "slow=30ms"]), long_us),
        };
        let text = match kind {
            K::T6 => format!("{fault}@{at}us"),
            K::T3 => format!("{fault}@{at}us+{us}us/{}us", 3 * us),
            _ => format!("{fault}@{at}us+{us}us"),
        };
        let lasts_us = if kind == K::T3 { 12 * us } else { us };
        let until = self.t + lasts_us * 1000 + 40 * MS;
        if kind == K::T3 {
            // A window that repeats would repeat for ever.
            for round in 0..4 {
                let from = at + 3 * us * round;
                self.strike_sample(&format!("dropout@{from}us+{us}us"), until);
            }
        } else {
            self.strike_sample(&text, until);
        }
        if matches!(kind, K::T4 | K::T6 | K::T10) {
            self.laws.lies_until(until);
        }
        self.lasts(kind, lasts_us * 1000 + 40 * MS, Undo::Nothing);
    }

    pub(crate) fn strike_sample(&mut self, text: &str, until: i64) {
        let struck = lock(&self.net).strike(text, until);
        if let Err(e) = struck {
            self.laws.fail(self.t, format!("mistake of the simulator: {e}"));
        }
    }

    /// What the tracker reports of the head is wrong, or missing.
    fn strike_head(&mut self, kind: Kind, dice: &mut Dice) {
        let lasts_us = dice.decades(10, 2_500) * 1000;
        let fault = if kind == Kind::X25 { "unseen=2" } else { "exchange" };
        let until = self.t + lasts_us * 1000 + 40 * MS;
        self.strike_sample(&format!("{fault}@{}us+{lasts_us}us", self.t / 1000), until);
        if kind == Kind::X26 {
            // The body is said to be where the head is.
            self.laws.lies_until(until);
            let now = self.t;
            self.laws.eyes.iter_mut().for_each(|eyes| eyes.exchanged(now, until));
        }
        self.lasts(kind, until - self.t, Undo::Nothing);
    }

    fn strike_server(&mut self, kind: Kind, dice: &mut Dice) {
        use Kind as K;
        let own = server_kind(&self.setup);
        let lasts_ns = dice.between(50, 1_500) * MS;
        let other = match kind {
            K::T11 => own.clone(),
            K::T12 => ServerKind { name: "stranger".into(), number: 9, ..own.clone() },
            K::T14 => ServerKind { is_old: true, ..own.clone() },
            K::T15 => ServerKind { rate_hz: dice.one_of(&[100, 200, 500, 1000]), ..own.clone() },
            _ => ServerKind { millimetres: true, ..own.clone() },
        };
        if kind == K::T15 && dice.happens(0.5) {
            lock(&self.net).faults.held = true;
            return self.lasts(kind, dice.between(20, 400) * MS, Undo::Net);
        }
        let undo = if other == own { Undo::Nothing } else { Undo::Server };
        self.replace_server(other);
        self.laws.lies_until(self.t + lasts_ns + S);
        self.lasts(kind, lasts_ns, undo);
    }

    fn replace_server(&mut self, kind: ServerKind) {
        let replaced = lock(&self.net).replace(kind);
        if let Err(e) = replaced {
            self.laws.fail(self.t, format!("mistake of the simulator: {e}"));
        }
    }

    fn strike_net(&mut self, kind: Kind, dice: &mut Dice) {
        use Kind as K;
        let lasts_ns = dice.between(20, 600) * MS;
        if kind == K::T13 {
            let at = self.t / 1000;
            let what = dice.one_of(&["truncate=0.5", "corrupt=0.5", "truncate=1", "loss=0.7"]);
            let text = format!("{what}@{at}us+{}us", lasts_ns / 1000);
            self.strike_sample(&text, self.t + lasts_ns);
            self.laws.lies_until(self.t + lasts_ns);
            return self.lasts(kind, lasts_ns, Undo::Nothing);
        }
        let mut net = lock(&self.net);
        let faults = &mut net.faults;
        match kind {
            K::T16 => faults.flood = dice.between(1, 5),
            K::N1 => faults.flood = dice.between(20, 100),
            K::N2 => (faults.flood, faults.huge) = (1, true),
            K::N7 => (faults.flood, faults.forged) = (dice.between(1, 10), true),
            _ => faults.replay = 0.5,
        }
        drop(net);
        let short_ns = if matches!(kind, K::N1 | K::N2) { lasts_ns / 4 } else { lasts_ns };
        self.laws.lies_until(self.t + short_ns);
        self.lasts(kind, short_ns, Undo::Net);
    }

    fn strike_plug(&mut self, kind: Kind, dice: &mut Dice) {
        use Kind as K;
        let lasts_ns = dice.decades(20, 2_500) * MS;
        if kind == K::U14 {
            lock(&self.cable).faults.denied = true;
            self.lasts(kind, lasts_ns, Undo::Cable);
            if !dice.happens(0.7) {
                return;
            }
        }
        if kind == K::U9 && self.aside.is_none() {
            if let Ok(other) = projector_of(&self.setup, Raster::new(32, 24), self.t) {
                self.pull();
                self.switch_off();
                let own = std::mem::replace(&mut self.projector, other);
                self.aside = Some(own);
                self.new_projector();
                self.laws.acknowledged();
                lock(&self.cable).push_in();
                return self.lasts(kind, lasts_ns, Undo::Projector);
            }
        }
        self.pull();
        self.lasts(kind, lasts_ns, Undo::Plug);
    }

    fn pull(&mut self) {
        lock(&self.cable).pull();
        if self.far.is_none() {
            // On a serial line a projector does not notice.
            self.projector.bus_reset(HostTime(self.t));
        }
        self.see_light();
        if let Some(tracks) = &mut self.tracks {
            tracks.no_session(&self.projector);
        }
    }

    /// Another projector is at the end of the cable, or this one has lost its memory.
    fn new_projector(&mut self) {
        self.new_far_end();
        if let Some(tracks) = &mut self.tracks {
            tracks.new_device();
        }
    }

    fn strike_cable(&mut self, kind: Kind, dice: &mut Dice) {
        use Kind as K;
        let lasts_ns = dice.decades(2, 1_500) * MS;
        let lasts_ns = if kind == K::U3 { lasts_ns.min(300 * MS) } else { lasts_ns };
        let mut cable = lock(&self.cable);
        let f = &mut cable.faults;
        match kind {
            K::U3 => f.stalled = true,
            K::U4 => f.slow_milli = dice.decades(2_000, 400_000),
            K::U5 => f.short = dice.one_of(&[0.01, 0.1, 0.5]),
            K::U6 => f.babble = dice.one_of(&[0.01, 0.1, 0.5]),
            K::U10 => f.stale = 0.5,
            _ => {
                f.corrupt = dice.one_of(&[0.0001, 0.001, 0.01, 0.1]);
                f.loss = dice.one_of(&[0.0, 0.001, 0.01, 0.1]);
                f.twice = dice.one_of(&[0.0, 0.01, 0.1]);
            }
        }
        drop(cable);
        self.lasts(kind, lasts_ns, Undo::Cable);
    }

    /// Frames queue between the stages, or the cable is too slow for them.
    fn strike_flow(&mut self, kind: Kind, dice: &mut Dice) {
        let slot_ns = S / i64::from(self.setup.rate_hz);
        // A program that ends by an earlier fault, as by a collector that never returns, is dark until it has begun again.
        let begins = self.is_alone()
            && self.laws.is_lit_well(self.t)
            && !self.laws.is_slow(self.t)
            && !self.laws.is_hidden(self.t);
        let (lasts_ns, spell) = if kind == Kind::X17 {
            // The stages keep up again after so long.
            let slow_ns = dice.between(50, 200) * MS + 4 * slot_ns;
            let until = HostTime(self.host() + slow_ns);
            let queue = Queue { until, slow_ns: slot_ns * 11 / 10, crowd_ns: slot_ns * 24 / 100 };
            lock(&self.beneath).queue = Some(queue);
            let settles_ns = slow_ns + S / 2 + 12 * slot_ns;
            let lasts_ns = settles_ns + dice.between(1_000, 2_000) * MS;
            (lasts_ns, Spell::new(self.t + settles_ns, slot_ns, 0.9, false))
        } else {
            let slots = dice.between(2, 6);
            let frame_ns = slots * slot_ns - dice.between(20, 60) * slot_ns / 100;
            let own_ns = self.setup.frame_bytes() * self.setup.ns_per_byte;
            lock(&self.cable).faults.crawl_ps = (frame_ns - own_ns).max(1) * 1000 / self.setup.frame_bytes();
            let settles_ns = 1_500 * MS + 12 * slots * slot_ns;
            let lasts_ns = settles_ns + dice.between(2_000, 5_000) * MS;
            // While it was slow, full speed was tried more and more seldom.
            self.laws.slow_until(self.t + 3 * lasts_ns + 2 * S);
            (lasts_ns, Spell::new(self.t + settles_ns, slots * slot_ns, 0.7, true))
        };
        if begins {
            self.laws.spell(spell, self.table.total());
        }
        self.lasts(kind, lasts_ns, if kind == Kind::X17 { Undo::Queue } else { Undo::Cable });
    }

    /// Nothing else is wrong, and frames are shown.
    fn is_alone(&self) -> bool {
        self.is_quiet() && self.state() == State::Running && !self.laws.has_standing_order()
    }

    fn strike_projector(&mut self, kind: Kind, dice: &mut Dice) {
        use Kind as K;
        let now = HostTime(self.t);
        match kind {
            K::U8 => {
                self.lose_memory();
                self.lasts(kind, MS, Undo::Nothing);
            }
            K::U11 => {
                self.laws.clock_moved(self.t);
                self.projector.shift_clock(now, dice.decades(10_000, 3_000_000_000) as u64);
                self.see_light();
                if let Some(tracks) = &mut self.tracks {
                    tracks.clock_moved();
                }
                self.lasts(kind, MS, Undo::Nothing);
            }
            K::U12 => {
                let bits = dice.one_of(&[faults::OVER_TEMPERATURE, faults::LAMP, faults::EMERGENCY_STOP]);
                self.projector.set_faults(now, bits);
                self.see_light();
                self.laws.hot(self.t);
                self.lasts(kind, dice.between(5, 800) * MS, Undo::Heat);
            }
            _ => {
                let rounds = dice.between(1, 6) as u32;
                self.again(kind, dice.bits(), rounds);
                self.lasts(kind, i64::from(rounds) * 10 * MS, Undo::Nothing);
            }
        }
    }

    /// The projector loses its power for a moment.
    pub(crate) fn lose_memory(&mut self) {
        self.projector.power_cycle(HostTime(self.t));
        self.see_light();
        self.new_projector();
        self.boot_noise();
        if self.projector.status().faults == 0 {
            self.laws.acknowledged();
        }
    }

    /// When the program runs: it finds nothing while it, or its machine, stands still.
    fn awake_at(&self) -> i64 {
        self.t.max(self.frozen_until)
    }

    fn strike_gpu(&mut self, kind: Kind, dice: &mut Dice) {
        use Kind as K;
        let awake_at = self.awake_at();
        let slot_ns = S / i64::from(self.setup.rate_hz);
        let mut beneath = lock(&self.beneath);
        let mut lasts_ns = 100 * MS;
        match kind {
            K::G1 => beneath.open_traps.push_back(OpenTrap::Absent),
            K::G2 => beneath.open_traps.push_back(OpenTrap::OutOfMemory),
            K::G4 => beneath.gpu_traps.push_back(GpuTrap::Lost),
            K::G5 => {
                beneath.gpu_traps.push_back(GpuTrap::Hangs);
                // Frames that hang one after the other are found one after the other, each by a crew of its own.
                self.gpu_hangs_until = (self.gpu_hangs_until + GPU_AGAIN_NS).max(awake_at + GPU_FOUND_NS);
                lasts_ns = self.gpu_hangs_until - self.t;
                self.laws.hidden_until(self.gpu_hangs_until);
            }
            K::G6 => {
                let ns = dice.between(300, 1_500) * MS;
                beneath.gpu_traps.push_back(GpuTrap::Late(ns));
                // A frame that comes late after another that is stuck is late from then on.
                self.gpu_hangs_until = self.gpu_hangs_until.max(awake_at) + ns + lasts_ns;
                lasts_ns = self.gpu_hangs_until - self.t;
                self.laws.hidden_until(self.gpu_hangs_until);
            }
            K::G7 => beneath.gpu_traps.push_back(GpuTrap::Late(slot_ns * dice.between(1, 4))),
            _ => {}
        }
        if matches!(kind, K::G1 | K::G2) {
            lasts_ns = dice.between(500, 1_500) * MS;
        }
        drop(beneath);
        self.lasts(kind, lasts_ns, Undo::Traps);
    }

    fn trap(&mut self, part: RunPart, trap: Trap) {
        // The collector may be busy for five seconds; the frame path reports fifty times a second. Two seconds are left to a link
        // that hangs to go on, before the run ends.
        let found_ns = match part {
            RunPart::Collector => 5_300 * MS,
            RunPart::Link => 2_300 * MS,
            RunPart::Tracking | RunPart::Plan | RunPart::Pack => 300 * MS,
        };
        if trap == Trap::Hangs {
            self.laws.hidden_until(self.awake_at() + found_ns);
        }
        lock(&self.beneath).traps.push((part, trap));
    }

    fn strike_process(&mut self, kind: Kind, dice: &mut Dice) {
        use Kind as K;
        let stage = dice.one_of(&STAGES);
        let soon = self.t + dice.between(1, 300) * MS;
        match kind {
            K::U15 => self.kill(),
            K::H2 | K::X3 => {
                self.give(dice.one_of(&[Order::Safe, Order::Black]));
                let after_ns =
                    if kind == K::H2 { dice.between(0, 3_000_000) } else { dice.between(5, 60) * MS };
                if dice.happens(0.3) {
                    lock(&self.disk).tear();
                }
                // A weaker order follows, which must not take its place.
                if matches!(self.setup.alone, Some(Guard::Orders | Guard::Hand)) && dice.happens(0.4) {
                    let weaker = dice.one_of(&[Order::Black, Order::Freeze]);
                    self.plan(self.t + after_ns / 2, Action::Give(weaker));
                }
                self.plan(self.t + after_ns, Action::Kill);
            }
            K::H3 if dice.happens(0.3) => {
                // Nothing of the rig reads the wall clock, but the kernel stamps datagrams with it.
                self.stands();
                lock(&self.net).wall_ahead += dice.between(-3_600, 3_600) * S;
                return self.lasts(kind, MS, Undo::Nothing);
            }
            // A machine that is suspended cannot be suspended once more: its clock would lag by both times.
            K::H3 if self.t < self.frozen_until => return self.lasts(kind, MS, Undo::Nothing),
            K::H3 => {
                let ns = dice.decades(50, 3_000) * MS;
                self.stands();
                self.frozen_until = self.t + ns;
                self.lag_by(ns);
                self.laws.pauses(self.t, ns);
                self.laws.clock_moved(self.t + ns);
                return self.lasts(kind, ns, Undo::Nothing);
            }
            K::X6 => {
                let ns = dice.decades(5, 2_000) * MS;
                self.stands();
                self.frozen_until = self.frozen_until.max(self.t + ns);
                self.laws.pauses(self.t, ns);
                self.laws.stands_still(self.t, self.frozen_until);
                return self.lasts(kind, ns, Undo::Nothing);
            }
            K::H5 => self.trap(stage, Trap::Panics),
            K::H6 => {
                self.ask_to_stop();
                if dice.happens(0.5) {
                    self.plan(soon, Action::Stop);
                }
            }
            K::X1 => self.trap(stage, Trap::Hangs),
            K::X2 => {
                self.trap(stage, Trap::Hangs);
                self.plan(soon, Action::Stop);
            }
            K::X4 => self.ask_to_stop(),
            K::X5 => {
                for k in 0..dice.between(2, 8) {
                    let order = dice.one_of(&[Order::Black, Order::Freeze, Order::Safe, Order::Arm]);
                    self.plan(self.t + k * dice.between(0, 20) * MS, Action::Give(order));
                }
            }
            _ => {
                lock(&self.beneath).gpu_traps.push_back(GpuTrap::Hangs);
                self.laws.hidden_until(self.awake_at() + GPU_FOUND_NS);
                let (at, us) = (self.t / 1000, dice.between(500, 2_000) * 1000);
                self.strike_sample(&format!("dropout@{at}us+{us}us"), self.t + us * 1000);
                return self.lasts(kind, us * 1000, Undo::Traps);
            }
        }
        self.lasts(kind, 320 * MS, Undo::Traps);
    }

    /// The interlock opens for a moment or for long, chatters, or its thread hangs.
    fn strike_interlock(&mut self, dice: &mut Dice) {
        let state = if dice.happens(0.25) { SimContact::HANGS } else { SimContact::OPEN };
        let rounds = if dice.happens(0.2) { dice.between(2, 5) } else { 1 };
        let mut at = self.t;
        for _ in 0..rounds {
            self.plan(at, Action::Contact(state));
            // A thread that hangs for less than the silence that counts is not noticed, and need not be.
            let shortest = if state == SimContact::HANGS { 300 } else { 3 };
            at += dice.decades(shortest, 2_500) / rounds * MS + MS;
            self.plan(at, Action::Contact(0));
            at += dice.between(5, 80) * MS;
        }
        self.lasts(Kind::X19, at - self.t, Undo::Nothing);
    }

    fn strike_host(&mut self, kind: Kind, dice: &mut Dice) {
        use Kind as K;
        let lasts_ns = dice.decades(20, 1_500) * MS;
        match kind {
            K::H1 => {
                let mut disk = lock(&self.disk);
                disk.refuses = dice.happens(0.6);
                disk.late_ns = if disk.refuses { 0 } else { dice.decades(10, 2_000) * MS };
                // Half of those that refuse are only full.
                disk.is_full = disk.refuses && dice.happens(0.5);
                disk.refuses &= !disk.is_full;
                // An order that waits, one that is written, and the ARM after them.
                let busy_ns = lasts_ns + 3 * disk.late_ns;
                drop(disk);
                self.laws.slow_disk_until(self.t + busy_ns);
                if dice.happens(0.7) {
                    self.give(dice.one_of(&[Order::Safe, Order::Black, Order::Freeze]));
                }
                self.lasts(kind, lasts_ns, Undo::Disk);
            }
            K::H4 => {
                let ns = dice.decades(1, 1_000) * MS;
                let stage = dice.one_of(&STAGES);
                self.trap(stage, Trap::Stalls(ns));
                self.lasts(kind, ns + 20 * MS, Undo::Traps);
            }
            K::H10 => {
                lock(&self.cable).faults.denied = true;
                self.lasts(kind, lasts_ns, Undo::Cable);
                self.no_descriptors(kind, lasts_ns);
            }
            // The lock refuses it before it does anything.
            K::H11 => self.lasts(kind, MS, Undo::Nothing),
            _ => {
                let milli = match kind {
                    K::H9 => dice.between(3_000, 8_000),
                    K::H8 => dice.between(1_500, 4_000),
                    _ => dice.between(1_200, 2_500),
                };
                lock(&self.beneath).load_milli = milli;
                self.lasts(kind, lasts_ns, Undo::Load);
            }
        }
    }

    /// The cable loses orders to go dark, and a person gives one.
    fn lose_orders(&mut self, dice: &mut Dice) {
        // A held picture ends by such an order alone: there only as many are lost as are repeated in time.
        let are_few = dice.happens(0.5) || self.laws.is_frozen();
        lock(&self.cable).loses_orders = if are_few { dice.between(1, 3) as u32 } else { u32::MAX };
        match dice.one_of(&[Some(Order::Black), Some(Order::Black), Some(Order::Safe), None]) {
            Some(order) => self.give(order),
            None => self.ask_to_stop(),
        }
        self.lasts(Kind::X22, dice.between(60, 900) * MS, Undo::Orders);
    }

    /// The projector latches a fault whose cause is gone at once, or SAFE. Then words arrive that acknowledge nothing.
    fn strike_latch(&mut self, dice: &mut Dice) {
        if dice.happens(0.5) {
            self.give(Order::Safe);
        } else {
            let bits = dice.one_of(&[faults::OVER_TEMPERATURE, faults::LAMP, faults::EMERGENCY_STOP]);
            for bits in [bits, 0] {
                self.projector.set_faults(HostTime(self.t), bits);
            }
            self.see_light();
            self.laws.hot(self.t);
        }
        for round in 1..=dice.between(1, 4) {
            self.plan(self.t + round * dice.between(3, 60) * MS, Action::BareArm);
        }
        self.lasts(Kind::X23, 300 * MS, Undo::Nothing);
    }

    /// A person gives an order to go dark as soon as the light rests.
    fn order_at_rest(&mut self, seed: u64, rounds: u32) {
        let health = self.process.as_ref().map(|process| process.health());
        if matches!(health, Some(ProjectorHealth::Resting(_))) {
            self.rests_met();
            return self.give([Order::Black, Order::Safe][seed as usize % 2]);
        }
        self.plan(self.t + 20 * MS, Action::Again(Kind::X24, seed, rounds - 1));
    }

    /// Another step of a fault that has several.
    pub(crate) fn again(&mut self, kind: Kind, seed: u64, rounds: u32) {
        if rounds == 0 {
            return;
        }
        if kind == Kind::X24 {
            return self.order_at_rest(seed, rounds);
        }
        // The second host greets the projector, under a session of its own.
        let settings = link_settings(&self.rig.config, self.rig.camera.raster);
        let mut number = (seed as u32) ^ rounds;
        let sessions = SessionNumbers::from_source(move || {
            number = number.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            number
        });
        let mut link = HostLink::with_sessions(settings, sessions);
        let mut words = Words::default();
        link.connect();
        let _ = link.poll(HostTime(self.t), &mut words);
        if lock(&self.cable).plugged {
            match self.far {
                Some(_) => self.hear_on_the_line(&words.0),
                None => {
                    let bytes = words.0.concat();
                    self.hear(&bytes, false);
                    self.projector.receive(HostTime(self.t), Lane::Control, &bytes);
                }
            }
            self.see_light();
        }
        self.plan(self.t + 10 * MS, Action::Again(kind, seed, rounds - 1));
    }

    pub(crate) fn undo(&mut self, undo: &Undo) {
        match undo {
            Undo::Nothing => {}
            Undo::Net => lock(&self.net).faults = NetFaults::default(),
            Undo::TrackerPlug => self.plug_tracker_in(),
            Undo::Server => {
                let own = server_kind(&self.setup);
                self.replace_server(own);
                self.laws.lies_until(self.t + S);
            }
            Undo::Cable => lock(&self.cable).faults = CableFaults::default(),
            Undo::Plug => {
                let mut cable = lock(&self.cable);
                if !cable.plugged {
                    cable.push_in();
                }
            }
            Undo::Projector => {
                if let Some(own) = self.aside.take() {
                    self.pull();
                    self.switch_off();
                    self.projector = own;
                    self.new_projector();
                    self.laws.acknowledged();
                    self.projector.advance_to(HostTime(self.t));
                    self.see_light();
                    lock(&self.cable).push_in();
                }
            }
            Undo::Heat => {
                self.projector.set_faults(HostTime(self.t), 0);
                self.see_light();
                if let Some(own) = &mut self.aside {
                    own.set_faults(HostTime(self.t), 0);
                }
            }
            Undo::Disk => {
                let mut disk = lock(&self.disk);
                (disk.refuses, disk.is_full, disk.late_ns) = (false, false, 0);
                disk.calls.all_succeed();
            }
            Undo::Calls => {
                lock(&self.net).calls.all_succeed();
                lock(&self.cable).calls.all_succeed();
            }
            Undo::Orders => lock(&self.cable).loses_orders = 0,
            Undo::Queue => lock(&self.beneath).queue = None,
            Undo::Load => lock(&self.beneath).load_milli = 1000,
            Undo::Traps => {
                let mut beneath = lock(&self.beneath);
                beneath.traps.clear();
                beneath.gpu_traps.clear();
                beneath.open_traps.clear();
            }
            Undo::File => self.bad_file = false,
        }
    }
}
