//! Session numbers: a new one for every connection, so that a device that stayed on never mistakes one host for
//! another.

/// The source of the session numbers of a [`HostLink`](super::HostLink).
///
/// A device only answers a HELLO of the session that is already open. If a host reused a number, the device would
/// continue with the frame numbers and counters of the previous connection, and would stay dark until the host's own
/// frame numbers had passed them.
pub struct SessionNumbers {
    source: Source,
    last: u32,
}

enum Source {
    System,
    Injected(Box<dyn FnMut() -> u32 + Send>),
}

impl SessionNumbers {
    /// Random numbers of the operating system.
    pub const fn from_system() -> Self {
        Self { source: Source::System, last: 0 }
    }

    /// Numbers from `source`, for tests that must repeat. It skips a number that may not be used (0, or the previous
    /// one).
    pub fn from_source(source: impl FnMut() -> u32 + Send + 'static) -> Self {
        Self { source: Source::Injected(Box::new(source)), last: 0 }
    }

    /// The number of the next session: never 0, which means "no session", and never the previous one.
    pub fn draw(&mut self) -> u32 {
        let drawn = match &mut self.source {
            Source::System => getrandom::u32().unwrap_or_else(|_| without_system()),
            Source::Injected(source) => source(),
        };
        let mut number = drawn;
        while number == 0 || number == self.last {
            number = number.wrapping_add(1);
        }
        self.last = number;
        number
    }
}

/// A number for a system without a source of randomness: the time, the process and an address, mixed.
fn without_system() -> u32 {
    use std::hash::{BuildHasher, Hasher};
    let mut hasher = std::hash::RandomState::new().build_hasher();
    let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    hasher.write_u128(since.map_or(0, |d| d.as_nanos()));
    hasher.write_u32(std::process::id());
    hasher.finish() as u32
}

impl std::fmt::Debug for SessionNumbers {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let source = match self.source {
            Source::System => "the operating system",
            Source::Injected(_) => "injected",
        };
        f.debug_struct("SessionNumbers").field("source", &source).field("last", &self.last).finish()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashSet;

    /// Found in use, R3 and C1: every process began with the same number, so on a projector that stayed on the second
    /// run was dark.
    #[test]
    fn numbers_of_the_system_are_new_in_every_link_and_never_0() {
        let mut seen = HashSet::new();
        let mut again = 0;
        for _ in 0..2000 {
            // A new source each, as every process has.
            let number = SessionNumbers::from_system().draw();
            assert_ne!(number, 0);
            again += u32::from(!seen.insert(number));
        }
        // Of 2000 numbers out of 2^32 two are equal once in 2000 runs of this test; three pairs, never.
        assert!(again <= 2, "{again} of 2000 numbers were not new");
        assert!((0..100).any(|_| without_system() != without_system()));
    }

    #[test]
    fn an_injected_source_is_kept_from_0_and_from_repeating() {
        let mut given = [0, 0, 7, 7, 8, u32::MAX, u32::MAX, 0].into_iter();
        let mut numbers = SessionNumbers::from_source(move || given.next().expect("eight"));
        let drawn: Vec<u32> = (0..8).map(|_| numbers.draw()).collect();
        assert_eq!(drawn, [1, 2, 7, 8, 9, u32::MAX, 1, 2]);
        assert!(drawn.windows(2).all(|w| w[0] != w[1]) && !drawn.contains(&0));
    }
}
