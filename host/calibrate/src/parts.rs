//! A measurement part by part, so that only the parts in which the light went off are repeated. Times count from its
//! beginning.

use std::time::Duration;

/// Length of a part.
const PART: Duration = Duration::from_secs(5);

/// What a measurement has collected.
#[derive(Debug)]
pub struct Parts<T> {
    /// Each with its beginning.
    parts: Vec<(Duration, T)>,
    /// When the part that goes on began.
    begin: Duration,
    /// When enough is collected.
    end: Duration,
    /// Time that was spoilt.
    lost: Duration,
}

impl<T> Parts<T> {
    /// Of a measurement that lasts `length`, and longer where parts of it are repeated.
    pub fn new(length: Duration) -> Self {
        Self { parts: Vec::new(), begin: Duration::ZERO, end: length, lost: Duration::ZERO }
    }

    /// True once enough is collected.
    pub fn are_over(&self, now: Duration) -> bool {
        now >= self.end
    }

    /// When the part that goes on is due.
    pub fn next(&self) -> Duration {
        self.begin + PART
    }

    /// Keeps what the part has that ends now. Returns the length of all that is kept.
    pub fn add(&mut self, part: T, now: Duration) -> Duration {
        self.parts.push((self.begin, part));
        self.begin = now;
        now.saturating_sub(self.lost)
    }

    /// Drops the parts that ended after `since`, and the one that goes on; it begins anew now. Returns the time that is to be
    /// repeated.
    pub fn spoil(&mut self, since: Duration, now: Duration) -> Duration {
        while self.begin > since {
            let Some((begin, _)) = self.parts.pop() else { break };
            self.begin = begin;
        }
        let again = now.saturating_sub(self.begin);
        (self.begin, self.end, self.lost) = (now, self.end + again, self.lost + again);
        again
    }

    /// What is kept, in order.
    pub fn all(self) -> impl Iterator<Item = T> {
        self.parts.into_iter().map(|(_, part)| part)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const S: fn(u64) -> Duration = Duration::from_secs;

    /// Without a fault nothing changes; with one the part of it is repeated and the others stay, and where it came right
    /// after the border of two parts both are.
    #[test]
    fn only_the_parts_of_a_fault_are_repeated() {
        let mut parts = Parts::new(S(20));
        assert_eq!(parts.add("a", S(5)), S(5));
        assert_eq!(parts.add("b", S(10)), S(10));
        // Noticed at 12 s, back at 14 s: what began at 10 s is repeated.
        assert_eq!(parts.spoil(S(11), S(14)), S(4));
        assert_eq!(parts.next(), S(19));
        assert_eq!(parts.add("c", S(19)), S(15), "of the 19 s four are worth nothing");
        assert!(!parts.are_over(S(23)) && parts.are_over(S(24)));
        // Noticed half a second after "c" ended: it may have been spoilt.
        assert_eq!(parts.spoil(Duration::from_millis(18_500), S(20)), S(6));
        assert_eq!((parts.add("d", S(25)), parts.end), (S(15), S(30)));
        parts.add("e", S(30));
        assert_eq!(parts.all().collect::<Vec<_>>(), ["a", "b", "d", "e"]);
        // The first second has nothing before it.
        let mut parts = Parts::<()>::new(S(20));
        assert_eq!(parts.spoil(Duration::ZERO, S(3)), S(3));
        assert_eq!((parts.all().count()), 0);
    }
}
