use super::*;
use crate::error::costs::{CardCosts, CardFrame};

fn work() -> FrameWork {
    let lanes = |width, busy| Lanes { width, busy, longest: 8 };
    FrameWork {
        lanes: vec![lanes(32, 0.5), lanes(64, 0.25)],
        listed_pixels: 300_000,
        paths: 1_000_000,
        path_rays: 2_130_000,
        proven_rays: 0,
        bytes_per_pixel: 1000.0,
        recorded_passes: 10,
        readback_bytes: 2_500_000,
    }
}

fn near(a: f64, b: f64) -> bool {
    (a - b).abs() < 1e-9 * b.abs().max(1.0)
}

fn rows(work: &FrameWork) -> Vec<Modelled> {
    CARDS.iter().filter_map(|card| on(card, ("dpm", 3e6, work))).collect()
}

#[test]
fn each_term_is_its_count_over_its_rate() {
    let all = rows(&work());
    assert_eq!(all.len(), CARDS.len());
    let r = &all[0];
    assert!(r.gpu == "RTX 4090" && near(r.screen_ms, 1e3 * 3e8 / (0.284 * 1008e9)), "{r:?}");
    assert!(near(r.barriers_ms, 0.05) && near(r.readback_ms, 0.1), "{r:?}");
    let issued = 0.68 * 512.0 * 2.52e9;
    let camera = 1e3 * CAMERA_TAIL_CLOCKS / 2.52e9 + 1e3 * 300_000.0 * CAMERA_INSTRUCTIONS / issued;
    let fit = 1e3 * TAIL_CLOCKS / 2.52e9 + 1e3 * 2.13e6 * instructions_a_ray(1.0, 2.13) / issued;
    for (i, of_fit) in SPREAD.into_iter().enumerate() {
        assert!(near(r.trace_ms[i], camera + of_fit * fit), "{r:?}");
        assert!(near(r.frame_ms[i], r.trace_ms[i] + r.screen_ms + 0.15), "{r:?}");
        assert!(near(r.frames_per_s[1 - i], 1e3 / r.frame_ms[i]), "{r:?}");
    }
    // The assumption is as it was written down before a card was measured: all rays by the lanes that have a sample.
    let assumed = &r.failed_assumption;
    assert!(near(assumed.trace_ms[0], 1.5) && near(assumed.trace_ms[1], 2.0), "{r:?}");
    assert!(near(assumed.frame_ms[0], 1.65 + 1e3 * 3e8 / 604.8e9), "{r:?}");
    assert!(all[1].gpu == "RX 7900 XTX" && near(all[1].failed_assumption.trace_ms[0], 6.0), "{:?}", all[1]);
    let text = table(&all);
    assert!(text.starts_with("computed, not measured") && text.contains("assumed, and failed"), "{text}");
    assert!(rows(&FrameWork { lanes: vec![], ..work() }).is_empty());
}

#[test]
fn rays_that_are_proven_to_miss_cost_less_than_walked_ones_and_more_than_nothing() {
    let at = |walked: f64| instructions_a_ray(walked, 2.13);
    // The simulated rows of a frame with two rays a vertex.
    for (walked, wanted) in [(1.0, 522.0), (0.305, 415.0), (0.165, 364.0)] {
        assert!((at(walked) / wanted - 1.0).abs() < 0.01, "{walked}: {} and not {wanted}", at(walked));
    }
    assert!((instructions_a_ray(0.303, 1.04) / 515.0 - 1.0).abs() < 0.01);
    let all: Vec<f64> = (0..=20).map(|i| at(f64::from(i) / 20.0)).collect();
    assert!(all.windows(2).all(|pair| pair[0] < pair[1]), "{all:?}");
    assert!(near(all[0], SHADING_INSTRUCTIONS));
    let trace = |proven_rays| {
        let all = rows(&FrameWork { proven_rays, ..work() });
        all.iter().map(|r| r.trace_ms[0]).collect::<Vec<_>>()
    };
    assert!(trace(1_500_000).iter().zip(trace(0)).all(|(less, more)| *less < more));
}

/// What `trace` took on a card by the fit: 1 is what it says.
fn of_fit(frame: &CardFrame) -> Option<f64> {
    let (rays, paths, proven) = (frame.path_rays?, frame.paths?, frame.proven_share?);
    Some(frame.trace_ms / GpuCard::measured_chip().trace_ms(rays, 1.0 - proven, rays / paths))
}

fn measured() -> Vec<(String, CardFrame, f64)> {
    let cards = CardCosts::all();
    let all = cards.iter().flat_map(|card| card.frames().iter().map(|f| (card.name().to_owned(), f.clone())));
    all.filter_map(|(card, frame)| Some((card, frame.clone(), of_fit(&frame)?))).collect()
}

/// Both frames with 8 samples of bunny-venus, before horizons and with them: the scene whose bodies the warps were simulated with.
#[test]
fn the_fit_meets_both_frames_with_8_samples_within_3_percent() {
    let all = measured();
    let of: Vec<_> = all.iter().filter(|(_, f, _)| f.scene == "bunny-venus" && f.samples == "8").collect();
    assert_eq!(of.iter().map(|(_, f, _)| f.horizons).collect::<Vec<_>>(), [false, true]);
    for (card, frame, of_fit) in of {
        assert!((of_fit - 1.0).abs() < 0.03, "{card}: {frame:?} took {of_fit:.3} of the fit");
    }
}

/// The range that every row of the model has is that of the frames that were measured, neither narrower nor much wider.
#[test]
fn the_range_of_the_model_is_that_of_all_measured_frames() {
    let all = measured();
    assert_eq!(all.len(), 17, "every committed frame has its counts");
    let [least, most] = SPREAD;
    for (card, frame, of_fit) in &all {
        assert!((least..=most).contains(of_fit), "{card}: {frame:?} took {of_fit:.3} of the fit");
    }
    let ends = all.iter().fold([f64::MAX, 0.0f64], |[a, b], (_, _, r)| [a.min(*r), b.max(*r)]);
    assert!(ends[0] < least + 0.05 && ends[1] > most - 0.05, "the frames took {ends:?} of the fit");
}

/// The rates that were assumed for this chip before it was measured. Their most pessimistic time is too short for every frame that took
/// more than 2 samples.
#[test]
fn the_old_assumption_fails_where_a_card_was_measured() {
    let chip = GpuCard::measured_chip();
    let many = measured().into_iter().filter(|(_, f, _)| f.samples == "8" || f.samples == "18");
    let mut n = 0;
    for (card, frame, _) in many.filter(|(_, f, _)| !f.horizons) {
        let assumed = 1e3 * frame.path_rays.unwrap_or(0.0) / (chip.assumed_rays_per_s[0] * 0.94);
        assert!(assumed < 0.7 * frame.trace_ms, "{card}: {frame:?} in {assumed:.3} ms at most");
        n += 1;
    }
    assert!(n >= 5, "{n}");
}
