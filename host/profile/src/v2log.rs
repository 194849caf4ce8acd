//! Histograms into an HdrHistogram log, version 2 encoding: what the HdrHistogram tools of every language read.

use dpm_rig::telemetry::interval::Interval;
use dpm_rig::telemetry::profile::Profiler;
use hdrhistogram::serialization::interval_log::{IntervalLogWriterBuilder, Tag};
use hdrhistogram::serialization::V2DeflateSerializer;
use std::io::{Error, Write};
use std::time::Duration;

/// Writes one line per interval, tagged with its name, all covering `length` from the start of the run; values in nanoseconds,
/// the column of largest values in milliseconds. The format holds no negative values: these have a line of their own, tagged
/// `NAME.early`, with their magnitudes, where there are any.
pub(super) fn write_v2_log(
    writer: &mut impl Write,
    profiler: &Profiler,
    length: Duration,
) -> Result<(), Error> {
    let mut serializer = V2DeflateSerializer::new();
    let mut builder = IntervalLogWriterBuilder::new();
    builder
        .add_comment("dpm profile: values in nanoseconds, one tag per interval of docs/LATENCY.md")
        .add_comment("NAME.early: magnitudes of the negative values of NAME, which are not in NAME")
        .with_max_value_divisor(1e6);
    let mut log = builder.begin_log_with(writer, &mut serializer)?;
    for interval in Interval::ALL {
        let (name, histogram) = (interval.name(), profiler.histogram(interval));
        let mut put = |tag: &str, half| {
            log.write_histogram(half, Duration::ZERO, length, Tag::new(tag))
                .map_err(|e| Error::other(format!("histogram {tag}: {e:?}")))
        };
        put(name, histogram.late())?;
        if !histogram.early().is_empty() {
            put(&format!("{name}.early"), histogram.early())?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixture::frame;
    use dpm_device::time::FrameRate;
    use hdrhistogram::serialization::interval_log::{IntervalLogIterator, LogEntry};
    use hdrhistogram::serialization::Deserializer;

    #[test]
    fn a_log_reads_back_as_the_same_histograms() {
        let mut profiler = Profiler::new(FrameRate::new(947, 1).unwrap(), true, 100);
        for k in 1..=500 {
            // One frame of five is lit before it was due.
            let mut t = frame(k, k * 1000);
            if k % 5 == 0 {
                t.due_at = t.lit_at.unwrap().plus_ns(k);
            }
            profiler.lit(&t, k as u64, false);
        }
        let mut bytes = Vec::new();
        write_v2_log(&mut bytes, &profiler, Duration::from_secs(2)).unwrap();
        let mut read = std::collections::BTreeMap::new();
        for entry in IntervalLogIterator::new(&bytes) {
            if let LogEntry::Interval(line) = entry.unwrap() {
                let encoded = base64_decoded(line.encoded_histogram());
                let histogram: hdrhistogram::Histogram<u64> =
                    Deserializer::new().deserialize(&mut encoded.as_slice()).unwrap();
                assert!(read.insert(line.tag().unwrap().as_str().to_owned(), histogram).is_none());
            }
        }
        for interval in Interval::ALL {
            let (name, kept) = (interval.name(), profiler.histogram(interval));
            assert_eq!(&read[name], kept.late());
            let early = read.get(&format!("{name}.early"));
            assert_eq!(early, Some(kept.early()).filter(|h| !h.is_empty()));
        }
        assert_eq!(read["lateness.early"].len(), 100);
    }

    /// RFC 4648, the standard alphabet.
    fn base64_decoded(text: &str) -> Vec<u8> {
        let value = |c: u8| match c {
            b'A'..=b'Z' => c - b'A',
            b'a'..=b'z' => c - b'a' + 26,
            b'0'..=b'9' => c - b'0' + 52,
            b'+' => 62,
            b'/' => 63,
            _ => panic!("{c} is not in the alphabet"),
        };
        let mut out = Vec::new();
        let (mut bits, mut n) = (0u32, 0);
        for c in text.bytes().filter(|c| *c != b'=') {
            bits = bits << 6 | u32::from(value(c));
            n += 6;
            if n >= 8 {
                n -= 8;
                out.push((bits >> n) as u8);
            }
        }
        out
    }
}
