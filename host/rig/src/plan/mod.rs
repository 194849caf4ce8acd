//! A slot and the newest poses into the plan of one frame: when its light is due and how many rays it may cost.

pub mod budget;
pub mod dark;
pub mod horizon;
pub mod lead;
pub mod light_centre;
pub mod slots;
