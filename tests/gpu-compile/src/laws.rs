//! What the table must keep.

use crate::cases::EVERY_LOBE;
use crate::table::{Row, Table};
use crate::targets::{Maker, Target};

/// Least waves of 32 lanes a SIMD of navi31 in passes whose rays walk through the scene.
pub const WAVES_OF_WALKS: u32 = 8;
/// The same in all other passes.
pub const WAVES: u32 = 16;
/// The GPU for which the laws on waves are written.
const WAVES_ON: &str = "navi31, RADV 25.0";

/// Registers that may be spilled where every lobe of glTF's extensions is compiled in, which no scene needs: scalar ones, to lanes of vector
/// registers, at an instruction each.
const SPILLS_OF_EVERY_LOBE: u32 = 2;

/// Every row that breaks a law, as a sentence. On AMD with a current driver no pass spills or uses scratch memory, and enough waves fit.
pub fn broken(table: &Table) -> Vec<String> {
    let mut all = Vec::new();
    for row in &table.passes {
        let Some(target) = Target::named(&row.target) else {
            all.push(format!("{} is no target", row.target));
            continue;
        };
        let name = format!("{} of {} on {}", row.pass, row.case, row.target);
        let spills = if row.case == EVERY_LOBE { SPILLS_OF_EVERY_LOBE } else { 0 };
        if target.maker == Maker::Amd && target.current && (row.spills > spills || row.scratch > 0) {
            all.push(format!("{name}: {} registers spilled, {} bytes of scratch", row.spills, row.scratch));
        }
        let least = if row.walks { WAVES_OF_WALKS } else { WAVES };
        if row.target == WAVES_ON && row.waves.unwrap_or(0) < least {
            all.push(format!("{name}: {:?} waves, at least {least} are due", row.waves));
        }
    }
    all
}

/// Rows that are worse than those of an older table: more spills, more scratch, or fewer waves. The committed table is the ceiling, and it only falls.
pub fn worse(new: &Table, old: &Table) -> Vec<String> {
    let same = |a: &Row, b: &Row| (&a.case, &a.pass, &a.target) == (&b.case, &b.pass, &b.target);
    let mut all = Vec::new();
    for row in &new.passes {
        let Some(before) = old.passes.iter().find(|r| same(r, row)) else { continue };
        let name = format!("{} of {} on {}", row.pass, row.case, row.target);
        let mut note = |what: &str, was: u32, is: u32| all.push(format!("{name}: {what} {was} -> {is}"));
        if row.spills > before.spills {
            note("spilled registers", before.spills, row.spills);
        }
        if row.scratch > before.scratch {
            note("bytes of scratch", before.scratch, row.scratch);
        }
        if let (Some(was), Some(is)) = (before.waves, row.waves) {
            if is < was {
                note("waves", was, is);
            }
        }
    }
    all
}
