//! What `dpm doctor` says of the displays that can serve as projectors.

use super::super::display::{look, CardView};
use super::{Finding, Severity};
use dpm_display::kms::Connector;

/// The displays of this machine.
pub(super) fn findings() -> Vec<Finding> {
    displays(&look())
}

/// The displays that `projector.backend.kind = "display"` could drive.
fn displays(all: &[CardView]) -> Vec<Finding> {
    const UNTRIED: &str = "a display as projector has not been tried on real hardware yet (docs/DISPLAY.md)";
    let mut findings = Vec::new();
    for CardView { path, is_in_use, connectors } in all {
        let name = format!("displays of {}", path.display());
        let connectors = match connectors {
            Ok(connectors) => connectors,
            Err(e) => {
                findings.push(Finding::new(&name, Severity::Info, "cannot be used", e.to_string()));
                continue;
            }
        };
        let answer = |c: &&Connector| c.is_connected;
        let told: Vec<String> = connectors
            .iter()
            .filter(answer)
            .map(|c| {
                let mode = c.modes.first().map_or_else(|| "no mode".into(), ToString::to_string);
                format!("{} ({mode})", c.name)
            })
            .collect();
        let found = if told.is_empty() { "none answers".into() } else { told.join(", ") };
        let remedy = if *is_in_use {
            "another program drives them: a rig needs a bare console (Ctrl+Alt+F3), or a lease of one of them from the desktop \
             (docs/DISPLAY.md)"
        } else if told.is_empty() {
            "plug one in and switch it on; `dpm display` lists connectors"
        } else {
            UNTRIED
        };
        findings.push(Finding::new(&name, Severity::Info, found, remedy));
    }
    if findings.is_empty() {
        findings.push(Finding::new("displays", Severity::Info, "no graphics card that can set modes", ""));
    }
    findings
}
