//! `dpm link-test --conformance`: a device on any medium, held against every rule of docs/PROTOCOL.md that a report can show.
//!
//! Each rule has a name, a section and one line; its function opens a session of its own, sends single packets, and compares what the device says with
//! what the section demands. Nothing of the host's own half of the link stands in between.

mod codecs;
mod dark;
mod driver;
mod handshake;
mod laws;
mod light;
mod orders;
mod packets;
mod planes;
mod safety;
mod session;
mod shift;
mod shot;
mod time;
mod timing;
mod tracks;
mod watchdog;

pub use driver::{Medium, MediumKind};

use dpm_device::link::{DeviceHello, Status};
use dpm_device::transport::TransportError;
use driver::{ConformanceDriver, R};

/// A rule that fails is tried this often: the machine may have kept its host from sending in time.
const TRIES: u32 = 3;

/// Why a rule's function ends early.
#[derive(Debug)]
pub(crate) enum Stop {
    /// The device broke the rule: what was expected, and what was seen.
    Failed(String),
    /// Nothing that the device reports can show it, and why.
    NotJudged(String),
    /// The medium is gone.
    Lost(TransportError),
    /// Somebody asked to stop.
    Asked,
}

/// What became of a rule.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case", tag = "verdict", content = "why")]
pub enum RuleVerdict {
    /// The device keeps it.
    Ok,
    /// It does not: what was expected, and what was seen.
    Failed(String),
    /// No report can show it here, and why.
    NotJudged(String),
}

/// A rule.
pub struct Rule {
    /// Its name.
    pub id: &'static str,
    /// Section of docs/PROTOCOL.md.
    pub section: &'static str,
    /// What it demands.
    pub statement: &'static str,
    check: fn(&mut ConformanceDriver<'_>) -> R,
}

/// Every rule, in the order in which they are judged.
pub fn rules() -> impl Iterator<Item = &'static Rule> {
    [
        handshake::RULES,
        orders::RULES,
        watchdog::RULES,
        light::RULES,
        dark::RULES,
        planes::RULES,
        codecs::RULES,
        packets::RULES,
        safety::RULES,
        timing::RULES,
        shift::RULES,
        tracks::RULES,
        time::RULES,
    ]
    .into_iter()
    .flatten()
}

/// A rule's line.
#[derive(Clone, Debug, serde::Serialize)]
pub struct RuleLine {
    /// The rule.
    pub rule: &'static str,
    /// Its section.
    pub section: &'static str,
    /// What it demands.
    pub statement: &'static str,
    /// What became of it.
    #[serde(flatten)]
    pub verdict: RuleVerdict,
    /// Times that it was tried; more than one where it failed at first.
    pub tries: u32,
}

/// What the device says it is.
#[derive(Clone, Debug, serde::Serialize)]
pub struct DeviceLine {
    /// Firmware, major and minor.
    pub firmware: [u8; 2],
    /// Mirrors, columns and rows.
    pub raster: [u32; 2],
    /// Most planes of a frame.
    pub planes: u8,
    /// Frames that can wait.
    pub buffers: u8,
    /// Ticks a second.
    pub tick_hz: u32,
    /// Codecs that it reads, bits.
    pub codecs: u32,
    /// Serial number.
    pub serial: u64,
}

/// The judgement.
#[derive(Clone, Debug, serde::Serialize)]
pub struct Judgement {
    /// Name of the medium.
    pub medium: String,
    /// The device; null where it never said HELLO.
    pub device: Option<DeviceLine>,
    /// A line for each rule.
    pub lines: Vec<RuleLine>,
    /// Numbers of rules kept, broken, and not judged.
    pub counts: [usize; 3],
    /// Why it ended before its time.
    pub ended: Option<String>,
}

/// What is judged, and how far.
#[derive(Clone, Copy, Debug, Default)]
pub struct Extent<'a> {
    /// Only these rules; all where it is empty.
    pub only: &'a [String],
    /// The light may flash for a second, for the rule on flashes.
    pub flashes: bool,
}

/// Judges the device behind `medium`. Its light is the least that a frame can have, but for the rules on limits of light. It is left dark.
pub fn judge(medium: Medium<'_>, extent: Extent<'_>) -> Judgement {
    let name = medium.transport.name().to_owned();
    let mut bench = ConformanceDriver::new(medium);
    bench.may_flash = extent.flashes;
    let mut lines = Vec::new();
    let mut ended = None;
    for rule in rules().filter(|r| extent.only.is_empty() || extent.only.iter().any(|id| id == r.id)) {
        let mut tries = 0;
        let verdict = loop {
            tries += 1;
            match (rule.check)(&mut bench) {
                Ok(()) => break Some(RuleVerdict::Ok),
                Err(Stop::NotJudged(why)) => break Some(RuleVerdict::NotJudged(why)),
                Err(Stop::Failed(told)) if tries >= TRIES => break Some(RuleVerdict::Failed(told)),
                Err(Stop::Failed(_)) => {}
                Err(Stop::Lost(e)) => {
                    ended = Some(e.to_string());
                    break None;
                }
                Err(Stop::Asked) => {
                    ended = Some("asked to stop".into());
                    break None;
                }
            }
        };
        let Some(verdict) = verdict else { break };
        lines.push(RuleLine {
            rule: rule.id,
            section: rule.section,
            statement: rule.statement,
            verdict,
            tries,
        });
    }
    bench.darken();
    let count = |wanted: fn(&RuleVerdict) -> bool| lines.iter().filter(|l| wanted(&l.verdict)).count();
    let counts = [
        count(|v| *v == RuleVerdict::Ok),
        count(|v| matches!(v, RuleVerdict::Failed(_))),
        count(|v| matches!(v, RuleVerdict::NotJudged(_))),
    ];
    Judgement { medium: name, device: bench.hello.map(|h| DeviceLine::of(&h)), lines, counts, ended }
}

impl DeviceLine {
    fn of(h: &DeviceHello) -> Self {
        Self {
            firmware: [(h.firmware >> 8) as u8, h.firmware as u8],
            raster: [h.raster.width(), h.raster.height()],
            planes: h.max_planes,
            buffers: h.frame_buffers,
            tick_hz: h.tick_hz,
            codecs: h.codecs,
            serial: h.serial,
        }
    }
}

impl Judgement {
    /// True when every rule was reached and none is broken.
    pub fn passes(&self) -> bool {
        self.counts[1] == 0 && self.ended.is_none()
    }

    /// One line a rule, for people.
    pub fn to_table(&self) -> String {
        let mut out = match &self.device {
            Some(d) => format!(
                "{}: {} x {} mirrors, {} planes, {} buffers, {} ticks/s, codecs {:#x}, firmware {}.{}, serial {}\n",
                self.medium,
                d.raster[0],
                d.raster[1],
                d.planes,
                d.buffers,
                d.tick_hz,
                d.codecs,
                d.firmware[0],
                d.firmware[1],
                d.serial
            ),
            None => format!("{}: no device said HELLO\n", self.medium),
        };
        for line in &self.lines {
            let verdict = match &line.verdict {
                RuleVerdict::Ok if line.tries > 1 => format!("ok (at try {})", line.tries),
                RuleVerdict::Ok => "ok".into(),
                RuleVerdict::Failed(told) => format!("FAILED: {told}"),
                RuleVerdict::NotJudged(why) => format!("not judged: {why}"),
            };
            out += &format!("{:<22} {:<4} {}: {verdict}\n", line.rule, line.section, line.statement);
        }
        let [ok, failed, not_judged] = self.counts;
        out += &format!("{ok} ok, {failed} failed, {not_judged} not judged\n");
        if let Some(why) = &self.ended {
            out += &format!("ended before its time: {why}\n");
        }
        out
    }
}

/// Fails unless `holds`: what was expected, and what was seen.
fn check(holds: bool, expected: &str, seen: impl FnOnce() -> String) -> R {
    if holds {
        Ok(())
    } else {
        Err(Stop::Failed(format!("expected {expected}, saw {}", seen())))
    }
}

/// A report in a few words.
fn tell(s: &Status) -> String {
    format!(
        "{:?}{}, faults {:#x}, tick {}, limit {} of {} accounted and {} free, {} seen: {} lit, {} incomplete, {} late, {} superseded, {} refused; {} slots: {} \
         repeated, {} blank; {} ignored, {} + {} damaged, newest whole {}, lit {}",
        s.state,
        if s.lit { " with light" } else { "" },
        s.faults,
        s.now.0,
        s.frame_limit,
        s.frames_accounted,
        s.buffers_free,
        s.frames_seen,
        s.frames_lit,
        s.frames_incomplete,
        s.frames_late,
        s.frames_superseded,
        s.frames_refused,
        s.slots,
        s.slots_repeated,
        s.slots_blank,
        s.packets_ignored,
        s.header_errors,
        s.payload_errors,
        s.last_whole_frame,
        s.last_lit_frame
    )
}

/// By how much a counter grew.
fn grew(before: &Status, after: &Status, counter: impl Fn(&Status) -> u32) -> u32 {
    counter(after).wrapping_sub(counter(before))
}

/// What became of frames between two reports: lit, incomplete, late, superseded, refused.
fn fates(before: &Status, after: &Status) -> [u32; 5] {
    let of = |s: &Status| {
        [s.frames_lit, s.frames_incomplete, s.frames_late, s.frames_superseded, s.frames_refused]
    };
    let (a, b) = (of(before), of(after));
    std::array::from_fn(|i| b[i].wrapping_sub(a[i]))
}
