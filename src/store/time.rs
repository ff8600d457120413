//! Time stamps in files: RFC 3339, UTC.

use std::time::{Duration, SystemTime, UNIX_EPOCH};

const SECONDS_PER_DAY: u64 = 86_400;

/// `2025-01-31T12:00:00.123Z` for `time`; times before 1970 are written as its first instant.
pub fn rfc3339_utc(time: SystemTime) -> String {
    let since = time.duration_since(UNIX_EPOCH).unwrap_or(Duration::ZERO);
    let (days, second) = (since.as_secs() / SECONDS_PER_DAY, since.as_secs() % SECONDS_PER_DAY);
    let (year, month, day) = civil_from_days(days);
    format!(
        "{year:04}-{month:02}-{day:02}T{:02}:{:02}:{:02}.{:03}Z",
        second / 3600,
        second / 60 % 60,
        second % 60,
        since.subsec_millis()
    )
}

/// Time since 1970 of a text such as [`rfc3339_utc`] writes, with or without a fraction of a second. `None` for anything else.
pub fn parse_rfc3339_utc(text: &str) -> Option<Duration> {
    let (date, clock) = text.strip_suffix('Z')?.split_once('T')?;
    let (clock, fraction) = clock.split_once('.').unwrap_or((clock, "0"));
    let numbers = |text: &str, mark: char| -> Option<[u64; 3]> {
        let parts: Vec<u64> = text.split(mark).map(|part| part.parse().ok()).collect::<Option<_>>()?;
        parts.try_into().ok()
    };
    let ([year, month, day], [hour, minute, second]) = (numbers(date, '-')?, numbers(clock, ':')?);
    let digits = !fraction.is_empty() && fraction.bytes().all(|digit| digit.is_ascii_digit());
    if !digits || !(1970..=9999).contains(&year) || hour > 23 || minute > 59 || second > 60 {
        return None;
    }
    // Whoever knows how days become dates need not know the reverse: a date lies within its year.
    let first = (year - 1970) * 365 + (year - 1969) / 4 - (year - 1901) / 100 + (year - 1601) / 400;
    let days = (first..first + 366).find(|days| civil_from_days(*days) == (year, month, day))?;
    let seconds = days * SECONDS_PER_DAY + hour * 3600 + minute * 60 + second;
    let fraction: f64 = format!("0.{fraction}").parse().ok()?;
    Some(Duration::from_secs(seconds) + Duration::from_secs_f64(fraction))
}

/// Date of the Gregorian calendar, `days` after 1970-01-01.
fn civil_from_days(days: u64) -> (u64, u64, u64) {
    // Counting from a 1 March puts the leap day last in the year, and 400 years are a whole number of days.
    let from_march = days + 719_468;
    let (era, day_of_era) = (from_march / 146_097, from_march % 146_097);
    let year_of_era = (day_of_era - day_of_era / 1460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let shifted_month = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * shifted_month + 2) / 5 + 1;
    let month = if shifted_month < 10 { shifted_month + 3 } else { shifted_month - 9 };
    (era * 400 + year_of_era + u64::from(month <= 2), month, day)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Date by stepping through every day.
    fn oracle(days: u64) -> (u64, u64, u64) {
        let (mut year, mut month, mut day) = (1970, 1, 1);
        for _ in 0..days {
            let leap = year % 4 == 0 && (year % 100 != 0 || year % 400 == 0);
            let length =
                [31, if leap { 29 } else { 28 }, 31, 30, 31, 30, 31, 31, 30, 31, 30, 31][month as usize - 1];
            day += 1;
            if day > length {
                (day, month) = (1, month + 1);
            }
            if month > 12 {
                (month, year) = (1, year + 1);
            }
        }
        (year, month, day)
    }

    #[test]
    fn dates_agree_with_a_calendar_walked_day_by_day() {
        for days in (0..80_000).step_by(97).chain(18_321..18_330).chain(47_482..47_490) {
            assert_eq!(civil_from_days(days), oracle(days), "day {days}");
        }
    }

    #[test]
    fn written_times_are_read_back() {
        for millis in (0..8_000_000_000_000).step_by(86_399_871 * 11) {
            let since = Duration::from_millis(millis);
            let text = rfc3339_utc(UNIX_EPOCH + since);
            let read = parse_rfc3339_utc(&text).expect(&text);
            assert!(read.abs_diff(since) < Duration::from_micros(1), "{text}: {read:?}, {since:?}");
        }
        assert_eq!(parse_rfc3339_utc("2024-02-29T12:34:56Z"), Some(Duration::from_secs(1_709_210_096)));
        for wrong in [
            "",
            "Z",
            "2024-02-30T00:00:00Z",
            "2024-02-29 12:34:56Z",
            "2024-02-29T12:34:56",
            "2024-02-29T12:34:56.Z",
            "2024-02-29T24:00:00Z",
            "1969-12-31T23:59:59Z",
            "99999999999999999999-01-01T00:00:00Z",
        ] {
            assert_eq!(parse_rfc3339_utc(wrong), None, "{wrong}");
        }
    }

    #[test]
    fn known_instants() {
        assert_eq!(rfc3339_utc(UNIX_EPOCH), "1970-01-01T00:00:00.000Z");
        assert_eq!(
            rfc3339_utc(UNIX_EPOCH + Duration::from_millis(1_709_210_096_789)),
            "2024-02-29T12:34:56.789Z"
        );
    }
}
