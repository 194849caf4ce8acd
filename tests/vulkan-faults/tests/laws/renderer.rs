//! A renderer on a device that is lost, hangs, is late, runs out of memory or forgets: what it says, that nothing waits without a bound, that
//! nothing more is asked of a lost device, and that the pictures of a device opened anew are those of one that was never lost.
//!
//! Found in use, R12: the loss of a GPU ended the run, and no test made one.

use crate::common;
use crate::common::{assert_no_validation_messages, clean, layer, submit, Bench, PATIENCE_NS, SLACK};
use dpm_render::gpu::{devices_unfinished, memory_given_up, Gpu, GpuError};
use dpm_render::History;
use dpm_render::{FrameSlot, Renderer};
use std::sync::mpsc::channel;
use std::sync::Arc;
use std::time::{Duration, Instant};
use vulkan_faults::Call;

/// Two seconds, and what a busy machine adds.
const REOPEN_LIMIT: Duration = Duration::from_secs(2);

/// Frames of a device that was opened in place of another one are those of any device.
fn goes_on(gpu: &Gpu) -> Bench {
    let bench = Bench::on(reopened(gpu)).unwrap_or_else(|e| panic!("{e}"));
    shows_the_right_pictures(bench)
}

fn reopened(gpu: &Gpu) -> Arc<Gpu> {
    let begin = Instant::now();
    let again = gpu.reopen().unwrap_or_else(|e| panic!("{e}"));
    assert!(begin.elapsed() < REOPEN_LIMIT + SLACK, "{:?}", begin.elapsed());
    assert_eq!(again.summary().name, gpu.summary().name);
    again
}

fn shows_the_right_pictures(mut bench: Bench) -> Bench {
    for (i, wanted) in clean().iter().take(3).enumerate() {
        assert_eq!(&bench.frame(i as u32).unwrap_or_else(|e| panic!("{e}")), wanted, "frame {i}");
    }
    bench
}

/// Runs `work` and demands that it ends by then.
fn within<T>(limit: Duration, what: &str, work: impl FnOnce() -> T) -> T {
    let begin = Instant::now();
    let out = work();
    assert!(begin.elapsed() < limit, "{what} took {:?}", begin.elapsed());
    out
}

/// A pipeline has one owner at a time: a renderer beside another one compiles its own.
#[test]
fn a_renderer_takes_the_pipelines_of_one_that_is_gone_and_draws_the_same() {
    let session = layer("");
    let compiled = |bench: &dyn Fn() -> Bench| {
        let before = session.count(Call::Pipeline);
        (bench(), session.count(Call::Pipeline) - before)
    };
    let (first, all) = compiled(&Bench::open);
    assert!(all > 5, "{all}");
    let gpu = first.gpu.clone();
    let on_gpu = || Bench::on(gpu.clone()).unwrap_or_else(|e| panic!("{e}"));
    let (second, of_second) = compiled(&on_gpu);
    assert_eq!(of_second, all);
    drop(shows_the_right_pictures(first));
    let (third, of_third) = compiled(&on_gpu);
    assert_eq!(of_third, 0);
    shows_the_right_pictures(third);
    shows_the_right_pictures(second);
    drop(gpu);
    assert_no_validation_messages();
}

/// A crew that takes over from one that hangs waits for no compiler, whatever the threads of the old one still hold.
#[test]
fn a_renderer_that_takes_over_compiles_nothing_and_draws_the_same_beside_the_old_one() {
    let session = layer("");
    clean();
    let mut first = Bench::open();
    first.frame(0).unwrap();
    first.submit(1).unwrap();
    let compiled = session.count(Call::Pipeline);
    let renderer = Renderer::from_prepared(first.renderer.prepared()).unwrap_or_else(|e| panic!("{e}"));
    let slot = renderer.create_slot(false).unwrap();
    let second = shows_the_right_pictures(Bench { renderer, slot, gpu: first.gpu.clone() });
    assert_eq!(session.count(Call::Pipeline), compiled);
    drop(first);
    let mut second = second;
    assert_eq!(second.frame(3).unwrap(), clean()[3]);
    drop(second);
    assert_no_validation_messages();
}

/// Found in use, R2: what a device that was given up held stayed until the end of the program, also where the device had finished
/// long ago.
#[test]
fn what_a_device_that_was_given_up_held_is_free_when_it_has_finished() {
    let session = layer("");
    clean();
    let mut bench = Bench::open();
    bench.frame(0).unwrap();
    let before = memory_given_up().bytes;
    assert!(bench.gpu.answers(Duration::from_secs(60)));
    session.set("submit-hang@frame=1,ms=3000");
    bench.submit(1).unwrap();
    assert!(
        !bench.gpu.answers(Duration::from_millis(100)),
        "what it is given stands behind the frame that hangs"
    );
    bench.gpu.give_up();
    assert!(memory_given_up().bytes > before);
    let next = reopened(&bench.gpu);
    drop(bench);
    let begin = Instant::now();
    while devices_unfinished() > 0 || memory_given_up().bytes > before {
        assert!(begin.elapsed().as_nanos() < u128::from(PATIENCE_NS), "{:?}", memory_given_up());
        std::thread::sleep(Duration::from_millis(5));
    }
    drop(next);
    assert_no_validation_messages();
}

#[test]
fn after_a_loss_nothing_more_is_asked_of_the_device_and_another_one_goes_on() {
    let session = layer("");
    clean();
    let mut bench = Bench::open();
    for plan in ["lost@frame=3", "lost@wait=3"] {
        session.set(plan);
        for i in 0..2 {
            assert_eq!(bench.frame(i).unwrap(), clean()[i as usize], "{plan}");
        }
        assert!(!bench.gpu.is_lost());
        let error = bench.frame(2).expect_err(plan);
        assert!(error.is_loss() && bench.gpu.is_lost(), "{plan}: {error}");
        let name = &bench.gpu.summary().name;
        for word in [name.as_str(), "lost", "frame"] {
            assert!(error.to_string().contains(word), "{word} in {error}");
        }
        // It stays lost, for every use, and the driver is not troubled.
        let asked = [Call::Submit, Call::Wait, Call::Create].map(|call| session.count(call));
        for _ in 0..100 {
            assert!(bench.frame(2).expect_err(plan).is_loss());
            assert!(bench.slot.poll_done(PATIENCE_NS).expect_err(plan).is_loss(), "an old picture is none");
            assert!(bench.slot.wait(PATIENCE_NS).expect_err(plan).is_loss());
        }
        assert!(bench.renderer.create_slot(false).is_err_and(|e| e.is_loss()));
        assert!(bench.renderer.edit_history(0..1, |_| ()).is_err_and(|e| e.is_loss()));
        assert_eq!(asked, [Call::Submit, Call::Wait, Call::Create].map(|call| session.count(call)), "{plan}");
        assert_eq!(session.count(Call::SubmitAfterLoss), 0);
        // From what the lost one was made from, without the scene.
        let again = reopened(&bench.gpu);
        let renderer = Renderer::from_plan(&again, &bench.renderer.plan()).unwrap_or_else(|e| panic!("{e}"));
        let slot = renderer.create_slot(false).unwrap();
        let next = shows_the_right_pictures(Bench { renderer, slot, gpu: again.clone() });
        within(SLACK, "dropping what was lost", || drop(bench));
        drop(next);
        bench = Bench::on(again).unwrap_or_else(|e| panic!("{e}"));
    }
    assert_no_validation_messages();
}

#[test]
fn a_late_gpu_is_no_loss_and_its_pictures_are_right() {
    let session = layer("");
    clean();
    let mut bench = Bench::open();
    session.set("late@frame=1..2,ms=80; submit-hang@frame=3,ms=200");
    for (i, at_least_ms) in [(0, 80), (1, 80), (2, 200), (3, 0)] {
        let begin = Instant::now();
        bench.submit(i).unwrap();
        let mut looks = 0;
        while bench.slot.poll_done(5_000_000).unwrap().is_none() {
            looks += 1;
            assert!(begin.elapsed().as_nanos() < u128::from(PATIENCE_NS));
        }
        assert!(begin.elapsed() >= Duration::from_millis(at_least_ms), "frame {i}: {:?}", begin.elapsed());
        assert!(at_least_ms == 0 || looks > 2, "frame {i}: {looks} looks");
        assert_eq!(bench.slot.codes(), clean()[i as usize], "frame {i}");
    }
    assert!(!bench.gpu.is_lost());
    drop(bench);
    assert_no_validation_messages();
}

#[test]
fn a_submission_that_finds_no_memory_costs_its_frame_alone() {
    let session = layer("");
    clean();
    let mut bench = Bench::open();
    session.set("oom-host@frame=2; oom-device@frame=3; oom-host@wait=2");
    assert_eq!(bench.frame(0).unwrap(), clean()[0]);
    for kind in ["main", "GPU"] {
        let error = bench.frame(1).expect_err("no memory");
        assert!(matches!(error, GpuError::OutOfMemory { .. }) && error.to_string().contains(kind), "{error}");
        assert!(!error.is_loss() && !bench.gpu.is_lost());
    }
    // The wait that fails is no end of the frame: its memory must not be touched before it is over.
    bench.submit(1).unwrap();
    assert!(matches!(bench.slot.poll_done(PATIENCE_NS), Err(GpuError::OutOfMemory { .. })));
    assert!(matches!(bench.submit(2), Err(GpuError::InFlight { .. })));
    assert!(matches!(bench.slot.poll_done(PATIENCE_NS), Ok(Some(_))));
    assert_eq!(bench.slot.codes(), clean()[1], "as if the failed ones had not been");
    assert_eq!(bench.frame(2).unwrap(), clean()[2]);
    drop(bench);
    assert_no_validation_messages();
}

/// All that is kept of past frames becomes garbage, frame numbers and counts included. (What is clamped and counted where a value that is
/// none reaches the code values: `compensation_on_gpu.rs`; other values in the history: case `gpu-poisoned-history`.)
#[test]
fn a_history_full_of_what_is_no_number_is_forgotten_within_two_frames() {
    let session = layer("");
    clean();
    let pixels = (common::WIDTH * common::HEIGHT) as usize;
    let mut bench = Bench::open();
    session.set(&format!("poison@frame=4,bytes={}", pixels * History::BYTES));
    for (i, wanted) in clean().iter().enumerate() {
        bench.submit(i as u32).unwrap();
        let cost = bench.slot.wait(PATIENCE_NS).unwrap();
        assert_eq!(cost.counters().nan_values, 0, "frame {i}");
        let shown = bench.slot.radiance().unwrap();
        assert!(shown.iter().flatten().all(|v| v.is_finite()), "frame {i}");
        let codes = bench.slot.codes();
        if i < 3 {
            assert_eq!(codes, wanted, "frame {i}");
        } else {
            let level = |codes: &[u32]| -> f64 {
                codes.iter().flat_map(|c| c.to_le_bytes()).map(f64::from).sum::<f64>() / pixels as f64
            };
            let lit = |codes: &[u32]| codes.iter().filter(|&&c| c != 0).count();
            // From the second frame on the whole picture is as bright as ever, and nowhere dark.
            if i >= 5 {
                let (is, was) = (level(codes), level(wanted));
                assert!(
                    (is / was - 1.0).abs() < 0.1,
                    "frame {i}: mean code {is:.2}, without the fault {was:.2}"
                );
                let (is, was) = (lit(codes), lit(wanted));
                assert!(is.abs_diff(was) * 50 <= was, "frame {i}: {is} pixels lit, without the fault {was}");
            }
        }
    }
    assert_ne!(bench.slot.codes(), clean()[7], "the fault reached the history");
    drop(bench);
    assert_no_validation_messages();
}

/// A thread may own them and be left alone with them.
#[test]
fn renderers_and_slots_own_what_they_need() {
    const fn may_be_left_alone<T: Send + 'static>() {}
    const { may_be_left_alone::<Renderer>() };
    const { may_be_left_alone::<FrameSlot>() };
    // And slots outlive their renderer, with a frame under way.
    let _session = layer("late@frame=1,ms=100");
    let Bench { mut renderer, mut slot, gpu } = Bench::open();
    submit(&mut renderer, &mut slot, 0).unwrap();
    drop((renderer, gpu));
    slot.wait(PATIENCE_NS).unwrap();
    assert_eq!(slot.codes(), clean()[0]);
    drop(slot);
    assert_no_validation_messages();
}

/// How long anything waits for a device, on a machine with nothing else to do.
mod real_pace {
    use super::*;

    /// A driver that needs a moment to reset its device is waited for; one that does not come back ends in a clear error, in bounded time.
    #[test]
    fn a_device_that_needs_a_moment_comes_back_and_one_that_is_gone_is_named() {
        let session = layer("");
        clean();
        let mut bench = Bench::open();
        session.set("lost@frame=1; init-failed@device=1..3");
        assert!(bench.frame(0).is_err_and(|e| e.is_loss()));
        let again = reopened(&bench.gpu);
        assert_eq!(session.count(Call::Device), 4);
        bench = Bench::on(again).unwrap_or_else(|e| panic!("{e}"));
        for gone in [
            "init-failed@device=1..",
            "oom-host@instance=1..",
            "submit-hang@submit=1..",
            "submit-block@submit=1..,ms=5000",
        ] {
            session.set("lost@frame=1");
            assert!(bench.frame(0).is_err_and(|e| e.is_loss()));
            session.set(gone);
            let error = within(Duration::from_secs(4) + SLACK, gone, || bench.gpu.reopen()).expect_err(gone);
            assert!(matches!(error, GpuError::NoneLeft { .. }), "{gone}: {error}");
            assert!(error.to_string().contains(&bench.gpu.summary().name), "{error}");
            session.set("");
            // When it is back at last, nothing stands in the way.
            let again = reopened(&bench.gpu);
            bench = Bench::on(again).unwrap_or_else(|e| panic!("{e}"));
        }
        drop(shows_the_right_pictures(bench));
        // Of those that were stuck.
        std::thread::sleep(Duration::from_secs(5));
        assert_no_validation_messages();
    }

    /// Nobody gave the device up: dropping finds out, in the time that it allows itself, once.
    #[test]
    fn dropping_what_hangs_takes_two_seconds_at_most_and_gives_the_device_up() {
        let session = layer("");
        let mut bench = Bench::open();
        let mut other = bench.renderer.create_slot(false).unwrap();
        bench.frame(0).unwrap();
        session.set("submit-hang@frame=1");
        submit(&mut bench.renderer, &mut other, 1).unwrap();
        bench.submit(2).unwrap();
        let gpu = bench.gpu.clone();
        within(Duration::from_secs(2) + SLACK, "dropping", || drop((bench, other)));
        assert!(gpu.is_lost());
        drop(goes_on(&gpu));
        assert_no_validation_messages();
    }

    #[test]
    fn a_submission_that_never_ends_is_waited_for_in_pieces_then_left_without_waiting() {
        let session = layer("");
        clean();
        let mut bench = Bench::open();
        session.set("submit-hang@frame=3");
        for i in 0..2 {
            bench.frame(i).unwrap();
        }
        bench.submit(2).unwrap();
        // Short waits are no losses and change nothing.
        for _ in 0..30 {
            let begin = Instant::now();
            assert!(matches!(bench.slot.poll_done(5_000_000), Ok(None)));
            assert!(begin.elapsed() >= Duration::from_millis(5));
        }
        let error = bench.slot.wait(5_000_000).expect_err("still running");
        assert!(matches!(error, GpuError::Timeout { waited_ms: 5, .. }) && !error.is_loss(), "{error}");
        assert!(!bench.gpu.is_lost(), "a timeout is no loss");
        assert!(matches!(bench.submit(3), Err(GpuError::InFlight { .. })), "its memory is still written");
        let before = memory_given_up();
        bench.gpu.give_up();
        assert!(bench.gpu.is_lost());
        let after = memory_given_up();
        assert_eq!(after.devices, before.devices + 1);
        let history = 2 * u64::from(common::WIDTH * common::HEIGHT) * History::BYTES as u64;
        assert!(after.bytes - before.bytes >= history, "{} bytes were held", after.bytes - before.bytes);
        assert!(bench.submit(3).expect_err("given up").is_loss());
        let next = goes_on(&bench.gpu);
        within(Duration::from_millis(500) + SLACK, "leaving it", || drop(bench));
        drop(next);
        assert_no_validation_messages();
    }

    /// The call itself does not come back: only its thread can be left, with the renderer that it owns.
    #[test]
    fn a_renderer_whose_thread_is_stuck_in_the_driver_is_left_and_another_one_goes_on() {
        let session = layer("");
        clean();
        let mut bench = Bench::open();
        bench.frame(0).unwrap();
        session.set("submit-block@frame=1,ms=6000");
        let gpu = bench.gpu.clone();
        let (told, heard) = channel();
        let stuck = std::thread::spawn(move || {
            let submitted = bench.submit(1);
            let _ = told.send(());
            // What comes of it is of no use to anybody.
            (submitted.is_ok(), bench.slot.poll_done(0).is_err())
        });
        // It is in the driver now, as far as one can see from outside.
        while session.count(Call::Frame) == 0 {
            std::thread::sleep(Duration::from_millis(1));
        }
        let begin = Instant::now();
        gpu.give_up();
        let next = goes_on(&gpu);
        // Where the machine is too slow for that the test says nothing, but does not fail either.
        if begin.elapsed() < Duration::from_secs(5) {
            assert!(heard.try_recv().is_err(), "the thread is still stuck");
        }
        drop(next);
        let (_, refused) = stuck.join().unwrap();
        assert!(refused, "what was given up stays so");
        // What the driver made of the call ends, too, and not at the same time as this process.
        let begin = Instant::now();
        while devices_unfinished() > 0 {
            assert!(begin.elapsed().as_nanos() < u128::from(PATIENCE_NS));
            std::thread::sleep(Duration::from_millis(5));
        }
        assert_no_validation_messages();
    }
}
