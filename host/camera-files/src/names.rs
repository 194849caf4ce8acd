//! The one table of dialects: what the name of an entry means in the files of calibration programs.
//!
//! Known are OpenCV and its samples, mapamok and ofxCv (ProCamToolkit), ProCamCalib, procam-calibration, scan3d-capture,
//! slstudio, kalibr, ROS (`camera_info`, both spellings), RealSense, and what people name variables in Python. Spellings
//! differ in case, blanks and underscores, which do not count, and in a device's name before or behind the word.

/// Whose an entry is, by its name alone.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum EntryOwner {
    /// That of the section's only device.
    Own,
    /// A projector's.
    Projector,
    /// A camera's.
    Camera,
    /// One of several of a kind: "1" in `cameraMatrix1`, "left".
    Other(String),
}

impl EntryOwner {
    /// Its name for a message and for `calibration_device`.
    pub(super) fn label(&self) -> &str {
        match self {
            Self::Own => "",
            Self::Projector => "projector",
            Self::Camera => "camera",
            Self::Other(label) => label,
        }
    }
}

/// What an entry is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Role {
    /// The matrix of focal lengths and principal point, or these four numbers in a row.
    Intrinsics,
    /// One number of the intrinsics: 0 to 3 for fx, fy, cx, cy.
    Intrinsic(usize),
    /// The lens's coefficients in OpenCV's order.
    Distortion,
    /// One of them by its place there.
    Coefficient(usize),
    /// A rotation matrix or vector from the world to the device.
    Rotation,
    /// The translation that belongs to it.
    Translation,
    /// Both as a matrix of four columns, from the world to the device.
    Pose,
    /// The same from the device to the world.
    Placement,
    /// A matrix of four columns whose name does not say which of the two it is.
    EitherPose,
    /// Columns of the raster.
    Width,
    /// Rows of the raster.
    Height,
    /// Columns and rows in a list.
    Size,
    /// Rows and columns, and perhaps channels, as numpy has them.
    Shape,
    /// Words that say which lens it is.
    LensModel,
    /// The mirror of an omnidirectional model, 0 without one.
    Mirror,
    /// The lens as MATLAB has it, whose other numbers count from 1.
    Other,
    /// What says nothing more of the projector: other forms of what was read, and how the calibration was made.
    ByProduct,
}

/// What a name means; `None` if it is unknown.
pub(super) fn meaning(name: &str) -> Option<(EntryOwner, Role, bool)> {
    let exact = EXACT.iter().find(|(known, ..)| *known == name);
    if let Some((_, owner, role, from_camera)) = exact {
        return Some((owner.clone(), *role, *from_camera));
    }
    let plain = plain(name);
    if let Some(role) = role(&plain) {
        return Some((EntryOwner::Own, role, false));
    }
    let (owner, rest) = owner(&plain)?;
    Some((owner, role(rest)?, false))
}

/// A name in lower case, of letters and digits alone.
pub(super) fn plain(name: &str) -> String {
    name.chars().filter(|c| c.is_alphanumeric()).flat_map(char::to_lowercase).collect()
}

/// Names whose case or meaning is their dialect's own. The last column: the pose leads from a camera to the projector.
const EXACT: &[(&str, EntryOwner, Role, bool)] = &[
    ("roration", EntryOwner::Own, Role::Rotation, true),
    ("R_cp", EntryOwner::Own, Role::Rotation, true),
    ("T_cp", EntryOwner::Own, Role::Translation, true),
    ("cam_proj_rotation", EntryOwner::Own, Role::Rotation, true),
    ("cam_proj_translation", EntryOwner::Own, Role::Translation, true),
    ("Kc", EntryOwner::Camera, Role::Intrinsics, false),
    ("kc", EntryOwner::Camera, Role::Distortion, false),
    ("Kp", EntryOwner::Projector, Role::Intrinsics, false),
    ("kp", EntryOwner::Projector, Role::Distortion, false),
    ("Rp", EntryOwner::Projector, Role::Rotation, true),
    ("Tp", EntryOwner::Projector, Role::Translation, true),
    ("screenResX", EntryOwner::Projector, Role::Width, false),
    ("screenResY", EntryOwner::Projector, Role::Height, false),
    ("frameWidth", EntryOwner::Camera, Role::Width, false),
    ("frameHeight", EntryOwner::Camera, Role::Height, false),
    ("T_cn_cnm1", EntryOwner::Own, Role::Pose, true),
    ("img_shape", EntryOwner::Camera, Role::Shape, false),
];

/// Words before and behind which a name names its device.
fn owner(plain: &str) -> Option<(EntryOwner, &str)> {
    const DEVICES: [(&str, EntryOwner); 5] = [
        ("projector", EntryOwner::Projector),
        ("proj", EntryOwner::Projector),
        ("prj", EntryOwner::Projector),
        ("camera", EntryOwner::Camera),
        ("cam", EntryOwner::Camera),
    ];
    for (word, device) in DEVICES {
        if let Some(rest) = plain.strip_prefix(word) {
            let number = rest.len() - rest.trim_start_matches(|c: char| c.is_ascii_digit()).len();
            // "cameraMatrix1" is the matrix of device 1, and "cam1K" the K of camera 1.
            if number > 0 && role(&rest[number..]).is_some() {
                return Some((EntryOwner::Other(plain[..word.len() + number].into()), &rest[number..]));
            }
            if role(rest).is_some() {
                return Some((device, rest));
            }
        }
        if let Some(rest) = plain.strip_suffix(word).filter(|rest| role(rest).is_some()) {
            return Some((device, rest));
        }
    }
    for side in ["left", "right"] {
        let rest = plain.strip_prefix(side).or_else(|| plain.strip_suffix(side));
        if let Some(rest) = rest.filter(|rest| role(rest).is_some()) {
            return Some((EntryOwner::Other(side.into()), rest));
        }
    }
    let rest = plain.trim_end_matches(|c: char| c.is_ascii_digit());
    let is_numbered = rest.len() < plain.len() && role(rest).is_some();
    // R1, P1 and Q are of a stereo rectification, and not a pose.
    let is_pose = matches!(rest, "r" | "p");
    (is_numbered && !is_pose).then(|| (EntryOwner::Other(plain[rest.len()..].into()), rest))
}

/// Names without their devices', in lower case and of letters and digits alone, by what they mean.
const ROLES: &[(Role, &str)] = &[
    (
        Role::Intrinsics,
        "cameramatrix k mtx m intrinsicmatrix intrinsics intrinsic int matrix intrinsicsmatrix kmatrix \
         intrinsicparameters cammatrix projectionparameters",
    ),
    (Role::Intrinsic(0), "fx focalx focallengthx gamma1 mu"),
    (Role::Intrinsic(1), "fy focaly focallengthy gamma2 mv"),
    (Role::Intrinsic(2), "cx ppx principalpointx u0"),
    (Role::Intrinsic(3), "cy ppy principalpointy v0"),
    (
        Role::Distortion,
        "distortioncoefficients distcoeffs distortioncoeffs distcoeff distortion dist d distcoefs \
         distcoef lensdistortion distortioncoef kc coeffs distortionparameters distortionvector",
    ),
    (Role::Coefficient(0), "k1"),
    (Role::Coefficient(1), "k2"),
    (Role::Coefficient(2), "p1"),
    (Role::Coefficient(3), "p2"),
    (Role::Coefficient(4), "k3"),
    (Role::Coefficient(5), "k4"),
    (Role::Coefficient(6), "k5"),
    (Role::Coefficient(7), "k6"),
    (Role::Rotation, "r rotation rotationmatrix rotationvector rvec rot rmat rotmat rmatrix rotvec"),
    (Role::Translation, "t translation translationvector tvec trans transvec"),
    (
        Role::Pose,
        "extrinsics extrinsic extrinsicmatrix rt worldtocamera worldtocam w2c worldtoprojector \
         worldtoproj tcamimu tcamworld tcw tprojworld tprojectorworld tcameraworld camerafromworld \
         projectorfromworld",
    ),
    (
        Role::Placement,
        "cameratoworld camtoworld c2w twc tworldcam tworldproj tworldprojector tworldcamera \
         projectortoworld projtoworld tbs timucam worldfromcamera worldfromprojector",
    ),
    (Role::EitherPose, "pose posematrix transform transformmatrix transformation transformationmatrix"),
    (
        Role::Width,
        "imagewidth width imagesizewidth imgwidth screenwidth screenresx resolutionx resx xres \
         xresolution rasterwidth w",
    ),
    (
        Role::Height,
        "imageheight height imagesizeheight imgheight screenheight screenresy resolutiony resy yres \
         yresolution rasterheight h",
    ),
    (
        Role::Size,
        "resolution imagesize size imgsize calibrationimagesize rastersize screenresolution screensize imageresolution res \
         raster dimensions",
    ),
    (Role::Shape, "shape imageshape imgshape"),
    (Role::LensModel, "fisheyemodel distortionmodel cameramodel lensmodel cameratype modeltype model"),
    (Role::Mirror, "xi"),
    (Role::Other, "radialdistortion tangentialdistortion"),
    (
        Role::ByProduct,
        "e f essentialmatrix fundamentalmatrix rotationaxis euler fov rotationangleradians \
         rotationangledegrees focallength principalpoint perviewreprojectionerrors perviewerrors \
         imagepoints gridpoints objectpoints projectionmatrix p calibrationtime boardwidth boardheight \
         squaresize markersize nframes nrofframes numberofframes flags flagvalue fixaspectratio \
         aspectratio avgreprojectionerror avgreprojerr maxreprojerr reprojectionerror rms rmserror \
         stereorms error camerror projerror stereoerror caliberror cameraname name camoverlaps rostopic \
         timeshiftcamimu calibrationdate fixprincipalpoint assumezerotangentialdistortion fixk1 fixk2 \
         fixk3 calibrationpattern fisheyecalibration typeid",
    ),
];

/// What a name of [`ROLES`] means.
fn role(plain: &str) -> Option<Role> {
    let row = ROLES.iter().find(|(_, names)| names.split_ascii_whitespace().any(|name| name == plain))?;
    Some(row.0)
}
