//! Drawn cameras before a board, in numbers.

use super::*;
use dpm_common::so3::so3_exp;
use dpm_device::rng::Draws;
use dpm_device::tag36h11::TagBoard;

/// What is wrong with the board or with how it was held.
#[derive(Clone, Copy)]
struct Flaws {
    noise_px: f64,
    bend_m: f64,
    stretch: f64,
    tilt: f64,
    /// How far the board's middle wanders over the picture, as a share of it.
    reach: f64,
}

const NONE: Flaws = Flaws { noise_px: 0.1, bend_m: 0.0, stretch: 0.0, tilt: 0.7, reach: 0.9 };

struct BoardScene {
    raster: Raster,
    truth: ProjectorModel,
}

fn drawn(draws: Draws) -> BoardScene {
    let sizes = [(640, 480), (1280, 800), (1920, 1080), (1456, 1088)];
    let (w, h) = sizes[(draws.bits(0) % 4) as usize];
    let raster = Raster::new(w, h).unwrap();
    let view = (40.0 + 35.0 * draws.unit(1)).to_radians();
    let focal = 0.5 * f64::from(w) / (0.5 * view).tan();
    let mut lens = [0.0; crate::model::LENS];
    let spread = [0.15, 0.05, 1e-3, 1e-3, 0.0];
    (0..5).for_each(|i| lens[i] = spread[i] * (2.0 * draws.unit(10 + i as u64) - 1.0));
    let truth = ProjectorModel {
        focal: DVec2::new(focal, focal * (1.0 + 0.01 * draws.normal(2))),
        centre: 0.5 * size_of(raster) + 0.02 * f64::from(w) * DVec2::new(draws.normal(3), draws.normal(4)),
        lens,
        rotation: DMat3::IDENTITY,
        translation: DVec3::ZERO,
        origin: DVec3::ZERO,
    };
    BoardScene { raster, truth }
}

impl BoardScene {
    fn view(&self, draws: Draws, flaws: Flaws) -> BoardView {
        let board = TagBoard::SMALL;
        let size = size_of(self.raster);
        let aside = |i| 2.0 * draws.unit(i) - 1.0;
        let distance = self.truth.focal.x * board.size_m()[0] / (size.x * (0.35 + 0.4 * draws.unit(5)));
        let axis = DVec3::new(aside(1), aside(2), 0.0).normalize();
        let turn = so3_exp(DVec3::Z * aside(3)) * so3_exp(axis * flaws.tilt * draws.unit(4));
        let at = 0.5 * flaws.reach * DVec2::new(aside(6), aside(7)) * size;
        let middle = DVec3::new(at.x / self.truth.focal.x, at.y / self.truth.focal.y, 1.0) * distance;
        let flip = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
        let model =
            ProjectorModel { rotation: DMat3::from_quat(turn) * flip, translation: middle, ..self.truth };
        let half = 0.5 * board.side_m;
        let mut view = BoardView::new();
        for (n, [x, y]) in board.tags() {
            let corners = [[-half, half], [half, half], [half, -half], [-half, -half]];
            let seen = corners.map(|[dx, dy]| {
                let place = DVec2::new(x + dx, y + dy);
                let rise = flaws.bend_m * (place.x / (0.5 * board.size_m()[0])).powi(2);
                let wide = DVec3::new(place.x * (1.0 + flaws.stretch), place.y, rise);
                (place, model.project(wide))
            });
            let inside = |q: &DVec2| q.cmpgt(DVec2::splat(3.0)).all() && q.cmplt(size - 3.0).all();
            if !seen.iter().all(|s| s.1.as_ref().is_some_and(inside)) {
                continue;
            }
            for (k, (place, pixel)) in seen.into_iter().enumerate() {
                let i = 1000 + 8 * u64::from(n) + 2 * k as u64;
                let noise = flaws.noise_px * DVec2::new(draws.normal(i), draws.normal(i + 1));
                view.push(BoardPoint { place, pixel: pixel.unwrap() + noise, sigma_px: 0.1 });
            }
        }
        view
    }

    fn views(&self, draws: Draws, count: u64, flaws: Flaws) -> Vec<BoardView> {
        (0..count).map(|v| self.view(draws.stream(100 + v), flaws)).collect()
    }

    /// The error of a camera over the picture: 99th percentile, pixels.
    fn error_px(&self, fit: &CameraFit) -> f64 {
        let truth = self.truth.camera(self.raster).unwrap();
        let own = fit.model.camera(self.raster).unwrap();
        let size = size_of(self.raster);
        let mut errors: Vec<f64> = (0..900u32)
            .map(|i| DVec2::new(f64::from(i % 30) + 0.5, f64::from(i / 30) + 0.5) / 30.0 * size)
            .filter_map(|p| {
                let ray = truth.straight_of_pixel(p)?;
                Some((own.project(DVec3::new(ray.x, -ray.y, -1.0))? - p).length())
            })
            .collect();
        errors.sort_by(f64::total_cmp);
        errors[errors.len() * 99 / 100]
    }
}

#[test]
fn without_noise_the_camera_is_the_drawn_one() {
    let scene = drawn(Draws::new(5));
    let flaws = Flaws { noise_px: 0.0, ..NONE };
    let fit = solve(scene.raster, &scene.views(Draws::new(6), 12, flaws)).unwrap();
    assert!(scene.error_px(&fit) < 2e-3, "{}", scene.error_px(&fit));
}

/// The law: over drawn cameras the error lies within the predicted one in 95 of 100, and the prediction is no excuse.
#[test]
fn the_predicted_error_holds_over_drawn_cameras() {
    let (mut covered, mut shares) = (0, Vec::new());
    let (mut focal, mut centre) = (0, 0);
    let mut draws = 0;
    for seed in 0..40 {
        let scene = drawn(Draws::new(seed));
        let views = scene.views(Draws::new(1000 + seed), 20 + seed % 10, NONE);
        let fit = match solve(scene.raster, &views) {
            Ok(fit) => fit,
            Err(why) => {
                println!("{seed}: {why}");
                continue;
            }
        };
        draws += 1;
        let error = scene.error_px(&fit);
        covered += usize::from(error <= fit.predicted.p99_px);
        shares.push(fit.predicted.p99_px / error);
        let [f, cx, cy] = fit.deviations();
        focal += usize::from((fit.model.focal.x - scene.truth.focal.x).abs() <= 1.96 * f);
        let off = (fit.model.centre - scene.truth.centre) / DVec2::new(cx, cy);
        centre += usize::from(off.length_squared() <= 5.99);
    }
    shares.sort_by(f64::total_cmp);
    let usual = shares[shares.len() / 2];
    println!("{covered} of {draws} covered, {focal} focal, {centre} centre; predicted over true {usual:.2}");
    assert!(draws >= 33 && 100 * covered >= 95 * draws, "{covered} of {draws}");
    assert!(100 * focal.min(centre) >= 88 * draws, "focal {focal}, centre {centre} of {draws}");
    assert!(usual < 4.0, "{usual}");
}

#[test]
fn views_that_make_no_camera_are_refused_by_name() {
    let scene = drawn(Draws::new(1));
    let told = |count: u64, flaws: Flaws| solve(scene.raster, &scene.views(Draws::new(2), count, flaws));
    assert_eq!(told(3, NONE).unwrap_err(), BoardRefusal::TooFew { have: 3, need: LEAST_VIEWS });
    let flat = told(14, Flaws { tilt: 0.02, ..NONE });
    assert!(matches!(flat, Err(BoardRefusal::OneTilt { .. })), "{flat:?}");
    let bent = told(14, Flaws { bend_m: 4e-3, ..NONE });
    assert!(
        matches!(bent, Err(BoardRefusal::NotFlat { bend_mm }) if (2.0..6.0).contains(&bend_mm)),
        "{bent:?}"
    );
    let wide = told(14, Flaws { stretch: 0.03, ..NONE });
    assert!(matches!(wide, Err(BoardRefusal::Stretched { percent }) if (2.5..3.5).contains(&percent)));
    let noisy = told(14, Flaws { noise_px: 4.0, ..NONE });
    assert!(matches!(noisy, Err(BoardRefusal::NoBoard { .. })), "{noisy:?}");
    let mut damaged = scene.views(Draws::new(2), 8, NONE);
    damaged[3][1].pixel.x = f64::NAN;
    assert_eq!(solve(scene.raster, &damaged).unwrap_err(), BoardRefusal::NotFinite { view: 3 });
    let mut middle = scene.views(Draws::new(2), 8, NONE);
    let half = 0.5 * size_of(scene.raster);
    middle.iter_mut().flatten().for_each(|p| p.pixel = half + 0.3 * (p.pixel - half));
    assert!(matches!(solve(scene.raster, &middle), Err(BoardRefusal::MiddleOnly { .. })));
}

/// A board that bends within what is accepted does no harm, because its bend is solved for; nor does one blurred view.
#[test]
fn a_slight_bend_and_a_moved_view_do_no_harm() {
    let scene = drawn(Draws::new(9));
    let mut views = scene.views(Draws::new(10), 16, Flaws { bend_m: 1e-3, ..NONE });
    views[4].iter_mut().for_each(|p| p.pixel += 3.0 * DVec2::new((p.place.x * 80.0).sin(), 0.0));
    let fit = solve(scene.raster, &views).unwrap();
    assert_eq!(fit.left_out, [4]);
    assert!((fit.bend_m - 1e-3).abs() < 5e-4, "{}", fit.bend_m);
    assert!(scene.error_px(&fit) <= fit.predicted.p99_px, "{} {:?}", scene.error_px(&fit), fit.predicted);
}
