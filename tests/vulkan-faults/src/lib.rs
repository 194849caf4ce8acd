//! A Vulkan layer that makes devices fail on request.
//!
//! The Vulkan loader puts this library between a program and the driver. Calls go through unchanged until a *plan* says otherwise: then a
//! device is lost, a submission never ends, memory runs out. The driver below stays healthy, so a test can tell what the program makes
//! of a fault from what a broken driver would do to it.
//!
//! # Plans
//!
//! A plan is a list of faults with semicolons between them; an empty one lets everything pass. A fault is
//!
//! ```text
//! KIND @ CALL = WHEN [, ms=T] [, bytes=B] [, gpu=K]
//! ```
//!
//! | kind | at these calls | what happens |
//! |---|---|---|
//! | `lost` | `submit` `frame` `wait` `status` | the call answers `VK_ERROR_DEVICE_LOST`, and so does every later call on this device that may; a new device works |
//! | `submit-hang` | `submit` `frame` | the call succeeds and nothing runs: the fence is not signalled, nor that of any later submission. With `ms` the GPU goes on after so long |
//! | `submit-block` | `submit` `frame` | the call itself returns `ms` milliseconds late; without `ms` never |
//! | `late` | `submit` `frame` | the fence is signalled no earlier than `ms` milliseconds after the submission |
//! | `poison` | `submit` `frame` | before the submission runs, every buffer of exactly `bytes` bytes is filled with floats that are not numbers |
//! | `skip` | `barrier` | the barrier is not recorded; the validation layer below sees what that breaks |
//! | `oom-device`, `oom-host`, `init-failed` | `create` `instance` `device` `memory` `buffer` `pipeline` `submit` `frame` `wait` | the call answers with that error and does nothing |
//!
//! | call | what is counted |
//! |---|---|
//! | `submit` | `vkQueueSubmit` |
//! | `frame` | those of them whose command buffers hold an indirect dispatch: frames, not uploads |
//! | `barrier` | `vkCmdPipelineBarrier` |
//! | `wait`, `status` | `vkWaitForFences`, `vkGetFenceStatus` |
//! | `instance`, `device` | `vkCreateInstance`, `vkCreateDevice` |
//! | `memory`, `buffer`, `pipeline` | `vkAllocateMemory`, `vkCreateBuffer`, `vkCreateComputePipelines` |
//! | `create` | every call that makes, allocates, binds, maps or records something, those above included |
//!
//! `WHEN` is the number of the call, counted from 1 in this process since the plan was given: `40` that one alone, `40..` from it on, `40..45` those.
//! With `gpu=K` a fault of the call `device` strikes only the K-th device of the loader's list.
//! `lost@frame=40` is a device that comes back, `lost@frame=40..` one that is lost again at each first frame of its successors,
//! `lost@frame=40; init-failed@device=2..` one that does not come back at all.
//!
//! # A program in a process of its own
//!
//! ```no_run
//! use std::process::Command;
//! use vulkan_faults::FaultLayer;
//!
//! let layer = FaultLayer::new("hang").unwrap();
//! let mut rig = Command::new("target/debug/dpm")
//!     .args(["demo", "--raster", "48x32"])
//!     .envs(layer.variables("submit-hang@frame=40"))
//!     .spawn()
//!     .unwrap();
//! // Later, while it runs: counting begins anew, so this is its very next frame.
//! layer.set("lost@frame=1").unwrap();
//! // What happened so far, and when (CLOCK_MONOTONIC).
//! for event in layer.events() {
//!     println!("{} ns: {} at {} {}", event.at_ns, event.what, event.call, event.number);
//! }
//! rig.wait().unwrap();
//! ```
//!
//! By hand the same is `DPM_VK_FAULTS="submit-hang@frame=40"` beside the variables of the loader that [`FaultLayer::variables`] gives:
//! `VK_LAYER_PATH` and `VK_INSTANCE_LAYERS=VK_LAYER_DPM_faults`. `DPM_VK_FAULTS_FILE` names a file whose present text is the plan, and
//! `DPM_VK_FAULTS_LOG` one to which events are appended.
//!
//! # In the test's own process
//!
//! [`in_this_process`] sets the loader's variables (call it before the first Vulkan call) and gives a handle to the layer as the loader has
//! it. [`Layer::plan`] hands one test at a time the layer and takes the plan back when it is over.
//!
//! # What it does not do
//!
//! The layer stands above the validation layer, which sees only what goes through: what validation says is about the program. It knows
//! `vkQueueSubmit` alone; `vkQueueSubmit2` is not handed out.

mod control;
mod interface;
mod layer;
mod plan;
mod state;

pub use control::{in_this_process, Event, FaultLayer, Layer, Session, LAYER_NAME};
pub use plan::{Call, Fault, Kind, Plan, PlanError};
