//! The animation of a file that is played: which nodes move, and how.
//!
//! An animation that is broken is no reason to refuse a scene: what of it cannot be used is left out and told.

use std::collections::HashMap;

use glam::{DQuat, DVec3};

use super::super::part_motion::{Interpolation, Keyed, Keys, ValueTrack};
use super::super::{AnimationChoice, LoadOptions, SceneError};
use super::accessor::{Accessor, Component, Data};
use super::json::{shorten, Item};

/// Longest animation, seconds of the file's time.
const LONGEST_S: f64 = 1e6;
/// Most values of all key frames together: channels may share what they read, so the size of a file is no bound.
const MOST_VALUES: u64 = 4_000_000;
/// Length of a round whose key frames all lie at the beginning, seconds.
const SHORTEST_S: f64 = 1e-3;

/// What a file says of the motion of its nodes.
#[derive(Debug, Default)]
pub(crate) struct Animation {
    /// For the operator, as `animation 0 'walk'`; empty if none is played.
    pub name: String,
    /// Seconds of the file's time in a round.
    pub length_s: f64,
    /// Nanoseconds that a round lasts.
    pub period_ns: i64,
    /// The nodes that it names.
    pub nodes: HashMap<usize, Channels>,
}

impl Animation {
    /// True if a shape or a size changes.
    pub(crate) fn deforms(&self) -> bool {
        self.nodes.values().any(|channels| channels.resizes() || channels.morphs())
    }
}

/// What an animation says of a node; `None`: nothing.
#[derive(Clone, Debug, Default)]
pub(crate) struct Channels {
    /// Metres, or units of the parent.
    pub translation: Option<ValueTrack<DVec3>>,
    /// Unit quaternions.
    pub rotation: Option<ValueTrack<DQuat>>,
    /// Along the node's own axes.
    pub scale: Option<ValueTrack<DVec3>>,
    /// Of each morph target of the node's mesh.
    pub weights: Option<Vec<ValueTrack<f64>>>,
}

impl Channels {
    /// True if the node moves as something rigid does.
    pub(crate) fn moves(&self) -> bool {
        matches!(self.translation, Some(ValueTrack::Keys(_)))
            || matches!(self.rotation, Some(ValueTrack::Keys(_)))
    }

    /// True if the node's size changes.
    pub(crate) fn resizes(&self) -> bool {
        matches!(self.scale, Some(ValueTrack::Keys(_)))
    }

    /// True if the shape of the node's mesh changes.
    pub(crate) fn morphs(&self) -> bool {
        self.weights.iter().flatten().any(|weight| matches!(weight, ValueTrack::Keys(_)))
    }

    fn is_empty(&self) -> bool {
        self.translation.is_none()
            && self.rotation.is_none()
            && self.scale.is_none()
            && self.weights.is_none()
    }
}

/// Reads the animation of `root` that the options choose.
///
/// # Errors
/// The options name one that the file does not have, or the file has too many.
pub(super) fn read(
    root: &Item,
    data: &Data,
    nodes: &[Item],
    options: &LoadOptions,
    warnings: &mut Vec<String>,
) -> Result<Animation, SceneError> {
    let all = root.list("animations", "animation", options.limits.objects)?;
    let item = match &options.animation {
        AnimationChoice::Off => None,
        AnimationChoice::First => all.first(),
        AnimationChoice::Named(name) => {
            let is_it = |a: &&Item| a.get("name").and_then(serde_json::Value::as_str) == Some(name);
            Some(all.iter().find(is_it).ok_or_else(|| unknown(name, &all))?)
        }
    };
    let Some(item) = item else {
        if !all.is_empty() {
            warnings.push("animations are not played: scene.animation = \"none\"".into());
        }
        return Ok(Animation::default());
    };
    if all.len() > 1 {
        let played = match &options.animation {
            AnimationChoice::Named(_) => "the one that scene.animation names",
            _ => "the first one; scene.animation names another",
        };
        warnings.push(format!("of {} animations one is played: {played}", all.len()));
    }
    let mut reader = AnimationReader { item, data, nodes, lost: Vec::new(), values_left: MOST_VALUES };
    let mut animation = reader.animation(options);
    let lost = reader.lost;
    if let Some((first, more)) = lost.split_first() {
        let rest = if more.is_empty() { String::new() } else { format!(", and {} more such", more.len()) };
        warnings.push(format!("{}: {first}{rest}", item.name));
    }
    animation.nodes.retain(|_, channels| !channels.is_empty());
    Ok(animation)
}

fn unknown(name: &str, all: &[Item]) -> SceneError {
    let names: Vec<String> =
        all.iter().filter_map(|a| a.text("name").ok().flatten()).take(30).map(shorten).collect();
    SceneError::Animation {
        name: name.to_owned(),
        known: if names.is_empty() { "none".into() } else { names.join(", ") },
    }
}

struct AnimationReader<'a> {
    item: &'a Item<'a>,
    data: &'a Data,
    nodes: &'a [Item<'a>],
    /// What cannot be shown.
    lost: Vec<String>,
    /// Values that may still be read.
    values_left: u64,
}

impl AnimationReader<'_> {
    fn animation(&mut self, options: &LoadOptions) -> Animation {
        let limit = options.limits.objects;
        let lists = self.item.list("channels", "channel", limit);
        let lists = lists.and_then(|c| Ok((c, self.item.list("samplers", "sampler", limit)?)));
        let (channels, samplers) = lists.unwrap_or_else(|e| {
            self.lost.push(e.to_string());
            (Vec::new(), Vec::new())
        });
        let mut animation = Animation { name: self.item.name.clone(), ..Animation::default() };
        for channel in &channels {
            if let Err(problem) = self.channel(channel, &samplers, &mut animation) {
                self.lost.push(format!("{}: {problem}", channel.name));
            }
        }
        animation.length_s = animation.length_s.max(SHORTEST_S);
        let speed = options.animation_speed.unwrap_or(1.0);
        animation.period_ns = ((animation.length_s / speed * 1e9).round() as i64).max(1);
        animation
    }

    /// Adds a channel to the animation, or says why not.
    fn channel(
        &mut self,
        channel: &Item,
        samplers: &[Item],
        animation: &mut Animation,
    ) -> Result<(), String> {
        let text = |e: SceneError| e.to_string();
        let target = channel.object("target").map_err(text)?.ok_or("it has no target")?;
        // Extensions name other targets, without a node.
        let Some(node) = target.index("node", self.nodes.len(), "node").map_err(text)? else { return Ok(()) };
        let sampler = channel.index("sampler", samplers.len(), "sampler").map_err(text)?;
        let sampler = &samplers[sampler.ok_or("it has no sampler")?];
        let path = target.text("path").map_err(text)?.unwrap_or("missing");
        let times = self.times(sampler)?;
        animation.length_s = animation.length_s.max(times.last().copied().unwrap_or(0.0));
        match path {
            "translation" => {
                let keys = self.keys::<3, DVec3>(sampler, times, |v| {
                    let v = DVec3::from_array(v.map(f64::from));
                    v.is_finite().then_some(v)
                })?;
                animation.nodes.entry(node).or_default().translation = Some(track(keys));
            }
            "rotation" => {
                let mut keys = self.keys::<4, DQuat>(sampler, times, |v| {
                    let q = DQuat::from_array(v.map(f64::from));
                    q.is_finite().then_some(q)
                })?;
                normalise(&mut keys)?;
                animation.nodes.entry(node).or_default().rotation = Some(track(keys));
            }
            "scale" => {
                let keys = self.keys::<3, DVec3>(sampler, times, |v| {
                    let v = DVec3::from_array(v.map(f64::from));
                    v.is_finite().then_some(v)
                })?;
                animation.nodes.entry(node).or_default().scale = Some(track(keys));
            }
            "weights" => {
                let weights = self.weights(sampler, &times)?;
                animation.nodes.entry(node).or_default().weights = Some(weights);
            }
            other => return Err(format!("'path' is {}", shorten(other))),
        }
        Ok(())
    }

    /// The rising times of a sampler.
    fn times(&mut self, sampler: &Item) -> Result<Vec<f64>, String> {
        let input = accessor(self.data, sampler, "input")?;
        // A key frame has three values at most, but for weights.
        self.spend(input.count.saturating_mul(3))?;
        if input.dimensions != 1 || input.component != Component::F32 {
            return Err(format!("{} serves as times: it must be SCALAR of 32-bit float", input.name));
        }
        let times: Vec<f64> =
            (0..input.count).map(|k| f64::from(self.data.floats::<1>(input, k)[0])).collect();
        let is_time = |t: &f64| (0.0..=LONGEST_S).contains(t);
        if !times.iter().all(is_time) || !times.windows(2).all(|pair| pair[0] < pair[1]) {
            return Err(format!(
                "{} serves as times: they must rise from one to the next, from 0",
                input.name
            ));
        }
        Ok(times)
    }

    /// The weights of morph targets, of which each key frame has as many as there are targets.
    fn weights(&mut self, sampler: &Item, times: &[f64]) -> Result<Vec<ValueTrack<f64>>, String> {
        let interpolation = interpolation(sampler)?;
        let output = accessor(self.data, sampler, "output")?;
        let small =
            matches!(output.component, Component::I8 | Component::U8 | Component::I16 | Component::U16);
        if output.dimensions != 1 || !(output.component == Component::F32 || small && output.normalized) {
            return Err(format!("{} has numbers of another type than its channel needs", output.name));
        }
        // Each target has a copy of the times.
        self.spend(output.count.saturating_mul(2))?;
        let per_key = interpolation.values_of_key();
        let targets = output.count as usize / (times.len() * per_key).max(1);
        if targets == 0 || output.count as usize != targets * times.len() * per_key {
            return Err(format!(
                "{} has {} elements, which {} key frames cannot share",
                output.name,
                output.count,
                times.len()
            ));
        }
        let value = |k: usize| f64::from(self.data.floats::<1>(output, k as u64)[0]);
        let of = |target: usize| {
            let values: Vec<f64> =
                (0..times.len() * per_key).map(|part| value(part * targets + target)).collect();
            let all_finite = values.iter().all(|v| v.is_finite());
            all_finite.then(|| track(Keys { times: times.to_vec(), values, interpolation }))
        };
        let all: Option<Vec<_>> = (0..targets).map(of).collect();
        all.ok_or_else(|| format!("{} holds what is no number", output.name))
    }

    /// Values that are about to be read, of those that may be.
    fn spend(&mut self, values: u64) -> Result<(), String> {
        self.values_left = self
            .values_left
            .checked_sub(values)
            .ok_or_else(|| format!("the key frames of the animation have more than {MOST_VALUES} values"))?;
        Ok(())
    }

    /// The key frames of a sampler; `value` refuses numbers that are none.
    fn keys<const N: usize, T: Keyed>(
        &self,
        sampler: &Item,
        times: Vec<f64>,
        value: impl Fn([f32; N]) -> Option<T>,
    ) -> Result<Keys<T>, String> {
        let interpolation = interpolation(sampler)?;
        let output = accessor(self.data, sampler, "output")?;
        let small = N == 4
            && output.normalized
            && matches!(output.component, Component::I8 | Component::U8 | Component::I16 | Component::U16);
        if output.dimensions != N as u64 || !(output.component == Component::F32 || small) {
            return Err(format!("{} has numbers of another type than its channel needs", output.name));
        }
        let needed = (times.len() * interpolation.values_of_key()) as u64;
        if output.count != needed {
            return Err(format!("{} has {} elements, and {needed} are needed", output.name, output.count));
        }
        let values: Option<Vec<T>> =
            (0..output.count).map(|k| value(self.data.floats::<N>(output, k))).collect();
        let values = values.ok_or_else(|| format!("{} holds what is no number", output.name))?;
        Ok(Keys { times, values, interpolation })
    }
}

/// How a sampler goes from key to key.
fn interpolation(sampler: &Item) -> Result<Interpolation, String> {
    match sampler.text("interpolation").map_err(|e| e.to_string())? {
        None | Some("LINEAR") => Ok(Interpolation::Linear),
        Some("STEP") => Ok(Interpolation::Step),
        Some("CUBICSPLINE") => Ok(Interpolation::CubicSpline),
        Some(other) => Err(format!("'interpolation' is {}", shorten(other))),
    }
}

/// The accessor that a sampler names by `key`.
fn accessor<'a>(data: &'a Data, sampler: &Item, key: &str) -> Result<&'a Accessor, String> {
    let index = sampler.index(key, data.accessors.len(), "accessor").map_err(|e| e.to_string())?;
    Ok(&data.accessors[index.ok_or_else(|| format!("{} has no '{key}'", sampler.name))?])
}

/// Makes the rotations of keys, but not their tangents, unit quaternions.
fn normalise(keys: &mut Keys<DQuat>) -> Result<(), String> {
    let per_key = keys.interpolation.values_of_key();
    for value in keys.values.iter_mut().skip(per_key / 2).step_by(per_key) {
        let length = value.length();
        if length.is_nan() || length < 1e-6 {
            return Err("a rotation has the length zero".into());
        }
        *value *= length.recip();
    }
    Ok(())
}

/// Exporters write keys for nodes that never move, too.
fn track<T: Keyed>(keys: Keys<T>) -> ValueTrack<T> {
    match keys.constant() {
        Some(value) => ValueTrack::Constant(value),
        None => ValueTrack::Keys(keys),
    }
}
