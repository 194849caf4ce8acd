//! How old a measurement is.

use crate::standing::seconds_of_utc;
use std::time::{SystemTime, UNIX_EPOCH};

/// A calibration that is older than this, days, is worth a check.
pub const OLD_DAYS: u64 = 30;

/// Whole days from a date of the form 2026-03-01T12:00:00Z until now; `None` for another text.
pub fn days_since(date: &str, now: SystemTime) -> Option<u64> {
    let now = now.duration_since(UNIX_EPOCH).ok()?.as_secs();
    Some(now.saturating_sub(seconds_of_utc(date)?) / 86_400)
}

/// An age in words.
pub fn aged(days: Option<u64>) -> String {
    match days {
        None => "of unknown date".into(),
        Some(0) => "of today".into(),
        Some(1) => "1 day old".into(),
        Some(days) => format!("{days} days old"),
    }
}

/// True if a measurement of that age is worth a check.
pub fn is_old(days: Option<u64>) -> bool {
    days.is_none_or(|days| days > OLD_DAYS)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::standing::utc;
    use std::time::Duration;

    #[test]
    fn an_age_is_counted_in_whole_days() {
        let then = UNIX_EPOCH + Duration::from_secs(1_772_366_400);
        let after = |days: f64| days_since(&utc(then), then + Duration::from_secs_f64(86_400.0 * days));
        assert_eq!(
            (after(0.0), after(0.99), after(1.0), after(400.5)),
            (Some(0), Some(0), Some(1), Some(400))
        );
        assert_eq!(days_since("yesterday", then), None);
        // A clock that was set back makes nothing negative.
        assert_eq!(days_since(&utc(then + Duration::from_secs(9)), then), Some(0));
        assert!(is_old(None) && is_old(Some(OLD_DAYS + 1)) && !is_old(Some(OLD_DAYS)));
    }
}
