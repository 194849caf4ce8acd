//! The second tier: breadth and repetition of what the commit tier holds once.

mod equal_work;
mod every_case;
mod large_rasters;
mod method_choice;
mod subgroup_widths;
mod turns;
