//! Decides when a packed frame is sent or left out, does what is due between frames, and ends the light.

use super::cadence::Cadence;
use super::facts::{Facts, RECEIPT_NS};
use super::follow::PlaneFollower;
use super::genlock;
use super::keeper::{is_dark, LinkKeeper};
use super::pace::Pace;
use super::pack::is_overtaken;
use super::queue::{FrameNeed, QueueWatch, StandingWait};
use super::reported_light::has_light;
use super::slack::{SlackFrame, SlackMeter};
use crate::frame::job::{Fate, FrameNote};
use crate::plan::lead::LeadEstimator;
use crate::telemetry::projector::ProjectorReport;
use crate::tracks::{SampleRhythm, TrackSnapshot};
use dpm_device::link::{DropReason, HostLink, LinkCounters, LinkState, SendOutcome};
use dpm_device::time::HostTime;
use dpm_device::transport::{Lane, Transport};
use dpm_handoff::latest::{Publisher, Reader};
use std::marker::PhantomData;
use std::sync::atomic::Ordering;
use std::sync::Arc;

use crate::plan::link_time::LinkTime;

/// How often a link without credit checks for new credit, nanoseconds.
const CREDIT_STEP_NS: i64 = 50_000;
/// How often a link with nothing to send polls its device, nanoseconds.
const IDLE_NS: i64 = 1_000_000;
/// The same while the answer to a clock exchange is pending. A late poll makes the clock wrong by as much.
const ECHO_STEP_NS: i64 = 50_000;
/// Time that reopening a lost medium may take, nanoseconds.
const REOPEN_NS: i64 = 2_000_000_000;
/// The supervisor must confirm at least this often that every stage is alive, nanoseconds.
const ALIVE_WITHIN_NS: i64 = 150_000_000;
/// Time between two checks of a projector that is going dark, nanoseconds.
const DARK_STEP_NS: i64 = 1_000_000;
/// The minimum number of checks: the projector may report that it is dark before the order arrives.
const DARK_LOOKS: u32 = 4;
/// Number of checks of a projector outside this process: STOP is repeated for 300 ms, and its watchdog does the rest.
const DARK_LOOKS_OUTSIDE: u32 = 300;

/// A tracker that has been silent for this long is not followed, nanoseconds.
const STALE_NS: i64 = 250_000_000;

/// What happened to a frame that was offered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Offer {
    /// The device or the medium has no room for it. Offer it again at this instant.
    Again(HostTime),
    /// It was sent or left out; its note records which.
    Settled,
}

/// How far the light's end has progressed.
#[derive(Clone, Copy, Debug)]
enum Ending {
    /// The last frames are still lit.
    LastLight { until: HostTime },
    /// STOP was sent, and the projector was checked this many times.
    Stopped { looks: u32 },
}

/// The link and the work between frames.
pub(crate) struct LinkStage<P> {
    facts: Arc<Facts>,
    link: HostLink,
    keeper: LinkKeeper,
    lead: LeadEstimator,
    slack: SlackMeter,
    queue: QueueWatch,
    /// The same for the medium, and which of both have a standing queue.
    medium_queue: QueueWatch,
    stands: [bool; 2],
    standing: StandingWait,
    cadence: Cadence,
    /// Sessions of the link, and steps of the projector's clock, so far.
    seen: [u64; 2],
    /// `None` if no tracks are sent.
    follower: Option<PlaneFollower>,
    slot_ns: i64,
    /// When the frame being offered was ready; `None` between frames.
    ready_at: Option<HostTime>,
    /// Until when a frame last waited for room in the device.
    credit_until: HostTime,
    /// How long the frame being offered waited for room in the device, and for stages that were busy with frames before
    /// it, nanoseconds; `None` if the lead does not learn from it.
    waits_ns: Option<[i64; 2]>,
    /// Bytes of planes that were sent, and bytes that the processor read and wrote of them from the read-back on.
    planes_bytes: u64,
    touched_bytes: u64,
    /// When the frame before was packed, and when it left this stage.
    before: [HostTime; 2],
    ending: Option<Ending>,
    looks: u32,
    pace: PhantomData<P>,
}

impl<P: Pace> LinkStage<P> {
    /// For a link that is up.
    pub(crate) fn new(
        facts: Arc<Facts>,
        link: HostLink,
        mut keeper: LinkKeeper,
        lead: LeadEstimator,
    ) -> Self {
        keeper.guards_heads = !facts.rig.heads.is_empty();
        let slot_ns = facts.rig.rate().slot_len_ns(0);
        // If light is known only from reports, the projector is outside this process.
        let looks = if keeper.has_reports() { DARK_LOOKS_OUTSIDE } else { DARK_LOOKS };
        Self {
            facts,
            link,
            keeper,
            lead,
            slack: SlackMeter::new(),
            queue: QueueWatch::new(slot_ns),
            medium_queue: QueueWatch::new(slot_ns),
            stands: [false; 2],
            standing: StandingWait::new(slot_ns),
            cadence: Cadence::new(slot_ns),
            seen: [0; 2],
            follower: None,
            slot_ns,
            ready_at: None,
            credit_until: HostTime(i64::MIN / 2),
            waits_ns: None,
            planes_bytes: 0,
            touched_bytes: 0,
            before: [HostTime(i64::MIN / 2); 2],
            ending: None,
            looks,
            pace: PhantomData,
        }
    }

    /// From now on planning receives the projector's clock through `times`.
    pub(crate) fn tell_times_to(&mut self, times: Publisher<LinkTime>) {
        self.keeper.tell_times_to(times);
    }

    /// From now on the projector is told of the bodies between frames, if it follows tracks, by what arrives at `newest`.
    pub(crate) fn follow_by(&mut self, newest: Reader<TrackSnapshot>) {
        self.follower = Some(PlaneFollower::new(&self.facts.rig, newest));
    }

    /// When the next tracks are due; `None` if none are sent.
    pub(crate) fn tracks_due_at(&self) -> Option<HostTime> {
        self.follower.as_ref().filter(|_| self.link.greatest_shift().is_some()).map(PlaneFollower::due_at)
    }

    /// True while frames can be sent.
    pub(crate) fn is_streaming(&self) -> bool {
        self.link.state() == LinkState::Streaming
    }

    /// How long the caller may wait for a frame at `now` before the link must be polled, nanoseconds.
    pub(crate) fn rest_ns(&self, now: HostTime) -> i64 {
        let step_ns = if self.link.awaits_echo(now) { ECHO_STEP_NS } else { IDLE_NS };
        self.tracks_due_at().map_or(step_ns, |due| due.ns_since(now).clamp(0, step_ns))
    }

    /// How long one call may take: `step_ns`, or longer while a lost medium is being reopened.
    pub(crate) fn expected_ns(&self, step_ns: i64) -> i64 {
        match self.link.state() {
            LinkState::Lost => REOPEN_NS,
            _ => step_ns,
        }
    }

    /// Polls the link and does what is due between frames.
    pub(crate) fn poll(&mut self, now: HostTime, transport: &mut dyn Transport) {
        let Self {
            facts, link, keeper, follower, slack, seen, slot_ns, medium_queue, stands, cadence, ..
        } = self;
        let lost = facts.crew_lost.swap(false, Ordering::Relaxed);
        let alive =
            !lost && now.ns_since(HostTime(facts.alive_at_ns.load(Ordering::Relaxed))) <= ALIVE_WITHIN_NS;
        let result = keeper.poll(now, link, transport, !P::FOLLOWS_CLOCK, alive, &facts.monitor);
        let now_seen = [link.counters().sessions, keeper.clock_steps()];
        if std::mem::replace(seen, now_seen) != now_seen {
            slack.forget();
            (*medium_queue, stands[1]) = (QueueWatch::new(*slot_ns), false);
        }
        let timing = link.status().and_then(|status| status.timing);
        let need = timing.and_then(|timing| slack.observe(timing, now));
        if let Some(timing) = timing.filter(|_| need.is_some()) {
            cadence.transferred(i64::from(timing.transfer_ns));
            slack.lit().into_iter().for_each(|lit| cadence.lit(lit));
        }
        let beyond_ns = if link.measures_timing() { 0 } else { keeper.travel_ns() + RECEIPT_NS };
        facts.travel_ns.store(beyond_ns, Ordering::Relaxed);
        if let Err(e) = result {
            facts.fail(e.into());
        }
        if let Some(follower) = follower {
            follower.poll(now, keeper.time(), link, transport);
        }
        if P::FOLLOWS_CLOCK {
            follow_tracker(now, facts, keeper.time(), *slot_ns, link, transport);
        }
        if let Some(need) = need {
            self.stands[1] = self.medium_queue.observe(self.slack.queued_ns(), now);
            self.learn(need);
        }
        self.tell_queues(now);
    }

    /// Planning learns whether a queue stands.
    fn tell_queues(&self, now: HostTime) {
        self.facts.queue_stands.store(self.stands != [false; 2], Ordering::Relaxed);
        self.facts.is_on_the_way.store(self.slack.is_on_the_way(now), Ordering::Relaxed);
    }

    /// The lead learns what a frame needed.
    fn learn(&mut self, need: FrameNeed) {
        let Self { facts, lead, standing, .. } = self;
        standing.observe(need, |needed_ns| lead.measured(needed_ns));
        facts.lead_ns.store(lead.lead_ns(), Ordering::Relaxed);
        facts.typical_ns.store(lead.typical_ns(), Ordering::Relaxed);
    }

    /// Offers a packed frame at `now`. `is_newest`: no other frame waits behind it. Call [`LinkStage::taken`] when it
    /// is settled.
    pub(crate) fn offer(
        &mut self,
        now: HostTime,
        note: &mut FrameNote,
        planes: &[u8],
        is_newest: bool,
        transport: &mut dyn Transport,
    ) -> Offer {
        self.poll(now, transport);
        let ready_at = match self.ready_at {
            None if is_overtaken(note, now, is_newest) => return Offer::Settled,
            None => *self.ready_at.insert(now),
            Some(ready_at) => ready_at,
        };
        if self.is_of_another_clock(note) {
            note.fate = Fate::Overtaken;
            self.ready_at = None;
            return Offer::Settled;
        }
        if self.waits_for_room(now, note, transport) {
            return Offer::Again(now.plus_ns(CREDIT_STEP_NS));
        }
        self.ready_at = None;
        // A frame that waited for room in the device, or behind a frame that did, was ready earlier.
        let queued_ns = self.credit_until.min(ready_at).ns_since(note.timeline.packed_at).max(0);
        if now > ready_at {
            self.credit_until = now;
        }
        let waited_ns = now.ns_since(ready_at) + queued_ns;
        let stamps = &note.timeline;
        let idle_ns = stamps.packing_at.ns_since(stamps.rendered_at) + now.ns_since(stamps.packed_at);
        // While a frame before it was packed, and while one was sent; not what a wake takes, which an earlier start makes
        // up for.
        let [packed_before, sent_before] = self.before;
        let behind_ns = packed_before.ns_since(stamps.rendered_at).max(0)
            + (sent_before.ns_since(stamps.packed_at) - queued_ns).max(0);
        self.waits_ns = Some([waited_ns, behind_ns]);
        self.stands[0] = self.queue.observe(idle_ns, now);
        self.tell_queues(now);
        // Where the projector's clock is not well known, light may come later than it seems.
        let latest = self.lit_at(note, now).plus_ns(self.keeper.time().bound_ns);
        if is_too_old(note, latest, self.slot_ns) {
            // The lead learns from this frame too: the next one should begin earlier.
            note.fate = Fate::TooOld;
            self.slack.doubts_travel();
            return Offer::Settled;
        }
        let plan = &note.plan;
        let before = self.link.counters();
        let outcome = self.link.send_frame(now, plan.id.0, plan.target_at, plan.dark_from, planes, transport);
        note.fate = Fate::Offered(outcome);
        if outcome == SendOutcome::Sent {
            self.count_touches(note.touched_bytes, planes.len() as u64, &before);
            self.keeper.sent(plan, has_light(planes), now);
            if let Some(follower) = &mut self.follower {
                follower.sent(plan);
            }
        } else {
            self.waits_ns = None;
        }
        Offer::Settled
    }

    /// A settled frame left the stage at `now`; the lead learns the time that it needed, here or when the device reports
    /// its slack. Time spent waiting for room in the device does not count: an earlier start would only fill the device
    /// more.
    pub(crate) fn taken(&mut self, note: &mut FrameNote, now: HostTime) {
        note.timeline.sent_at = now;
        self.before = [note.timeline.packed_at, now];
        self.learn_cadence(&note.fate, now);
        let Some([waited_ns, behind_ns]) = self.waits_ns.take() else { return };
        if self.link.measures_timing() && note.is_sent() {
            self.slack.sent(SlackFrame {
                frame: note.plan.id.0 as u32,
                latch_due_at: note.latch_due_at,
                due_at: note.timeline.due_at,
                sent_at: now,
                waited_ns,
                behind_ns,
            });
        } else {
            let needed_ns = now.ns_since(note.latch_due_at) - waited_ns + self.slack.travel_ns();
            self.learn(FrameNeed { needed_ns, behind_ns });
        }
    }

    /// Counts what the processor has read and written of a frame of `planes` bytes: `packed` bytes before it was offered, and
    /// what was added to the link's counters, which were `before`, to compact it and to put it on the wire.
    fn count_touches(&mut self, packed: u64, planes: u64, before: &LinkCounters) {
        let now = self.link.counters();
        // A payload is read once, for its checksum and its copy together, and written once.
        let wire = 2 * (now.frame_bytes_sent - before.frame_bytes_sent);
        let compacted = now.compaction_bytes - before.compaction_bytes;
        self.planes_bytes += planes;
        self.touched_bytes += packed + wire + compacted;
    }

    /// True if the frame was planned by a clock of the projector that has since started anew, or whose map was wrong by
    /// more than a slot: it would be lit at another time than it was drawn for.
    fn is_of_another_clock(&self, note: &FrameNote) -> bool {
        let meant_at = self.keeper.time().host_of(note.plan.target_at);
        meant_at.ns_since(note.plan.due_at).abs() > self.slot_ns
    }

    /// From sent to whole in the device, nanoseconds.
    fn travel_ns(&self) -> i64 {
        if self.link.measures_timing() {
            self.slack.travel_ns()
        } else {
            self.keeper.travel_ns() + RECEIPT_NS
        }
    }

    /// When a frame that is sent at `now` will be lit: in its slot, or in the first one that begins after it arrives.
    fn lit_at(&self, note: &FrameNote, now: HostTime) -> HostTime {
        let due_at = note.timeline.due_at;
        let arrives_ns = match (P::FOLLOWS_CLOCK, self.link.measures_timing()) {
            (false, _) => 0,
            (true, true) => self.slack.arrives_ns(now),
            (true, false) => self.travel_ns(),
        };
        let arrives_at = now.plus_ns(arrives_ns);
        if arrives_at <= due_at {
            return due_at;
        }
        let time = self.keeper.time();
        time.host_of_slot(time.slot_after(arrives_at))
    }

    /// True while a frame must wait for room in the device or on the medium. It waits at most until its slot begins.
    fn waits_for_room(&self, now: HostTime, note: &FrameNote, medium: &mut dyn Transport) -> bool {
        self.is_streaming()
            && (self.link.credit() == 0 || !medium.has_room(Lane::Data))
            && now < note.timeline.due_at
            && !self.facts.monitor.stop_requested()
    }

    /// The cadence learns from a settled frame at `now`.
    fn learn_cadence(&mut self, fate: &Fate, now: HostTime) {
        use DropReason::{FlashLimit, LightLimit, LinkLost, NotNewer, NotStreaming};
        match fate {
            Fate::Offered(SendOutcome::Sent) => self.cadence.sent(now),
            Fate::Offered(SendOutcome::Dropped {
                reason: NotStreaming | LinkLost | NotNewer | FlashLimit | LightLimit(_),
            }) => self.cadence.pause(),
            _ => return,
        }
        if P::FOLLOWS_CLOCK {
            self.facts.slots_a_frame.store(self.cadence.slots(), Ordering::Relaxed);
            self.facts.light_slots.store(self.cadence.light_slots(), Ordering::Relaxed);
        }
    }

    /// Ends the light, step by step: after the last frames' light if the run is complete, at once if a stop was
    /// requested. `last`: when the last frame was sent. Returns when to call again; `None` when the projector is
    /// dark, or was ordered often enough.
    pub(crate) fn end(
        &mut self,
        now: HostTime,
        last: HostTime,
        transport: &mut dyn Transport,
    ) -> Option<HostTime> {
        let ending = self.ending.unwrap_or_else(|| {
            let until = last.plus_ns(P::last_light_ns(&self.facts, self.travel_ns()));
            Ending::LastLight { until }
        });
        let next = match ending {
            Ending::LastLight { until } if now < until && !self.facts.monitor.stop_requested() => {
                self.poll(now, transport);
                ending
            }
            Ending::LastLight { .. } => {
                self.keeper.stop(now, &mut self.link, transport);
                Ending::Stopped { looks: 0 }
            }
            Ending::Stopped { looks } => {
                // The line may still be busy with a frame. The link repeats STOP until the projector reports that it
                // is dark.
                self.poll(now, transport);
                Ending::Stopped { looks: looks + 1 }
            }
        };
        self.ending = Some(next);
        let again = now.plus_ns(DARK_STEP_NS);
        match next {
            Ending::LastLight { until } => Some(again.min(until)),
            Ending::Stopped { looks } => {
                let is_over = looks >= self.looks || looks >= DARK_LOOKS && is_dark(&self.link);
                if is_over {
                    self.facts.monitor.light_gauge().end();
                }
                (!is_over).then_some(again)
            }
        }
    }

    /// What the link carried over the medium `name`.
    pub(crate) fn report(&self, name: &str) -> ProjectorReport {
        let touches = (self.planes_bytes > 0).then(|| self.touched_bytes as f64 / self.planes_bytes as f64);
        ProjectorReport { slack: self.slack.report(), touches, ..self.keeper.report(&self.link, name) }
    }
}

/// Shifts the slots so that they follow the tracker, where the projector lets it and the rates allow it.
fn follow_tracker(
    now: HostTime,
    facts: &Facts,
    time: &LinkTime,
    slot_ns: i64,
    link: &mut HostLink,
    medium: &mut dyn Transport,
) {
    let is_fresh = |rhythm: &SampleRhythm| now.ns_since(rhythm.captured_at) < STALE_NS;
    let rhythm = facts.rhythm().filter(|rhythm| is_fresh(rhythm) && genlock::keeps_step(rhythm, slot_ns));
    facts.in_step.store(rhythm.is_some() && link.shifts_slots(), Ordering::Relaxed);
    let Some(rhythm) = rhythm.filter(|_| link.may_shift() && !facts.gpu_is_slow.load(Ordering::Relaxed))
    else {
        return;
    };
    let lead_ns = facts.lead_ns.load(Ordering::Relaxed) + facts.travel_ns.load(Ordering::Relaxed);
    let is_first = !link.has_sent_frames();
    let shift = genlock::shift_ns(&rhythm, time, lead_ns, slot_ns, is_first, now);
    if let Some((slot, by_ns)) = shift.and_then(|(slot, by)| Some((slot.checked_sub(time.first)?, by))) {
        // A medium without room is asked again at the next poll.
        let _ = link.shift_slots(now, slot, by_ns, medium);
    }
}

/// True when the poses of a frame may be older than the prediction time plus one slot when it is lit, at `latest` or before.
fn is_too_old(note: &FrameNote, latest: HostTime, slot_ns: i64) -> bool {
    let oldest = note.plan.oldest_captured_at();
    oldest.is_some_and(|captured| latest.ns_since(captured) > note.plan.predict_ns + slot_ns)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Overrides, RigConfig};
    use crate::rig::Rig;
    use dpm_device::planes::Raster;

    const MS: i64 = 1_000_000;

    /// Found in use, R5: what counts is the age of the poses when the light falls.
    #[test]
    fn a_frame_is_too_old_by_what_its_poses_will_be_when_it_is_lit() {
        let config = RigConfig::demo(&Overrides::default()).unwrap_or_else(|e| panic!("{e}"));
        let rig = Rig::build(&config, Raster::new(16, 16)).unwrap_or_else(|e| panic!("{e}"));
        let (slot_ns, predict_ns) = (10 * MS, 20 * MS);
        let mut note = FrameNote::new(&rig);
        note.plan.predict_ns = predict_ns;
        assert!(!is_too_old(&note, HostTime(500 * MS), slot_ns), "all bodies are dark: nothing is old");
        let mut at = |captured_ms: i64, lit_ms: i64| {
            (note.plan.is_lit, note.plan.captured_at) = (true, HostTime(captured_ms * MS));
            is_too_old(&note, HostTime(lit_ms * MS), slot_ns)
        };
        assert!(!at(70, 100), "30 ms old in its slot: predict_ms and a slot");
        assert!(at(69, 100), "31 ms old in its slot");
    }
}
