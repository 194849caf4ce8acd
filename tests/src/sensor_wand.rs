//! `hil-mock serve sensor-wand` for tests: a tracker, a projector and a light sensor in a process of their own.

use crate::programs::{program, Talk};
use std::process::{Command, Stdio};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// Projector, host and sensor run at real pace. Two such chains at once are more than two cores carry in time, and a
/// sweep with half of its frames is refused.
static TURN: Mutex<()> = Mutex::new(());

/// `hil-mock serve sensor-wand`, ended with this. There is one at a time.
pub struct SensorWandMock {
    talk: Talk,
    _turn: MutexGuard<'static, ()>,
    /// Path of its projector.
    pub projector: String,
    /// Path of its light sensor.
    pub sensor: String,
}

impl SensorWandMock {
    /// Starts it with these arguments, and with orders.
    ///
    /// # Panics
    /// It does not start.
    pub fn start(arguments: &[&str]) -> Self {
        let turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
        let child = Command::new(program("hil-mock"))
            .args(["serve", "sensor-wand", "--port", "pty", "--orders"])
            .args(arguments)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .expect("a program that was built");
        let mut talk = Talk::with(child);
        let mut after = |words: &str| {
            talk.until(words);
            talk.until("\n").trim().to_owned()
        };
        let sensor = after("light sensor on ");
        let projector = after("bit-plane projector on ");
        Self { talk, _turn: turn, projector, sensor }
    }

    /// Gives an order to the hand with the wand, again while it cannot be followed, and waits until the hand is there.
    ///
    /// # Panics
    /// It has ended.
    pub fn order(&mut self, order: &str) {
        loop {
            self.talk.say(order);
            // A pattern is lit some frames after the question.
            if self.talk.until_one(&["the tip is at", "the wand", "there is no light"]).0 < 2 {
                return;
            }
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    /// What the mock has said since it was last waited for, after it has done an order.
    ///
    /// # Panics
    /// It has ended.
    pub fn said(&mut self) -> String {
        self.talk.say("tip 0 0 0");
        self.talk.until("the tip is at")
    }

    /// A rig file with its projector and tracker, at real pace.
    pub fn rig(&self, [width, height]: [u32; 2], rate: u32, command_port: u16) -> String {
        format!(
            "[projector]\nwidth = {width}\nheight = {height}\nframe_rate = \"{rate}\"\n\
             backend = {{ kind = \"serial\", port = \"{}\" }}\n\
             [tracker]\nkind = \"natnet\"\ncommand_port = {command_port}\ndata_port = {}\n\
             [real_time]\npace = \"real\"\n",
            self.projector,
            command_port + 1
        )
    }
}
