//! Runs one seed for a while, and shrinks it if a law was broken.

use crate::guard::Guard;
use crate::kinds::Kind;
use crate::laws::Broken;
use crate::plan::{Episodes, Setup, TrackerKind};
use crate::table::Table;
use crate::tracks::Placed;
use crate::world::{World, S};
use std::collections::BTreeSet;

/// What to run.
#[derive(Clone, Debug)]
pub struct Order {
    /// The seed.
    pub seed: u64,
    /// Simulated time, nanoseconds.
    pub length_ns: i64,
    /// Frames per second, if not the seed's own.
    pub rate_hz: Option<u32>,
    /// Whether the projector follows tracks, if not as the seed says.
    pub follows: Option<bool>,
    /// Whether the projector hangs on a serial line, if not as the seed says.
    pub serial: Option<bool>,
    /// What the tracker speaks, if not as the seed says.
    pub tracker: Option<TrackerKind>,
    /// Whether the life is strained, if not as the seed says.
    pub strained: Option<bool>,
    /// Whether single calls fail, if not as the seed says.
    pub flaky: Option<bool>,
    /// The guard of the light that stands alone; the projector then has neither tracks nor a serial line.
    pub alone: Option<Guard>,
    /// The kinds of which one strikes first in every episode; empty: all in turn.
    pub first: Vec<Kind>,
    /// Faults that do not strike, by number.
    pub without: BTreeSet<u32>,
    /// Stop at this event.
    pub until: Option<u64>,
    /// Print what happens.
    pub is_loud: bool,
}

/// What came of a life.
#[derive(Clone, Debug)]
pub struct Lived {
    /// The rig.
    pub setup: Setup,
    /// Simulated time, nanoseconds.
    pub length_ns: i64,
    /// Faults by kind and state.
    pub table: Table,
    /// The broken law.
    pub broken: Option<Broken>,
    /// Numbers of the faults of all episodes that began.
    pub faults: Vec<u32>,
    /// Hash of everything that happened.
    pub trace: u64,
    /// Events.
    pub events: u64,
    /// The last things that happened.
    pub story: Vec<String>,
    /// The worst age of a pose, in thousandths of what is allowed.
    pub worst_age_milli: i64,
    /// See [`Laws::worst_lag_milli`](crate::laws::Laws::worst_lag_milli).
    pub worst_lag_milli: i64,
    /// The longest time from calm to light, nanoseconds.
    pub slowest_return_ns: i64,
    /// Planes of which tracks moved light, and how far it was from the body.
    pub planes_moved: u64,
    /// See `planes_moved`.
    pub placed: Placed,
}

/// Runs a life.
///
/// # Errors
/// The world cannot be made, which is a mistake in this program.
pub fn live(order: &Order) -> Result<Lived, String> {
    let setup = match order.alone {
        Some(guard) => Setup::alone(order.seed, order.rate_hz, order.tracker, guard),
        None => Setup::of(order.seed, order.rate_hz, order.follows, order.serial, order.tracker)
            .strained(order.strained)
            .flaky(order.flaky),
    };
    let mut world = World::new(setup.clone())?;
    world.is_loud = order.is_loud;
    world.laws.is_loud = order.is_loud;
    if let Some(tracks) = &mut world.tracks {
        tracks.is_loud = order.is_loud;
    }
    let mut episodes = Episodes::new(&world.setup, &order.first);
    let mut faults = Vec::new();
    let mut next = episodes.next_episode();
    let mut ready_since = None;
    while world.t < order.length_ns && order.until.is_none_or(|until| world.events < until) {
        if !world.step() {
            break;
        }
        if !world.is_ready() {
            ready_since = None;
            continue;
        }
        let since = *ready_since.get_or_insert(world.t);
        if world.t - since >= next.rest_ns {
            ready_since = None;
            let mut episode = std::mem::replace(&mut next, episodes.next_episode());
            faults.extend(episode.faults.iter().map(|fault| fault.number));
            episode.faults.retain(|fault| !order.without.contains(&fault.number));
            if !episode.faults.is_empty() {
                world.begin(episode);
            }
        }
    }
    Ok(Lived {
        setup,
        length_ns: world.t,
        table: std::mem::take(&mut world.table),
        broken: world.laws.broken.clone(),
        faults,
        trace: world.trace,
        events: world.events,
        story: world.story.into(),
        worst_age_milli: world.laws.worst_age_milli,
        worst_lag_milli: world.laws.worst_lag_milli(),
        slowest_return_ns: world.laws.slowest_return_ns,
        planes_moved: world.tracks.as_ref().map_or(0, |tracks| tracks.planes_moved),
        placed: world.tracks.as_ref().map_or(Placed::default(), |tracks| tracks.placed),
    })
}

/// Drops faults from a life that breaks a law as long as some law is still broken. Returns the smaller order.
///
/// # Errors
/// As [`live`].
pub fn shrink(order: &Order, broken_at: i64, faults: &[u32]) -> Result<(Order, Lived), String> {
    let mut best = Order { length_ns: broken_at + 10 * S, is_loud: false, ..order.clone() };
    let mut lived = live(&best)?;
    let mut kept: Vec<u32> = faults.to_vec();
    let mut size = kept.len().div_ceil(2).max(1);
    let mut tries = 0;
    while size > 0 && tries < 200 {
        let mut from = 0;
        let mut has_shrunk = false;
        while from < kept.len() && tries < 200 {
            let until = (from + size).min(kept.len());
            let mut trial = best.clone();
            trial.without.extend(&kept[from..until]);
            tries += 1;
            let outcome = live(&trial)?;
            if let Some(broken) = &outcome.broken {
                trial.length_ns = trial.length_ns.min(broken.at + 10 * S);
                kept.drain(from..until);
                (best, lived, has_shrunk) = (trial, outcome, true);
            } else {
                from = until;
            }
        }
        if !has_shrunk {
            size /= 2;
        } else {
            size = size.min(kept.len().div_ceil(2).max(1));
        }
    }
    Ok((best, lived))
}
