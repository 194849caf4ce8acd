//! What the eye guard did to the light of a run: counted by frame, and told to the operator once per loss of a head.
//!
//! This runs beside the frame path, so it may allocate.

use crate::light::record::FrameRecord;
use crate::rig::Rig;
use crate::telemetry::report::EyesReport;
use dpm_device::time::HostTime;

/// Counts for one run.
#[derive(Clone, Debug, Default)]
pub(crate) struct EyeCounts {
    report: EyesReport,
    /// The head that is lost, and since when.
    lost: Option<(usize, HostTime)>,
}

impl EyeCounts {
    /// For the heads of `rig`.
    pub(crate) fn new(rig: &Rig) -> Self {
        let name = |tracked: usize| rig.tracked().nth(tracked).map_or_else(String::new, |b| b.name.clone());
        let heads: Vec<String> = rig.heads.iter().map(|head| name(head.tracked)).collect();
        Self {
            report: EyesReport { losses: vec![0; heads.len()], heads, ..EyesReport::default() },
            lost: None,
        }
    }

    /// A frame was lit at `at`. Returns what the operator should know of it.
    pub(crate) fn lit(&mut self, record: &FrameRecord, at: HostTime) -> Option<String> {
        let r = &mut self.report;
        r.frames_cut += u64::from(record.cut_mirrors > 0);
        r.mirrors_cut += u64::from(record.cut_mirrors);
        r.frames_dark += u64::from(record.head_lost.is_some());
        if record.head_lost.is_none() {
            r.most_mirrors = r.most_mirrors.max(record.cut_mirrors);
            r.greatest_radius_m = r.greatest_radius_m.max(record.guard_radius_m);
        }
        match (record.head_lost, self.lost) {
            (Some(head), None) => {
                self.lost = Some((head, at));
                r.losses[head] += 1;
                let name = &r.heads[head];
                Some(format!(
                    "dark: the tracker has lost the head {name:?}, and nobody knows where it is; light comes back when it is \
                     seen again ([safety.eyes])"
                ))
            }
            (None, Some((head, since))) => {
                self.lost = None;
                let (name, s) = (&r.heads[head], at.ns_since(since) as f64 * 1e-9);
                Some(format!("light again: the head {name:?} is seen, after {s:.1} s"))
            }
            _ => None,
        }
    }

    /// The counts so far; `None` if no head is guarded.
    pub(crate) fn report(&self) -> Option<EyesReport> {
        (!self.report.heads.is_empty()).then(|| self.report.clone())
    }
}
