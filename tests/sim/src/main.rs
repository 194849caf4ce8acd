//! `dpm-sim`: hours of rig, with every fault, in minutes.

use dpm_sim::guard::Guard;
use dpm_sim::kinds::Kind;
use dpm_sim::life::{live, shrink, Lived, Order};
use dpm_sim::plan::TrackerKind;
use dpm_sim::table::Table;
use dpm_sim::tracks::Placed;
use std::collections::{BTreeMap, BTreeSet};
use std::process::ExitCode;
use std::time::Instant;

const HELP: &str = "\
dpm-sim: a simulated world around the rig, with every fault in every state

  --hours H       simulated hours; default 0.2
  --seed N        first seed; default: a fresh one, which is printed
  --rate HZ       frames per second of every life; default: each seed's own
  --life S        simulated seconds of each seed; default 120
  --tracks WHO    all or none: whose projector follows tracks; default: a third of the seeds'
  --serial WHO    all, none or some: whose projector hangs on a serial line; default: some, a fifth of the seeds'
                  (none of --tracks all)
  --tracker WHAT  natnet, serial, vrpn or all: what the trackers speak; default: all, a fifth of the seeds' serial and
                  a fifth VRPN
  --kinds LIST    kinds of faults, as T18,X9; every episode begins with one of them in lives that they can strike;
                  default: all in turn. With X17 or X18, which strike an eighth of the seeds', and with
                  X27 or X28, which strike a quarter of them, all lives are for them
  --alone WHO     which guard of the light stands alone: watchdog, dark-from, age, orders, session, clock, interlock,
                  by-hand, limits, unconfirmed, latch, eyes; none; or some: default, one of them in three of five
                  seeds (none of --tracks all, --serial all and --kinds)
  --until EVENT   stop the (single) seed at this event and print what happened
  --without LIST  numbers of faults that do not strike, as a shrunk seed names them
  --minutes M     end after so many minutes of real time
  --table FILE    write the table of kinds and states there, as Markdown
  --loud          print everything that happens
  --first         end with the first seed that breaks a law
  --no-shrink     do not shrink a seed that breaks a law
  --json          the last line is a JSON object
";

/// In whose lives which guard of the light stands alone.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Alone {
    AsDrawn,
    Of(Option<Guard>),
}

impl Alone {
    fn named(word: &str) -> Result<Self, String> {
        match word {
            "some" => Ok(Self::AsDrawn),
            "none" => Ok(Self::Of(None)),
            _ => match Guard::ALL.into_iter().find(|guard| guard.word() == word) {
                Some(guard) => Ok(Self::Of(Some(guard))),
                None => Err(format!("--alone {word:?}: no such guard; --help has them")),
            },
        }
    }
}

struct Wish {
    hours: f64,
    seed: Option<u64>,
    rate: Option<u32>,
    life_s: f64,
    follows: Option<bool>,
    serial: Option<bool>,
    tracker: Option<TrackerKind>,
    alone: Alone,
    first: Vec<Kind>,
    until: Option<u64>,
    without: BTreeSet<u32>,
    minutes: Option<f64>,
    table: Option<String>,
    is_loud: bool,
    is_first: bool,
    shrinks: bool,
    json: bool,
}

fn wish() -> Result<Wish, String> {
    let mut wish = Wish {
        hours: 0.2,
        seed: None,
        rate: None,
        life_s: 120.0,
        follows: None,
        serial: None,
        tracker: None,
        alone: Alone::AsDrawn,
        first: Vec::new(),
        until: None,
        without: BTreeSet::new(),
        minutes: None,
        table: None,
        is_loud: false,
        is_first: false,
        shrinks: true,
        json: false,
    };
    let mut args = std::env::args().skip(1);
    while let Some(arg) = args.next() {
        let mut value = || args.next().ok_or_else(|| format!("{arg} needs a value\n\n{HELP}"));
        fn number<T: std::str::FromStr>(text: &str) -> Result<T, String> {
            text.parse().map_err(|_| format!("{text:?} is no number that fits here"))
        }
        match arg.as_str() {
            "--hours" => wish.hours = number(&value()?)?,
            "--seed" => wish.seed = Some(number(&value()?)?),
            "--rate" => wish.rate = Some(number(&value()?)?),
            "--life" => wish.life_s = number(&value()?)?,
            "--tracks" => match value()?.as_str() {
                "all" => wish.follows = Some(true),
                "none" => wish.follows = Some(false),
                other => return Err(format!("--tracks {other:?}: give \"all\" or \"none\"")),
            },
            "--serial" => match value()?.as_str() {
                "all" => wish.serial = Some(true),
                "none" => wish.serial = Some(false),
                "some" => wish.serial = None,
                other => return Err(format!("--serial {other:?}: give \"all\", \"none\" or \"some\"")),
            },
            "--tracker" => wish.tracker = tracker_named(&value()?)?,
            "--kinds" => wish.first = kinds_named(&value()?)?,
            "--alone" => wish.alone = Alone::named(&value()?)?,
            "--until" => wish.until = Some(number(&value()?)?),
            "--without" => {
                for word in value()?.split(',').filter(|word| !word.is_empty()) {
                    wish.without.insert(number(word)?);
                }
            }
            "--minutes" => wish.minutes = Some(number(&value()?)?),
            "--table" => wish.table = Some(value()?),
            "--loud" => wish.is_loud = true,
            "--first" => wish.is_first = true,
            "--no-shrink" => wish.shrinks = false,
            "--json" => wish.json = true,
            "--help" | "-h" => return Err(HELP.into()),
            other => return Err(format!("unknown argument {other:?}\n\n{HELP}")),
        }
    }
    let is_number = |x: f64| x.is_finite() && x > 0.0;
    if !is_number(wish.hours) || !is_number(wish.life_s) || wish.rate == Some(0) {
        return Err("--hours, --life and --rate must be greater than 0".into());
    }
    let has_other_rigs = wish.serial == Some(true) || wish.follows == Some(true) || !wish.first.is_empty();
    if has_other_rigs {
        if matches!(wish.alone, Alone::Of(Some(_))) {
            return Err("--alone: not with --tracks all, --serial all or --kinds".into());
        }
        wish.alone = Alone::Of(None);
    }
    if wish.serial == Some(true) && wish.follows == Some(true) {
        return Err("--serial all and --tracks all: no tracks are sent on a serial line".into());
    }
    Ok(wish)
}

/// What all trackers of a campaign speak; `None`: each what its seed says.
fn tracker_named(word: &str) -> Result<Option<TrackerKind>, String> {
    let kinds = [TrackerKind::NatNet, TrackerKind::Serial, TrackerKind::Vrpn];
    match kinds.into_iter().find(|kind| kind.word() == word) {
        None if word != "all" => {
            Err(format!("--tracker {word:?}: give \"natnet\", \"serial\", \"vrpn\" or \"all\""))
        }
        found => Ok(found),
    }
}

/// The kinds that a list names.
fn kinds_named(list: &str) -> Result<Vec<Kind>, String> {
    let named = |word: &str| {
        let found = Kind::ALL.iter().copied().find(|kind| format!("{kind:?}") == word);
        found.ok_or_else(|| format!("--kinds {word:?}: no such kind; docs/FAILURES.md has them"))
    };
    list.split(',').filter(|word| !word.is_empty()).map(named).collect()
}

/// A seed that nobody has chosen.
fn fresh() -> u64 {
    use std::hash::{BuildHasher, Hasher};
    std::hash::RandomState::new().build_hasher().finish() >> 16
}

/// What a campaign has seen.
#[derive(Default)]
struct Sum {
    length_ns: i64,
    table: Table,
    failures: Vec<String>,
    by_rate: BTreeMap<u32, (i64, f64, u64)>,
    worst_age_milli: i64,
    worst_lag_milli: i64,
    slowest_return_ns: i64,
    lives: u64,
    following: u64,
    on_lines: u64,
    /// Lives whose tracker hangs on a serial line, and those whose tracker is a VRPN server.
    other_trackers: [u64; 2],
    /// Lives in which each guard stood alone.
    alone: [u64; Guard::ALL.len()],
    planes_moved: u64,
    placed: Placed,
}

fn report(lived: &Lived, order: &Order, shrinks: bool) -> Result<String, String> {
    let Some(broken) = &lived.broken else { return Ok(String::new()) };
    println!("seed {}: {} (at {:.3} s)", order.seed, broken.told, broken.at as f64 * 1e-9);
    let (small, least) =
        if shrinks { shrink(order, broken.at, &lived.faults)? } else { (order.clone(), lived.clone()) };
    let told = least.broken.as_ref().map_or("", |broken| broken.told.as_str());
    println!("  {:?}", least.setup);
    least.story.iter().rev().take(40).rev().for_each(|line| println!("  {line}"));
    let without: Vec<String> = small.without.iter().map(u32::to_string).collect();
    let rate = order.rate_hz.map_or(String::new(), |hz| format!(" --rate {hz}"));
    let tracks = match order.follows {
        None => "",
        Some(true) => " --tracks all",
        Some(false) => " --tracks none",
    };
    println!("  LAW: {told}");
    let serial = match order.serial {
        None => "",
        Some(true) => " --serial all",
        Some(false) => " --serial none",
    };
    let alone = format!(" --alone {}", order.alone.map_or("none", Guard::word));
    let tracker = order.tracker.map_or(String::new(), |kind| format!(" --tracker {}", kind.word()));
    let kinds: Vec<String> = order.first.iter().map(|kind| format!("{kind:?}")).collect();
    let kinds = if kinds.is_empty() { String::new() } else { format!(" --kinds {}", kinds.join(",")) };
    println!(
        "  again: --seed {}{rate}{tracks}{serial}{tracker}{kinds}{alone} --life {:.0} --hours 0.0001 --loud --without {}",
        order.seed,
        (least.length_ns as f64 * 1e-9).ceil() + 1.0,
        if without.is_empty() { "\"\"".into() } else { without.join(",") }
    );
    Ok(told.to_owned())
}

fn run() -> Result<bool, String> {
    let wish = wish()?;
    let first = wish.seed.unwrap_or_else(fresh);
    println!("seeds from {first}");
    let begin = Instant::now();
    let mut sum = Sum::default();
    let mut seed = first;
    while (sum.length_ns as f64) < wish.hours * 3.6e12
        && wish.minutes.is_none_or(|m| begin.elapsed().as_secs_f64() < m * 60.0)
    {
        let order = Order {
            seed,
            length_ns: (wish.life_s * 1e9) as i64,
            rate_hz: wish.rate,
            follows: wish.follows,
            serial: wish.serial,
            tracker: wish.tracker,
            strained: wish.first.iter().any(|kind| kind.needs_strain()).then_some(true),
            flaky: wish.first.iter().any(|kind| kind.needs_flakiness()).then_some(true),
            alone: match wish.alone {
                Alone::AsDrawn => Guard::drawn(seed),
                Alone::Of(guard) => guard,
            },
            first: wish.first.clone(),
            without: wish.without.clone(),
            until: wish.until,
            is_loud: wish.is_loud,
        };
        let watch = Instant::now();
        let lived = live(&order)?;
        let took = watch.elapsed().as_secs_f64();
        let entry = sum.by_rate.entry(lived.setup.rate_hz).or_default();
        *entry = (entry.0 + lived.length_ns, entry.1 + took, entry.2 + lived.table.total());
        sum.length_ns += lived.length_ns;
        sum.table.add(&lived.table);
        sum.worst_age_milli = sum.worst_age_milli.max(lived.worst_age_milli);
        sum.worst_lag_milli = sum.worst_lag_milli.max(lived.worst_lag_milli);
        sum.slowest_return_ns = sum.slowest_return_ns.max(lived.slowest_return_ns);
        sum.lives += 1;
        sum.following += u64::from(lived.setup.follows);
        sum.on_lines += u64::from(lived.setup.serial.is_some());
        sum.other_trackers[0] += u64::from(lived.setup.tracker.kind() == TrackerKind::Serial);
        sum.other_trackers[1] += u64::from(lived.setup.tracker.kind() == TrackerKind::Vrpn);
        if let Some(guard) = lived.setup.alone {
            sum.alone[guard as usize] += 1;
        }
        sum.planes_moved += lived.planes_moved;
        sum.placed.add(&lived.placed);
        if lived.broken.is_some() {
            let told = report(&lived, &order, wish.shrinks && wish.until.is_none())?;
            sum.failures.push(format!("{seed}: {told}"));
            if wish.is_first {
                break;
            }
        }
        if wish.until.is_some() {
            lived.story.iter().for_each(|line| println!("{line}"));
            println!(
                "event {} at {:.9} s, trace {:016x}",
                lived.events,
                lived.length_ns as f64 * 1e-9,
                lived.trace
            );
            break;
        }
        if wish.is_loud {
            println!("trace {:016x}", lived.trace);
        }
        seed = seed.wrapping_add(1);
    }
    for (rate, (ns, took, faults)) in &sum.by_rate {
        let hours = *ns as f64 / 3.6e12;
        println!(
            "{rate:>5} frames/s: {hours:.2} h in {took:.0} s, {:.2} h a minute, {faults} faults, {:.0} a minute",
            hours / took * 60.0,
            *faults as f64 / took * 60.0
        );
    }
    let hours = sum.length_ns as f64 / 3.6e12;
    let below = sum.table.cells_below(1000);
    println!(
        "{hours:.2} h in {} lives ({} on serial lines; trackers: {} serial, {} VRPN), {} faults, {} of them with an effect that was seen, {} laws broken; cells below 1000: {below}, never with an effect: {}; of what is allowed: \
         oldest pose {:.0} %, lag of a second {:.0} %; slowest return of light {:.2} s; {:.0} s of real time",
        sum.lives,
        sum.on_lines,
        sum.other_trackers[0],
        sum.other_trackers[1],
        sum.table.total(),
        sum.table.effects(),
        sum.failures.len(),
        sum.table.cells_below(1),
        sum.worst_age_milli as f64 / 10.0,
        sum.worst_lag_milli as f64 / 10.0,
        sum.slowest_return_ns as f64 * 1e-9,
        begin.elapsed().as_secs_f64()
    );
    let alone = Guard::ALL.map(|guard| format!("{} {}", sum.alone[guard as usize], guard.word()));
    println!("lives in which one guard stood alone: {}", alone.join(", "));
    let rms = |sum_px2: f64| (sum_px2 / sum.placed.moved.max(1) as f64).sqrt();
    println!(
        "{} of the lives with tracks: {} planes moved; the light of {} was judged: {:.2} mirrors off the body (rms), and \
         without tracks it would have been {:.2}",
        sum.following,
        sum.planes_moved,
        sum.placed.moved,
        rms(sum.placed.with),
        rms(sum.placed.without)
    );
    if let Some(path) = &wish.table {
        std::fs::write(path, sum.table.to_markdown()).map_err(|e| format!("{path}: {e}"))?;
    }
    if wish.json {
        println!(
            "{{\"hours\": {hours:.4}, \"faults\": {}, \"failures\": {}, \"cells_below_1000\": {below}, \"seed\": {first}}}",
            sum.table.total(),
            sum.failures.len()
        );
    }
    Ok(sum.failures.is_empty())
}

fn main() -> ExitCode {
    match run() {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::from(1),
        Err(told) => {
            eprintln!("{told}");
            ExitCode::from(2)
        }
    }
}
