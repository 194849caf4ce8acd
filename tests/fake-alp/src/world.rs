//! The devices of this process, their clocks, and the file that a test reads when the process is gone.

use std::collections::BTreeMap;
use std::io::Write;
use std::sync::{LazyLock, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use crate::codes::*;
use crate::faults::{Fault, Plan};
use crate::{Panel, Settings};

/// How often the file with the plan is looked at.
const PLAN_EVERY: Duration = Duration::from_millis(5);

/// The device that exists in every process, made of `FAKE_ALP_PANEL`.
pub(crate) const FIRST: i32 = 1;

/// Time of a device.
#[derive(Clone, Copy, Debug)]
enum Clock {
    /// `CLOCK_MONOTONIC`.
    Real,
    /// What the test says, and the calls' own duration.
    Virtual(i64),
}

/// A device and what surrounds it.
#[derive(Debug)]
pub(crate) struct Device {
    pub panel: Panel,
    /// Its identifier while it is allocated.
    pub allocated: Option<u32>,
    plugged: bool,
    clock: Clock,
    plan: Plan,
    plan_text: String,
    looked: Option<Instant>,
    /// Answers other than `ALP_OK` that no plan asked for.
    pub refusals: u64,
    pub last_refusal: i32,
    log: Option<std::fs::File>,
}

/// All devices by number.
#[derive(Debug)]
pub(crate) struct World {
    pub devices: BTreeMap<i32, Device>,
    next_id: u32,
    next_number: i32,
}

static WORLD: LazyLock<Mutex<World>> = LazyLock::new(|| {
    let text = std::env::var("FAKE_ALP_PANEL").unwrap_or_default();
    let settings = Settings::parse(&text).unwrap_or_else(|e| {
        eprintln!("{e}");
        Settings::default()
    });
    let mut first = Device::new(settings, Clock::Real);
    first.set_plan(&std::env::var("FAKE_ALP_FAULTS").unwrap_or_default());
    first.log = std::env::var_os("FAKE_ALP_LOG")
        .and_then(|path| std::fs::OpenOptions::new().create(true).append(true).open(path).ok());
    Mutex::new(World { devices: BTreeMap::from([(FIRST, first)]), next_id: 1, next_number: FIRST + 1 })
});

pub(crate) fn world() -> MutexGuard<'static, World> {
    WORLD.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The rig's clock, `CLOCK_MONOTONIC`.
#[allow(unsafe_code)]
fn monotonic_ns() -> i64 {
    let mut time = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    // SAFETY: the pointer is to a local of the type that the call fills.
    unsafe { libc::clock_gettime(libc::CLOCK_MONOTONIC, &mut time) };
    time.tv_sec * 1_000_000_000 + time.tv_nsec
}

impl World {
    /// A new device at virtual pace, or at real pace.
    pub(crate) fn add(&mut self, settings: Settings, is_virtual: bool) -> i32 {
        let number = self.next_number;
        self.next_number += 1;
        let clock = if is_virtual { Clock::Virtual(0) } else { Clock::Real };
        self.devices.insert(number, Device::new(settings, clock));
        number
    }

    /// `AlpDevAlloc`. Number 0 is the first device; those that tests have made are found by their number only.
    pub(crate) fn allocate(&mut self, number: i32, init_flag: i32) -> Result<u32, i32> {
        let id = self.next_id;
        let device = self.devices.get_mut(&if number == 0 { FIRST } else { number }).ok_or(NOT_ONLINE)?;
        device.look_at_plan();
        let now = device.now();
        device.panel.advance(now);
        match device.strike("alloc") {
            Some(Fault::Code(code)) => return Err(code),
            Some(Fault::Slow(ms)) => device.pass(i64::from(ms) * 1_000_000),
            Some(Fault::Removed) | None => {}
        }
        if !device.plugged {
            return Err(NOT_ONLINE);
        }
        let refusal = match (init_flag, device.allocated) {
            (0, None) => {
                device.allocated = Some(id);
                self.next_id += 1;
                return Ok(id);
            }
            (0, Some(_)) => NOT_READY,
            _ => PARM_INVALID,
        };
        device.refuse(refusal);
        Err(refusal)
    }

    pub(crate) fn by_id(&mut self, id: u32) -> Option<&mut Device> {
        self.devices.values_mut().find(|device| device.allocated == Some(id))
    }
}

impl Device {
    fn new(settings: Settings, clock: Clock) -> Self {
        Self {
            panel: Panel::new(settings),
            allocated: None,
            plugged: true,
            clock,
            plan: Plan::default(),
            plan_text: String::new(),
            looked: None,
            refusals: 0,
            last_refusal: OK,
            log: None,
        }
    }

    pub(crate) fn now(&self) -> i64 {
        match self.clock {
            Clock::Real => monotonic_ns(),
            Clock::Virtual(ns) => ns,
        }
    }

    pub(crate) fn is_real(&self) -> bool {
        matches!(self.clock, Clock::Real)
    }

    /// Virtual time goes on by itself while a call lasts.
    pub(crate) fn pass(&mut self, ns: i64) {
        if let Clock::Virtual(now) = &mut self.clock {
            *now += ns;
        }
    }

    pub(crate) fn set_time(&mut self, ns: i64) {
        if let Clock::Virtual(now) = &mut self.clock {
            *now = ns.max(*now);
        }
        let now = self.now();
        self.panel.advance(now);
    }

    /// Puts a plan in force. An unplugged device is plugged in again.
    pub(crate) fn set_plan(&mut self, text: &str) -> bool {
        self.plugged = true;
        self.plan_text = text.into();
        match Plan::parse(text) {
            Ok(plan) => self.plan = plan,
            Err(e) => {
                eprintln!("{e}");
                return false;
            }
        }
        true
    }

    /// A plan in the file `FAKE_ALP_FAULTS_FILE` replaces the one before.
    pub(crate) fn look_at_plan(&mut self) {
        if !self.is_real() || self.looked.is_some_and(|at| at.elapsed() < PLAN_EVERY) {
            return;
        }
        self.looked = Some(Instant::now());
        let Some(path) = std::env::var_os("FAKE_ALP_FAULTS_FILE") else { return };
        let text = std::fs::read_to_string(path).unwrap_or_default();
        if text.trim() != self.plan_text.trim() {
            self.set_plan(text.trim());
        }
    }

    pub(crate) fn strike(&mut self, call: &str) -> Option<Fault> {
        let fault = self.plan.strike(call);
        if fault == Some(Fault::Removed) && self.plugged {
            self.plugged = false;
            let now = self.now();
            self.panel.unplug(now);
            self.write(format_args!("unplugged at={now}"));
        }
        fault
    }

    pub(crate) fn is_plugged(&self) -> bool {
        self.plugged
    }

    pub(crate) fn refuse(&mut self, code: i32) {
        self.refusals += 1;
        self.last_refusal = code;
        self.write(format_args!("refused code={code}"));
    }

    pub(crate) fn has_log(&self) -> bool {
        self.log.is_some()
    }

    /// Adds a line to the file of `FAKE_ALP_LOG`.
    pub(crate) fn write(&mut self, line: std::fmt::Arguments<'_>) {
        if let Some(log) = &mut self.log {
            // One write for each line, so that a process that is killed leaves whole lines.
            let _ = log.write_all(format!("{line}\n").as_bytes());
        }
    }
}

/// A number for the bytes of a plane, in the file of `FAKE_ALP_LOG` (FNV-1a over words of 8 bytes).
pub fn hash(bytes: &[u8]) -> u64 {
    bytes.chunks(8).fold(0xcbf2_9ce4_8422_2325, |hash, chunk| {
        let mut word = [0; 8];
        word[..chunk.len()].copy_from_slice(chunk);
        (hash ^ u64::from_le_bytes(word)).wrapping_mul(0x100_0000_01b3)
    })
}
