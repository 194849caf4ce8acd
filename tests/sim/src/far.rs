//! The projector's end of a serial line, as the world serves it, and what strikes only there.

use crate::cable::lock;
use crate::dice::Dice;
use crate::kinds::Kind;
use crate::line::Echo;
use crate::world::{Undo, World, MS};
use dpm_device::cobs::{encode, encoded_bytes};
use dpm_device::time::HostTime;
use hil_mock::projector::serial::SerialEnd;

impl World {
    /// A piece of the stream arrives.
    pub(crate) fn hear_piece(&mut self, bytes: &[u8]) {
        let are_last_words = lock(&self.cable).line.as_ref().is_some_and(|line| line.has_words(self.t));
        if self.process.is_none() && are_last_words {
            self.laws.heard_of_the_dead(self.t);
        }
        if let Some(far) = &mut self.far {
            far.receive(&mut self.projector, HostTime(self.t), bytes);
        }
    }

    /// A second program has the line, too: its `packets` come between the bytes of the first.
    pub(crate) fn hear_on_the_line(&mut self, packets: &[Vec<u8>]) {
        for packet in packets {
            let mut bytes = vec![0; encoded_bytes(packet.len())];
            let n = encode(&[packet], &mut bytes).unwrap_or(0);
            self.hear_piece(&bytes[..n]);
        }
    }

    /// The projector replies when the line has taken what it replied before.
    pub(crate) fn reply_on_the_line(&mut self) {
        let Some(far) = &mut self.far else { return };
        let mut cable = lock(&self.cable);
        let Some(line) = cable.line.as_mut().filter(|line| line.takes_replies()) else { return };
        let replies = far.replies(&mut self.projector, HostTime(self.t));
        if !replies.is_empty() {
            line.reply(replies, self.t);
            replies.clear();
        }
    }

    /// Another projector is at the end of the line, or this one has lost its memory.
    pub(crate) fn new_far_end(&mut self) {
        if self.far.is_some() {
            self.far = Some(SerialEnd::new(&self.projector));
        }
    }

    /// Whoever takes a projector away switches it off. One on a serial line would not notice that it is alone.
    pub(crate) fn switch_off(&mut self) {
        if self.far.is_some() {
            self.projector.bus_reset(HostTime(self.t));
            self.see_light();
        }
    }

    /// The program has ended. What its driver holds still goes out.
    pub(crate) fn last_words(&mut self) {
        let mut cable = lock(&self.cable);
        if let Some(line) = &mut cable.line {
            line.last_words();
        }
    }

    /// What a projector that starts has to say on its line.
    pub(crate) fn boot_noise(&mut self) {
        let mut cable = lock(&self.cable);
        if let Some(line) = &mut cable.line {
            line.boot(self.t);
        }
    }

    /// What strikes only serial lines.
    pub(crate) fn strike_line(&mut self, kind: Kind, dice: &mut Dice) {
        let lasts_ns = dice.decades(2, 1_500) * MS;
        let mut cable = lock(&self.cable);
        let faults = &mut cable.faults;
        match kind {
            Kind::X9 => faults.echo = dice.one_of(&[Echo::Host, Echo::Mixed, Echo::Projector]),
            Kind::X10 => faults.silent = true,
            _ => faults.garbled = true,
        }
        drop(cable);
        self.lasts(kind, lasts_ns, Undo::Cable);
    }
}
