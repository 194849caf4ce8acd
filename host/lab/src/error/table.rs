//! A rig into the whole comparison of the methods: one body in four materials, standing and moving, looked at and looked past.
//!
//! The materials are those of \[paper\] section 3. An eye that looks past has the whole picture beyond the paper's outer zone, where its
//! filter is fully in: that is where flicker is judged. What the eye looks at does not change the reference, so both share one.

use super::plan::Setting;
use super::report::tables;
use super::runs::GroupResult;
use serde::{Deserialize, Serialize};

/// A measured setting, as it is kept in its file.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct TableGroup {
    /// Material.
    pub material: String,
    /// Bodies move.
    pub moving: bool,
    /// The eye looks past the picture.
    pub aside: bool,
    /// The numbers.
    pub result: GroupResult,
}

impl TableGroup {
    /// What was measured in a setting.
    pub fn new(setting: Setting, result: GroupResult) -> Self {
        let material = setting.material().unwrap_or_default();
        Self { material, moving: setting.moving, aside: setting.aside, result }
    }

    /// Its setting.
    pub fn setting(&self) -> Setting {
        Setting::of_material(&self.material, self.moving, self.aside)
    }
}

/// All rows as Markdown tables with the stamps above, and dpm by the best of the others below.
pub fn markdown(groups: &[TableGroup]) -> String {
    tables(&groups.iter().map(|g| (g.setting(), &g.result)).collect::<Vec<_>>())
}
