//! Forms and lenses of other programs that are not read, each with what to give instead.

use super::entries::{Entries, FileEntry, Matrix};
use super::names::plain;
use super::{rotation, StorageError};
use glam::{DMat3, DVec3};

/// What to save in the place of a form that has other axes, units or centres.
const AS_JSON: &str = "save the projector's matrix K, the coefficients dist and the pose rvec and tvec, as OpenCV has them, as JSON";

/// Words that all stand in a text, what the text is, and what is special about it.
const TEXTS: &[(&[&str], &str, &str)] = &[
    (
        &["<ProjectorCameraEnsemble"],
        "an ensemble of RoomAlive Toolkit, whose poses are told from its depth camera",
        "save the projector's cameraMatrix, lensDistortion and pose as K, dist, rvec and tvec in JSON",
    ),
    (
        &["<document", "<chunk"],
        "a project of Agisoft Metashape, whose f, cx, cy, b1, p1 and p2 are counted in another way than OpenCV's",
        "export the calibration in the form OpenCV, and add the pose rvec and tvec to it",
    ),
    (
        &["<calibration>", "<projection>"],
        "a calibration of Agisoft Metashape, whose cx and cy count from the middle of the picture",
        "export the calibration in the form OpenCV, and add the pose rvec and tvec to it",
    ),
    (&["<camera_model", "<params>"], "a rig of Calibu, whose lens and axes are its own", AS_JSON),
    (&["<intrinsic", "focalLengthU"], "a calibration of Qualisys, in 64ths of a pixel and for its cameras", AS_JSON),
    (
        &["# oST version"],
        "a .ini file of ROS's camera_calibration",
        "convert it to YAML (rosrun camera_calibration_parsers convert FILE.ini FILE.yaml), and add rvec and tvec",
    ),
    (
        &["# Camera list with one line of data per camera"],
        "cameras.txt of COLMAP, whose pixel centres lie at halves and whose poses stand in images.txt",
        "subtract 0.5 from cx and cy, and save K, dist, rvec and tvec of the projector as JSON",
    ),
    (&["# Image list with two lines of data per image"], "images.txt of COLMAP, which has poses and no lens", AS_JSON),
    (&["# Bundle file"], "a file of Bundler, whose axes have y up and which has no principal point", AS_JSON),
    (&["NVM_V3"], "a file of VisualSFM, which has no principal point", AS_JSON),
    (&["cam0=[", "doffs="], "a calib.txt of Middlebury's stereo pictures, which has no pose", AS_JSON),
    (&["matrix = [", "translation = ["], "TOML as Anipose writes it", AS_JSON),
];

/// The advice for a text of a known form that is not read.
pub(super) fn refused_text(text: &str) -> Option<StorageError> {
    let (_, what, instead) = TEXTS.iter().find(|(words, ..)| words.iter().all(|word| text.contains(word)))?;
    Some(StorageError::Refused(format!("it is {what}; {instead}")))
}

/// Names of entries that no other form has, what the file is, and what to give.
const MARKS: &[(&str, &str, &str)] = &[
    (
        "fl_x",
        "transforms.json of nerfstudio or instant-ngp, whose pixel centres lie at halves and whose poses look along -Z",
        "subtract 0.5 from cx and cy, turn the pose's axes y and z about, and save K, dist and camera_to_world as JSON",
    ),
    ("camera_angle_x", "transforms.json of Blender's scenes, which has no principal point", AS_JSON),
    ("pxFocalLength", "a scene of Meshroom (AliceVision)", AS_JSON),
    ("projection_type", "a reconstruction of OpenSfM, whose numbers are parts of the picture's width", AS_JSON),
    ("ModelParameters", "a calibration of Azure Kinect, whose numbers are parts of the picture's sides", AS_JSON),
    ("T_imu_cam", "a calibration of Basalt, whose poses are quaternions", AS_JSON),
    ("T_B_C", "a rig of maplab or SVO", AS_JSON),
    ("CameraIntrinsicsPrior", "priors of Theia, which have no pose", AS_JSON),
];

/// The same error, or what a file that lacks a part is and what to give instead.
pub(super) fn explained(error: StorageError, all: &Entries) -> StorageError {
    if !matches!(error, StorageError::Missing { .. }) {
        return error;
    }
    let names = || {
        let of = |(section, inside): (&'_ String, &'_ std::collections::BTreeMap<String, FileEntry>)| {
            let path = section.split('/').map(str::to_owned);
            path.chain(inside.keys().cloned()).collect::<Vec<_>>()
        };
        all.sections.iter().flat_map(of)
    };
    if let Some((_, what, instead)) = MARKS.iter().find(|(mark, ..)| names().any(|name| name == *mark)) {
        return StorageError::Refused(format!("it is {what}; {instead}"));
    }
    let is_turn = |name: &String| matches!(&*plain(name), "quaternion" | "quat" | "qw" | "orientation");
    match (&error, names().find(is_turn)) {
        (StorageError::Missing { part: "rotation", .. }, Some(name)) => StorageError::Refused(format!(
            "it has no rotation but {name:?}, a quaternion, of which programs order the numbers differently; give a rotation \
             matrix R, as of scipy's Rotation.from_quat([x, y, z, w]).as_matrix()"
        )),
        _ => error,
    }
}

/// Models of a lens that OpenCV's two do not express, by the words for them.
const MODELS: &[(&str, &str)] = &[
    ("mei", OMNIDIRECTIONAL),
    ("omni", OMNIDIRECTIONAL),
    ("omnidirectional", OMNIDIRECTIONAL),
    ("omniradtan", OMNIDIRECTIONAL),
    ("unified", OMNIDIRECTIONAL),
    ("eucm", "the extended unified model (EUCM)"),
    ("ds", "the double sphere model"),
    ("doublesphere", "the double sphere model"),
    ("fov", "the model FOV (atan)"),
    ("atan", "the model FOV (atan)"),
    ("scaramuzza", "the polynomial of OCamCalib (Scaramuzza)"),
    ("ocam", "the polynomial of OCamCalib (Scaramuzza)"),
    ("thinprismfisheye", "the fisheye of COLMAP with a thin prism"),
    ("fulltheta", "the model F-theta of RealSense"),
    ("ftheta", "the model F-theta of RealSense"),
];
/// The model of C. Mei, with the mirror's xi.
pub(super) const OMNIDIRECTIONAL: &str = "the unified omnidirectional model (MEI, with xi)";

/// What a word for the model of a lens means, if the lens is none of OpenCV's.
pub(super) fn model(word: &str) -> Option<&'static str> {
    let word = plain(word);
    MODELS.iter().find(|(known, _)| *known == word).map(|(_, what)| *what)
}

/// A lens of a model that is not read.
pub(super) fn refused_model(path: &str, word: &str, what: &str) -> StorageError {
    let told = format!(
        "is {word:?}: the lens is of {what}, and neither of OpenCV's models is the same; calibrate the same pictures with \
         cv2.fisheye.calibrate (equidistant), or with cv2.calibrateCamera where the lens sees less than 120 degrees"
    );
    StorageError::value(path, told)
}

/// A rigid transformation of a chain.
#[derive(Clone, Copy)]
struct ChainLink {
    turn: DMat3,
    shift: DVec3,
}

impl ChainLink {
    fn of(entry: Option<&FileEntry>) -> Option<Self> {
        let Some(FileEntry::Matrix(m)) = entry else { return None };
        if m.columns != 4 || !(3..=4).contains(&m.rows) || m.data.iter().any(|v| !v.is_finite()) {
            return None;
        }
        let row = |i: usize| DVec3::from_slice(&m.data[4 * i..]);
        let turn = rotation(DMat3::from_cols(row(0), row(1), row(2)).transpose())?;
        Some(Self { turn, shift: DVec3::new(m.data[3], m.data[7], m.data[11]) })
    }

    /// This one behind another.
    fn after(self, first: Self) -> Self {
        Self { turn: self.turn * first.turn, shift: self.turn * first.shift + self.shift }
    }

    fn entry(self) -> FileEntry {
        let (r, t) = (self.turn.transpose().to_cols_array(), self.shift);
        let data =
            vec![r[0], r[1], r[2], t.x, r[3], r[4], r[5], t.y, r[6], r[7], r[8], t.z, 0.0, 0.0, 0.0, 1.0];
        FileEntry::Matrix(Matrix { rows: 4, columns: 4, data })
    }
}

/// Where kalibr tells a camera from the one before, in a section after which the cameras are numbered.
const FROM_BEFORE: &str = "T_cn_cnm1";
/// Where it tells a camera from the inertial unit.
const FROM_UNIT: &str = "T_cam_imu";

/// Resolves kalibr's chain of cameras: each gets its place from the inertial unit, if one of those before it has that, and from
/// camera 0 otherwise.
///
/// # Errors
/// A camera with both places, which contradict each other.
pub(super) fn join_chain(all: &mut Entries) -> Result<(), StorageError> {
    let (mut from_unit, mut from_first): (Option<ChainLink>, Option<ChainLink>) = (None, None);
    for number in 0.. {
        let section = format!("cam{number}");
        let Some(inside) = all.sections.get_mut(&section) else { break };
        let step = ChainLink::of(inside.get(FROM_BEFORE));
        let own = ChainLink::of(inside.get(FROM_UNIT));
        let by_chain = from_unit.zip(step).map(|(before, step)| step.after(before));
        if let Some((own, chained)) = own.zip(by_chain) {
            let turned = (own.turn - chained.turn).to_cols_array().iter().any(|v| v.abs() > 2e-3);
            if turned || (own.shift - chained.shift).length() > 1e-2 * own.shift.length().max(0.1) {
                let what = format!("and {FROM_BEFORE:?} with the cameras before tell different poses; leave the right one in the file");
                return Err(StorageError::value(&format!("{section}/{FROM_UNIT}"), what));
            }
        }
        from_first = match number {
            0 => step.is_none().then_some(ChainLink { turn: DMat3::IDENTITY, shift: DVec3::ZERO }),
            _ => from_first.zip(step).map(|(before, step)| step.after(before)),
        };
        from_unit = own.or(by_chain);
        if let Some(place) = from_unit.filter(|_| step.is_some()) {
            inside.remove(FROM_BEFORE);
            inside.entry(FROM_UNIT.to_owned()).or_insert(place.entry());
        } else if let Some(place) = from_first.filter(|_| number > 0) {
            inside.insert(FROM_BEFORE.to_owned(), place.entry());
        }
    }
    Ok(())
}
