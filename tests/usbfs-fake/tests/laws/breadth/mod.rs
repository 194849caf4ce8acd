//! The second tier: breadth and repetition of what the commit tier holds once.

mod plug_cycles;
