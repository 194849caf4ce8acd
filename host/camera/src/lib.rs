//! Pictures of a camera into the poses of bodies: printed tags and bright markers.
//!
//! [`TagDetector`] finds tags of the family AprilTag 36h11 and the corners of their borders to hundredths of a pixel,
//! [`SpotDetector`] bright spots and their centres. [`Markings::locate`] turns what one or several cameras saw into the pose
//! of a body with its covariance. A camera is a [`ProjectorCamera`](dpm_scene::geometry::projector::ProjectorCamera): the
//! pinhole and the lenses are those of the calibration, and so is the solver.
//!
//! # Example: a tag of 8 cm, straight ahead at one metre
//!
//! ```
//! use dpm_camera::{Markings, Sightings, TagPlace, TagSighting};
//! use dpm_device::planes::Raster;
//! use dpm_scene::geometry::projector::ProjectorCamera;
//! use glam::{DAffine3, DVec3};
//!
//! let raster = Raster::new(1280, 800).unwrap();
//! let camera = ProjectorCamera::look_at(raster, DVec3::ZERO, DVec3::NEG_Z, DVec3::Y, 1.05).unwrap();
//! let tag = TagPlace { id: 7, side: 0.08, body_from_tag: DAffine3::IDENTITY };
//! let body = DAffine3::from_rotation_y(0.5);
//! let body = DAffine3::from_translation(DVec3::new(0.1, 0.0, -1.0)) * body;
//! let corners = tag.corners().map(|c| camera.project(body.transform_point3(c)).unwrap());
//! let seen = [TagSighting { id: 7, corners, sigma_px: [0.1; 4], wrong_cells: 0 }];
//!
//! let markings = Markings { tags: vec![tag], markers: vec![] };
//! let sightings = Sightings { tags: &seen, spots: &[], row_s: 0.0, row: 400.0 };
//! let found = markings.locate(&[camera], &[sightings], None).expect("a pose");
//! assert!((found.fit.position - DVec3::new(0.1, 0.0, -1.0)).length() < 1e-6);
//! ```

mod blobs;
mod board;
mod body;
mod coded;
mod constellation;
mod decode;
mod detect;
mod edges;
mod finder;
mod image;
mod outline;
mod planar;
mod pose;
mod several;
mod sightings;
mod source;
mod sources;
mod stream;
mod threshold;
mod tracker;
mod v4l2;

pub use blobs::{SpotDetector, SpotSighting};
pub use board::{board_pdf, board_view};
pub use body::{BodyPose, Markings, TagPlace};
pub use coded::{board_markings, coded_view};
pub use detect::{TagDetector, TagSighting, TAGS};
pub use finder::{sample_of, BodyFinder, FinderSetup};
pub use image::{GreyImage, LEAST_SIDE, MOST_SIDE};
pub use pose::{Covariance, Observation, PoseFit, Velocity};
pub use sightings::{Expectation, Sightings};
pub use source::{
    CameraDoubt, CameraLook, Picture, PictureLosses, PictureRequest, PictureSource, SourceExaminer,
    SourceKind, SourceOpener,
};
pub use sources::{examine_source, open_source};
pub use tracker::{CameraTracker, PlacedCamera};
pub use v4l2::motion_jpeg_grey;
