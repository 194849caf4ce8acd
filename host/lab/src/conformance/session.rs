//! The way to light: a session, its configuration, ARM; and the device's time.

use super::driver::{ConformanceDriver, R, WATCHDOG_US};
use super::Stop;
use dpm_device::link::{
    Config, DeviceHello, DeviceMessage, DeviceState, FaultCode, HostHello, HostMessage, LightLimits,
    SlotClock, Status, Underrun, VERSION,
};
use dpm_device::planes::{Channel, PlaneSchedule, PlaneSpec};
use dpm_device::time::{DeviceTicks, FrameRate};

impl ConformanceDriver<'_> {
    /// Opens a new session and waits for the device's HELLO.
    pub(super) fn open(&mut self) -> R<DeviceHello> {
        self.session = self.sessions.draw();
        (self.config, self.slots, self.newest) = (None, None, None);
        (self.frames_sent, self.packets_sent, self.packets_base) = (0, 0, None);
        // Anywhere: no number is the first.
        self.next_frame = self.session.rotate_left(7);
        self.feed = true;
        self.forget()?;
        let session = self.session;
        for _ in 0..3 {
            self.say(&HostMessage::Hello(HostHello {
                version_min: u16::from(VERSION),
                version_max: u16::from(VERSION),
                codecs: 0xf,
            }))?;
            let answer = self.wait(self.answer_ns(), |h| match h.message {
                DeviceMessage::Hello(hello) if h.session == session => Some((hello, h.at)),
                _ => None,
            })?;
            if let Some((hello, at)) = answer {
                self.clock = (hello.now.0, at);
                self.hello = Some(hello);
                return Ok(hello);
            }
        }
        Err(self.silent("HELLO of the session that was asked for"))
    }

    /// What the rules ask for, unless they are about something else: two planes at most, of the least light, repeated, never late.
    pub(crate) fn plain_config(&self) -> R<Config> {
        let hello = self.hello.ok_or(Stop::Failed("no HELLO".into()))?;
        let planes: Vec<PlaneSpec> = (0..2u8.min(hello.max_planes.max(1)))
            .map(|k| PlaneSpec { channel: Channel::Red, bit: 1 - k })
            .collect();
        let ahead = u64::from(hello.tick_hz) / 50;
        Ok(Config {
            raster: hello.raster,
            schedule: PlaneSchedule::new(&planes).ok_or(Stop::Failed("no planes".into()))?,
            rate: FrameRate::new(1000, self.slot_ms()).ok_or(Stop::Failed("no rate".into()))?,
            watchdog_us: WATCHDOG_US,
            underrun: Underrun::Repeat,
            late_slots: 0,
            epoch: DeviceTicks(hello.now.0 + ahead),
            limits: LightLimits::OFF,
            tracks: false,
            timing: false,
            shifts: false,
        })
    }

    /// Length of a slot, ms: long enough for a frame and the reports of a slot.
    pub(super) fn slot_ms(&self) -> u32 {
        let frame = self.frame_bytes() + 400;
        (20 + self.carry_ns(frame) * 3 / 1_000_000).clamp(20, 1000) as u32
    }

    /// Asks for `config`; the report that confirms it. Latched faults hide the state, not the configuration.
    pub(super) fn configure(&mut self, config: &Config) -> R<Status> {
        self.forget()?;
        self.say(&HostMessage::Config(*config))?;
        let session = self.session;
        let answer = self.wait(self.answer_ns(), |h| match h.message {
            DeviceMessage::Status(s)
                if h.session == session
                    && matches!(s.state, DeviceState::Configured | DeviceState::Faulted) =>
            {
                Some(Ok(s))
            }
            DeviceMessage::Fault(f) if f.code == FaultCode::Config => Some(Err(f.detail)),
            _ => None,
        })?;
        match answer {
            Some(Ok(status)) => {
                let hz = self.hello.map_or(1, |h| h.tick_hz);
                self.slots = SlotClock::new(config.epoch, hz, config.rate);
                self.config = Some(*config);
                // Known from here on: what was counted before.
                self.report().map(|s| if s.state == status.state { s } else { status })
            }
            Some(Err(detail)) => {
                Err(Stop::Failed(format!("CONFIG that the device's HELLO allows refused, detail {detail}")))
            }
            None => Err(self.silent("STATUS \"configured\" after CONFIG")),
        }
    }

    /// Arms, acknowledging what is latched.
    pub(super) fn arm(&mut self) -> R<Status> {
        // Light may rest after a rule on limits.
        for _ in 0..30 {
            let faults = self.report()?.faults;
            self.forget()?;
            self.say(&HostMessage::Arm(faults))?;
            let session = self.session;
            let answer = self.wait(self.answer_ns(), |h| match h.message {
                DeviceMessage::Status(s) if h.session == session && s.state == DeviceState::Armed => {
                    Some(Ok(s))
                }
                DeviceMessage::Fault(f) if f.code == FaultCode::Arm => Some(Err(f.detail)),
                _ => None,
            })?;
            match answer {
                Some(Ok(status)) => return Ok(status),
                Some(Err(3)) => self.pass(100_000_000)?,
                Some(Err(detail)) => {
                    return Err(Stop::Failed(format!(
                        "ARM that acknowledges {faults:#x} refused, detail {detail}; {}",
                        self.newest()
                    )))
                }
                None => return Err(self.silent("STATUS \"armed\" after ARM")),
            }
        }
        Err(Stop::Failed("ARM refused for 3 s because light rests".into()))
    }

    /// A new session, configured; `change` may ask for something else than the plain configuration.
    pub(super) fn configured(&mut self, change: impl FnOnce(&mut Config)) -> R<Status> {
        self.open()?;
        let mut config = self.plain_config()?;
        change(&mut config);
        self.configure(&config)
    }

    /// The same, armed.
    pub(super) fn armed(&mut self, change: impl FnOnce(&mut Config)) -> R<Status> {
        self.configured(change)?;
        self.arm()
    }

    // --- the device's time ---

    pub(super) fn slots(&self) -> R<SlotClock> {
        self.slots.ok_or(Stop::Failed("no slots: not configured".into()))
    }

    pub(super) fn tick_hz(&self) -> u64 {
        self.hello.map_or(1, |h| u64::from(h.tick_hz))
    }

    pub(crate) fn ticks_of_ms(&self, ms: u64) -> u64 {
        (self.tick_hz() * ms).div_ceil(1000)
    }

    /// The device's clock now, as far as it was told; not ahead of it but for its rate.
    pub(crate) fn ticks_now(&self) -> u64 {
        let ns = self.now().ns_since(self.clock.1).max(0) as u128;
        self.clock.0 + (ns * u128::from(self.tick_hz()) / 1_000_000_000) as u64
    }

    /// A slot that a frame sent now will make.
    pub(crate) fn slot_ahead(&mut self) -> R<u64> {
        // A clock that was told long ago, or late, is asked again.
        self.report()?;
        let slots = self.slots()?;
        let carry = self.carry_ns(self.frame_bytes() + 200) * 2 + 30_000_000;
        let ticks = (carry as u128 * u128::from(self.tick_hz()) / 1_000_000_000) as u64;
        Ok(slots.slot_at(DeviceTicks(self.ticks_now() + ticks)).map_or(1, |k| k + 1))
    }

    /// The same by the clock as it was told last: SYNC would account frames.
    pub(crate) fn slot_ahead_quietly(&mut self) -> R<u64> {
        let slots = self.slots()?;
        let carry = self.carry_ns(self.frame_bytes() + 200) * 2 + 60_000_000;
        let ticks = (i128::from(carry) * i128::from(self.tick_hz()) / 1_000_000_000) as u64;
        Ok(slots.slot_at(DeviceTicks(self.ticks_now() + ticks)).map_or(1, |k| k + 1))
    }

    /// Reports until one is of `ticks` or later: that one.
    pub(super) fn until(&mut self, ticks: u64) -> R<Status> {
        let all = self.watch_until(ticks)?;
        all.last().copied().ok_or_else(|| self.silent("a STATUS"))
    }

    /// All reports until one is of `ticks` or later, asked for every few milliseconds.
    pub(crate) fn watch_until(&mut self, ticks: u64) -> R<Vec<Status>> {
        let left = ticks.saturating_sub(self.ticks_now());
        let left_ns = (u128::from(left) * 1_000_000_000 / u128::from(self.tick_hz().max(1))) as i64;
        let end = self.now().plus_ns(left_ns.saturating_mul(2).saturating_add(2_000_000_000));
        let mut all = Vec::new();
        while self.now() < end {
            let status = self.report()?;
            all.push(status);
            if status.now.0 >= ticks {
                return Ok(all);
            }
            let step = 3_000_000 + self.carry_ns(400) * 2;
            self.pass(step)?;
        }
        Err(Stop::Failed(format!(
            "expected the device's clock to reach {ticks} (2 s of grace), saw {}",
            all.last().map_or(0, |s| s.now.0)
        )))
    }

    /// The device's moment in the slot `slot`, a little after its start.
    pub(crate) fn until_slot(&mut self, slot: u64) -> R<Status> {
        let start = self.slots()?.start(slot).0;
        self.until(start + self.ticks_of_ms(2))
    }
}
