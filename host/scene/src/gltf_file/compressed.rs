//! Meshes that were compressed by meshopt or Draco.

#[cfg(feature = "compressed")]
mod unpack;
#[cfg(feature = "compressed")]
pub(super) use unpack::decompress;

use super::super::SceneError;
#[cfg(not(feature = "compressed"))]
use super::super::{limits::Cancel, Limits};
use super::json::Item;
#[cfg(not(feature = "compressed"))]
use serde_json::Value;

/// The extension of Draco, at primitives.
pub(super) const DRACO: &str = "KHR_draco_mesh_compression";
/// The extensions of meshopt, at buffer views and at the buffers that they replace.
pub(super) const MESHOPT: [&str; 2] = ["EXT_meshopt_compression", "KHR_meshopt_compression"];

/// True if the buffer holds nothing in this file, because its content lies compressed in another one.
pub(super) fn is_placeholder(buffer: &Item) -> Result<bool, SceneError> {
    for name in MESHOPT {
        if let Some(extension) = buffer.extension(name)? {
            return extension.flag("fallback");
        }
    }
    Ok(false)
}

/// Refuses what is compressed.
///
/// # Errors
/// Something is.
#[cfg(not(feature = "compressed"))]
pub(super) fn decompress(
    tree: &mut Value,
    _: &mut Vec<Vec<u8>>,
    limits: &Limits,
    _: &Cancel,
) -> Result<(), SceneError> {
    let root = Item::new(tree, "document".into())?;
    let refused = |item: &Item, name: &str| {
        let remedy =
            "this program was built without the feature `compressed`; export the scene without compression";
        Err(SceneError::unsupported(format!("{}: {name}", item.name), remedy))
    };
    for view in root.list("bufferViews", "bufferView", limits.objects)? {
        for name in MESHOPT {
            if view.extension(name)?.is_some() {
                return refused(&view, name);
            }
        }
    }
    for mesh in root.list("meshes", "mesh", limits.objects)? {
        for primitive in mesh.list("primitives", "primitive", limits.objects)? {
            if primitive.extension(DRACO)?.is_some() {
                return refused(&mesh, DRACO);
            }
        }
    }
    Ok(())
}
