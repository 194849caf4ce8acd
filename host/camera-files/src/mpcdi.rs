//! The XML of MPCDI (Multiple Projection Common Data Interchange, VESA) into a projector.
//!
//! Only its profile `sl` ("shader lamps") tells the lens and the place of a projector. By the standard and its public
//! explanation by Christie (`MPCDI_explained.md` of the repository ChristieDigital/mpcdi):
//!
//! - `coordinateFrame` has the projector's position and three axes: `pitch` points right, `yaw` down and `roll` forward.
//!   These are OpenCV's axes of a camera.
//! - `frustum` turns the projector from there: first by `yaw` to the right, then by `pitch` up, then by `roll` to the
//!   right wing down, each about its own axis as it is then.
//! - `leftAngle` to `upAngle` lead from the axis to the raster's edges; right and up are positive.
//!
//! The other profiles tell the view of the picture that is to be warped, and not the projector's.

use super::xml::Document;
use super::{
    pose, rotation, Intrinsics, LengthUnit, PoseFrame, ReadOptions, StorageError, StoredCalibration,
};
use dpm_device::planes::Raster;
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DMat3, DVec3};

/// One region of a file.
struct Region<'d, 'a> {
    document: &'d Document<'a>,
    element: usize,
    id: String,
}

/// Reads the projector of the only region, or of the one that the options name.
pub(super) fn read(text: &str, options: &ReadOptions) -> Result<StoredCalibration, StorageError> {
    let document = Document::parse(text.trim_start_matches('\u{feff}'))?;
    let root = document.named("MPCDI").next().ok_or(StorageError::UnknownForm)?;
    let profile = document.attribute(root, "profile").unwrap_or_default();
    if !profile.eq_ignore_ascii_case("sl") {
        let all = regions(&document);
        let names: Vec<String> = all.iter().take(16).map(|i| format!("{:?}", id(&document, *i))).collect();
        return Err(StorageError::Refused(format!(
            "its MPCDI profile is {profile:?}, which tells the view of a picture and not the projector's lens and place; \
             export it with the profile \"sl\" (it has {} regions: {})",
            all.len(),
            names.join(", ")
        )));
    }
    let region = region(&document, options.region)?;
    region.refuse_extensions()?;
    let [left, right, down, up] = region.edges()?;
    let size = (region.side("xResolution")?, region.side("yResolution")?);
    let (fx, fy) = (f64::from(size.0) / (right - left), f64::from(size.1) / (up - down));
    let intrinsics = Intrinsics { fx, fy, cx: -left * fx, cy: up * fy }.at(Some(size), options.raster)?;
    let mut unread = Vec::new();
    region.files(options.unit, &mut unread)?;
    let (turned, position) = region.pose()?;
    let turned = turned.transpose();
    let pose = pose(turned, -(turned * position) * options.unit.metres());
    let Intrinsics { fx, fy, cx, cy } = intrinsics;
    Ok(StoredCalibration {
        camera: ProjectorCamera::new(options.raster, pose, fx, fy, cx, cy)?,
        frame: PoseFrame::World,
        image_size: Some(size),
        found: vec![format!("region: {}", region.id)],
        unread,
        notes: vec![],
    })
}

/// The regions of the displays. Extensions have elements of the same name outside `display`.
fn regions(document: &Document) -> Vec<usize> {
    let above = |i: usize| document.elements[i].parent;
    let shown = |i: &usize| {
        let display = above(*i).and_then(above);
        display.is_some_and(|d| document.elements[d].name.eq_ignore_ascii_case("display"))
    };
    document.named("region").filter(shown).collect()
}

fn id(document: &Document, region: usize) -> String {
    document.attribute(region, "id").unwrap_or_default()
}

fn region<'d, 'a>(document: &'d Document<'a>, wanted: Option<&str>) -> Result<Region<'d, 'a>, StorageError> {
    let id = |i: usize| id(document, i);
    let all = regions(document);
    let hit = match (wanted, all.as_slice()) {
        (Some(wanted), all) => all.iter().copied().find(|i| id(*i) == wanted),
        (None, [only]) => Some(*only),
        (None, _) => None,
    };
    let Some(element) = hit else {
        let names: Vec<String> = all.iter().take(16).map(|i| format!("{:?}", id(*i))).collect();
        return Err(StorageError::Refused(format!(
            "it has {} regions ({}); name the projector's with calibration_region",
            all.len(),
            names.join(", ")
        )));
    };
    Ok(Region { document, element, id: id(element) })
}

impl Region<'_, '_> {
    fn wrong(&self, what: impl std::fmt::Display) -> StorageError {
        StorageError::value(&self.id, format!("is a region that {what}"))
    }

    fn side(&self, name: &str) -> Result<u32, StorageError> {
        let text = self.document.attribute(self.element, name);
        let side = text.as_ref().and_then(|t| t.trim().parse::<u32>().ok());
        side.filter(|s| (1..=Raster::MAX_SIDE).contains(s))
            .ok_or_else(|| self.wrong(format!("has no {name}, the projector's resolution")))
    }

    /// Numbers of children of one child of the region.
    fn numbers<const N: usize>(&self, part: &str, names: [&str; N]) -> Result<[f64; N], StorageError> {
        let inside =
            self.document.child(self.element, part).ok_or_else(|| self.wrong(format!("has no {part}")))?;
        let mut out = [0.0; N];
        for (value, name) in out.iter_mut().zip(names) {
            let text = self.document.child_text(inside, name);
            *value = text
                .and_then(|t| t.parse::<f64>().ok())
                .filter(|v| v.is_finite())
                .ok_or_else(|| self.wrong(format!("has no finite number {part}/{name}")))?;
        }
        Ok(out)
    }

    /// Where the raster's left, right, lower and upper edge lie in the plane at distance 1; right and up are positive.
    fn edges(&self) -> Result<[f64; 4], StorageError> {
        let angles = self.numbers("frustum", ["leftAngle", "rightAngle", "downAngle", "upAngle"])?;
        let [left, right, down, up] = angles;
        if angles.iter().any(|a| a.abs() >= 90.0) || left >= right || down >= up {
            return Err(self.wrong(format!(
                "has a frustum from {left} to {right} and from {down} to {up} degrees; both must grow within -90 to 90"
            )));
        }
        Ok(angles.map(|a| a.to_radians().tan()))
    }

    /// The rotation from the projector's axes (OpenCV's) to the file's world, and the position there.
    fn pose(&self) -> Result<(DMat3, DVec3), StorageError> {
        let position = self.numbers("coordinateFrame", ["posx", "posy", "posz"])?;
        let right = self.numbers("coordinateFrame", ["pitchx", "pitchy", "pitchz"])?;
        let down = self.numbers("coordinateFrame", ["yawx", "yawy", "yawz"])?;
        let forward = self.numbers("coordinateFrame", ["rollx", "rolly", "rollz"])?;
        let axes = DMat3::from_cols(right.into(), down.into(), forward.into());
        let what =
            "has a coordinateFrame whose axes pitch, yaw and roll are not orthonormal and right-handed";
        let axes = rotation(axes).ok_or_else(|| self.wrong(what))?;
        let [yaw, pitch, roll] = self.numbers("frustum", ["yaw", "pitch", "roll"])?.map(f64::to_radians);
        let turn = DMat3::from_rotation_y(yaw) * DMat3::from_rotation_x(pitch) * DMat3::from_rotation_z(roll);
        Ok((axes * turn, position.into()))
    }

    /// Christie's lenses that are not planar are told in extensions.
    fn refuse_extensions(&self) -> Result<(), StorageError> {
        let document = self.document;
        for other in document.named("region").filter(|i| *i != self.element) {
            let same = document.attribute(other, "id").as_ref() == Some(&self.id);
            let lens = ["fisheye", "anamorphic"].into_iter().find(|e| document.child(other, e).is_some());
            if let Some(lens) = lens.filter(|_| same) {
                return Err(self.wrong(format!(
                    "has an extension <{lens}>, which is not read; export the lens as OpenCV XML, YAML or JSON"
                )));
            }
        }
        Ok(())
    }

    /// Checks the unit of lengths, and names the files of the region, which are not read.
    fn files(&self, unit: LengthUnit, unread: &mut Vec<String>) -> Result<(), StorageError> {
        let document = self.document;
        let of_region = |i: &usize| document.attribute(*i, "region").as_ref() == Some(&self.id);
        for set in document.named("fileset").filter(of_region) {
            let warp = document.child(set, "geometryWarpFile");
            let told = warp.and_then(|i| document.child_text(i, "geometricUnit")).unwrap_or("unknown");
            let wanted = match unit {
                LengthUnit::Metre => "m",
                LengthUnit::Centimetre => "cm",
                LengthUnit::Millimetre => "mm",
            };
            if !told.is_empty() && !told.eq_ignore_ascii_case("unknown") && told != wanted {
                return Err(self.wrong(format!(
                    "has lengths in {told:?}, but the rig file's calibration_unit means {wanted:?}; \
                     metre (\"m\"), centimetre (\"cm\") and millimetre (\"mm\") are known"
                )));
            }
            for map in ["geometryWarpFile", "distortionMap", "alphaMap", "betaMap"] {
                let path = document.child(set, map).and_then(|i| document.child_text(i, "path"));
                unread.extend(path.filter(|p| !p.is_empty()).map(|p| format!("{map} {p}")));
            }
        }
        Ok(())
    }
}
