//! Readings at one place into a curve and a brightness for each channel, darkness and ambient light.
//!
//! Light adds up: with the ambient light (projector off) taken away, what all channels show at code 0 is the darkness of
//! the projector, and a channel's light is its reading less that. A curve never falls, so readings that fall by their
//! noise are pooled (\[Ayer55\]).

use super::Steady;
use dpm_calibration_file::light::{Channels, CURVE_POINTS};
use thiserror::Error;

/// Why readings are refused.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum LightError {
    /// A reading that every curve needs is missing.
    #[error("light: no reading of {0}")]
    Missing(String),
    /// A code outside 0 to 1, or a channel that is not there.
    #[error("light: code {code} of channel {channel} is none")]
    NoCode {
        /// Channel.
        channel: usize,
        /// Code.
        code: f64,
    },
    /// The channel is not brighter at full code than in the dark.
    #[error("light: channel {channel} gives no light: {full:.4} at code 1, {dark:.4} at code 0; is the sensor in the picture?")]
    NoLight {
        /// Channel.
        channel: usize,
        /// Level at code 1.
        full: f64,
        /// Level at code 0.
        dark: f64,
    },
    /// A curve falls by more than noise.
    #[error("light: channel {channel} falls by {percent:.1} % from code {from:.3} to {to:.3}: the sensor was moved or saturates, or the projector adapts its picture; switch that off and read again")]
    Falls {
        /// Channel.
        channel: usize,
        /// Fall over the channel's light at code 1, percent.
        percent: f64,
        /// The code before.
        from: f64,
        /// The code after.
        to: f64,
    },
    /// The readings are too noisy.
    #[error("light: levels would be uncertain by {percent:.2} %, at most {MOST_SIGMA_PERCENT} % are accepted; hold the sensor still for longer, nearer to the projector")]
    Uncertain {
        /// Three standard deviations over full white, percent.
        percent: f64,
    },
    /// The channels do not add up.
    #[error("light: all channels together give {together:.3}, one after the other {sum:.3}: the projector mixes channels (a white segment or colour management); switch that off")]
    DoesNotAdd {
        /// Level of white.
        together: f64,
        /// Sum of the channels.
        sum: f64,
    },
}

const MOST_SIGMA_PERCENT: f64 = 1.0;
/// A fall that no noise explains, as a share of the channel's light.
const MOST_FALL: f64 = 0.02;
/// Codes of each channel that are read, as shares of [`CURVE_POINTS`].
const CODES: usize = 33;

/// What the sensor should read next.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Next {
    /// Projector off or shut.
    Ambient,
    /// All channels at code 0.
    Black,
    /// One channel at a code, the others at 0.
    Code {
        /// Channel.
        channel: usize,
        /// Code, 0 to 1.
        code: f64,
    },
    /// All channels at code 1.
    White,
}

/// Readings in progress, at one place.
#[derive(Clone, Debug)]
pub struct ResponseSession {
    channels: Vec<Vec<(f64, Steady)>>,
    ambient: Option<Steady>,
    black: Option<Steady>,
    white: Option<Steady>,
}

impl ResponseSession {
    /// For a projector of some channels.
    pub fn new(channels: usize) -> Self {
        Self { channels: vec![Vec::new(); channels], ambient: None, black: None, white: None }
    }

    /// What should be read next; `None` when all is there.
    pub fn next_reading(&self) -> Option<Next> {
        let steps = (CODES - 1) as f64;
        let missing = (0..self.channels.len()).find_map(|channel| {
            let has = |code: f64| self.channels[channel].iter().any(|(c, _)| (c - code).abs() < 1e-9);
            let code = (1..CODES).rev().map(|i| i as f64 / steps).find(|c| !has(*c))?;
            Some(Next::Code { channel, code })
        });
        let first = [(self.ambient, Next::Ambient), (self.black, Next::Black), (self.white, Next::White)];
        first.into_iter().find(|(have, _)| have.is_none()).map(|(_, next)| next).or(missing)
    }

    /// Adds a reading.
    ///
    /// # Errors
    /// [`LightError::NoCode`].
    pub fn add(&mut self, what: Next, reading: Steady) -> Result<(), LightError> {
        match what {
            Next::Ambient => self.ambient = Some(reading),
            Next::Black => self.black = Some(reading),
            Next::White => self.white = Some(reading),
            Next::Code { channel, code } => {
                let sound = (0.0..=1.0).contains(&code);
                let list = self.channels.get_mut(channel).filter(|_| sound);
                list.ok_or(LightError::NoCode { channel, code })?.push((code, reading));
            }
        }
        Ok(())
    }

    /// Makes curves of the readings.
    ///
    /// # Errors
    /// Each reason of [`LightError`].
    pub fn solve(&self) -> Result<Channels, LightError> {
        let need = |r: Option<Steady>, what: &str| r.ok_or_else(|| LightError::Missing(what.into()));
        let ambient = need(self.ambient, "ambient light (projector off)")?;
        let black = need(self.black, "code 0")?;
        let mut full = Vec::new();
        for (channel, list) in self.channels.iter().enumerate() {
            let at_one: Vec<f64> = list.iter().filter(|(c, _)| *c == 1.0).map(|(_, r)| r.level).collect();
            if at_one.is_empty() || list.len() < 3 {
                return Err(LightError::Missing(format!("channel {channel} at code 1 and at two others")));
            }
            let level = at_one.iter().sum::<f64>() / at_one.len() as f64;
            if level - black.level < 20.0 * black.sigma.max(1e-12) {
                return Err(LightError::NoLight { channel, full: level, dark: black.level });
            }
            full.push(level - black.level);
        }
        let all: f64 = full.iter().sum();
        if let Some(white) = self.white {
            let together = white.level - black.level;
            if (together - all).abs() > 0.03 * all {
                return Err(LightError::DoesNotAdd { together, sum: all });
            }
        }
        let white = all + black.level - ambient.level;
        let readings = self.channels.iter().flatten().map(|(_, r)| r.sigma);
        let sigma = readings.fold(black.sigma.max(ambient.sigma), f64::max) / white;
        if 300.0 * sigma > MOST_SIGMA_PERCENT {
            return Err(LightError::Uncertain { percent: 300.0 * sigma });
        }
        let curves = self.channels.iter().zip(&full).enumerate();
        let curves = curves.map(|(channel, (list, full))| curve(channel, list, black.level, *full));
        Ok(Channels {
            curves: curves.collect::<Result<_, _>>()?,
            intensity: full.iter().map(|f| f / all).collect(),
            black: ((black.level - ambient.level) / white).max(0.0),
            ambient: ambient.level / white,
            sigma,
        })
    }
}

/// Readings of a channel into a curve that never falls.
fn curve(channel: usize, list: &[(f64, Steady)], dark: f64, full: f64) -> Result<Vec<f64>, LightError> {
    let mut points: Vec<(f64, f64, f64)> =
        list.iter().map(|(c, r)| (*c, (r.level - dark) / full, 1.0)).chain([(0.0, 0.0, 1.0)]).collect();
    points.sort_by(|a, b| a.0.total_cmp(&b.0));
    // Readings of the same code are one.
    let mut merged: Vec<(f64, f64, f64)> = Vec::new();
    for p in points {
        match merged.last_mut().filter(|last| (last.0 - p.0).abs() < 1e-9) {
            Some(last) => *last = (last.0, (last.1 * last.2 + p.1) / (last.2 + 1.0), last.2 + 1.0),
            None => merged.push(p),
        }
    }
    for pair in merged.windows(2) {
        let fall = pair[0].1 - pair[1].1;
        if fall > MOST_FALL {
            return Err(LightError::Falls { channel, percent: 100.0 * fall, from: pair[0].0, to: pair[1].0 });
        }
    }
    let level = pooled(&merged);
    let codes: Vec<f64> = merged.iter().map(|p| p.0).collect();
    let first = level[0];
    let scale = level[level.len() - 1] - first;
    let value = |code: f64| {
        let after = codes.partition_point(|c| *c < code).clamp(1, codes.len() - 1);
        let share = (code - codes[after - 1]) / (codes[after] - codes[after - 1]);
        (level[after - 1] + share * (level[after] - level[after - 1]) - first) / scale
    };
    let steps = (CURVE_POINTS - 1) as f64;
    Ok((0..CURVE_POINTS).map(|i| value(i as f64 / steps).clamp(0.0, 1.0)).collect())
}

/// The never falling levels of least squares: neighbours that fall are pooled.
fn pooled(points: &[(f64, f64, f64)]) -> Vec<f64> {
    let mut pools: Vec<(f64, f64, usize)> = Vec::new();
    for &(_, level, weight) in points {
        pools.push((level, weight, 1));
        while let [.., a, b] = pools[..] {
            if a.0 <= b.0 {
                break;
            }
            pools.truncate(pools.len() - 2);
            pools.push(((a.0 * a.1 + b.0 * b.1) / (a.1 + b.1), a.1 + b.1, a.2 + b.2));
        }
    }
    pools.into_iter().flat_map(|(level, _, n)| std::iter::repeat_n(level, n)).collect()
}
