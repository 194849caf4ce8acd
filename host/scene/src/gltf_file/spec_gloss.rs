//! KHR_materials_pbrSpecularGlossiness, which older files require: its diffuse and specular colours as a base colour without metal
//! and the colours of KHR_materials_specular, which reflect the same.

use serde_json::{json, Map, Value};

/// The extension.
pub(super) const NAME: &str = "KHR_materials_pbrSpecularGlossiness";
/// What a surface of the index of refraction 1.5 reflects, of which the specular colour is a multiple.
const REFLECTED: f64 = 0.04;

/// Takes the extension, whose values fit, out of a material, and puts what has the same meaning in its place. Returns what should
/// be said of it.
pub(super) fn convert(material: &mut Map<String, Value>) -> Option<String> {
    let extensions = material.get_mut("extensions")?.as_object_mut()?;
    let old = extensions.remove(NAME)?;
    let own = material.get("pbrMetallicRoughness").and_then(Value::as_object);
    if own.is_some_and(|own| ["baseColorFactor", "baseColorTexture"].iter().any(|key| own.contains_key(*key)))
    {
        return Some(format!("{NAME} is ignored: its own metallic-roughness is shown"));
    }
    let number = |key: &str| old.get(key).and_then(Value::as_f64).unwrap_or(1.0);
    let [diffuse, specular] =
        ["diffuseTexture", "specularGlossinessTexture"].map(|key| old.get(key).cloned());
    // The glossiness of each texel is in a channel that nothing else takes.
    let share = if specular.is_some() { 0.5 } else { 1.0 };
    let mut plain = json!({
        "metallicFactor": 0.0,
        "roughnessFactor": 1.0 - share * number("glossinessFactor"),
        "baseColorFactor": old.get("diffuseFactor").cloned().unwrap_or_else(|| json!([1.0, 1.0, 1.0, 1.0])),
    });
    let colour = old.get("specularFactor").and_then(Value::as_array);
    let colour: Vec<f64> =
        (0..3).map(|i| colour.and_then(|c| c.get(i)?.as_f64()).unwrap_or(1.0) / REFLECTED).collect();
    let mut reflection = json!({"specularColorFactor": colour});
    let told = match specular {
        Some(texture) => {
            reflection["specularColorTexture"] = texture;
            ", but for the glossiness in its texture, which is taken for one half"
        }
        None => "",
    };
    if let Some(texture) = diffuse {
        plain["baseColorTexture"] = texture;
    }
    material.insert("pbrMetallicRoughness".into(), plain);
    let extensions = material.get_mut("extensions")?.as_object_mut()?;
    extensions.insert("KHR_materials_specular".into(), reflection);
    Some(format!("{NAME} is shown as metallic-roughness and KHR_materials_specular{told}"))
}
