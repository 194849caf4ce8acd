//! Each call that makes or allocates something fails once, at every place where the program makes one: a clear error, nothing left behind,
//! nothing broken for the next attempt.

use crate::common;
use crate::common::{assert_no_validation_messages, clean, layer, options, rig, threads, Bench};
use dpm_render::gpu::{Gpu, GpuError, MemoryPool};
use dpm_render::{RenderError, Renderer};
use dpm_rig::pipeline::renderer_settings;
use vulkan_faults::{Call, Session};

/// Memory of one kind may be had in several ways, and all of them are tried before one gives up.
const WAYS: u64 = 64;

/// Lets everything fail from one call of `make` on, for each of its calls in turn, until there is none left to fail. Returns how many there
/// were.
fn every_call<T>(
    session: &Session,
    kind: &str,
    from: u64,
    step: u64,
    mut make: impl FnMut() -> Result<T, GpuError>,
) -> u64 {
    let mut n = from;
    loop {
        session.set(&format!("{kind}@create={n}.."));
        let made = make();
        let calls = session.count(Call::Create);
        match made {
            Ok(_) => {
                assert!(calls < n, "call {n} of {calls} failed, and nobody said so");
                return n;
            }
            Err(e) => {
                assert!(
                    (n..n + WAYS).contains(&calls),
                    "{calls} calls, of which {n} and all later ones failed: {e}"
                );
                assert!(!e.is_loss() && !matches!(e, GpuError::Timeout { .. }), "call {n}: {e}");
                let wanted = match kind {
                    "oom-device" => MemoryPool::Device,
                    _ => MemoryPool::Host,
                };
                match &e {
                    GpuError::OutOfMemory { pool, .. } => assert_eq!(*pool, wanted, "call {n}: {e}"),
                    other => panic!("call {n}: {other}"),
                }
            }
        }
        n += step;
        assert!(n < 10_000, "there is no end");
    }
}

fn gpu_error(e: RenderError) -> GpuError {
    match e {
        RenderError::Gpu(e) => e,
        other => panic!("{other}"),
    }
}

#[test]
fn opening_a_device_fails_clearly_at_every_call_and_leaves_nothing() {
    let session = layer("");
    drop(Gpu::open(&options()).unwrap());
    let before = threads();
    for kind in ["oom-host", "oom-device"] {
        let calls = every_call(&session, kind, 1, 1, || Gpu::open(&options()));
        assert!(calls > 4, "instance, two for the list, device: {calls}");
        assert_eq!(threads(), before, "{kind}: threads stay behind");
    }
    session.set("init-failed@device=1");
    let error = Gpu::open(&options()).expect_err("no device");
    assert!(error.to_string().contains("opening the Vulkan device"), "{error}");
    assert_eq!(threads(), before);
    assert_no_validation_messages();
}

/// A device that is lost or hangs while a scene is loaded: the copies are waited for with a bound.
#[test]
fn a_loss_while_a_scene_is_loaded_is_told_at_once() {
    let session = layer("");
    let name = Gpu::open(&options()).unwrap().summary().name.clone();
    for n in [1, 2, 9] {
        for plan in [format!("lost@submit={n}"), format!("lost@wait={n}")] {
            session.set("");
            let gpu = Gpu::open(&options()).unwrap();
            session.set(&plan);
            let error = Renderer::new(&gpu, &rig().scene, renderer_settings(rig()))
                .map_err(gpu_error)
                .err()
                .expect("lost");
            assert!(error.is_loss() && error.to_string().contains(&name), "{plan}: {error}");
            assert_eq!((session.count(Call::Submit), session.count(Call::SubmitAfterLoss)), (n, 0), "{plan}");
        }
    }
    // A device that was opened anew and hangs again while the scene is loaded costs 2 s a copy at most, and the first one ends it.
    session.set("");
    let first = Gpu::open(&options()).unwrap();
    let plan =
        Renderer::new(&first, &rig().scene, renderer_settings(rig())).map_err(gpu_error).unwrap().plan();
    let second = first.reopen().unwrap();
    session.set("submit-hang@submit=2");
    let begin = std::time::Instant::now();
    let error = Renderer::from_plan(&second, &plan).map_err(gpu_error).err().expect("it hangs");
    assert!(matches!(error, GpuError::Timeout { .. }), "{error}");
    assert!(second.is_lost(), "and was given up");
    assert!(begin.elapsed() < std::time::Duration::from_secs(2) + common::SLACK, "{:?}", begin.elapsed());
    assert_no_validation_messages();
}

/// Every single call that a start makes.
mod breadth {
    use super::*;

    /// Memory is returned to the last byte: validation counts every object when the device is closed.
    #[test]
    fn making_a_renderer_or_a_slot_fails_clearly_at_every_call_and_the_next_attempt_works() {
        let session = layer("");
        clean();
        let gpu = Gpu::open(&options()).unwrap();
        let plan =
            Renderer::new(&gpu, &rig().scene, renderer_settings(rig())).map_err(gpu_error).unwrap().plan();
        let before = threads();
        // All of making one but looking at the scene, which asks nothing of Vulkan.
        let make = || Renderer::from_plan(&gpu, &plan).map_err(gpu_error);
        // Every call with one kind of memory, every seventh with the other.
        let calls = every_call(&session, "oom-device", 1, 1, make);
        assert!(calls > 100, "{calls}");
        every_call(&session, "oom-host", 3, 7, make);
        session.set("");
        let renderer = make().unwrap();
        let calls = every_call(&session, "oom-host", 1, 1, || renderer.create_slot(true));
        assert!(calls > 50, "{calls}");
        session.set("");
        drop(renderer);
        assert_eq!(threads(), before, "threads stay behind");
        let mut bench = Bench::on(gpu).unwrap();
        for (i, wanted) in clean().iter().take(3).enumerate() {
            assert_eq!(&bench.frame(i as u32).unwrap(), wanted);
        }
        drop(bench);
        assert_no_validation_messages();
    }
}
