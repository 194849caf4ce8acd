//! EXT_mesh_gpu_instancing: a node whose mesh appears in many places, each with its own translation, rotation and
//! scale.

use std::collections::HashMap;

use glam::{DAffine3, DQuat, DVec3};

use super::super::{Limits, SceneError};
use super::accessor::{Accessor, Component, Data};
use super::json::Item;

/// Name of the extension.
pub(super) const NAME: &str = "EXT_mesh_gpu_instancing";

/// Maps each node that has the extension to the places of its mesh, node-from-instance.
pub(crate) type Instances = HashMap<usize, Vec<DAffine3>>;

/// Reads the instances of all nodes.
///
/// # Errors
/// Attributes of other types or of different lengths, numbers that are not finite, a rotation of length zero, more instances than
/// [`Limits::objects`].
pub(crate) fn read_instances(nodes: &[Item], data: &Data, limits: &Limits) -> Result<Instances, SceneError> {
    let mut instances = Instances::new();
    let mut total = 0u64;
    for (index, node) in nodes.iter().enumerate() {
        let Some(extension) = node.extension(NAME)? else { continue };
        let Some(attributes) = extension.object("attributes")? else {
            return Err(extension.error("has no 'attributes'"));
        };
        let find = |name: &str, dimensions: u64| -> Result<Option<&Accessor>, SceneError> {
            let Some(i) = attributes.index(name, data.accessors.len(), "accessor")? else { return Ok(None) };
            let accessor = &data.accessors[i];
            let small = name == "ROTATION"
                && accessor.normalized
                && matches!(accessor.component, Component::I8 | Component::I16);
            if accessor.dimensions != dimensions || !(accessor.component == Component::F32 || small) {
                return Err(attributes.error(format!(
                    "{name} must have {dimensions} components of 32-bit float{}",
                    if name == "ROTATION" { " or of normalized 8 or 16 bits" } else { "" }
                )));
            }
            Ok(Some(accessor))
        };
        let translations = find("TRANSLATION", 3)?;
        let rotations = find("ROTATION", 4)?;
        let scales = find("SCALE", 3)?;
        let mut counts = [translations, rotations, scales].into_iter().flatten().map(|a| a.count);
        let Some(count) = counts.next() else {
            return Err(attributes.error("has none of TRANSLATION, ROTATION and SCALE"));
        };
        if counts.any(|other| other != count) {
            return Err(attributes.error("gives different numbers of instances"));
        }
        total = total.saturating_add(count);
        SceneError::check_limit(
            "the number of instances",
            total,
            limits.objects,
            "remove instances: a projector's raster cannot show so many",
        )?;
        let vector = |of: Option<&Accessor>, k: u64, default: DVec3| {
            of.map_or(default, |a| DVec3::from_array(data.floats::<3>(a, k).map(f64::from)))
        };
        let place = |k: u64| {
            let rotation = rotations
                .map_or(DQuat::IDENTITY, |a| DQuat::from_array(data.floats::<4>(a, k).map(f64::from)));
            let (scale, at) = (vector(scales, k, DVec3::ONE), vector(translations, k, DVec3::ZERO));
            let length = rotation.length();
            if !(scale.is_finite() && at.is_finite() && length.is_finite() && length > 1e-6) {
                let problem =
                    format!("instance {k} holds a number that is not finite, or a rotation of length zero");
                return Err(attributes.error(problem));
            }
            Ok(DAffine3::from_scale_rotation_translation(scale, rotation.normalize(), at))
        };
        instances.insert(index, (0..count).map(place).collect::<Result<_, _>>()?);
    }
    Ok(instances)
}
