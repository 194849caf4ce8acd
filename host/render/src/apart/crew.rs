//! The threads that walk.
//!
//! Every thread waits in the driver until the device asks, takes chunks of the rays until none is left, and the one that ends the last chunk answers.
//! They wait for one another nowhere. A thread that is late finds nothing to do.

use super::frame::{ApartFrame, WalkMemory};
use crate::gpu::{Gpu, GpuError, Relay};
use crate::scene_data::SceneData;
use crate::walker::WalkKernel;
use crossbeam::queue::ArrayQueue;
use dpm_handoff::path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

/// Longest wait in the driver; then a thread looks whether it is still needed.
const LOOK_NS: u64 = 50_000_000;
/// Frames that a thread may be behind: more than are ever in flight.
const BEHIND: usize = 64;
/// How long the end of the threads is waited for; one that hangs in the driver is left behind.
const LAST_WAIT: Duration = Duration::from_millis(500);

/// A frame, and the number of its first question.
type Job = (u64, Arc<ApartFrame>);

struct Common {
    relay: Relay,
    data: Arc<SceneData>,
    kernel: WalkKernel,
    stops: AtomicBool,
}

/// The threads of one renderer. Dropping it ends them.
pub(crate) struct WalkCrew {
    common: Arc<Common>,
    jobs: Vec<Arc<ArrayQueue<Job>>>,
    threads: Vec<JoinHandle<()>>,
}

impl WalkCrew {
    /// A thread for each processor that this process may use.
    ///
    /// # Errors
    /// A call of Vulkan failed.
    pub(crate) fn new(gpu: &Arc<Gpu>, data: &Arc<SceneData>, nodes: usize) -> Result<Self, GpuError> {
        let common = Arc::new(Common {
            relay: Relay::new(gpu)?,
            data: data.clone(),
            kernel: WalkKernel::best(),
            stops: AtomicBool::new(false),
        });
        // They are unpacked now and not by the first frame.
        data.wide_trees();
        let mut crew = Self { common, jobs: Vec::new(), threads: Vec::new() };
        let count = std::thread::available_parallelism().map_or(1, usize::from);
        for i in 0..count {
            let (common, jobs) = (crew.common.clone(), Arc::new(ArrayQueue::new(BEHIND)));
            let own = jobs.clone();
            let bench = WalkMemory::new(data.bodies.len(), nodes);
            let thread = std::thread::Builder::new()
                .name(format!("dpm-walk-{i}"))
                .spawn(move || walk(&common, &own, bench));
            match thread {
                Ok(thread) => {
                    crew.threads.push(thread);
                    crew.jobs.push(jobs);
                }
                Err(e) => tracing::warn!("one thread fewer walks rays: {e}"),
            }
        }
        Ok(crew)
    }

    /// Whether there is anybody.
    pub(crate) fn is_empty(&self) -> bool {
        self.threads.is_empty()
    }

    /// The turns of device and host.
    pub(crate) fn relay(&self) -> &Relay {
        &self.common.relay
    }

    /// Hands a frame to the threads, whose first question is `first`, before it is submitted. Allocates nothing.
    pub(crate) fn hand(&self, first: u64, frame: &Arc<ApartFrame>) {
        for jobs in &self.jobs {
            // A thread that is so far behind is not missed: the others have walked those frames.
            drop(jobs.force_push((first, frame.clone())));
        }
    }
}

impl Drop for WalkCrew {
    fn drop(&mut self) {
        self.common.stops.store(true, Ordering::Release);
        let begin = std::time::Instant::now();
        while self.threads.iter().any(|t| !t.is_finished()) && begin.elapsed() < LAST_WAIT {
            std::thread::sleep(Duration::from_millis(2));
        }
    }
}

/// The loop of a thread.
fn walk(common: &Common, jobs: &ArrayQueue<Job>, mut bench: WalkMemory) {
    let mut current: Option<Job> = None;
    let mut question = 1;
    while !common.stops.load(Ordering::Acquire) {
        match common.relay.wait(question, LOOK_NS) {
            Ok(true) => {}
            Ok(false) => continue,
            // Nothing of the device's will be asked any more.
            Err(_) => return,
        }
        path::enter(true);
        let ends = |job: &Job| job.0 + u64::from(job.1.layout.steps());
        while current.as_ref().is_none_or(|job| question >= ends(job)) {
            let Some(job) = jobs.pop() else { break };
            job.1.look(&mut bench);
            current = Some(job);
        }
        if let Some((first, frame)) = &current {
            // Frames that were displaced were walked by others.
            question = question.max(*first);
            let trees = common.data.wide_trees();
            let step = (question - first) as u32;
            if question >= *first && step < frame.layout.steps() {
                let answered = frame.walk((step, question), trees, common.kernel, &mut bench);
                if answered > 0 {
                    // If this fails the device is gone, and the frame with it.
                    let _ = common.relay.answer(question + u64::from(answered) - 1);
                }
            }
            question += 1;
        }
        path::enter(false);
    }
}
