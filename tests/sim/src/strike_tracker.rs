//! What strikes trackers that are not on the network by datagrams: serial lines and VRPN servers.

use crate::cable::lock;
use crate::dice::Dice;
use crate::kinds::Kind;
use crate::line::Spoils;
use crate::plan::TrackerKind;
use crate::tracker_stream::TrackerStream;
use crate::world::{Undo, World, MS, S};

/// Short ones are as frequent as those after which trackers have lost what they had.
fn how_long(dice: &mut Dice) -> i64 {
    let ms = if dice.happens(0.5) { dice.decades(2, 1_500) } else { dice.between(100, 3_000) };
    ms * MS
}

impl World {
    /// A serial tracker's line is noisy, mute or unplugged, or its port may not be opened.
    pub(crate) fn strike_tracker_line(&mut self, dice: &mut Dice) {
        let lasts_ns = how_long(dice);
        let share = dice.one_of(&[0.000_1, 0.001, 0.01, 0.1]);
        let mut net = lock(&self.net);
        let now = self.t;
        let faults = &mut net.faults;
        let spoils = &mut faults.line.spoils;
        match dice.bits() % 10 {
            0 => *spoils = Spoils { flip: share, stray: share / 4.0, ..*spoils },
            1 => *spoils = Spoils { lose: share, twice: share, ..*spoils },
            // Half lines.
            2 => spoils.gap = share,
            // The ends run at different rates.
            3 => spoils.all = true,
            4 => spoils.silent = true,
            5 => faults.line.echoes = true,
            6 => faults.held = true,
            what => {
                faults.line.denied = what == 7;
                let _ = net.on_line(|line, _, _| line.pull());
            }
        }
        let _ = net.on_line(|line, _, faults| line.advance(now, faults));
        drop(net);
        self.lasts(Kind::T18, lasts_ns, Undo::TrackerPlug);
    }

    /// The adapter is plugged in again, and the line is as it should be.
    pub(crate) fn plug_tracker_in(&mut self) {
        let mut net = lock(&self.net);
        let now = self.t;
        net.faults = Default::default();
        let _ = net.on_line(|line, _, _| line.push_in(now));
    }

    /// No port or connection is opened for a while.
    pub(crate) fn no_descriptors(&mut self, kind: Kind, lasts_ns: i64) {
        if self.setup.tracker.kind() != TrackerKind::NatNet {
            let mut net = lock(&self.net);
            (net.faults.line.denied, net.faults.stream.refuses) = (true, true);
            drop(net);
            self.lasts(kind, lasts_ns, Undo::Net);
        }
    }

    /// What strikes a VRPN server, or the connection to it.
    pub(crate) fn strike_connection(&mut self, kind: Kind, dice: &mut Dice) {
        use Kind as K;
        let lasts_ns = how_long(dice);
        let now = self.t;
        let mut net = lock(&self.net);
        let faults = &mut net.faults.stream;
        match kind {
            K::X12 => {
                faults.refuses = dice.happens(0.7);
                let _ = net.on_stream(|stream, _, _| stream.reset(now));
            }
            K::X13 => {
                faults.cut = true;
                let _ = net.on_stream(|stream, _, _| stream.forget());
            }
            K::X14 => faults.cut = true,
            K::X15 => {
                faults.other = dice.happens(0.3);
                faults.hangs = !faults.other;
                if dice.happens(0.5) || faults.other {
                    let _ = net.on_stream(|stream, _, _| stream.reset(now));
                }
            }
            _ => {
                let _ = net.on_stream(|stream, _, _| TrackerStream::set_clock(stream));
                drop(net);
                self.laws.lies_until(self.t + S);
                return self.lasts(kind, MS, Undo::Nothing);
            }
        }
        drop(net);
        self.lasts(kind, lasts_ns, Undo::Net);
    }
}
