//! What the projector's reports say of the light, joined with what the frames that they name show.

use crate::plan::dark::DarkCause;
use crate::plan::frame::FramePlan;
use crate::telemetry::light_gauge::{LightGauge, LightReport, HELD_NS, NEVER};
use dpm_device::link::{DeviceState, Status};
use dpm_device::time::{DeviceTicks, HostTime};

/// Sent frames whose content is remembered. A projector holds 64 at most, and its base. The one on its mirrors has a
/// place of its own: FREEZE holds it however many follow.
const REMEMBERED: usize = 128;
/// The place of the frame on the mirrors, behind them.
const SHOWN: usize = REMEMBERED;

/// What a frame that was sent shows.
#[derive(Clone, Copy, Debug)]
struct SentContent {
    /// Low 32 bits of its number.
    frame: u32,
    /// At least one mirror is lit in one of its planes.
    has_light: bool,
    /// It is dark because the head of somebody who is tracked is lost.
    head_lost: bool,
}

/// Reads the reports of the projector, one session after the other. Its memory is taken at the start.
#[derive(Debug)]
pub(crate) struct ReportedLight {
    sent: [Option<SentContent>; SHOWN + 1],
    next: usize,
    /// Per remembered frame and tracked body: why it is dark.
    dark: Vec<Option<DarkCause>>,
    /// Per tracked body: when it had light last.
    body_lit_at: Vec<HostTime>,
    /// The clock and the count of lit frames of the last report.
    last: Option<(DeviceTicks, u32)>,
    mirrors_lit_at: HostTime,
    frame_lit_at: HostTime,
    /// When a frame was lit last that is dark for a lost head.
    head_lost_at: HostTime,
    sent_at: HostTime,
    was_armed: bool,
}

impl ReportedLight {
    /// For a rig with `bodies` tracked bodies.
    pub(crate) fn new(bodies: usize) -> Self {
        Self {
            sent: [None; SHOWN + 1],
            next: 0,
            dark: vec![None; (SHOWN + 1) * bodies],
            body_lit_at: vec![NEVER; bodies],
            last: None,
            mirrors_lit_at: NEVER,
            frame_lit_at: NEVER,
            head_lost_at: NEVER,
            sent_at: NEVER,
            was_armed: false,
        }
    }

    /// The frame of `plan` was sent at `now`. `has_light`: at least one mirror is lit in it.
    pub(crate) fn sent(&mut self, plan: &FramePlan, has_light: bool, now: HostTime) {
        let place = self.next;
        self.next = (self.next + 1) % REMEMBERED;
        self.sent[place] =
            Some(SentContent { frame: plan.id.0 as u32, has_light, head_lost: plan.eyes.lost.is_some() });
        self.sent_at = now;
        let bodies = self.body_lit_at.len();
        let dark = self.dark[place * bodies..].iter_mut();
        dark.zip(plan.dark.iter()).take(bodies).for_each(|(to, dark)| *to = *dark);
    }

    /// Reads the newest report at `now`, and passes what it says of bodies to `gauge`. The caller adds what it alone
    /// knows.
    pub(crate) fn observe(
        &mut self,
        status: Option<&Status>,
        now: HostTime,
        gauge: &LightGauge,
    ) -> LightReport {
        if let Some(status) = status.filter(|s| self.last.map(|(at, _)| at) != Some(s.now)) {
            let lit_before = self.last.map(|(_, lit)| lit);
            self.last = Some((status.now, status.frames_lit));
            self.read(status, lit_before, now, gauge);
        }
        LightReport {
            mirrors_lit_at: self.mirrors_lit_at,
            frame_lit_at: self.frame_lit_at,
            sent_at: self.sent_at,
            head_lost_at: self.head_lost_at,
            was_armed: self.was_armed,
            is_over: false,
            standing: None,
        }
    }

    fn read(&mut self, status: &Status, lit_before: Option<u32>, now: HostTime, gauge: &LightGauge) {
        self.was_armed |=
            matches!(status.state, DeviceState::Armed | DeviceState::Black | DeviceState::Frozen);
        if !matches!(status.state, DeviceState::Armed | DeviceState::Frozen) {
            // It says that it is dark.
            self.mirrors_lit_at = NEVER;
            return;
        }
        if lit_before != Some(status.frames_lit) && status.frames_lit > 0 {
            self.frame_lit_at = now;
        }
        // Also where light has gone off since: the frame was lit between two reports.
        let is_lit = status.lit || self.frame_lit_at == now;
        if !is_lit || status.frames_lit == 0 {
            return;
        }
        let bodies = self.body_lit_at.len();
        let is_it = |sent: &Option<SentContent>| sent.is_some_and(|s| s.frame == status.last_lit_frame);
        if !is_it(&self.sent[SHOWN]) {
            let place = self.sent.iter().position(is_it);
            self.sent[SHOWN] = place.and_then(|place| self.sent[place]);
            if let Some(place) = place {
                self.dark.copy_within(place * bodies..(place + 1) * bodies, SHOWN * bodies);
            }
        }
        let shown = self.sent[SHOWN];
        // A frame that is not known was sent by nobody here: what is on the mirrors counts as light.
        if shown.is_none_or(|content| content.has_light) {
            self.mirrors_lit_at = now;
        }
        let Some(content) = shown else { return };
        if content.head_lost {
            self.head_lost_at = now;
        }
        let dark = &self.dark[SHOWN * bodies..];
        for (body, (lit_at, dark)) in self.body_lit_at.iter_mut().zip(dark).enumerate() {
            if dark.is_none() {
                *lit_at = now;
            }
            gauge.tell_body(body, dark.filter(|_| now.ns_since(*lit_at) >= HELD_NS));
        }
    }
}

/// True if a mirror is lit in `planes`.
pub(crate) fn has_light(planes: &[u8]) -> bool {
    // In blocks, so that the compiler can compare many bytes at once.
    planes.chunks(256).any(|block| block.iter().fold(0, |all, byte| all | byte) != 0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Overrides, RigConfig};
    use crate::plan::frame::FrameId;
    use crate::rig::Rig;
    use crate::telemetry::light_state::Evidence;
    use crate::telemetry::monitor::ProjectorHealth;
    use dpm_device::planes::Raster;
    use DarkCause::Silent;

    const MS: i64 = 1_000_000;

    struct LightBench {
        light: ReportedLight,
        gauge: LightGauge,
        plan: FramePlan,
        status: Status,
    }

    fn bench() -> LightBench {
        let config = RigConfig::demo(&Overrides::default()).unwrap_or_else(|e| panic!("{e}"));
        let rig = Rig::build(&config, Raster::new(16, 16)).unwrap_or_else(|e| panic!("{e}"));
        assert_eq!(rig.bodies.len(), 2);
        let status = Status { state: DeviceState::Armed, ..Status::default() };
        LightBench {
            light: ReportedLight::new(2),
            gauge: LightGauge::default(),
            plan: FramePlan::empty(&rig),
            status,
        }
    }

    impl LightBench {
        fn sent(&mut self, frame: u64, has_light: bool, dark: [Option<DarkCause>; 2], ms: i64) {
            self.plan.id = FrameId(frame);
            self.plan.dark = dark.to_vec();
            self.light.sent(&self.plan, has_light, HostTime(ms * MS));
        }

        /// What is known after the newest report was read at `ms`.
        fn read(&mut self, ms: i64) -> Evidence {
            let seen = self.light.observe(Some(&self.status), HostTime(ms * MS), &self.gauge);
            self.gauge.tell(&seen, HostTime(ms * MS));
            self.gauge.evidence(ProjectorHealth::Up)
        }

        /// Frame `frame` is on the mirrors at `ms`.
        fn lit(&mut self, frame: u32, ms: i64) -> Evidence {
            let frames_lit = self.status.frames_lit + u32::from(self.status.last_lit_frame != frame);
            self.status = Status {
                lit: true,
                frames_lit,
                last_lit_frame: frame,
                now: DeviceTicks(ms as u64),
                ..self.status
            };
            self.read(ms)
        }

        fn dark(&mut self, state: DeviceState, ms: i64) -> Evidence {
            self.status = Status { lit: false, state, now: DeviceTicks(ms as u64), ..self.status };
            self.read(ms)
        }
    }

    #[test]
    fn light_is_what_the_frame_on_the_mirrors_shows_and_lasts_for_less_than_a_second() {
        let mut bench = bench();
        bench.sent(7, true, [None, None], 1_000);
        assert!(!bench.dark(DeviceState::Armed, 1_001).mirrors_lit, "nothing has been lit");
        assert!(bench.lit(7, 1_010).mirrors_lit);
        // Frames go on, and they are black: for a moment the last light still counts.
        bench.sent(8, false, [Some(Silent); 2], 1_020);
        assert!(bench.lit(8, 1_030).mirrors_lit);
        assert_eq!(bench.gauge.body(0), None, "it had light 20 ms ago");
        let seen = bench.lit(8, 1_935);
        assert!(!seen.mirrors_lit && !seen.frames_lit, "frame 8 is no new one");
        assert_eq!([0, 1].map(|body| bench.gauge.body(body)), [Some(Silent); 2]);
        bench.sent(9, false, [Some(Silent); 2], 1_940);
        assert!(bench.lit(9, 1_950).frames_lit);
        // One body returns.
        bench.sent(10, true, [None, Some(Silent)], 1_990);
        assert!(bench.lit(10, 2_000).mirrors_lit);
        assert_eq!([0, 1].map(|body| bench.gauge.body(body)), [None, Some(Silent)]);
    }

    #[test]
    fn a_projector_that_says_it_is_dark_is_dark_at_once_and_one_that_says_nothing_within_a_second() {
        let mut bench = bench();
        bench.sent(1, true, [None, None], 0);
        assert!(bench.lit(1, 10).was_armed);
        assert!(!bench.dark(DeviceState::Faulted, 11).mirrors_lit);
        assert!(!bench.dark(DeviceState::Black, 12).mirrors_lit);
        bench.status.state = DeviceState::Armed;
        bench.sent(2, true, [None, None], 20);
        assert!(bench.lit(2, 30).mirrors_lit);
        // The same report is no news, however often it is read.
        assert!(bench.read(929).mirrors_lit && !bench.read(930).mirrors_lit);
        // A frame that nobody here has sent counts as light.
        assert!(bench.lit(99, 3_000).mirrors_lit);
    }

    /// FREEZE holds what is on the mirrors, while frames go on to be sent that the projector refuses.
    #[test]
    fn a_black_picture_that_is_held_is_no_light_however_many_frames_follow() {
        for has_light in [false, true] {
            let mut bench = bench();
            let dark = [None, (!has_light).then_some(Silent)];
            bench.sent(1, has_light, dark, 0);
            bench.lit(1, 10);
            bench.status.state = DeviceState::Frozen;
            for frame in 2..2_000 {
                let ms = frame as i64 * 10;
                bench.sent(frame, true, [None, None], ms);
                assert_eq!(bench.lit(1, ms).mirrors_lit, has_light, "{ms} ms");
            }
            assert_eq!(bench.gauge.body(1), dark[1]);
        }
    }

    #[test]
    fn one_lit_mirror_is_light() {
        for at in [0, 1, 255, 256, 999] {
            let mut planes = vec![0; 1000];
            assert!(!has_light(&planes));
            planes[at] = 4;
            assert!(has_light(&planes));
        }
    }
}
