//! Frames of the demo one by one: each is shown by the product's own panel on the kernel's card, read back, and compared in
//! all its pixels, before the next one is sent. What the rig counts is compared with the kernel's count of blanks.

use std::collections::BTreeSet;
use std::sync::atomic::Ordering;
use std::sync::Arc;
use std::time::{Duration, Instant};

use dpm_device::link::{HostLink, LinkState, SendOutcome, Status, Verb};
use dpm_device::time::{HostClock, HostTime};
use dpm_device::transport::inproc::Direct;
use dpm_display::card::open_for;
use dpm_display::encoding::Encoding;
use dpm_display::panel::DisplayPanel;
use dpm_display::set_up::{plan, DisplaySettings};

use crate::demo::{cases, DemoCase};
use crate::oracle;
use crate::rig::{clock, link_settings, settings, timing, CONNECTOR, PATIENCE};
use crate::witness::{Disturbance, Witness, WitnessLog};

/// A rig whose thread is the test's: nothing happens but by a call.
struct SteppedRig {
    link: HostLink,
    cable: Direct<DisplayPanel<Witness>>,
    clock: Arc<dyn HostClock>,
    log: WitnessLog,
    /// Planes of the frames, and the pixels that they must become. Frame `id` is number `id - 1`, again and again.
    frames: Vec<(Vec<u8>, Vec<u8>)>,
    /// Frames that were sent.
    sent: u64,
    last_slot: u64,
    /// What each picture that the card took shows: the count of its blank from the first slot on, and the frame.
    shown: Vec<(u64, Option<u64>)>,
    /// Pictures of the log that have been looked at.
    looked: usize,
    /// The kernel's count of the blank that is number 0.
    base: Option<u32>,
    /// The picture on its way, by its number, and the newest slot that has begun meanwhile.
    on_its_way: Option<(usize, u64)>,
    /// A slot had begun before the kernel told that the picture before it had been taken, since the last judgement.
    was_told_late: bool,
    /// Judgements in which slots were compared, and all.
    judged: (u32, u32),
}

/// What the rig and the kernel say at a moment at which nothing is on its way.
#[derive(Clone, Debug)]
struct Sample {
    /// Blanks since number 0, by the kernel's count.
    blank: u64,
    /// Pictures that the card took in them.
    pictures: u64,
    missed: u64,
    status: Status,
}

impl SteppedRig {
    fn open(case: &DemoCase) -> Self {
        let settings = DisplaySettings { schedule: case.schedule, ..settings(case.encoding) };
        let raster = settings.raster;
        let clock = clock();
        let log = WitnessLog::default();
        let mut card = open_for(None, Some(CONNECTOR)).expect("vkms");
        let plan = plan(&card.connectors().unwrap(), &settings).expect("it can be used");
        card.start(&plan.setup).expect("it starts");
        let panel = DisplayPanel::new(Witness::new(card, log.clone()), plan.panel, 1, clock.as_ref());
        let mut link = HostLink::new(link_settings(&settings));
        link.connect();
        let pixels = |planes: &[u8]| oracle::pixels(case.encoding, &case.schedule, raster, planes);
        let frames = case.frames.iter().map(|planes| (planes.clone(), pixels(planes))).collect();
        Self {
            link,
            cable: Direct::new(panel),
            clock,
            log,
            frames,
            sent: 0,
            last_slot: 0,
            shown: Vec::new(),
            looked: 0,
            base: None,
            on_its_way: None,
            was_told_late: false,
            judged: (0, 0),
        }
    }

    /// To be called after every call of the panel, with its time: notes slots that have begun while a picture was on its way.
    fn note(&mut self, now: HostTime) {
        let panel = self.cable.device();
        let (Some(pacer), Some(slots), Some(base)) = (panel.pacer(), self.link.slots(), self.base) else {
            return;
        };
        let log = self.log.lock();
        if let Some((number, newest)) = self.on_its_way {
            if let Some(taken) = log.taken.get(number - 1) {
                self.was_told_late |= u64::from(taken.flip.sequence.wrapping_sub(base)) < newest;
                self.on_its_way = None;
            }
        }
        if log.accepted > log.taken.len() {
            let slot = slots.slot_at(pacer.clock().ticks_at(now)).unwrap_or(0);
            self.on_its_way = Some((log.accepted, slot));
        }
    }

    /// Looks at what the card took since the last look: nothing but black, the frame before, or a newer one, in all pixels.
    fn look(&mut self) {
        let Some(pacer) = self.cable.device().pacer() else { return };
        let log = self.log.lock();
        let Some(last) = log.taken.last() else { return };
        let number = pacer.number(last.flip.sequence);
        let base = *self.base.get_or_insert(last.flip.sequence.wrapping_sub(number as u32));
        for (i, taken) in log.taken.iter().enumerate().skip(self.looked) {
            let blank = taken.flip.sequence.wrapping_sub(base);
            if let Some(before) = i.checked_sub(1).map(|i| log.taken[i].flip) {
                let blanks = taken.flip.sequence.wrapping_sub(before.sequence);
                let ns = f64::from(blanks) * 1e9 / timing().rate().unwrap().hz();
                let stamped = (taken.flip.at_ns - before.at_ns) as f64;
                assert!(blanks > 0 && (stamped - ns).abs() < 1e6, "{blanks} blanks in {stamped} ns");
            }
            let before = self.shown.last().and_then(|(_, frame)| *frame);
            let Some(pixels) = &taken.pixels else {
                // The test will read it: the picture before once more, or what was sent last.
                let is_new = log.taken[i - 1].picture != taken.picture;
                self.shown.push((blank.into(), if is_new { Some(self.sent) } else { before }));
                continue;
            };
            let newer = (before.unwrap_or(0)..=self.sent).filter(|id| *id > 0);
            let is_black = pixels.iter().all(|b| *b == 0);
            let wanted = |id: &u64| &self.frames[(*id - 1) as usize % self.frames.len()].1;
            let frame = newer.into_iter().find(|id| wanted(id) == pixels);
            assert!(is_black || frame.is_some(), "blank {blank} shows what was not sent, or an older frame");
            if blank < u32::MAX / 2 {
                self.shown.push((blank.into(), frame));
            } else {
                assert!(is_black, "light before the blanks were learned");
            }
        }
        self.looked = log.taken.len();
    }

    /// One turn of the rig's loop. Returns a sample if nothing was on its way at one of its calls.
    fn turn(&mut self) -> Option<Sample> {
        let now = self.clock.now();
        match self.link.poll(now, &mut self.cable).expect("the display stays") {
            LinkState::Ready => self.link.arm(0),
            state => assert_ne!(state, LinkState::Faulted),
        }
        self.note(now);
        let mut sample = self.sample(now);
        if sample.is_none() {
            let now = self.clock.now();
            self.cable.device_mut().advance(now);
            self.note(now);
            sample = self.sample(now);
        }
        assert!(!self.cable.device().is_lost(), "{:?}", self.cable.device().counts().lost());
        self.look();
        if sample.is_none() {
            let due = self.cable.device().next_due().ns_since(self.clock.now()).clamp(0, 1_000_000);
            std::thread::sleep(Duration::from_nanos(due as u64));
        }
        sample
    }

    /// What is counted, if nothing is on its way at `now` and the slot of the newest blank is the newest.
    fn sample(&self, now: HostTime) -> Option<Sample> {
        let panel = self.cable.device();
        let pacer = panel.pacer()?;
        let log = self.log.lock();
        let last = log.taken.last()?.flip.sequence;
        let blank = u64::from(last.wrapping_sub(self.base?));
        if log.accepted != log.taken.len() || pacer.slot_at(blank + 1) <= now {
            return None;
        }
        let after = |sequence: u32| (1..u32::MAX / 2).contains(&sequence.wrapping_sub(self.base.unwrap()));
        Some(Sample {
            blank,
            pictures: log.taken.iter().filter(|t| after(t.flip.sequence)).count() as u64,
            missed: panel.counts().missed.load(Ordering::Relaxed),
            status: panel.firmware().status(),
        })
    }

    /// Turns until there is a sample for which `done` holds.
    fn until(&mut self, what: &str, mut done: impl FnMut(&Self, &Sample) -> bool) -> Sample {
        let limit = Instant::now() + PATIENCE;
        loop {
            if let Some(sample) = self.turn().filter(|sample| done(self, sample)) {
                return sample;
            }
            assert!(Instant::now() < limit, "{what}: still {:?}", self.link.state());
        }
    }

    /// Sends the next frame at `now`, for the slot after the next one or a later one. Returns its number; `None` if the link
    /// does not take it.
    fn post(&mut self, now: HostTime) -> Option<u64> {
        let slots = self.link.slots().filter(|_| self.link.state() == LinkState::Streaming)?;
        let pacer = self.cable.device().pacer()?;
        let slot = slots.slot_at(pacer.clock().ticks_at(now)).map_or(0, |s| s + 2).max(self.last_slot + 1);
        let (target, dark_from) = (slots.start(slot), slots.dark_from(slot, 60_000_000_000));
        let id = self.sent + 1;
        let planes = &self.frames[(id - 1) as usize % self.frames.len()].0;
        let outcome = self.link.send_frame(now, id, target, dark_from, planes, &mut self.cable);
        self.note(now);
        match outcome {
            SendOutcome::Sent => {
                (self.sent, self.last_slot) = (id, slot);
                Some(id)
            }
            _ => None,
        }
    }

    /// Sends the next frame as soon as the link takes it, and returns its number.
    fn send(&mut self) -> u64 {
        let limit = Instant::now() + PATIENCE;
        loop {
            self.turn();
            if let Some(id) = self.post(self.clock.now()) {
                return id;
            }
            assert!(Instant::now() < limit, "no frame is taken: {:?}", self.link.state());
        }
    }

    /// Turns until frame `id` is on the display and was read back.
    fn lit(&mut self, id: u64) -> Sample {
        self.until("a frame is lit", |rig, _| rig.shown.last().is_some_and(|(_, frame)| *frame == Some(id)))
    }

    /// The pixels of frame `id`.
    fn pixels(&self, id: u64) -> &Vec<u8> {
        &self.frames[(id - 1) as usize % self.frames.len()].1
    }

    /// The frame that is scanned out from blank `blank` on.
    fn at(&self, blank: u64) -> Option<u64> {
        self.shown.iter().rev().find(|(from, _)| *from <= blank).and_then(|(_, frame)| *frame)
    }
}

/// Every blank takes a picture. One that took none is a flip that was missed, and counted once.
fn judge_flips(sample: &Sample) {
    let without = sample.blank - sample.pictures;
    assert_eq!(sample.missed, without, "{} blanks, {} pictures", sample.blank, sample.pictures);
}

/// What the rig counted between two samples is what the kernel's count of blanks and the pixels say, exactly.
fn judge(rig: &mut SteppedRig, from: &Sample, to: &Sample) {
    judge_flips(to);
    rig.judged.1 += 1;
    if std::mem::take(&mut rig.was_told_late) {
        // The panel cannot know in time, and tells the frame one slot later.
        println!("  (this machine was late to tell of a picture: its slot is not judged)");
        return;
    }
    rig.judged.0 += 1;
    let (mut lit, mut repeated, mut blank, mut seen) = (0, 0, 0, BTreeSet::new());
    for slot in from.blank + 1..=to.blank {
        match (rig.at(slot - 1), rig.at(slot)) {
            (_, None) => blank += 1,
            (before, now) if before == now => repeated += 1,
            (_, now) => {
                lit += 1;
                seen.extend(now);
            }
        }
    }
    let [a, b] = [from, to].map(|s| s.status);
    let counted = [b.slots - a.slots, b.frames_lit - a.frames_lit, b.slots_repeated - a.slots_repeated];
    let by_kernel = [(to.blank - from.blank) as u32, lit, repeated];
    assert_eq!(counted, by_kernel, "slots, frames lit, slots repeated");
    assert_eq!(b.slots_blank - a.slots_blank, blank, "dark slots");
    // The newest frame stands in the slot in which its pixels were first scanned out.
    let Some(newest) = rig.at(to.blank) else { return };
    let first = rig.shown.iter().find(|(_, frame)| *frame == Some(newest)).expect("it was seen").0;
    let told = rig.link.slots().and_then(|slots| slots.slot_at(b.last_lit_at));
    assert_eq!((u64::from(b.last_lit_frame), told), (newest, Some(first)), "frame and slot as told");
    // Frames that were sent before it and never seen have been superseded.
    let before = rig.at(from.blank).unwrap_or(0);
    let unseen = (before + 1..newest).filter(|id| !seen.contains(id)).count() as u32;
    assert_eq!(b.frames_superseded - a.frames_superseded, unseen, "superseded");
}

/// Every frame of the demo, one by one.
fn step(rig: &mut SteppedRig) -> Sample {
    let start = rig.until("the link streams", |rig, _| rig.link.state() == LinkState::Streaming);
    let mut last = start.clone();
    for _ in 0..rig.frames.len() {
        let id = rig.send();
        let sample = rig.lit(id);
        judge(rig, &last, &sample);
        last = sample;
    }
    let frames = rig.frames.len() as u32;
    assert_eq!(last.status.frames_lit - start.status.frames_lit, frames);
    println!(
        "  {frames} frames in {} pictures read back, each pixel as packed; {} blanks, {} flips missed",
        last.pictures - start.pictures,
        last.blank - start.blank,
        last.missed - start.missed
    );
    last
}

/// The picture of a new frame is `blanks` too late. Nothing is read meanwhile, so that no other flip is missed unless this
/// machine is late.
fn stall(rig: &mut SteppedRig, last: &Sample, blanks: u32) -> Sample {
    rig.log.lock().is_blind = true;
    let last = rig.until("nothing is read", |_, sample| sample.blank > last.blank + 3);
    rig.log.lock().next = Disturbance::Stall(blanks);
    let id = rig.send();
    let sample = rig.lit(id);
    judge(rig, &last, &sample);
    assert_eq!(rig.log.lock().next, Disturbance::None);
    let pixels = rig.cable.device_mut().out().reader.read().expect("the card is there");
    assert!(pixels == *rig.pixels(id), "frame {id} was scanned out as it was packed");
    rig.log.lock().is_blind = false;
    let missed = sample.missed - last.missed;
    assert!(missed >= u64::from(blanks), "{missed} missed in a stall of {blanks} blanks");
    println!(
        "  a stall of {blanks} blanks between choice and flip: {missed} flips missed, as the kernel counts"
    );
    sample
}

/// The rig's thread sleeps for `blanks` while two frames wait: the first of them is never seen.
fn sleep(rig: &mut SteppedRig, last: &Sample, blanks: u32) -> Sample {
    let limit = Instant::now() + PATIENCE;
    let id = loop {
        rig.turn();
        // No time passes for the rig between the two, so that no slot begins.
        let now = rig.clock.now();
        if rig.post(now).is_some() {
            break rig.post(now).expect("there is room for two");
        }
        assert!(Instant::now() < limit, "no frame is taken");
    };
    rig.cable.device_mut().out().reader.wait_blanks(blanks);
    let sample = rig.lit(id);
    judge(rig, last, &sample);
    let missed = sample.missed - last.missed;
    let superseded = sample.status.frames_superseded - last.status.frames_superseded;
    println!("  {blanks} blanks asleep: {missed} flips missed, {superseded} frame superseded");
    assert_eq!(superseded, 1, "both were due when the rig woke up");
    assert!(missed + 1 >= u64::from(blanks), "{missed} missed in {blanks} blanks asleep");
    sample
}

/// The kernel refuses a picture because it is busy. Where a blank passes just then, it is busy no longer, and the next frame
/// tries again.
fn occupy(rig: &mut SteppedRig, last: &Sample) -> Sample {
    let before = rig.log.lock().refused;
    let mut sample = last.clone();
    for tried in 1..=20 {
        rig.log.lock().next = Disturbance::Occupy;
        let id = rig.send();
        let lit = rig.lit(id);
        judge(rig, &sample, &lit);
        sample = lit;
        let refused = rig.log.lock().refused - before;
        if refused > 0 {
            let missed = sample.missed - last.missed;
            println!(
                "  a busy kernel: pictures refused {refused} times in {tried} frames, {missed} flips missed"
            );
            return sample;
        }
    }
    panic!("the kernel was never busy");
}

/// An order to go dark is black at the next blank whose picture was not chosen before, and stays so.
fn black(rig: &mut SteppedRig, last: &Sample) {
    rig.link.command(rig.clock.now(), Verb::Black, &mut rig.cable).expect("an order");
    let ordered = rig.cable.device_mut().out().reader.blank().wrapping_sub(rig.base.unwrap());
    let sample = rig.until("black by order", |rig, _| rig.shown.last().is_some_and(|(_, f)| f.is_none()));
    judge_flips(&sample);
    let (from, missed) = (rig.shown.last().unwrap().0, sample.missed - last.missed);
    let late = from - u64::from(ordered);
    println!("  black {late} blanks after the order, {missed} flips missed");
    assert!(late <= missed + 2, "black {late} blanks after the order with {missed} flips missed");
    let dark = rig.until("it stays dark", |_, later| later.blank > sample.blank + 5);
    judge(rig, &sample, &dark);
    assert_eq!(dark.status.slots_blank - sample.status.slots_blank, (dark.blank - sample.blank) as u32);
}

/// Frames scanned out equal frames packed, and what is missed is counted, with every encoding.
pub(crate) fn demo_frames() {
    cases(settings(Encoding::Rgb8).raster).iter().for_each(prove);
}

fn prove(case: &DemoCase) {
    println!("  {}:", case.name);
    let mut rig = SteppedRig::open(case);
    let mut last = step(&mut rig);
    // What is missed does not depend on what the bits of a controller mean.
    let stalls: &[u32] = if case.name.starts_with("dlpc900") { &[2] } else { &[1, 2, 5] };
    for blanks in stalls {
        last = stall(&mut rig, &last, *blanks);
    }
    if stalls.len() > 1 {
        last = sleep(&mut rig, &last, 4);
        last = occupy(&mut rig, &last);
    }
    black(&mut rig, &last);
    let (judged, all) = rig.judged;
    assert!(2 * judged > all, "slots were judged {judged} times of {all}");
    let log = rig.log.clone();
    drop(rig);
    let log = log.lock();
    assert!(!log.blackened.is_empty(), "the way out was read back");
    assert!(log.blackened.iter().flatten().all(|b| *b == 0), "the way out is black in all pixels");
}
