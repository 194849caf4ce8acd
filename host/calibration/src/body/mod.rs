//! The place of a mesh in its tracked body's frame, T_BM: from points of the mesh that the wand's tip touched
//! ([`TouchSession`]), and from a tip that wandered over its surface ([`wander()`]).
//!
//! Everything is measured in the body's frame: the tip in the world, brought back by the pose of the body at the same
//! instant. So the body may move meanwhile.

mod nearest;
mod touch;
mod wander;

pub use nearest::TriangleTree;
pub use touch::{tip_in_body, Contact, Touch, TouchError, TouchFit, TouchSession};
pub use wander::{wander, WanderError, WanderFit};

#[cfg(test)]
mod tests;
