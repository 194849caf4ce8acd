//! Which output of an X server is which connector of the kernel.
//!
//! Drivers tell the kernel's number of a connector as the property CONNECTOR_ID of their output. Those that do not are known
//! by how they name outputs: "HDMI-A-1" of the kernel is "HDMI-1" to Xorg's own driver, "HDMI1" to Intel's, and "HDMI-A-0" to
//! AMD's, which counts from 0.

/// An output as the X server describes it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct X11Output {
    /// The server's number of it.
    pub id: u32,
    /// Its name.
    pub name: String,
    /// The kernel's number of its connector, if the driver tells it.
    pub connector_id: Option<u32>,
    /// A display answers there.
    pub is_connected: bool,
    /// The CRTC that shows the desktop there; 0 if none.
    pub crtc: u32,
    /// The CRTCs that can drive it. None, if it is on lease.
    pub crtcs: Vec<u32>,
}

/// The output at the kernel's connector `wanted`; `None` if there is none, or if it is not clear which. `kernel`: numbers and
/// names of connectors, as far as they are known; on machines with several cards, numbers may occur more than once.
pub fn find<'a>(outputs: &'a [X11Output], wanted: &str, kernel: &[(u32, String)]) -> Option<&'a X11Output> {
    let counts_from_0 = outputs.iter().any(|output| output.name.ends_with("-0"));
    let is_named = |output: &&X11Output| is_same(wanted, &output.name, counts_from_0);
    let ids: Vec<u32> = kernel.iter().filter(|(_, name)| name == wanted).map(|(id, _)| *id).collect();
    let tells = outputs.iter().any(|output| output.connector_id.is_some());
    if !tells || ids.is_empty() {
        return only(outputs.iter().filter(is_named));
    }
    let by_id = || outputs.iter().filter(|output| output.connector_id.is_some_and(|id| ids.contains(&id)));
    only(by_id()).or_else(|| only(by_id().filter(is_named)))
}

fn only<T>(mut all: impl Iterator<Item = T>) -> Option<T> {
    all.next().filter(|_| all.next().is_none())
}

/// True if an X server that counts from 0 or 1 may call the kernel's connector `kernel` so.
fn is_same(kernel: &str, output: &str, counts_from_0: bool) -> bool {
    let Some((kind, number)) = split(kernel) else { return kernel == output };
    let Some((other, other_number)) = split(output) else { return false };
    let number = if counts_from_0 { number.checked_sub(1) } else { Some(number) };
    kinds(kind).contains(&other) && number == Some(other_number)
}

/// "HDMI-A-1" and "HDMI-A1" are "HDMI-A" and 1.
fn split(name: &str) -> Option<(&str, u32)> {
    let kind = name.trim_end_matches(|c: char| c.is_ascii_digit());
    let number = name[kind.len()..].parse().ok()?;
    Some((kind.strip_suffix('-').unwrap_or(kind), number))
}

/// What X servers call the kernel's kind of connector.
fn kinds(kernel: &str) -> Vec<&str> {
    let other = match kernel {
        "HDMI-A" => "HDMI",
        "DP" => "DisplayPort",
        "SVIDEO" => "S-video",
        // Intel's driver does not tell these apart.
        "DVI-D" | "DVI-I" | "DVI-A" => "DVI",
        _ => kernel,
    };
    vec![kernel, other]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn output(id: u32, name: &str, connector_id: Option<u32>) -> X11Output {
        X11Output { id, name: name.into(), connector_id, is_connected: true, crtc: 0, crtcs: vec![1] }
    }

    fn outputs(names: &[&str]) -> Vec<X11Output> {
        names.iter().zip(1..).map(|(name, id)| output(id, name, None)).collect()
    }

    #[test]
    fn names_of_every_driver_are_understood() {
        let at =
            |names: &[&str], wanted| find(&outputs(names), wanted, &[]).map(|output| output.name.clone());
        let found = |name: &str| Some(name.to_owned());
        let own = ["eDP-1", "HDMI-1", "DP-1", "DP-2"];
        assert_eq!(at(&own, "HDMI-A-1"), found("HDMI-1"));
        assert_eq!(at(&own, "DP-2"), found("DP-2"));
        assert_eq!(at(&own, "DP-3"), None);
        assert_eq!(at(&own, "HDMI-B-1"), None, "another connector, although its name begins alike");
        assert_eq!(at(&["eDP1", "HDMI1", "DP1", "DVI1"], "HDMI-A-1"), found("HDMI1"));
        assert_eq!(at(&["eDP1", "HDMI1", "DP1", "DVI1"], "DVI-D-1"), found("DVI1"));
        let amd = ["HDMI-A-0", "DisplayPort-0", "DisplayPort-1"];
        assert_eq!(at(&amd, "HDMI-A-1"), found("HDMI-A-0"));
        assert_eq!(at(&amd, "DP-1"), found("DisplayPort-0"));
        assert_eq!(at(&amd, "DP-2"), found("DisplayPort-1"), "it counts from 0");
        assert_eq!(at(&amd, "DP-3"), None);
        assert_eq!(at(&["screen"], "screen"), found("screen"));
        assert_eq!(at(&["", "-", "1", "HDMI-99999999999999"], "HDMI-A-1"), None);
    }

    #[test]
    fn the_kernels_number_decides_before_any_name() {
        let all = [output(7, "DP-1", Some(44)), output(8, "DP-2", Some(33))];
        let kernel = [(33, "DP-1".to_owned()), (44, "DP-2".to_owned())];
        assert_eq!(find(&all, "DP-1", &kernel).map(|o| o.id), Some(8));
        assert_eq!(find(&all, "DP-9", &[(1, "DP-9".to_owned())]), None, "no output has this number");
        assert_eq!(find(&all, "DP-1", &[]).map(|o| o.id), Some(7), "no card may be opened: names decide");
    }

    #[test]
    fn two_cards_with_the_same_numbers_are_told_apart_by_name_or_not_at_all() {
        let kernel = [(33, "HDMI-A-1".to_owned()), (33, "DP-1".to_owned())];
        let all = [output(7, "HDMI-1", Some(33)), output(8, "DP-1", Some(33))];
        assert_eq!(find(&all, "DP-1", &kernel).map(|o| o.id), Some(8));
        let alike = [output(7, "DP-1", Some(33)), output(8, "DP-1", Some(33))];
        assert_eq!(find(&alike, "DP-1", &kernel), None);
    }
}
