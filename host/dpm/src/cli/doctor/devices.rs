//! What `dpm doctor RIG.toml` says of the rig's tracker and projector: each is opened, listened to and closed. The
//! projector stays dark.

use super::super::watch::take_locks;
use super::{Finding, Severity};
use dpm_common::clock::{Clock, MonotonicClock};
use dpm_device::link::{faults, DeviceHello, HostLink, LinkState};
use dpm_device::pose::Pose;
use dpm_device::time::HostTime;
use dpm_device::tracker::{BodyKey, Tracker};
use dpm_device::transport::Transport;
use dpm_rig::config::RigConfig;
use dpm_rig::pipeline::connect;
use dpm_rig::pipeline::projector::{self, Surroundings};
use dpm_rig::plan::beat::RatePair;
use dpm_rig::presence;
use dpm_rig::rig::plausible::Exchanges;
use dpm_rig::rig::Rig;
use dpm_rig::standing::Identity;
use dpm_rig::telemetry::monitor::RunMonitor;
use glam::DVec3;
use std::sync::Arc;
use std::time::Duration;

/// How long the tracker is listened to, nanoseconds.
const LISTEN_NS: i64 = 3_000_000_000;
/// Time between two polls of the tracker, nanoseconds.
const POLL_EVERY_NS: i64 = 500_000;

/// The bodies that the tracker should report: those of the rig, or where the scene could not be read those that the rig
/// file names. `None` if only the scene's file has their names.
fn bodies(config: &RigConfig, rig: Option<&Rig>) -> Option<Vec<BodyKey>> {
    let key = |name: &String, id: Option<i64>| BodyKey { name: name.clone(), id };
    let named = &config.scene.bodies;
    match rig {
        Some(rig) => Some(rig.tracked().map(|b| key(&b.name, b.id)).collect()),
        None if named.is_empty() => None,
        None => {
            let worn = config.worn().into_iter().map(|worn| key(&worn.name, worn.id));
            Some(named.iter().map(|b| key(&b.name, b.id)).chain(worn).collect())
        }
    }
}

/// What the tracker told of each body while it was listened to.
pub(super) struct HeardBody {
    /// Its name.
    pub name: String,
    /// How many samples.
    pub count: u32,
    /// The newest pose.
    pub last: Option<Pose>,
}

/// What was heard of all bodies, in their order.
pub(super) type Heard = Vec<HeardBody>;

/// What each camera of a tracker is and what speaks against it, if the tracker looks by cameras that say so.
#[cfg(feature = "camera")]
pub(super) fn cameras(config: &RigConfig) -> Vec<Finding> {
    let name = "camera";
    let findings = config.tracker.examine().into_iter().map(|answer| match answer {
        Err(doubt) => Finding::new(name, Severity::Missing, doubt.found, doubt.remedy),
        Ok(look) if look.doubts.is_empty() => Finding::new(name, Severity::Ok, look.found, ""),
        Ok(look) => {
            let doubts: Vec<&str> = look.doubts.iter().map(|doubt| &*doubt.found).collect();
            let remedies: Vec<&str> = look.doubts.iter().map(|doubt| &*doubt.remedy).collect();
            let found = format!("{}; {}", doubts.join("; "), look.found);
            Finding::new(name, Severity::Warning, found, remedies.join("; "))
        }
    });
    findings.collect()
}

/// Which bodies the tracker reports, and how often. `rig`: the rig of `config`, if its scene could be read. With it what
/// was heard, if anybody listened.
pub(super) fn tracker(config: &RigConfig, rig: Option<&Rig>) -> (Finding, Option<Heard>) {
    let name = "tracker";
    let page = format!("see {}", config.tracker.kind().page);
    if config.tracker.is_mock() {
        return (Finding::new(name, Severity::Info, "the mock in this process", ""), None);
    }
    let Some(bodies) = bodies(config, rig) else {
        let found = "which bodies it has to report is in the scene's file, which could not be read";
        let remedy = "name them as scene.bodies, or correct the scene first";
        return (Finding::new(name, Severity::Warning, found, remedy), None);
    };
    if bodies.is_empty() {
        return (Finding::new(name, Severity::Info, "no body is tracked", ""), None);
    }
    let clock = MonotonicClock::new(0);
    let start = clock.now();
    let opened =
        dpm_rig::tracks::open_for_names(config, bodies.clone(), Arc::new(move || clock.now()), start);
    let mut tracker = match opened {
        Ok(tracker) => tracker,
        Err(e) => {
            let finding = Finding::new(name, Severity::Missing, e.to_string(), page);
            return (finding, None);
        }
    };
    let (heard, failed, exchanges) = listen(tracker.as_mut(), bodies, &clock, start);
    let seconds = 1e-9 * LISTEN_NS as f64;
    let told = heard.iter().map(|body| match body.count {
        0 => format!("\"{}\" is not seen", body.name),
        count => format!("\"{}\" {:.0} times a second", body.name, f64::from(count) / seconds),
    });
    let found = told.collect::<Vec<_>>().join(", ");
    let finding = match failed {
        Some(why) => Finding::new(name, Severity::Missing, format!("{found}; {why}"), page),
        None if heard.iter().any(|body| body.count == 0) => {
            let state =
                if heard.iter().all(|body| body.count == 0) { Severity::Missing } else { Severity::Warning };
            let remedy = format!("{}; a body that is not seen stays dark", tracker.status());
            Finding::new(name, state, found, remedy)
        }
        None => match tracker.warning() {
            Some(warning) => Finding::new(name, Severity::Warning, format!("{found}; {warning}"), page),
            None => Finding::new(name, Severity::Ok, found, ""),
        },
    };
    (with_exchanges(finding, &exchanges, &heard), Some(heard))
}

/// Listens for [`LISTEN_NS`] from `start`. What was heard of each body, why the tracker failed, and which bodies changed places.
fn listen(
    tracker: &mut dyn Tracker,
    bodies: Vec<BodyKey>,
    clock: &MonotonicClock,
    start: HostTime,
) -> (Heard, Option<String>, Exchanges) {
    let named = bodies.into_iter().map(|body| HeardBody { name: body.name, count: 0, last: None });
    let mut heard: Heard = named.collect();
    let mut exchanges = Exchanges::default();
    loop {
        let now = clock.now();
        if now.ns_since(start) > LISTEN_NS {
            return (heard, None, exchanges);
        }
        let polled = tracker.poll(now, &mut |sample| {
            let index = usize::from(sample.body.0);
            if let Some(body) = heard.get_mut(index).filter(|_| sample.tracked) {
                body.count += 1;
                body.last = Some(sample.pose);
                exchanges.observe(index, DVec3::from_array(sample.pose.position_m));
            }
        });
        if let Err(e) = polled {
            return (heard, Some(e.to_string()), exchanges);
        }
        clock.wait_until(now.plus_ns(POLL_EVERY_NS));
    }
}

/// A finding about the tracker, with the bodies that changed places.
fn with_exchanges(finding: Finding, exchanges: &Exchanges, heard: &Heard) -> Finding {
    let swaps = exchanges.pairs.iter().map(|([a, b], count)| {
        let times = if *count == 1 { "once".into() } else { format!("{count} times") };
        format!("\"{}\" and \"{}\" changed places {times}", heard[*a].name, heard[*b].name)
    });
    let swaps: Vec<String> = swaps.collect();
    if swaps.is_empty() {
        return finding;
    }
    let state = if finding.state == Severity::Ok { Severity::Warning } else { finding.state };
    let remedy = "their markers are too alike: give each body an arrangement of its own";
    let remedy =
        if finding.remedy.is_empty() { remedy.into() } else { format!("{}; {remedy}", finding.remedy) };
    Finding { state, found: format!("{}; {}", finding.found, swaps.join(", ")), remedy, ..finding }
}

/// What a device says of where the observer looks, if one measures it. Without it the gaze follows the axis of the glasses, so
/// nothing is missing.
pub(super) fn gaze(config: &RigConfig) -> Option<Finding> {
    let name = "gaze";
    let clock = MonotonicClock::new(0);
    let mut source = config.observer.gaze.open(Arc::new(move || clock.now()), true)?;
    let (start, mut latency_ns) = (clock.now(), 0);
    while clock.now().ns_since(start) < LISTEN_NS {
        source.poll(Duration::from_millis(20), &mut |sample| {
            latency_ns += sample.received_at.ns_since(sample.at);
        });
    }
    let counts = source.counts();
    if let Some(doubt) = source.doubt() {
        let remedy = format!("{}; see docs/TRACKERS.md", doubt.remedy);
        return Some(Finding::new(name, Severity::Warning, doubt.found, remedy));
    }
    if counts.used == 0 {
        let found = format!(
            "{} samples in {} s, none of which can be used",
            counts.samples,
            LISTEN_NS / 1_000_000_000
        );
        return Some(Finding::new(name, Severity::Warning, found, "see docs/TRACKERS.md"));
    }
    let found = format!(
        "{:.0} samples a second, {:.0} % of them unsure, {:.1} ms old when they come, clocks within {:.1} ms",
        counts.samples as f64 * 1e9 / LISTEN_NS as f64,
        100.0 * counts.unsure as f64 / counts.samples.max(1) as f64,
        latency_ns as f64 * 1e-6 / counts.used as f64,
        counts.clock_bound_ns as f64 * 1e-6
    );
    Some(Finding::new(name, Severity::Ok, found, ""))
}

/// Whether the slots can follow the tracker: its rate in the rig file beside that of frames. If it was `heard` at another
/// rate, that one counts. `None` if neither is known.
pub(super) fn beat(config: &RigConfig, heard: Option<&Heard>) -> Option<Finding> {
    let most = heard.and_then(|heard| heard.iter().map(|body| body.count).max()).filter(|count| *count > 0);
    let counted_hz = most.map(|most| f64::from(most) / (1e-9 * LISTEN_NS as f64));
    let meant_hz = config.tracker.rate_hz().map(f64::from);
    // While it was listened to, it also had to connect: a count says roughly what the rate is.
    let is_meant = |meant: &f64| counted_hz.is_none_or(|counted| (counted / meant - 1.0).abs() < 0.1);
    let tracker_hz = meant_hz.filter(is_meant).or(counted_hz.map(f64::round))?;
    let pair = RatePair { tracker_hz, slots_hz: config.projector.frame_rate.hz() };
    Some(match pair.told() {
        None => Finding::new("beat", Severity::Ok, "slots and samples of the tracker go together", ""),
        Some(told) => {
            let [below, above] = pair.nearest_slots_hz();
            let remedy = format!(
                "projector.frame_rate = \"{below:.0}\" or \"{above:.0}\", or another rate of the tracker"
            );
            Finding::new("beat", Severity::Info, told, remedy)
        }
    })
}

/// Whether the projector answers, and whether it can show the rig's frames. `loads`: the code of a library that the rig
/// file names may run.
pub(super) fn projector(config: &RigConfig, loads: bool) -> Finding {
    let identity = Identity::of(&config.projector.backend).to_string();
    let failed = |why: String| Finding::new("projector", Severity::Missing, why, "see docs/PROJECTORS.md");
    // A projector that another run lights is left alone.
    let _locks = match take_locks(config) {
        Ok(locks) => locks,
        Err(e) => return failed(e.message),
    };
    if let Err(missing) = presence::PROJECTOR.look(config) {
        return failed(missing.message);
    }
    if config.projector.backend.is_mock() {
        return Finding::new("projector", Severity::Info, "the mock in this process", "");
    }
    let answered = match config.projector.backend.examine(loads) {
        Some(look) => look.map(|look| {
            let state = if look.is_doubtful { Severity::Warning } else { Severity::Ok };
            (state, look.found, look.remedy)
        }),
        None => linked(config),
    };
    match answered {
        Ok((state, found, remedy)) => {
            Finding::new("projector", state, format!("{identity}: {found}"), remedy)
        }
        Err(why) => failed(why),
    }
}

/// State, what was found, and what to do.
type Answer = (Severity, String, String);

/// Says HELLO and CONFIG to a projector of the link, and ends the session before it was armed.
fn linked(config: &RigConfig) -> Result<Answer, String> {
    let clock = MonotonicClock::new(0);
    let around = Surroundings::plain(Arc::new(move || clock.now()));
    let raster = config.projector.raster();
    let medium = projector::open(config, raster, &around).map_err(|e| e.to_string())?;
    let mut medium = medium.ok_or("it has no link")?;
    let mut link = HostLink::new(projector::link_settings(config, raster));
    // A link for which dark is ordered comes up without being armed.
    let monitor = RunMonitor::default();
    monitor.request_stop();
    let mut now = || {
        std::thread::sleep(Duration::from_micros(200));
        clock.now()
    };
    let transport: &mut dyn Transport = &mut *medium.transport;
    connect(&mut link, transport, 0, &monitor, &mut now, &|| false).map_err(|e| e.to_string())?;
    let mut found = medium.warnings;
    found.extend(link.device().map(told_of_device));
    let p = &config.projector;
    found.push(format!("{} frames/s of {} planes are within its limits", p.frame_rate.hz(), p.planes));
    let bytes = projector::frame_bytes(raster, p.schedule().len()) as f64 * p.frame_rate.hz();
    found.push(format!(
        "raw frames are {:.1} MB/s, `dpm link-test` measures what the link carries",
        1e-6 * bytes
    ));
    let latched = link.status().map_or(0, |status| status.faults);
    if link.state() == LinkState::Faulted {
        found.push(format!("latched faults: {}", faults::names(latched)));
        let remedy =
            "`dpm arm` acknowledges them while the rig runs; a run acknowledges a watchdog by itself";
        return Ok((Severity::Warning, found.join("; "), remedy.into()));
    }
    Ok((Severity::Ok, found.join("; "), String::new()))
}

fn told_of_device(device: &DeviceHello) -> String {
    let [major, minor] = device.firmware.to_be_bytes();
    format!(
        "firmware {major}.{minor}, {} frame buffers, {} planes at most, each {:.1} us or longer",
        device.frame_buffers,
        device.max_planes,
        1e-3 * f64::from(device.min_plane_ns)
    )
}
