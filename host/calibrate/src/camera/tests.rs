//! Drawn cameras before the mock's board, from pictures to the camera.

use super::*;
use dpm_scene::geometry::lens::Lens;
use glam::{DAffine3, DVec3};
use hil_mock::camera::{BoardHold, CameraOptics, MockCamera, MockCameraConfig};

/// Pictures of the mock's camera, four while the board rests at a place.
struct PaintedSource {
    camera: MockCamera,
    place: u64,
}

/// The board moves on the last three eighths of the time at a place.
const AT_REST: [i64; 4] = [0, 1, 2, 3];

impl PaintedSource {
    fn new(optics: &CameraOptics, hold: &BoardHold) -> Self {
        let config =
            MockCameraConfig { optics: optics.clone(), seed: hold.seed, ..MockCameraConfig::default() };
        let body = hold.body(&config).unwrap();
        Self { camera: MockCamera::new(config, vec![body]).unwrap(), place: 0 }
    }
}

impl PictureSource for PaintedSource {
    fn next(&mut self, _: Duration, picture: &mut Picture) -> Result<bool, String> {
        let (place, turn) = (self.place / 4, AT_REST[(self.place % 4) as usize]);
        self.place += 1;
        let number = 60 * place + 10 + 2 * turn as u64;
        let exposure = self.camera.exposure(number).ok_or("lost")?;
        self.camera.paint(&exposure, &mut picture.pixels);
        let size = self.camera.config().optics.size;
        (picture.width, picture.height) = (size[0] as usize, size[1] as usize);
        Ok(true)
    }

    fn name(&self) -> &str {
        "painted"
    }
}

const SIZE: [u32; 2] = [640, 400];

fn calibrated(optics: &CameraOptics, hold: &BoardHold) -> Result<CameraFit, Failure> {
    let raster = Raster::new(SIZE[0], SIZE[1]).unwrap();
    let task = CameraTask { board: hold.board, raster, views: 24, time: Duration::from_secs(600) };
    calibrate(&mut PaintedSource::new(optics, hold), &task, &mut |_| ())
}

/// The error over the picture, 99th percentile, pixels.
fn error_px(optics: &CameraOptics, fit: &CameraFit) -> f64 {
    let raster = Raster::new(SIZE[0], SIZE[1]).unwrap();
    let [f, c] = [optics.focal, optics.centre];
    let truth = ProjectorCamera::new(raster, DAffine3::IDENTITY, f[0], f[1], c[0], c[1]).unwrap();
    let truth = truth.with_lens(Lens::opencv(&optics.lens).unwrap()).unwrap();
    let own = fit.model.camera(raster).unwrap();
    let size = DVec2::new(f64::from(SIZE[0]), f64::from(SIZE[1]));
    let mut errors: Vec<f64> = (0..900)
        .map(|i| DVec2::new(f64::from(i % 30) + 0.5, f64::from(i / 30) + 0.5) / 30.0 * size)
        .filter_map(|p| {
            let s = truth.straight_of_pixel(p)?;
            Some((own.project(DVec3::new(s.x, -s.y, -1.0))? - p).length())
        })
        .collect();
    errors.sort_by(f64::total_cmp);
    errors[errors.len() * 99 / 100]
}

/// Of so many drawn cameras: those that were solved, and whose error lay within the predicted one.
fn covered(cameras: u64) -> [usize; 2] {
    let mut counts = [0; 2];
    for seed in 0..cameras {
        let optics = CameraOptics::drawn(SIZE, seed);
        match calibrated(&optics, &BoardHold { seed, ..BoardHold::default() }) {
            Ok(fit) => {
                let (error, told) = (error_px(&optics, &fit), fit.predicted.p99_px);
                println!("{seed}: {error:.3} px, predicted {told:.3} px, residual {:.3} px", fit.rms_px);
                counts[0] += 1;
                counts[1] += usize::from(error <= told);
            }
            Err(why) => println!("{seed}: {why:?}"),
        }
    }
    counts
}

#[test]
fn a_drawn_camera_is_found_in_the_mocks_pictures() {
    assert_eq!(covered(1), [1, 1]);
}

mod breadth {
    use super::*;

    #[test]
    fn a_bent_board_and_one_tilt_are_refused_by_name() {
        let optics = CameraOptics::drawn(SIZE, 4);
        let told = |hold: BoardHold| calibrated(&optics, &hold).map(|f| f.bend_m).unwrap_err().message;
        let bent = told(BoardHold { bend_m: 6e-3, ..BoardHold::default() });
        assert!(bent.contains("not flat"), "{bent}");
        let flat = told(BoardHold { tilt: 0.03, ..BoardHold::default() });
        assert!(flat.contains("at one tilt"), "{flat}");
    }

    #[test]
    fn the_error_lies_within_the_predicted_one_for_95_of_100_drawn_cameras() {
        let [solved, within] = covered(40);
        assert!(solved >= 38 && 100 * within >= 95 * solved, "{within} of {solved} of 40");
    }
}
