//! The second tier: more of what the commit tier holds once.

mod hours;
