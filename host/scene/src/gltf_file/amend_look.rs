//! The second half of the validation: materials, textures, samplers and lights. What is malformed or out of range there costs
//! that value and not the scene: it is taken out of the document before anything reads it, so that glTF's default stands in its
//! place, and a note names the object, the extension, the key and the value. What geometry hangs on is refused in
//! [`super::check`].

use std::f32::consts::FRAC_PI_2;

use serde_json::{json, Map, Value};

use super::flatten::VISIBILITY;
use super::json::{label, shorten};
use super::spec_gloss;
use super::texture_image::{BASISU, WEBP};

type Object = Map<String, Value>;

/// Radiance factors and intensities beyond this count as damage.
const GREATEST_INTENSITY: f32 = 1.0e9;
/// Colours of a specular reflection beyond this count as damage. The reflectance itself is at most 1.
const GREATEST_COLOR: f32 = 1.0e6;
/// Thickness of a film beyond this counts as damage, nanometres: light of a wavelength has long lost its order there.
const THICKEST_FILM_NM: f32 = 1.0e9;
/// The readers clamp factors 0..1 that writers round to slightly above 1.
const UNIT: f32 = 1.001;
/// Notes of one file; of more values only their number is told.
const MOST_NOTES: usize = 1000;

const LIGHTS: &str = "KHR_lights_punctual";
const TRANSFORM: &str = "KHR_texture_transform";

/// What a value must be.
#[derive(Clone, Copy)]
enum ValueRule {
    /// A number in a range.
    Number(f32, f32),
    /// So many numbers, each in a range.
    Numbers(usize, f32, f32),
    /// An index of refraction: 0, or a number in the range of all others.
    Ior,
    /// A whole number below this one.
    Below(usize),
    /// One of these codes.
    Code(&'static [u64]),
    /// One of these words.
    Word(&'static [&'static str]),
    /// Any text.
    Text,
    Flag,
    /// The use of a texture.
    Texture,
}

const FACTOR: ValueRule = ValueRule::Number(0.0, UNIT);
const INTENSITY: ValueRule = ValueRule::Number(0.0, GREATEST_INTENSITY);
const POSITIVE: ValueRule = ValueRule::Number(0.0, f32::MAX);
const ANY_NUMBER: ValueRule = ValueRule::Number(f32::MIN, f32::MAX);
const COLOR: ValueRule = ValueRule::Numbers(3, 0.0, UNIT);
const TWO_NUMBERS: ValueRule = ValueRule::Numbers(2, f32::MIN, f32::MAX);
/// This program reads sets of coordinates below this number.
const SET: ValueRule = ValueRule::Below(256);
const WRAP: ValueRule = ValueRule::Code(&[33071, 33648, 10497]);

type Rules = &'static [(&'static str, ValueRule)];

const NAME: Rules = &[("name", ValueRule::Text)];

const MATERIAL: Rules = &[
    ("name", ValueRule::Text),
    ("emissiveFactor", ValueRule::Numbers(3, 0.0, GREATEST_INTENSITY)),
    ("alphaCutoff", POSITIVE),
    ("alphaMode", ValueRule::Word(&["OPAQUE", "MASK", "BLEND"])),
    ("doubleSided", ValueRule::Flag),
    ("normalTexture", ValueRule::Texture),
    ("occlusionTexture", ValueRule::Texture),
    ("emissiveTexture", ValueRule::Texture),
];

const METALLIC_ROUGHNESS: Rules = &[
    ("baseColorFactor", ValueRule::Numbers(4, 0.0, UNIT)),
    ("metallicFactor", FACTOR),
    ("roughnessFactor", FACTOR),
    ("baseColorTexture", ValueRule::Texture),
    ("metallicRoughnessTexture", ValueRule::Texture),
];

/// The extensions of materials that are reproduced.
const EXTENSIONS: [(&str, Rules); 13] = [
    (
        "KHR_materials_anisotropy",
        &[
            ("anisotropyStrength", FACTOR),
            ("anisotropyRotation", ANY_NUMBER),
            ("anisotropyTexture", ValueRule::Texture),
        ],
    ),
    (
        "KHR_materials_clearcoat",
        &[
            ("clearcoatFactor", FACTOR),
            ("clearcoatRoughnessFactor", FACTOR),
            ("clearcoatTexture", ValueRule::Texture),
            ("clearcoatRoughnessTexture", ValueRule::Texture),
            ("clearcoatNormalTexture", ValueRule::Texture),
        ],
    ),
    (
        "KHR_materials_diffuse_transmission",
        &[
            ("diffuseTransmissionFactor", FACTOR),
            ("diffuseTransmissionColorFactor", COLOR),
            ("diffuseTransmissionTexture", ValueRule::Texture),
            ("diffuseTransmissionColorTexture", ValueRule::Texture),
        ],
    ),
    ("KHR_materials_dispersion", &[("dispersion", POSITIVE)]),
    ("KHR_materials_emissive_strength", &[("emissiveStrength", INTENSITY)]),
    ("KHR_materials_ior", &[("ior", ValueRule::Ior)]),
    (
        "KHR_materials_iridescence",
        &[
            ("iridescenceFactor", FACTOR),
            ("iridescenceIor", ValueRule::Number(1.0, 10.0)),
            ("iridescenceThicknessMinimum", ValueRule::Number(0.0, THICKEST_FILM_NM)),
            ("iridescenceThicknessMaximum", ValueRule::Number(0.0, THICKEST_FILM_NM)),
            ("iridescenceTexture", ValueRule::Texture),
            ("iridescenceThicknessTexture", ValueRule::Texture),
        ],
    ),
    (
        spec_gloss::NAME,
        &[
            ("diffuseFactor", ValueRule::Numbers(4, 0.0, UNIT)),
            ("specularFactor", COLOR),
            ("glossinessFactor", FACTOR),
            ("diffuseTexture", ValueRule::Texture),
            ("specularGlossinessTexture", ValueRule::Texture),
        ],
    ),
    (
        "KHR_materials_sheen",
        &[
            ("sheenColorFactor", COLOR),
            ("sheenRoughnessFactor", FACTOR),
            ("sheenColorTexture", ValueRule::Texture),
            ("sheenRoughnessTexture", ValueRule::Texture),
        ],
    ),
    (
        "KHR_materials_specular",
        &[
            ("specularFactor", FACTOR),
            ("specularColorFactor", ValueRule::Numbers(3, 0.0, GREATEST_COLOR)),
            ("specularTexture", ValueRule::Texture),
            ("specularColorTexture", ValueRule::Texture),
        ],
    ),
    (
        "KHR_materials_transmission",
        &[("transmissionFactor", FACTOR), ("transmissionTexture", ValueRule::Texture)],
    ),
    ("KHR_materials_unlit", &[]),
    (
        "KHR_materials_volume",
        &[
            ("thicknessFactor", POSITIVE),
            ("attenuationDistance", POSITIVE),
            ("attenuationColor", COLOR),
            ("thicknessTexture", ValueRule::Texture),
        ],
    ),
];

/// What the use of a texture has besides its index.
const TEXTURE_USE: Rules =
    &[("texCoord", SET), ("scale", ValueRule::Number(-100.0, 100.0)), ("strength", ANY_NUMBER)];

const TEXTURE_PLACE: Rules =
    &[("offset", TWO_NUMBERS), ("scale", TWO_NUMBERS), ("rotation", ANY_NUMBER), ("texCoord", SET)];

const SAMPLER: Rules = &[
    ("magFilter", ValueRule::Code(&[9728, 9729])),
    ("minFilter", ValueRule::Code(&[9728, 9729, 9984, 9985, 9986, 9987])),
    ("wrapS", WRAP),
    ("wrapT", WRAP),
    ("name", ValueRule::Text),
];

const LIGHT: Rules = &[
    ("name", ValueRule::Text),
    ("color", ValueRule::Numbers(3, 0.0, GREATEST_INTENSITY)),
    ("intensity", INTENSITY),
    ("range", ValueRule::Number(f32::MIN_POSITIVE, f32::MAX)),
];

const KINDS_OF_LIGHT: ValueRule = ValueRule::Word(&["point", "spot", "directional"]);
/// A spot's angles, radians; writers round a quarter turn up.
const CONE: Rules = &[
    ("innerConeAngle", ValueRule::Number(0.0, FRAC_PI_2 + 1e-4)),
    ("outerConeAngle", ValueRule::Number(0.0, FRAC_PI_2 + 1e-4)),
];
/// The angles that glTF has where a file gives none.
const CONE_DEFAULT: [f64; 2] = [0.0, std::f64::consts::FRAC_PI_4];

impl ValueRule {
    fn fits(self, value: &Value) -> bool {
        let number = |v: &Value| v.as_f64().map(|x| x as f32).filter(|x| x.is_finite());
        let within = |v: &Value, low, high| number(v).is_some_and(|x| (low..=high).contains(&x));
        match self {
            Self::Number(low, high) => within(value, low, high),
            Self::Numbers(count, low, high) => value
                .as_array()
                .is_some_and(|all| all.len() == count && all.iter().all(|v| within(v, low, high))),
            Self::Ior => within(value, 0.0, 0.0) || within(value, 1.0, 10.0),
            Self::Below(end) => value.as_u64().is_some_and(|n| n < end as u64),
            Self::Code(codes) => value.as_u64().is_some_and(|n| codes.contains(&n)),
            Self::Word(words) => value.as_str().is_some_and(|word| words.contains(&word)),
            Self::Text => value.is_string(),
            Self::Flag => value.is_boolean(),
            Self::Texture => value.is_object(),
        }
    }

    /// What follows "must" in a note.
    fn wanted(self) -> String {
        let range = |low, high| match (low, high) {
            (low, f32::MAX) if low > 0.0 => "above 0".to_owned(),
            (low, f32::MAX) => format!("finite and from {low}"),
            (low, UNIT) => format!("from {low} to 1"),
            (low, high) => format!("from {low} to {high}"),
        };
        match self {
            Self::Number(f32::MIN, _) => "be a finite number".into(),
            Self::Number(low, high) => format!("be a number {}", range(low, high)),
            Self::Numbers(count, f32::MIN, _) => format!("be {count} finite numbers"),
            Self::Numbers(count, low, high) => format!("be {count} numbers, each {}", range(low, high)),
            Self::Ior => "be 0, or a number from 1 to 10".into(),
            Self::Below(0) => "be absent: the file has none to point at".into(),
            Self::Below(end) => format!("be a whole number from 0 to {}", end - 1),
            Self::Code(codes) => format!("be one of {codes:?}"),
            Self::Word(words) => format!("be one of {}", words.join(", ")),
            Self::Text => "be text".into(),
            Self::Flag => "be true or false".into(),
            Self::Texture => "be an object".into(),
        }
    }
}

/// Leaves out of a document what is malformed or out of range in its look; returns a note for each value.
pub(super) fn amend_look(tree: &mut Value) -> Vec<String> {
    let mut amender = Amender::default();
    let count = |tree: &Value, key: &str| tree.get(key).and_then(Value::as_array).map_or(0, Vec::len);
    let (images, samplers) = (count(tree, "images"), count(tree, "samplers"));
    let Some(root) = tree.as_object_mut() else { return vec![] };
    for (list, kind) in [("scenes", "scene"), ("meshes", "mesh")] {
        amender.each(root, list, kind, |amender, object, name| amender.plain(object, name, NAME));
    }
    amender.each(root, "samplers", "sampler", |amender, object, name| amender.plain(object, name, SAMPLER));
    amender.each(root, "textures", "texture", |amender, texture, name| {
        amender.texture(texture, name, images, samplers);
    });
    amender.each(root, "materials", "material", Amender::material);
    amender.lights(root);
    amender.each(root, "nodes", "node", Amender::node);
    amender.notes()
}

#[derive(Default)]
struct Amender {
    told: Vec<String>,
    /// Notes beyond the greatest number.
    more: usize,
    /// Of each texture: whether a program can show it.
    textures: Vec<bool>,
    /// Of each light: whether its kind is one.
    lights: Vec<bool>,
}

impl Amender {
    fn note(&mut self, note: String) {
        match self.told.len() < MOST_NOTES {
            true => self.told.push(note),
            false => self.more += 1,
        }
    }

    fn notes(mut self) -> Vec<String> {
        if self.more > 0 {
            self.told.push(format!("{} more values are left out", self.more));
        }
        self.told
    }

    /// The objects of a list at the top of the file with their names. What is no list or no object is refused elsewhere.
    fn each(
        &mut self,
        root: &mut Object,
        list: &str,
        kind: &str,
        mut work: impl FnMut(&mut Self, &mut Object, &str),
    ) {
        for (i, value) in root.get_mut(list).and_then(Value::as_array_mut).into_iter().flatten().enumerate() {
            let name = label(kind, i, value);
            if let Some(object) = value.as_object_mut() {
                work(self, object, &name);
            }
        }
    }

    fn leave_out(&mut self, owner: &mut Object, name: &str, key: &str, wanted: &str) {
        if let Some(value) = owner.remove(key) {
            let value = shorten(&value.to_string());
            self.note(format!("{name}: '{key}' is {value} and is left out: it must {wanted}"));
        }
    }

    /// The object at a key; `None`: there is none, or what is there is left out.
    fn object<'o>(&mut self, owner: &'o mut Object, name: &str, key: &str) -> Option<&'o mut Object> {
        if owner.get(key).is_some_and(|value| !value.is_object()) {
            self.leave_out(owner, name, key, "be an object");
        }
        owner.get_mut(key)?.as_object_mut()
    }

    fn extension<'o>(&mut self, owner: &'o mut Object, name: &str, key: &str) -> Option<&'o mut Object> {
        let all = self.object(owner, name, "extensions")?;
        self.object(all, name, key)
    }

    /// An object of whose extensions none is read.
    fn plain(&mut self, object: &mut Object, name: &str, rules: &[(&str, ValueRule)]) {
        self.values(object, name, rules);
        self.object(object, name, "extensions");
    }

    fn values(&mut self, object: &mut Object, name: &str, rules: &[(&str, ValueRule)]) {
        for &(key, rule) in rules {
            let Some(value) = object.get(key) else { continue };
            if !rule.fits(value) {
                self.leave_out(object, name, key, &rule.wanted());
            } else if matches!(rule, ValueRule::Texture) {
                self.texture_use(object, name, key);
            }
        }
    }

    /// A use of a texture, which is an object.
    fn texture_use(&mut self, owner: &mut Object, name: &str, key: &str) {
        let index = owner[key].get("index").and_then(Value::as_u64);
        let shown = index.and_then(|i| self.textures.get(i as usize).copied());
        let Some(shown) = shown else {
            let wanted = match (index, self.textures.len()) {
                (None, _) => "have an 'index'".into(),
                (Some(i), count) => format!("not point at texture {i}, for the file has {count}"),
            };
            return self.leave_out(owner, name, key, &wanted);
        };
        if !shown {
            // What is wrong is said of the texture.
            owner.remove(key);
            return;
        }
        let name = format!("{name}, {key}");
        let Some(used) = owner.get_mut(key).and_then(Value::as_object_mut) else { return };
        self.values(used, &name, TEXTURE_USE);
        if let Some(place) = self.extension(used, &name, TRANSFORM) {
            self.values(place, &format!("{name}, {TRANSFORM}"), TEXTURE_PLACE);
        }
    }

    fn texture(&mut self, texture: &mut Object, name: &str, images: usize, samplers: usize) {
        let source = [("source", ValueRule::Below(images))];
        self.values(
            texture,
            name,
            &[("name", ValueRule::Text), ("sampler", ValueRule::Below(samplers)), source[0]],
        );
        let mut shown = texture.contains_key("source");
        for key in [BASISU, WEBP] {
            if let Some(extension) = self.extension(texture, name, key) {
                self.values(extension, &format!("{name}, {key}"), &source);
                shown |= extension.contains_key("source");
            }
        }
        if !shown {
            let why = "has no 'source' this program can read: re-export with PNG, JPEG or KTX2 textures";
            self.note(format!("{name}: it {why}, and is left out"));
            // Nothing uses it any more, but the list keeps its places.
            texture.insert("source".into(), json!(0));
        }
        self.textures.push(shown);
    }

    fn material(&mut self, material: &mut Object, name: &str) {
        self.values(material, name, MATERIAL);
        if let Some(pbr) = self.object(material, name, "pbrMetallicRoughness") {
            let name = format!("{name}, pbrMetallicRoughness");
            self.plain(pbr, &name, METALLIC_ROUGHNESS);
        }
        let Some(extensions) = self.object(material, name, "extensions") else { return };
        for key in extensions.keys().filter(|key| EXTENSIONS.iter().all(|(known, _)| known != key)) {
            self.note(format!("{name}: {} is ignored", shorten(key)));
        }
        for (key, rules) in EXTENSIONS {
            if let Some(extension) = self.object(extensions, name, key) {
                self.values(extension, &format!("{name}, {key}"), rules);
            }
        }
        if let Some(told) = spec_gloss::convert(material) {
            self.note(format!("{name}: {told}"));
        }
    }

    fn lights(&mut self, root: &mut Object) {
        let Some(extension) = self.extension(root, "document", LIGHTS) else { return };
        if extension.get("lights").is_some_and(|lights| !lights.is_array()) {
            self.leave_out(extension, &format!("document, {LIGHTS}"), "lights", "be a list");
        }
        let lights = extension.get_mut("lights").and_then(Value::as_array_mut).into_iter().flatten();
        for (i, light) in lights.enumerate() {
            let name = format!("{}, {LIGHTS}", label("light", i, light));
            let is_one = light.get("type").is_some_and(|kind| KINDS_OF_LIGHT.fits(kind));
            self.lights.push(is_one);
            match light.as_object_mut().filter(|_| is_one) {
                Some(light) => self.light(light, &name),
                None => {
                    let kind = shorten(&light.get("type").unwrap_or(&Value::Null).to_string());
                    let wanted = KINDS_OF_LIGHT.wanted();
                    self.note(format!(
                        "{name}: 'type' is {kind} and the light is left out: it must {wanted}"
                    ));
                    // No node has it any more, but the list keeps its places.
                    *light = json!({"type": "point"});
                }
            }
        }
    }

    fn light(&mut self, light: &mut Object, name: &str) {
        self.plain(light, name, LIGHT);
        let is_spot = light["type"] == "spot";
        if let Some(cone) = self.object(light, name, "spot") {
            let name = format!("{name}, spot");
            self.values(cone, &name, CONE);
            let angle = |key: &str, default| cone.get(key).and_then(Value::as_f64).unwrap_or(default);
            let [inner, outer] = [0, 1].map(|i| angle(CONE[i].0, CONE_DEFAULT[i]));
            if inner >= outer {
                let why = "the inner one must be less: both are left out";
                self.note(format!("{name}: 'innerConeAngle' is {inner} and 'outerConeAngle' {outer}: {why}"));
                cone.clear();
            }
        } else if is_spot {
            self.note(format!("{name}: it is a spot without a 'spot' object: a cone of 45 degrees is taken"));
            light.insert("spot".into(), json!({}));
        }
    }

    fn node(&mut self, node: &mut Object, name: &str) {
        self.values(node, name, NAME);
        if let Some(light) = self.extension(node, name, LIGHTS) {
            let rules = [("light", ValueRule::Below(self.lights.len()))];
            self.values(light, &format!("{name}, {LIGHTS}"), &rules);
            let lit = light.get("light").and_then(Value::as_u64).map(|i| self.lights[i as usize]);
            if let Some(extensions) = node.get_mut("extensions").filter(|_| lit != Some(true)) {
                extensions.as_object_mut().map(|all| all.remove(LIGHTS));
            }
        }
        if let Some(visibility) = self.extension(node, name, VISIBILITY) {
            self.values(visibility, &format!("{name}, {VISIBILITY}"), &[("visible", ValueRule::Flag)]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What a rule refuses.
    fn wrong(rule: ValueRule) -> Vec<Value> {
        let beyond = |low: f32, high: f32| {
            let below = (low > f32::MIN).then(|| json!(f64::from(low) - 0.01));
            let above = (high < f32::MAX).then(|| json!(f64::from(high) * 1.01));
            below.into_iter().chain(above).chain([json!(1e39), json!(-1e39)])
        };
        let own: Vec<Value> = match rule {
            ValueRule::Number(low, high) => beyond(low, high).chain([json!([0.5]), json!("0.5")]).collect(),
            ValueRule::Numbers(count, low, high) => {
                let lists = beyond(low, high).chain([json!("x"), json!(null)]).map(|v| {
                    let mut all = vec![json!(0.5); count];
                    all[count - 1] = v;
                    json!(all)
                });
                lists.chain([json!(0.5), json!(vec![0.5; count + 1]), json!([])]).collect()
            }
            ValueRule::Ior => vec![json!(0.5), json!(-1), json!(11), json!("1.5")],
            ValueRule::Below(end) => vec![json!(end), json!(-1), json!(0.5), json!("0")],
            ValueRule::Code(_) => vec![json!(1), json!("9729"), json!(-1)],
            ValueRule::Word(_) => vec![json!("GLOW"), json!(1)],
            ValueRule::Text => vec![json!(5), json!(["a"])],
            ValueRule::Flag => vec![json!("true"), json!(1)],
            ValueRule::Texture => vec![json!({"index": 2}), json!({"index": -1}), json!({}), json!(0)],
        };
        own.into_iter().chain([json!(null)]).collect()
    }

    fn right(rule: ValueRule) -> Value {
        match rule {
            ValueRule::Number(low, high) => json!(low.max(0.0).max(high.min(1.0) * 0.5)),
            ValueRule::Numbers(count, ..) => json!(vec![0.5; count]),
            ValueRule::Ior => json!(1.4),
            ValueRule::Below(_) => json!(0),
            ValueRule::Code(codes) => json!(codes[0]),
            ValueRule::Word(words) => json!(words[0]),
            ValueRule::Text => json!("text"),
            ValueRule::Flag => json!(true),
            ValueRule::Texture => {
                json!({"index": 1, "texCoord": 1, "extensions": {TRANSFORM: {"offset": [0.1, 0.2]}}})
            }
        }
    }

    /// A document with a value at a place, and its only material, texture use, sampler, light, spot, node or texture.
    fn with(place: &[&str], value: Value) -> Value {
        let mut tree = json!({
            "images": [{}], "samplers": [{}], "textures": [{"source": 0}, {"source": 0}],
            "materials": [{"name": "glass"}], "nodes": [{"name": "lamp", "extensions": {LIGHTS: {"light": 0}}}],
            "extensions": {LIGHTS: {"lights": [{"type": "spot", "spot": {}}]}},
        });
        let mut at = &mut tree;
        for step in place {
            at = match step.parse::<usize>() {
                Ok(i) => &mut at[i],
                Err(_) => &mut at[*step],
            };
        }
        *at = value;
        tree
    }

    /// Every place that a rule holds for: the steps to its object, what notes call the object, and the rules.
    fn places() -> Vec<(Vec<&'static str>, String, Rules)> {
        let material = vec!["materials", "0"];
        let below = |of: &[&'static str], more: &[&'static str]| [of, more].concat();
        let transform = ["normalTexture", "extensions", TRANSFORM];
        let lights = ["extensions", LIGHTS, "lights", "0"];
        let mut all = vec![
            // Of a name that is none there is nothing to call the object by.
            (material.clone(), "material 0".into(), MATERIAL),
            (below(&material, &["pbrMetallicRoughness"]), "pbrMetallicRoughness".into(), METALLIC_ROUGHNESS),
            (below(&material, &transform), format!("normalTexture, {TRANSFORM}"), TEXTURE_PLACE),
            (vec!["samplers", "0"], "sampler 0".into(), SAMPLER),
            (lights.to_vec(), format!("light 0, {LIGHTS}"), LIGHT),
            (below(&lights, &["spot"]), format!("light 0, {LIGHTS}, spot"), CONE),
            (vec!["nodes", "0"], "node 0".into(), NAME),
        ];
        // What is converted is not there afterwards.
        all.extend(EXTENSIONS.into_iter().filter(|(key, _)| *key != spec_gloss::NAME).map(|(key, rules)| {
            (below(&material, &["extensions", key]), format!("material 0 'glass', {key}"), rules)
        }));
        all
    }

    #[test]
    fn each_value_out_of_its_rule_is_left_out_alone_and_named() {
        let mut tried = 0;
        for (place, name, rules) in places() {
            for &(key, rule) in rules {
                let at = [&place[..], &[key]].concat();
                let pointer = format!("/{}", at.join("/"));
                let in_use = |value: Value| {
                    let mut tree = with(&at, value);
                    if let Some(used) = tree.pointer_mut("/materials/0/normalTexture") {
                        // The use whose place is looked at.
                        used.as_object_mut().map(|used| used.entry("index").or_insert(json!(1)));
                    }
                    tree
                };
                let mut good = in_use(right(rule));
                let before = good.clone();
                assert_eq!((amend_look(&mut good), &good), (vec![], &before), "{pointer}");
                for value in wrong(rule) {
                    if key == "normalTexture" && value == json!({}) {
                        continue;
                    }
                    let mut tree = in_use(value.clone());
                    let notes = amend_look(&mut tree);
                    let [note] = &notes[..] else { panic!("{pointer} = {value}: {notes:?}") };
                    assert_eq!(tree.pointer(&pointer), None, "{pointer} = {value}");
                    let said = [name.as_str(), &format!("'{key}' is "), &shorten(&value.to_string())];
                    assert!(
                        said.iter().all(|word| note.contains(word)),
                        "{pointer}: {note} without {said:?}"
                    );
                    // Nothing else of it is changed.
                    let mut without = in_use(json!(0));
                    let parent = without.pointer_mut(pointer.rsplit_once('/').map_or("", |p| p.0));
                    parent.and_then(Value::as_object_mut).map(|object| object.remove(key));
                    assert_eq!(tree, without, "{pointer} = {value}");
                    tried += 1;
                }
            }
        }
        assert!(tried > 300, "{tried} values");
    }

    #[test]
    fn lists_keep_their_places_when_an_entry_is_left_out() {
        let mut tree = json!({
            "images": [{}], "textures": [{"extensions": {"EXT_texture_avif": {"source": 0}}}, {"source": 0}],
            "materials": [{"normalTexture": {"index": 0}, "emissiveTexture": {"index": 1}}],
            "extensions": {LIGHTS: {"lights": [{"type": "laser"}, {"type": "point"}, {"type": "spot"}]}},
            "nodes": [{"extensions": {LIGHTS: {"light": 0}}}, {"extensions": {LIGHTS: {"light": 1}}}],
        });
        let notes = amend_look(&mut tree).join("\n");
        for word in ["texture 0: it has no 'source'", "light 0", "\"laser\"", "light 2", "cone of 45 degrees"]
        {
            assert!(notes.contains(word), "{notes}");
        }
        assert_eq!(tree["materials"][0], json!({"emissiveTexture": {"index": 1}}));
        assert_eq!(tree["extensions"][LIGHTS]["lights"][2], json!({"type": "spot", "spot": {}}));
        assert_eq!(tree["nodes"][0]["extensions"], json!({}));
        assert_eq!(tree["nodes"][1]["extensions"][LIGHTS], json!({"light": 1}));
    }

    #[test]
    fn many_values_are_told_by_their_number() {
        let mut tree = json!({"materials": vec![json!({"doubleSided": 1}); MOST_NOTES + 7]});
        let notes = amend_look(&mut tree);
        assert_eq!((notes.len(), notes[MOST_NOTES].as_str()), (MOST_NOTES + 1, "7 more values are left out"));
    }
}
