//! The inputs of the last frame, and whether the next frame may rely on what that one found.

use super::scene_data::BodyData;
use super::settings::FrameInputs;
use super::tiles::corners;
use dpm_device::planes::Raster;
use dpm_scene::geometry::projector::ProjectorCamera;
use dpm_shaders::structs::{INSTANCE_EMPTY, NO_FRAME};
use glam::{DAffine3, DVec3};

/// Maximum motion of a body's corners along each axis of the raster, in pixels, for a frame to count as steady. It is half a pixel less than the
/// distance to which `still_dark` of `primary.comp` looks.
pub(crate) const STEADY_PX: f64 = 1.5;

/// The same limit for the eye and for corners behind the projector, metres.
pub(crate) const STEADY_M: f64 = 5e-3;

/// Place of a frame among those that were drawn. Everything that alternates from frame to frame uses this one count: the checkerboard, the rates of
/// every second frame, the rays that each block traces in every fourth frame, and the slices of blue noise. The numbers of frames do not serve for
/// this, because a rig that draws every second slot has even numbers only, and half of the turns would never come.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Turn {
    /// Number of frames drawn before it; wraps.
    pub(super) drawn: u32,
    /// Samples that those frames took together in a pixel; wraps.
    pub(super) first_sample: u32,
}

/// The frame that the history holds.
pub(super) struct LastFrame {
    /// Its number; `NO_FRAME` before the first frame.
    pub(super) frame: u32,
    /// The one of the two history buffers that it wrote.
    pub(super) parity: usize,
    /// The turn of the next frame.
    turn: Turn,
    /// world-from-body of each body.
    pub(super) poses: Vec<DAffine3>,
    /// Whether each body is lost.
    lost: Vec<bool>,
    /// Position of the projector.
    pub(super) origin: DVec3,
    eye: DVec3,
    camera: Option<ProjectorCamera>,
}

impl LastFrame {
    /// No frame yet, for a scene with this number of bodies.
    pub(super) fn none(bodies: usize) -> Self {
        Self {
            frame: NO_FRAME,
            parity: 0,
            turn: Turn::default(),
            poses: Vec::with_capacity(bodies),
            lost: Vec::with_capacity(bodies),
            origin: DVec3::ZERO,
            eye: DVec3::ZERO,
            camera: None,
        }
    }

    /// Whether nothing has jumped, was lost or was found since the last frame. Then light has moved by [`STEADY_PX`] at most, except on surface that
    /// another body's or the eye's motion uncovers.
    pub(super) fn is_steady(
        &self,
        bodies: &[BodyData],
        inputs: &FrameInputs<'_>,
        is_lost: impl Fn(usize) -> bool,
    ) -> bool {
        let near = |a: DVec3, b: DVec3| (a - b).length() <= STEADY_M;
        self.frame != NO_FRAME
            && self.camera.as_ref() == Some(inputs.camera)
            && near(self.eye, inputs.eye)
            && self.poses.len() == bodies.len()
            && bodies.iter().enumerate().all(|(i, body)| {
                let (was, is) = (&self.poses[i], &inputs.poses[i]);
                body.flags & INSTANCE_EMPTY != 0
                    || (self.lost[i] == is_lost(i)
                        && corners(body.bounds_min.as_dvec3(), body.bounds_max.as_dvec3()).all(|corner| {
                            let (was, is) = (was.transform_point3(corner), is.transform_point3(corner));
                            match (inputs.camera.project(was), inputs.camera.project(is)) {
                                (Some(was), Some(is)) => (was - is).abs().max_element() <= STEADY_PX,
                                _ => near(was, is),
                            }
                        }))
            })
    }

    /// Its number, if it traced this raster: what it left is of no use on another one. Else `NO_FRAME`.
    pub(super) fn frame_on(&self, raster: Raster) -> u32 {
        match &self.camera {
            Some(camera) if camera.raster != raster => NO_FRAME,
            _ => self.frame,
        }
    }

    /// The turn of the frame with this number. A number that is not larger than the last one begins a new run (after a warm-up), and the turns begin
    /// again with it.
    pub(super) fn turn_of(&self, frame: u32) -> Turn {
        if self.frame != NO_FRAME && frame > self.frame {
            self.turn
        } else {
            Turn::default()
        }
    }

    /// Makes this frame the last one. Allocates nothing.
    pub(super) fn becomes(
        &mut self,
        inputs: &FrameInputs<'_>,
        parity: usize,
        lost: impl Iterator<Item = bool>,
    ) {
        self.turn = self.turn_of(inputs.frame);
        self.frame = inputs.frame;
        self.parity = parity;
        let Turn { drawn, first_sample } = self.turn;
        self.turn =
            Turn { drawn: drawn.wrapping_add(1), first_sample: first_sample.wrapping_add(inputs.spp) };
        self.poses.clear();
        self.poses.extend_from_slice(inputs.poses);
        self.lost.clear();
        self.lost.extend(lost);
        self.origin = inputs.camera.position();
        self.eye = inputs.eye;
        self.camera = Some(*inputs.camera);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_device::planes::Raster;
    use glam::DQuat;

    const EYE: DVec3 = DVec3::new(0.3, 0.2, 1.0);

    fn camera() -> ProjectorCamera {
        let raster = Raster::new(640, 480).unwrap();
        ProjectorCamera::look_at(raster, DVec3::Z, DVec3::ZERO, DVec3::Y, 0.6).unwrap()
    }

    /// Whether the frame is steady after a box of 20 cm at a distance of 1 m moved to `pose`, seen from `eye`, lost or not.
    fn steady_with(pose: DAffine3, eye: DVec3, lost: bool) -> bool {
        let body = BodyData::of_20_cm();
        let camera = camera();
        let (at_rest, moved) = ([DAffine3::IDENTITY], [pose]);
        let inputs = FrameInputs { frame: 7, ..FrameInputs::new(&camera, (EYE, DVec3::ZERO), &at_rest) };
        let mut last = LastFrame::none(1);
        let bodies = [body];
        assert!(!last.is_steady(&bodies, &inputs, |_| false), "the first frame");
        last.becomes(&inputs, 1, [false].into_iter());
        last.is_steady(&bodies, &FrameInputs { eye, poses: &moved, ..inputs }, |_| lost)
    }

    fn steady(pose: DAffine3) -> bool {
        steady_with(pose, EYE, false)
    }

    #[test]
    fn the_limit_is_in_pixels_on_the_picture() {
        // The nearest corners are 0.9 m away.
        let pixel = 0.9 / camera().fx;
        let along = |x: f64| DAffine3::from_translation(DVec3::X * x * pixel);
        assert!(steady(along(0.0)) && steady(along(0.99 * STEADY_PX)) && steady(along(-0.99 * STEADY_PX)));
        assert!(!steady(along(1.01 * STEADY_PX)) && !steady(along(-1.01 * STEADY_PX)) && !steady(along(1e9)));
        let turn = |angle: f64| DAffine3::from_quat(DQuat::from_rotation_y(angle));
        assert!(steady(turn(0.5 * pixel)) && !steady(turn(0.1)));
    }

    #[test]
    fn turns_are_counted_by_frames_drawn_and_begin_anew_with_their_numbers() {
        let camera = camera();
        let mut last = LastFrame::none(0);
        let mut next = |frame: u32, spp: u32| {
            let turn = last.turn_of(frame);
            let inputs = FrameInputs { frame, spp, ..FrameInputs::new(&camera, (EYE, DVec3::ZERO), &[]) };
            last.becomes(&inputs, 0, std::iter::empty());
            (turn.drawn, turn.first_sample)
        };
        // A warm-up, then a run that begins at 0 and drops every second frame.
        assert_eq!(next(0, 5), (0, 0));
        assert_eq!(next(0, 3), (0, 0));
        assert_eq!([next(2, 4), next(4, 4), next(6, 1)], [(1, 3), (2, 7), (3, 11)]);
        assert_eq!(next(7, 1), (4, 12));
    }

    #[test]
    fn who_comes_goes_or_cannot_be_told_is_not_steady() {
        let nan = DAffine3::from_translation(DVec3::NAN);
        assert!(!steady(nan) && !steady_with(DAffine3::IDENTITY, EYE, true));
        assert!(!steady(DAffine3::from_translation(DVec3::Z * 5.0)), "from before to behind the projector");
        assert!(steady_with(DAffine3::IDENTITY, EYE + DVec3::X * 0.9 * STEADY_M, false));
        assert!(!steady_with(DAffine3::IDENTITY, EYE + DVec3::X * 1.1 * STEADY_M, false));
        assert!(!steady_with(DAffine3::IDENTITY, DVec3::NAN, false));
    }
}
