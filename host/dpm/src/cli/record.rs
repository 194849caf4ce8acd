//! `dpm record OUT --rig RIG.toml`: records a rig's tracker into a file until the time is over, a signal arrives or
//! the disk is full.

use super::rig_args::RigArgs;
use super::watch::print;
use dpm_common::clock::{Clock, MonotonicClock};
use dpm_common::signals;
use dpm_device::tracker::record::Recorder;
use dpm_device::tracker::{BodyKey, Tracker};
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::rig::Rig;
use std::io::Write;
use std::path::PathBuf;
use std::sync::Arc;

/// Time between two polls of the tracker, nanoseconds. Unless the kernel stamps a packet, it is stamped when it is
/// read.
const POLL_EVERY_NS: i64 = 500_000;
/// Time between two lines of progress, nanoseconds.
const SAY_EVERY_NS: i64 = 1_000_000_000;

/// Flags of `dpm record`.
#[derive(clap::Args, Clone, Debug)]
pub(crate) struct RecordArgs {
    /// The new file; an existing file is not overwritten
    #[arg(value_name = "OUT")]
    out: PathBuf,
    /// The rig file with the tracker and the bodies
    #[arg(long, value_name = "RIG.toml")]
    rig: PathBuf,
    /// Duration in seconds; default: until a signal arrives
    #[arg(long, value_name = "S", value_parser = seconds)]
    seconds: Option<f64>,
    /// Set a key of the rig file, for example tracker.server=192.168.1.10; may be given several times
    #[arg(long = "set", value_name = "KEY=VALUE")]
    set: Vec<String>,
}

fn seconds(text: &str) -> Result<f64, String> {
    let s = text.parse().ok().filter(|s: &f64| *s > 0.0 && *s <= 1e9);
    s.ok_or_else(|| "write seconds, above 0 and at most 1e9".into())
}

/// Records.
///
/// # Errors
/// Exit code 2: a bad rig file, or an output that cannot be created. 3: the file could not be written completely
/// (what was written before can be played), or the tracker failed or delivered nothing, with its own explanation.
pub(super) fn execute(args: &RecordArgs) -> Result<(), Failure> {
    let config = RigArgs { set: args.set.clone(), ..RigArgs::default() }.rig(Some(&args.rig))?;
    let rig = Rig::build(&config, None)?;
    signals::install()
        .map_err(|e| Failure::new(FailureKind::Device, format!("cannot handle signals: {e}")))?;
    let clock = MonotonicClock::new(0);
    let start = clock.now();
    let tracker = dpm_rig::tracks::open_for(&rig, Arc::new(move || clock.now()), start)?;
    let bodies: Vec<_> = rig.tracked().map(|b| BodyKey { name: b.name.clone(), id: None }).collect();
    let mut seen = vec![false; bodies.len()];
    let mut recorder = Recorder::create(tracker, &args.out, &bodies, start)?;
    let mut say_at = start.plus_ns(SAY_EVERY_NS);
    let failed = loop {
        let now = clock.now();
        let over = args.seconds.is_some_and(|s| now.ns_since(start) as f64 >= s * 1e9);
        if over || signals::received().is_some() || recorder.has_failed() {
            break None;
        }
        let polled = recorder.poll(now, &mut |sample| {
            if let Some(seen) = seen.get_mut(usize::from(sample.body.0)) {
                *seen = true;
            }
        });
        if let Err(e) = polled {
            break Some(e);
        }
        if now >= say_at {
            say_at = now.plus_ns(SAY_EVERY_NS);
            let line = serde_json::json!({
                "elapsed_s": now.ns_since(start) / 1_000_000_000,
                "samples": recorder.written(),
                "unrecorded": recorder.unrecorded(),
                "tracker": recorder.inner().status(),
            });
            let _ = writeln!(std::io::stderr(), "{line}");
        }
        clock.wait_until(now.plus_ns(POLL_EVERY_NS));
    };
    let (status, warning, unrecorded) = (recorder.status(), recorder.warning(), recorder.unrecorded());
    let so_far = recorder.written();
    let written = recorder.finish().map_err(|e| {
        let told =
            format!("{e}; the {so_far} samples before can be played, the rest of this recording is lost");
        Failure { message: told, ..Failure::from(e) }
    })?;
    if let Some(e) = failed {
        return Err(Failure::new(
            FailureKind::Device,
            format!("{e}; {written} samples until then are recorded"),
        ));
    }
    if written == 0 {
        return Err(Failure::new(FailureKind::Device, format!("the tracker delivered no sample: {status}")));
    }
    say_written(written, &args.out, (&bodies, &seen), &status);
    if unrecorded > 0 {
        print(&format!(
            "warning: {unrecorded} samples came faster than they could be written, and are not in it\n"
        ));
    }
    if let Some(warning) = warning {
        print(&format!("warning: {warning}\n"));
    }
    Ok(())
}

/// Says how many samples of how many of `bodies` were written, and which of them were never `seen`.
fn say_written(written: u64, out: &std::path::Path, (bodies, seen): (&[BodyKey], &[bool]), status: &str) {
    let there = seen.iter().filter(|seen| **seen).count();
    let of = if there == bodies.len() { format!("{there}") } else { format!("{there} of {}", bodies.len()) };
    print(&format!("{written} samples of {of} bodies in {}\n", out.display()));
    if there < bodies.len() {
        let missing = bodies.iter().zip(seen).filter(|(_, seen)| !**seen);
        let missing: Vec<String> = missing.map(|(body, _)| format!("{:?}", body.name)).collect();
        print(&format!("warning: no sample of {}: {status}\n", missing.join(", ")));
    }
}
