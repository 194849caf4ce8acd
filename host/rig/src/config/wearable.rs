//! What people wear that is tracked, such as glasses: rigid bodies that need neither a node of the scene nor a mesh.

use super::world::MotionValue;
use dpm_common::keys::read::{Any, ConfigValue, KeyReader, NotEmpty, Within};
use dpm_common::keys::source::{SourceNode, Value};
use dpm_common::section;

section! {
    /// A rigid body that a person wears.
    pub struct WearableConfig {
        /// Name under which the tracker reports it; required.
        name: String = String::new(), "", NotEmpty;
        /// Number under which the tracker reports it, if the tracker has no names.
        id: Option<i64> = None, "", Within(0, i64::from(i32::MAX));
        /// Where it is at rest if the tracker is the mock.
        position: Option<[f64; 3]> = None, "m", Within(-1e6, 1e6);
        /// How it moves if the tracker is the mock. If left out, it stands still.
        motion: MotionValue = MotionValue::default(), "", Any;
    }
}

/// The same, written as its name alone or as a table.
#[derive(Clone, Debug, PartialEq)]
pub struct Wearable(pub WearableConfig);

impl ConfigValue for Wearable {
    fn kind() -> String {
        "a name, or a table with `name`, `id`, `position` and `motion`".into()
    }

    fn read(node: &SourceNode, reader: &mut KeyReader, key: &str) -> Option<Self> {
        let worn = match &node.value {
            Value::String(name) => WearableConfig { name: name.clone(), ..WearableConfig::default() },
            Value::Table(_) => WearableConfig::read(node, reader, key)?,
            other => {
                let problem = format!("is {}, must be {}", other.kind(), Self::kind());
                reader.refuse(&node.origin, key, problem, "");
                return None;
            }
        };
        if worn.name.trim().is_empty() {
            reader.refuse(&node.origin, key, "has no `name`", "add the name that the tracker reports");
            return None;
        }
        Some(Self(worn))
    }

    fn show(&self) -> String {
        format!("{:?}", self.0.name)
    }
}
