//! Orders to the hand that holds the mock's wand: lines of the standard input into where its tip goes.

use super::say;
use dpm_device::time::HostTime;
use hil_mock::hand::{Hand, HandOrder, REACH_NS};
use hil_mock::projector::Shown;
use hil_mock::sensor_wand::ProjectorOptics;
use std::io::{BufRead, Read};
use std::sync::mpsc::{sync_channel, Receiver};
use std::sync::Arc;

/// Longest line that is read; the rest of it counts as a line of its own.
const LONGEST_LINE: u64 = 4096;
/// Lines that may wait.
const WAITING: usize = 64;
/// An order holds from so long after it was read, nanoseconds.
const LEAD_NS: i64 = 5_000_000;
/// What the lines may say.
const HELP: &str =
    "orders: wander; visit [SECONDS at each place, 2 if not told]; tip X Y Z; pivot X Y Z; touch BODY X Y Z (in the \
                    body's space); dot [BODY] X Y Z (into the middle of the light, as far away as this point); metres";

/// A line.
#[derive(Clone, Debug, PartialEq)]
enum Line {
    To(HandOrder),
    /// The tip to a point of a body's space.
    Touch(String, [f64; 3]),
    /// The tip into the middle of the light, at the depth of a point of the world or of a body's space.
    Dot(Option<String>, [f64; 3]),
}

/// How long the wand rests at each place, nanoseconds.
fn rest_ns(words: &[&str]) -> Option<i64> {
    let seconds = match words {
        [] => 2.0,
        [word] => word.parse().ok().filter(|s: &f64| (0.0..=3600.0).contains(s))?,
        _ => return None,
    };
    Some((1e9 * seconds) as i64)
}

fn line_of(text: &str) -> Option<Line> {
    let mut words = text.split_whitespace();
    let order = words.next()?;
    let words: Vec<&str> = words.collect();
    let place = |words: &[&str]| -> Option<[f64; 3]> {
        // A place may be copied as dpm prints it: (1.0, 2.0, 3.0).
        let number = |word: &str| word.trim_matches(['(', ',', ')']).parse().ok();
        let all: Option<Vec<f64>> =
            words.iter().map(|w| number(w).filter(|v: &f64| v.abs() <= 1000.0)).collect();
        all?.try_into().ok()
    };
    match order {
        "wander" if words.is_empty() => Some(Line::To(HandOrder::Wander)),
        "visit" => Some(Line::To(HandOrder::Visit { rest_ns: rest_ns(&words)? })),
        "tip" => Some(Line::To(HandOrder::Tip(place(&words)?))),
        "pivot" => Some(Line::To(HandOrder::Pivot(place(&words)?))),
        "dot" if words.len() == 3 => Some(Line::Dot(None, place(&words)?)),
        "touch" | "dot" => {
            // A body's name may have blanks.
            let (name, numbers) = words.split_at(words.len().checked_sub(3).filter(|n| *n > 0)?);
            let (name, place) = (name.join(" "), place(numbers)?);
            Some(if order == "dot" { Line::Dot(Some(name), place) } else { Line::Touch(name, place) })
        }
        _ => None,
    }
}

/// The standard input, the hand that follows it, and what it has to know.
pub(super) struct Orders {
    lines: Receiver<String>,
    hand: Arc<Hand>,
    optics: ProjectorOptics,
    width: u32,
    bodies: Vec<(String, [f64; 3])>,
    newest: Option<Shown>,
    /// When the hand will be where it was told to go, and where that is.
    arrives: Option<(HostTime, String)>,
}

impl Orders {
    /// Begins to read. `bodies` lie at rest, not turned.
    ///
    /// # Errors
    /// The system cannot start a thread.
    pub(super) fn start(
        hand: Arc<Hand>,
        optics: ProjectorOptics,
        width: u32,
        bodies: Vec<(String, [f64; 3])>,
    ) -> std::io::Result<Self> {
        let (send, lines) = sync_channel(WAITING);
        std::thread::Builder::new().name("orders".into()).spawn(move || loop {
            let mut line = String::new();
            match std::io::stdin().lock().take(LONGEST_LINE).read_line(&mut line) {
                Ok(n) if n > 0 && send.send(line).is_ok() => {}
                _ => return,
            }
        })?;
        say(format_args!("{HELP}"));
        Ok(Self { lines, hand, optics, width, bodies, newest: None, arrives: None })
    }

    /// Follows what has been said, and says what was done. `shown` is new light; `now` lies behind all samples that were taken.
    pub(super) fn follow(&mut self, shown: &[Shown], now: HostTime) {
        if let Some(newest) = shown.last() {
            self.newest = Some(newest.clone());
        }
        if let Some((_, told)) = self.arrives.take_if(|(at, _)| *at <= now) {
            say(format_args!("{told}"));
        }
        while let Ok(text) = self.lines.try_recv() {
            if text.trim().is_empty() {
                continue;
            }
            match line_of(&text).ok_or_else(|| HELP.to_owned()).and_then(|line| self.order_of(&line)) {
                Ok(order) => {
                    // No sample that was taken may lie behind the order, and other threads take them, too.
                    self.hand.tell(now.plus_ns(LEAD_NS).0, order);
                    let told = match order {
                        HandOrder::Wander => "the wand wanders".to_owned(),
                        HandOrder::Visit { .. } => "the wand rests at one place after another".to_owned(),
                        HandOrder::Tip([x, y, z]) => format!("the tip is at {x:.5} {y:.5} {z:.5}"),
                        HandOrder::Pivot([x, y, z]) => {
                            format!("the wand turns about its tip at {x:.5} {y:.5} {z:.5}")
                        }
                    };
                    self.arrives = Some((now.plus_ns(LEAD_NS + REACH_NS), told));
                }
                Err(why) => say(format_args!("{why}")),
            }
        }
    }

    fn order_of(&self, line: &Line) -> Result<HandOrder, String> {
        match line {
            Line::To(order) => Ok(*order),
            Line::Touch(name, at) => self.in_world(name, at).map(HandOrder::Tip),
            Line::Dot(name, near) => {
                let near = name.as_ref().map_or(Ok(*near), |name| self.in_world(name, near))?;
                let dark = || "there is no light on the raster".to_owned();
                let middle =
                    self.newest.as_ref().and_then(|s| middle_of_light(s, self.width)).ok_or_else(dark)?;
                self.optics.lit_near(middle, near).map(HandOrder::Tip).ok_or_else(|| {
                    format!(
                        "the light at pixel ({:.1}, {:.1}) falls on no point near there",
                        middle[0], middle[1]
                    )
                })
            }
        }
    }

    /// A point of a body's space in the world.
    fn in_world(&self, name: &str, at: &[f64; 3]) -> Result<[f64; 3], String> {
        let body = self.bodies.iter().find(|(n, _)| n == name);
        let (_, place) = body.ok_or_else(|| format!("no --body is named \"{name}\""))?;
        Ok(std::array::from_fn(|i| place[i] + at[i]))
    }
}

/// The middle of all pixels that are lit in any plane, pixels from the upper left corner; `None` in the dark.
fn middle_of_light(shown: &Shown, width: u32) -> Option<[f64; 2]> {
    let row_bytes = (width as usize).div_ceil(8);
    let plane_bytes = shown.planes.len() / shown.schedule.planes().len().max(1);
    let (mut sum, mut count) = ([0.0, 0.0], 0.0);
    for i in 0..plane_bytes {
        let lit = shown.planes.iter().skip(i).step_by(plane_bytes).fold(0, |a, b| a | b);
        for bit in (0..8).filter(|bit| lit << bit & 0x80 != 0) {
            let (x, y) = ((i % row_bytes) * 8 + bit, i / row_bytes);
            sum = [sum[0] + x as f64 + 0.5, sum[1] + y as f64 + 0.5];
            count += 1.0;
        }
    }
    (count > 0.0).then(|| sum.map(|s| s / count))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_orders_and_others_are_none() {
        assert_eq!(line_of("wander\n"), Some(Line::To(HandOrder::Wander)));
        assert_eq!(line_of(" tip 1 -2 0.5 "), Some(Line::To(HandOrder::Tip([1.0, -2.0, 0.5]))));
        assert_eq!(line_of("visit"), Some(Line::To(HandOrder::Visit { rest_ns: 2_000_000_000 })));
        assert_eq!(line_of("visit 3.5"), Some(Line::To(HandOrder::Visit { rest_ns: 3_500_000_000 })));
        assert_eq!(line_of("pivot 0 0 0"), Some(Line::To(HandOrder::Pivot([0.0; 3]))));
        assert_eq!(line_of("dot 0 0 1e-1"), Some(Line::Dot(None, [0.0, 0.0, 0.1])));
        assert_eq!(line_of("dot box 0 0 1"), Some(Line::Dot(Some("box".into()), [0.0, 0.0, 1.0])));
        assert_eq!(line_of("touch left foot 0 1 0"), Some(Line::Touch("left foot".into(), [0.0, 1.0, 0.0])));
        let copied = line_of("touch bunny (-0.0156, 0.0990, 0.0015)");
        assert_eq!(copied, Some(Line::Touch("bunny".into(), [-0.0156, 0.099, 0.0015])));
        for bad in [
            "",
            "tip",
            "tip 1 2",
            "tip 1 2 3 4",
            "tip nan 0 0",
            "tip 1e9 0 0",
            "touch 1 2 3",
            "wander off",
            "visit -1",
            "visit 1 2",
            "x",
        ] {
            assert_eq!(line_of(bad), None, "{bad}");
        }
    }
}
