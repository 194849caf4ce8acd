//! Which image a texture shows, where an extension names one in KTX2 or WebP.

use serde_json::{json, Value};

use super::super::{Limits, SceneError};
use super::json::Item;

/// The extension, at textures.
pub(super) const BASISU: &str = "KHR_texture_basisu";
/// The extension by which a texture names an image in WebP.
pub(super) const WEBP: &str = "EXT_texture_webp";

/// Rewrites every texture with the extension as a plain one that shows the extension's image, also where there is
/// another image for programs that do not know the extension.
///
/// # Errors
/// Lists that are none, or are longer than the limits allow.
pub(super) fn make_plain(tree: &mut Value, limits: &Limits) -> Result<(), SceneError> {
    let root = Item::new(tree, "document".into())?;
    let images = root.list("images", "image", limits.objects)?.len();
    let mut sources = vec![];
    for (i, texture) in root.list("textures", "texture", limits.objects)?.iter().enumerate() {
        if let Some(extension) = texture.extension(BASISU)? {
            if let Some(source) = extension.index("source", images, "image")? {
                sources.push((i, source));
            }
        } else if let Some(extension) = texture.extension(WEBP)?.filter(|_| texture.get("source").is_none()) {
            // An image for all programs is taken where there is one.
            sources.extend(extension.index("source", images, "image")?.map(|source| (i, source)));
        }
    }
    for (texture, source) in sources {
        tree["textures"][texture]["source"] = json!(source);
    }
    Ok(())
}
