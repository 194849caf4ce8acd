//! The `motion` tables of a rig file: what may stand in them, and their part of the manual.

use serde::{Deserialize, Serialize};

/// A kind of motion with its keys, for manuals.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MotionKind {
    /// Value of `kind`.
    pub name: &'static str,
    /// What it does, in lines.
    pub doc: &'static [&'static str],
    /// Its keys in order: name, type as Rust writes it, and what it does, in lines.
    pub keys: &'static [(&'static str, &'static str, &'static [&'static str])],
}

/// Declares the kinds once: for serde, and with all their texts for manuals.
macro_rules! motions {
    (
        $(#[doc = $doc:literal])+
        pub enum MotionSpec {
            $(
                $(#[doc = $kind_doc:literal])+
                $name:literal => $kind:ident {
                    $(
                        $(#[doc = $key_doc:literal])+
                        $(#[serde($($serde:tt)+)])?
                        $key:ident: $ty:ty,
                    )*
                },
            )+
        }
    ) => {
        $(#[doc = $doc])+
        #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
        #[serde(tag = "kind", deny_unknown_fields)]
        pub enum MotionSpec {
            $(
                $(#[doc = $kind_doc])+
                #[serde(rename = $name)]
                $kind {
                    $(
                        $(#[doc = $key_doc])+
                        $(#[serde($($serde)+)])?
                        $key: $ty,
                    )*
                },
            )+
        }

        impl MotionSpec {
            /// All kinds, in the order of their declaration.
            pub const KINDS: &'static [MotionKind] = &[$(MotionKind {
                name: $name,
                doc: &[$($kind_doc),+],
                keys: &[$((stringify!($key), stringify!($ty), &[$($key_doc),+])),*],
            }),+];
        }
    };
}

motions! {
    /// A motion as the rig file writes it (`{ kind = "translate", speed_m_s = 1.0 }`). World axes, relative to the rest pose.
    pub enum MotionSpec {
        /// The body stays at its rest pose.
        "still" => Still {},
        /// Back and forth on a line at constant speed, with turns of constant acceleration. At time 0 the body is at
        /// its rest position and moves at full speed in `direction`.
        "translate" => Translate {
            /// Any non-zero vector; its length does not matter. Default: to the left, -x.
            #[serde(default = "left")]
            direction: [f64; 3],
            /// Speed on the stretches, metres per second, above 0. Default 1.
            #[serde(default = "one")]
            speed_m_s: f64,
            /// Largest distance from the rest position, metres; at least `speed^2 / (2 acceleration)`. Default 0.15.
            #[serde(default = "amplitude")]
            amplitude_m: f64,
            /// Acceleration in the turns, m/s^2, above 0. Default 20.
            #[serde(default = "acceleration")]
            acceleration_m_s2: f64,
            /// Time at rest in the middle of each turn, seconds, 0 or more. Default 0.
            #[serde(default)]
            rest_s: f64,
        },
        /// `amplitude * sin(w t)` along `direction`, given by its peaks: amplitude = speed^2 / acceleration, w = acceleration / speed.
        "sinusoid" => Sinusoid {
            /// Any non-zero vector. Default: to the left, -x.
            #[serde(default = "left")]
            direction: [f64; 3],
            /// Speed when passing the rest position, metres per second, above 0.
            peak_speed_m_s: f64,
            /// Acceleration at the turning points, m/s^2, above 0.
            peak_acceleration_m_s2: f64,
        },
        /// Steady rotation about an axis.
        "rotate" => Rotate {
            /// Any non-zero vector, right-handed. Default: +y.
            #[serde(default = "up")]
            axis: [f64; 3],
            /// Radians per second; negative turns the other way, 0 does not turn. Default 1 turn in 2 s.
            #[serde(default = "half_turn")]
            rate_rad_s: f64,
            /// A point of the axis, metres from the rest position. Default 0: in place.
            #[serde(default)]
            pivot_offset_m: [f64; 3],
        },
        /// Rotation to and fro about an axis through the body's origin: `amplitude * sin(w t)`, by its peaks as in `sinusoid`.
        "sway" => Sway {
            /// Any non-zero vector, right-handed. Default: +y.
            #[serde(default = "up")]
            axis: [f64; 3],
            /// Angular speed when passing the rest orientation, rad/s, above 0.
            peak_rate_rad_s: f64,
            /// Angular acceleration at the turning points, rad/s^2, above 0.
            peak_acceleration_rad_s2: f64,
        },
        /// Rotation about an axis through the body's origin while going back and forth along it.
        "screw" => Screw {
            /// Any non-zero vector, right-handed.
            axis: [f64; 3],
            /// Radians per second.
            rate_rad_s: f64,
            /// Speed along the axis, as in `translate`.
            speed_m_s: f64,
            /// As in `translate`. Default 0.15.
            #[serde(default = "amplitude")]
            amplitude_m: f64,
            /// As in `translate`. Default 20.
            #[serde(default = "acceleration")]
            acceleration_m_s2: f64,
        },
        /// Several motions applied to the rest pose one after the other, first to last (at most 8).
        "together" => Together {
            /// The motions; none may be `together` itself.
            parts: Vec<MotionSpec>,
        },
    }
}

fn left() -> [f64; 3] {
    [-1.0, 0.0, 0.0]
}
fn up() -> [f64; 3] {
    [0.0, 1.0, 0.0]
}
fn one() -> f64 {
    1.0
}
fn amplitude() -> f64 {
    0.15
}
fn acceleration() -> f64 {
    20.0
}
fn half_turn() -> f64 {
    core::f64::consts::PI
}

impl MotionSpec {
    /// Most parts of [`MotionSpec::Together`].
    pub const MAX_PARTS: usize = 8;

    /// Along x and back without a rest, as in `translate`: m/s, m, m/s^2.
    pub fn shuttle(speed_m_s: f64, amplitude_m: f64, acceleration_m_s2: f64) -> Self {
        let direction = [1.0, 0.0, 0.0];
        Self::Translate { direction, speed_m_s, amplitude_m, acceleration_m_s2, rest_s: 0.0 }
    }

    /// The motion of the paper's experiment: 1 m/s to the left and back, all other values default.
    pub fn paper_translation() -> Self {
        Self::Translate {
            direction: left(),
            speed_m_s: one(),
            amplitude_m: amplitude(),
            acceleration_m_s2: acceleration(),
            rest_s: 0.0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::{json, Map, Value};

    fn read(table: &Map<String, Value>) -> Result<MotionSpec, String> {
        serde_json::from_value(Value::Object(table.clone())).map_err(|e| e.to_string())
    }

    /// Serde takes the keys that the manual names, and no others.
    #[test]
    fn the_manual_has_the_keys_that_are_read() {
        assert_eq!(MotionSpec::KINDS.len(), 7);
        for kind in MotionSpec::KINDS {
            let mut table = Map::new();
            table.insert("kind".into(), json!(kind.name));
            for (key, ty, _) in kind.keys {
                let value = match *ty {
                    "f64" => json!(1.5),
                    "[f64; 3]" => json!([1.0, 2.0, 3.0]),
                    _ => json!([{ "kind": "still" }]),
                };
                table.insert((*key).into(), value);
            }
            let spec = read(&table).unwrap_or_else(|e| panic!("{}: {e}", kind.name));
            assert_eq!(serde_json::to_value(&spec).unwrap(), Value::Object(table.clone()));
            table.insert("no_such_key".into(), json!(1.0));
            let told = read(&table).unwrap_err();
            assert!(told.contains("unknown field `no_such_key`"), "{}: {told}", kind.name);
        }
    }
}
