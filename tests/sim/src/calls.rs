//! Calls of the program to something outside it, of which one can fail.

/// See the module's documentation.
#[derive(Clone, Copy, Debug, Default)]
pub struct Calls {
    fails_in: Option<u32>,
    /// How many have failed.
    pub met: u64,
}

impl Calls {
    /// The call after `n` more fails, once.
    pub fn fail_in(&mut self, n: u32) {
        self.fails_in = Some(n);
    }

    /// No call fails any more.
    pub fn all_succeed(&mut self) {
        self.fails_in = None;
    }

    /// A call is made: true if it is to fail.
    pub fn fails(&mut self) -> bool {
        let is_due = self.fails_in == Some(0);
        self.fails_in = self.fails_in.and_then(|n| n.checked_sub(1));
        self.met += u64::from(is_due);
        is_due
    }
}
