//! What an operator may change while a rig runs: exposure, samples, the budget, the gaze, and small motions of the
//! projector and of bodies.
//!
//! [`Values`] are the values as an operator thinks of them. [`desk::ParameterDesk`] checks changes, remembers the past
//! for undo, and hands [`applied::ParameterVersion`] to planning, which uses it from one frame on. None of this can raise a limit
//! on light: those are kept by the link and by the projector, from the planes that are sent.

pub mod applied;
pub mod command;
pub mod desk;

pub use command::ParameterCommand;
pub use desk::{ParameterDesk, Saver};

use crate::rig::Rig;
use std::fmt::Write as _;

/// Range of the exposure, as in the rig file.
const EXPOSURE: [f64; 2] = [1e-6, 1e6];
/// Most samples per pixel, as in the rig file.
const MOST_SAMPLES: u32 = 4096;
/// A rig may be asked for so many times the samples of its rig file: the GPU counts as hung after two seconds.
const SAMPLES_BEYOND: u32 = 8;
/// Fewest samples of a budget, per pixel.
const LEAST_BUDGET: f64 = 0.125;
/// Farthest motion by hand along an axis, millimetres.
const FARTHEST_MM: f64 = 500.0;
/// Widest turn by hand about an axis, degrees.
const WIDEST_DEG: f64 = 45.0;
/// Farthest coordinate of a gaze point, metres.
const FARTHEST_GAZE_M: f64 = 100.0;
/// First part of the name of a body's motion.
const BODY: &str = "body.";

/// One of the parameters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Parameter {
    /// `render.exposure`.
    Exposure,
    /// `render.spp`.
    Samples,
    /// `render.budget_spp`.
    Budget,
    /// The point that the observer looks at.
    Gaze,
    /// A small motion of the projector.
    Projector,
    /// A small motion of the tracked body of this number.
    Body(usize),
}

/// A small rigid motion by hand, along and about the axes of what is moved.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Nudge {
    /// Millimetres.
    pub moved_mm: [f64; 3],
    /// Rotation vector, degrees. A body turns about its middle, the projector about its lens.
    pub turned_deg: [f64; 3],
}

/// A value for every parameter.
#[derive(Clone, Debug, PartialEq)]
pub struct Values {
    /// Factor by which radiance is multiplied before it becomes light.
    pub exposure: f64,
    /// Samples per pixel; their largest average with method `dpm`.
    pub samples: u32,
    /// Largest average of samples per pixel (method `dpm`); larger than `samples` it has no effect.
    pub budget: f64,
    /// The point that the observer looks at, world coordinates, metres; `None`: as the rig file says.
    pub gaze: Option<[f64; 3]>,
    /// Of the projector, from where the rig has it.
    pub projector: Nudge,
    /// Of every tracked body's mesh, from where the rig has it.
    pub bodies: Vec<Nudge>,
}

/// Why a change was refused; nothing was changed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ChangeRefusal {
    /// The run draws no scene.
    #[error("this run has no parameters to change: they exist once a scene is drawn")]
    NoRun,
    /// There is no parameter of this name.
    #[error("no parameter is named {name:?}; there are: {known}")]
    Unknown {
        /// The name that was given.
        name: String,
        /// Those that exist.
        known: String,
    },
    /// It would change nothing on this rig.
    #[error("{name} has no effect here: {why}")]
    NoEffect {
        /// Its name.
        name: String,
        /// Why.
        why: &'static str,
    },
    /// Too many or too few numbers.
    #[error("{name} takes {wanted}, not {given}")]
    Count {
        /// Its name.
        name: String,
        /// How many it takes.
        wanted: &'static str,
        /// How many were given.
        given: usize,
    },
    /// A number is out of its range, or is none.
    #[error("{name}: {value} is not allowed; it must be {low} to {high}{unit}")]
    Range {
        /// Name of the parameter and of the number.
        name: String,
        /// The number that was given.
        value: String,
        /// Smallest.
        low: String,
        /// Largest.
        high: String,
        /// Unit, with a space before it.
        unit: String,
    },
    /// A number that must be whole is not.
    #[error("{name}: {value} is not a whole number")]
    NotWhole {
        /// Its name.
        name: String,
        /// The number that was given.
        value: String,
    },
    /// What was sent is no command.
    #[error("{0}")]
    Syntax(String),
    /// There is no earlier value.
    #[error("nothing to take back")]
    NothingToUndo,
    /// The values can be kept nowhere, or are being kept.
    #[error("not saved: {0}")]
    NotSaved(String),
}

/// One number of a parameter, for those who show it.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct ParameterField {
    /// What it is; empty if the parameter has one number only.
    pub label: &'static str,
    /// Unit; may be empty.
    pub unit: &'static str,
    /// Smallest value.
    pub low: f64,
    /// Largest value.
    pub high: f64,
    /// Usual step.
    pub step: f64,
}

impl Parameter {
    /// Every parameter that has an effect on `rig`.
    pub fn all_of(rig: &Rig) -> Vec<Self> {
        let fixed = [Self::Exposure, Self::Samples, Self::Budget, Self::Gaze, Self::Projector];
        let bodies = (0..rig.bodies.len()).map(Self::Body);
        fixed.into_iter().chain(bodies).filter(|p| p.why_not(rig).is_none()).collect()
    }

    /// Its name.
    pub fn name(self, rig: &Rig) -> String {
        match self {
            Self::Exposure => "exposure".into(),
            Self::Samples => "samples".into(),
            Self::Budget => "budget".into(),
            Self::Gaze => "gaze".into(),
            Self::Projector => "projector".into(),
            Self::Body(i) => format!("{BODY}{}", rig.bodies.get(i).map_or("", |b| b.name.as_str())),
        }
    }

    /// What it does, for operators.
    pub fn told(self) -> &'static str {
        match self {
            Self::Exposure => "factor of all radiance before it becomes light",
            Self::Samples => "samples per pixel; with method dpm their largest average",
            Self::Budget => "largest average of samples per pixel",
            Self::Gaze => {
                "the point that the observer looks at, world coordinates; without numbers as in the rig file"
            }
            Self::Projector => "moves the projector along and about its own axes",
            Self::Body(_) => "moves the mesh in its tracked body along and about its own axes",
        }
    }

    /// The parameter of this name.
    ///
    /// # Errors
    /// There is none, or it would have no effect.
    pub fn named(name: &str, rig: &Rig) -> Result<Self, ChangeRefusal> {
        let fixed = [Self::Exposure, Self::Samples, Self::Budget, Self::Gaze, Self::Projector];
        let found = fixed
            .into_iter()
            .chain((0..rig.bodies.len()).map(Self::Body))
            .find(|parameter| parameter.name(rig) == name);
        let Some(parameter) = found else {
            let known: Vec<String> = Self::all_of(rig).into_iter().map(|p| p.name(rig)).collect();
            let name = name.chars().take(80).collect();
            return Err(ChangeRefusal::Unknown { name, known: known.join(", ") });
        };
        match parameter.why_not(rig) {
            Some(why) => Err(ChangeRefusal::NoEffect { name: name.to_owned(), why }),
            None => Ok(parameter),
        }
    }

    /// Why it has no effect on `rig`; `None` if it has one.
    fn why_not(self, rig: &Rig) -> Option<&'static str> {
        let render = &rig.config.render;
        let takes_a_budget = render.method.takes_a_budget();
        match self {
            Self::Samples if !takes_a_budget && render.effects_on().spp_by_angle => {
                Some("the method takes its samples by the angle from the gaze (render.paper.zone_spp)")
            }
            Self::Budget if !takes_a_budget => {
                Some("only methods dpm and own share a budget out; samples is the one to change")
            }
            _ => None,
        }
    }

    /// Its numbers.
    pub fn fields(self, rig: &Rig) -> Vec<ParameterField> {
        let one =
            |unit, [low, high]: [f64; 2], step| vec![ParameterField { label: "", unit, low, high, step }];
        let most = most_samples(rig);
        match self {
            Self::Exposure => one("", EXPOSURE, 0.05),
            Self::Samples => one("samples/px", [1.0, most], 1.0),
            Self::Budget => one("samples/px", [LEAST_BUDGET, most], 0.125),
            Self::Gaze => axes(["x", "y", "z"], "m", FARTHEST_GAZE_M, 0.01).collect(),
            Self::Projector | Self::Body(_) => axes(["x", "y", "z"], "mm", FARTHEST_MM, 0.5)
                .chain(axes(["about x", "about y", "about z"], "deg", WIDEST_DEG, 0.05))
                .collect(),
        }
    }
}

/// Three numbers of the same range on both sides of zero.
fn axes(
    labels: [&'static str; 3],
    unit: &'static str,
    far: f64,
    step: f64,
) -> impl Iterator<Item = ParameterField> {
    labels.into_iter().map(move |label| ParameterField { label, unit, low: -far, high: far, step })
}

/// Most samples per pixel that this rig may be asked for.
fn most_samples(rig: &Rig) -> f64 {
    let wanted = rig.config.render.spp.saturating_mul(SAMPLES_BEYOND).min(MOST_SAMPLES);
    f64::from(wanted.min(rig.config.render.to_method().most_spp()))
}

impl Nudge {
    fn numbers(&self) -> Vec<f64> {
        [self.moved_mm, self.turned_deg].concat()
    }

    fn of(numbers: &[f64]) -> Self {
        let three = |from: usize| std::array::from_fn(|k| numbers.get(from + k).copied().unwrap_or(0.0));
        Self { moved_mm: three(0), turned_deg: three(3) }
    }
}

impl Values {
    /// As the rig file has them.
    pub fn of(rig: &Rig) -> Self {
        let render = &rig.config.render;
        Self {
            exposure: render.exposure,
            samples: render.spp,
            budget: render.budget_spp.unwrap_or(f64::INFINITY).min(most_samples(rig)),
            gaze: None,
            projector: Nudge::default(),
            bodies: vec![Nudge::default(); rig.bodies.len()],
        }
    }

    /// The numbers of a parameter; none for a gaze that is as the rig file says.
    pub fn get(&self, parameter: Parameter) -> Vec<f64> {
        match parameter {
            Parameter::Exposure => vec![self.exposure],
            Parameter::Samples => vec![f64::from(self.samples)],
            Parameter::Budget => vec![self.budget],
            Parameter::Gaze => self.gaze.map_or(Vec::new(), |point| point.to_vec()),
            Parameter::Projector => self.projector.numbers(),
            Parameter::Body(i) => self.bodies.get(i).copied().unwrap_or_default().numbers(),
        }
    }

    /// Changes a parameter.
    ///
    /// # Errors
    /// The numbers are too few or too many, not numbers, or out of range. Then nothing is changed.
    pub fn set(&mut self, parameter: Parameter, numbers: &[f64], rig: &Rig) -> Result<(), ChangeRefusal> {
        check(parameter, numbers, rig)?;
        match (parameter, numbers) {
            (Parameter::Exposure, [value]) => self.exposure = *value,
            (Parameter::Samples, [value]) => self.samples = *value as u32,
            (Parameter::Budget, [value]) => self.budget = *value,
            (Parameter::Gaze, [x, y, z]) => self.gaze = Some([*x, *y, *z]),
            (Parameter::Gaze, _) => self.gaze = None,
            (Parameter::Projector, all) => self.projector = Nudge::of(all),
            (Parameter::Body(i), all) => {
                if let Some(body) = self.bodies.get_mut(i) {
                    *body = Nudge::of(all);
                }
            }
            _ => {}
        }
        Ok(())
    }

    /// What differs from `before`, as one line for the operator.
    pub fn changes_since(&self, before: &Self, rig: &Rig) -> String {
        let mut told = String::new();
        for parameter in Parameter::all_of(rig) {
            let now = self.get(parameter);
            if now != before.get(parameter) {
                let sep = if told.is_empty() { "" } else { "; " };
                let _ = write!(told, "{sep}{} is {}", parameter.name(rig), told_of(&now));
            }
        }
        told
    }
}

/// Numbers as an operator writes them; no numbers: as in the rig file.
pub fn told_of(numbers: &[f64]) -> String {
    if numbers.is_empty() {
        return "as in the rig file".into();
    }
    numbers.iter().map(f64::to_string).collect::<Vec<_>>().join(",")
}

fn check(parameter: Parameter, numbers: &[f64], rig: &Rig) -> Result<(), ChangeRefusal> {
    let name = parameter.name(rig);
    let fields = parameter.fields(rig);
    let is_none_meant = parameter == Parameter::Gaze && numbers.is_empty();
    if !is_none_meant && numbers.len() != fields.len() {
        let wanted = match fields.len() {
            1 => "one number",
            3 => "three numbers or none",
            _ => "six numbers",
        };
        return Err(ChangeRefusal::Count { name, wanted, given: numbers.len() });
    }
    for (field, value) in fields.iter().zip(numbers) {
        let full = format!("{name} {}", field.label).trim_end().to_owned();
        if !(field.low..=field.high).contains(value) {
            return Err(ChangeRefusal::Range {
                name: full,
                value: value.to_string(),
                low: field.low.to_string(),
                high: field.high.to_string(),
                unit: if field.unit.is_empty() { String::new() } else { format!(" {}", field.unit) },
            });
        }
        if parameter == Parameter::Samples && value.fract() != 0.0 {
            return Err(ChangeRefusal::NotWhole { name: full, value: value.to_string() });
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests;
