//! From what a rig file wants and what a card offers to what is set, or to why it cannot be.

use dpm_device::planes::{PlaneSchedule, Raster};
use dpm_device::time::FrameRate;

use crate::encoding::{Encoding, PixelMap};
use crate::kms::{Connector, Domain, Property, PropertyOwner, ScanOutSetup};
use crate::mode::{written, ModeWish, Timing};
use crate::panel::PanelSettings;

/// What a rig file says of its display.
#[derive(Clone, Debug)]
pub struct DisplaySettings {
    /// The connector, as `/sys/class/drm` names it; the only connected one if `None`.
    pub connector: Option<String>,
    /// The mode.
    pub mode: ModeWish,
    /// What the bits of a pixel mean.
    pub encoding: Encoding,
    /// Properties that a physical connector may lack although the encoding needs them.
    pub without: Vec<String>,
    /// From the choice of a frame to the vertical blank from which on it is scanned out, nanoseconds; half of the blank is
    /// added to it, or with `shows_at_pulse` the time from the pulse in it to the first row.
    pub commit_ns: i64,
    /// What the display feeds shows a frame from the vertical pulse on that follows its last row, instead of row by row: a
    /// controller that cuts frames into patterns.
    pub shows_at_pulse: bool,
    /// The rig's raster.
    pub raster: Raster,
    /// The rig's planes.
    pub schedule: PlaneSchedule,
    /// The rig's frame rate.
    pub rate: FrameRate,
}

/// What was chosen.
#[derive(Clone, Debug)]
pub struct Plan {
    /// What the kernel is told.
    pub setup: ScanOutSetup,
    /// What the panel has to know.
    pub panel: PanelSettings,
    /// What the operator should know.
    pub warnings: Vec<String>,
}

/// A property that must have one value, and by which of several words a driver calls it.
struct Wish {
    owner: PropertyOwner,
    name: &'static str,
    value: Wishes,
    /// Bits are lost on a physical connector without it.
    is_needed: bool,
}

enum Wishes {
    Number(u64),
    Word(&'static [&'static str]),
}

/// What keeps the bits of a pixel exact: eight bits for each colour, full range, RGB, no dithering, no tables, no variable
/// refresh. Names are the kernel's; each driver has some of them.
const WISHES: [Wish; 16] = {
    use PropertyOwner::{Connector as C, Crtc, Plane};
    const fn wish(owner: PropertyOwner, name: &'static str, value: Wishes, is_needed: bool) -> Wish {
        Wish { owner, name, value, is_needed }
    }
    [
        wish(C, "max bpc", Wishes::Number(8), true),
        wish(C, "Broadcast RGB", Wishes::Word(&["Full"]), true),
        wish(C, "Colorspace", Wishes::Word(&["Default", "RGB_Wide_Gamut_Fixed_Point"]), false),
        wish(C, "color format", Wishes::Word(&["rgb", "RGB"]), false),
        wish(C, "dithering mode", Wishes::Word(&["off"]), false),
        wish(C, "dither", Wishes::Word(&["off"]), false),
        wish(C, "underscan", Wishes::Word(&["off"]), false),
        wish(C, "scaling mode", Wishes::Word(&["None"]), false),
        wish(C, "HDR_OUTPUT_METADATA", Wishes::Number(0), false),
        wish(Crtc, "DEGAMMA_LUT", Wishes::Number(0), false),
        wish(Crtc, "CTM", Wishes::Number(0), false),
        wish(Crtc, "GAMMA_LUT", Wishes::Number(0), false),
        wish(Crtc, "VRR_ENABLED", Wishes::Number(0), false),
        wish(Plane, "rotation", Wishes::Word(&["rotate-0"]), false),
        wish(Plane, "alpha", Wishes::Number(0xffff), false),
        wish(Plane, "pixel blend mode", Wishes::Word(&["None", "Pre-multiplied"]), false),
    ]
};

/// Why a display cannot be used as the rig file says.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct SetUpRefusal(pub String);

fn refuse<T>(text: impl Into<String>) -> Result<T, SetUpRefusal> {
    Err(SetUpRefusal(text.into()))
}

/// Chooses connector, mode and properties.
///
/// # Errors
/// Everything that would show other bits than were packed, at another rate, or nothing: named, with what to write instead.
pub fn plan(connectors: &[Connector], settings: &DisplaySettings) -> Result<Plan, SetUpRefusal> {
    let connector = connector(connectors, settings.connector.as_deref())?;
    let named = |what: String| SetUpRefusal(format!("{}: projector.backend.mode: {what}", connector.name));
    let timing = settings.mode.choose(&connector.modes).map_err(named)?;
    check_timing(&timing, settings)?;
    let Some(map) = PixelMap::new(settings.encoding, &settings.schedule) else {
        return refuse(format!(
            "projector.planes = {} do not fit projector.backend.encoding; write projector.planes = 24",
            settings.schedule.len()
        ));
    };
    let period_ns = settings.rate.slot_len_ns(0);
    let before_ns = if settings.shows_at_pulse {
        (period_ns - timing.pulse_ns()).max(0)
    } else {
        (period_ns - timing.scan_ns()).max(0) / 2
    };
    let lead_ns = settings.commit_ns + before_ns;
    if lead_ns * 10 > period_ns * 9 {
        let most_us = (period_ns * 9 / 10 - before_ns).max(0) / 1000;
        return refuse(format!(
            "projector.backend.commit_us = {} leaves no time at {timing}; write {most_us} at most",
            settings.commit_ns / 1000
        ));
    }
    let mut warnings = Vec::new();
    let properties = properties(connector, settings, &mut warnings)?;
    let setup = ScanOutSetup { connector: connector.name.clone(), timing, properties };
    let (raster, planes) = (settings.raster, settings.schedule.len());
    Ok(Plan { setup, panel: PanelSettings { raster, planes, map, rate: settings.rate, lead_ns }, warnings })
}

fn connector<'a>(all: &'a [Connector], wish: Option<&str>) -> Result<&'a Connector, SetUpRefusal> {
    let names = |only_connected: bool| {
        let named: Vec<&str> =
            all.iter().filter(|c| c.is_connected || !only_connected).map(|c| c.name.as_str()).collect();
        named.join(", ")
    };
    match wish {
        Some(name) => match all.iter().find(|c| c.name == name) {
            Some(c) if c.is_connected => Ok(c),
            Some(_) => refuse(format!(
                "{name}: no display answers there (with one: {}); is it plugged in and switched on?",
                or_none(names(true))
            )),
            None => refuse(format!(
                "projector.backend.connector = {name:?}: the card has no such connector, but {}",
                or_none(names(false))
            )),
        },
        None => {
            let mut connected = all.iter().filter(|c| c.is_connected);
            match (connected.next(), connected.next()) {
                (Some(one), None) => Ok(one),
                (None, _) => refuse(format!(
                    "no display answers at any connector ({}); is it plugged in and switched on?",
                    or_none(names(false))
                )),
                _ => refuse(format!(
                    "displays answer at {}; write the one to drive as projector.backend.connector",
                    names(true)
                )),
            }
        }
    }
}

fn or_none(names: String) -> String {
    if names.is_empty() {
        "none".into()
    } else {
        names
    }
}

fn check_timing(timing: &Timing, settings: &DisplaySettings) -> Result<(), SetUpRefusal> {
    let (width, height) = timing.size();
    let raster = settings.raster;
    if (width, height) != (raster.width(), raster.height()) {
        return refuse(format!(
            "projector.width = {} and projector.height = {} are not the mode's {width} x {height}; write these",
            raster.width(),
            raster.height()
        ));
    }
    if !timing.is_progressive() {
        return refuse(format!("{timing} does not scan every row once a frame; choose a progressive mode"));
    }
    let Some(rate) = timing.rate() else {
        return refuse(format!("projector.backend.mode: {timing} has no rate"));
    };
    let is_equal = |a: FrameRate, b: FrameRate| {
        u64::from(a.num()) * u64::from(b.den()) == u64::from(b.num()) * u64::from(a.den())
    };
    if !is_equal(rate, settings.rate) {
        return refuse(format!(
            "projector.frame_rate = {} is not the rate of {timing}, which is {} kHz / ({} x {}); write frame_rate = {}",
            written(settings.rate),
            timing.clock_khz,
            timing.row[3],
            timing.frame[3],
            written(rate)
        ));
    }
    Ok(())
}

/// The value of `wish` for `property`; `None` if it does not take it.
fn value_for(wish: &Wish, property: &Property) -> Option<u64> {
    match (&wish.value, &property.domain) {
        (Wishes::Number(n), Domain::Range(low, high)) => (low..=high).contains(&n).then_some(*n),
        (Wishes::Number(0), Domain::Blob) => Some(0),
        (Wishes::Word(words), Domain::Words(known)) => words.iter().find_map(|word| {
            known.iter().find(|(name, _)| name.eq_ignore_ascii_case(word)).map(|(_, value)| *value)
        }),
        _ => None,
    }
}

fn properties(
    connector: &Connector,
    settings: &DisplaySettings,
    warnings: &mut Vec<String>,
) -> Result<Vec<(PropertyOwner, String, u64)>, SetUpRefusal> {
    let mut set = Vec::new();
    let mut lacking = Vec::new();
    for wish in &WISHES {
        let found = connector.properties.iter().find(|p| p.owner == wish.owner && p.name == wish.name);
        match found.map(|p| (p, value_for(wish, p))) {
            Some((p, Some(value))) if p.is_mutable => set.push((p.owner, p.name.clone(), value)),
            // What cannot be changed is right as it is, or not.
            Some((p, Some(value))) if p.value == value => {}
            // A property that is there and cannot have the value is as bad as one that is not there.
            Some(_) => lacking.push(wish),
            None if wish.is_needed => lacking.push(wish),
            None => {}
        }
    }
    if connector.is_virtual {
        return Ok(set);
    }
    let is_waived = |wish: &Wish| settings.without.iter().any(|name| name.eq_ignore_ascii_case(wish.name));
    let named =
        |wishes: &[&Wish]| wishes.iter().map(|w| format!("{:?}", w.name)).collect::<Vec<_>>().join(", ");
    let refused: Vec<&Wish> = lacking.iter().copied().filter(|w| !is_waived(w)).collect();
    if settings.encoding == Encoding::Planes24 && !refused.is_empty() {
        return refuse(format!(
            "{}: its driver cannot set {}, so the bits of a pixel may be changed on their way (docs/DISPLAY.md, \"Bits\"); use another \
             card or connector, or, if you have measured that they arrive, write projector.backend.without = [{}]",
            connector.name,
            named(&refused),
            named(&refused)
        ));
    }
    if !lacking.is_empty() {
        warnings.push(format!(
            "{}: its driver cannot set {}: colours may be changed on their way (range, depth, dithering)",
            connector.name,
            named(&lacking)
        ));
    }
    Ok(set)
}
