//! Error against rays and time of every method: runs, references, tables, plots.

pub mod costs;
pub(crate) mod equal;
pub mod export;
pub mod figure3;
pub mod groups;
mod parts;
pub mod plan;
pub mod planes;
pub mod plot;
pub mod reference;
pub mod report;
pub mod runs;
pub mod seen;
pub mod sheet;
pub mod table;
mod verdict;
