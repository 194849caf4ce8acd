//! Planned faults: which call fails, how, and when.

use crate::codes::*;

/// What happens at a call.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Fault {
    /// The device is gone from then on, until there is another plan.
    Removed,
    /// The call answers this code and does nothing.
    Code(i32),
    /// The call takes so many milliseconds more.
    Slow(u32),
}

#[derive(Clone, Debug)]
struct Planned {
    fault: Fault,
    call: String,
    first: u64,
    last: u64,
    seen: u64,
}

/// A list of faults, `KIND@CALL=WHEN`, with semicolons between them. See the crate's page.
#[derive(Clone, Debug, Default)]
pub(crate) struct Plan {
    all: Vec<Planned>,
}

impl Plan {
    pub(crate) fn parse(text: &str) -> Result<Self, String> {
        let parts = text.split(';').map(str::trim).filter(|part| !part.is_empty());
        let all =
            parts.map(|part| planned(part).ok_or_else(|| format!("fake-alp: {part:?} is not understood")));
        Ok(Self { all: all.collect::<Result<_, _>>()? })
    }

    /// What strikes this call; every call is counted.
    pub(crate) fn strike(&mut self, call: &str) -> Option<Fault> {
        let mut struck = None;
        for planned in self.all.iter_mut().filter(|planned| planned.call == call || planned.call == "any") {
            planned.seen += 1;
            if (planned.first..=planned.last).contains(&planned.seen) {
                struck = struck.or(Some(planned.fault));
            }
        }
        struck
    }
}

fn planned(text: &str) -> Option<Planned> {
    let (kind, rest) = text.split_once('@')?;
    let (call, when) = rest.split_once('=')?;
    let fault = match kind {
        "removed" => Fault::Removed,
        "comm" => Fault::Code(ERROR_COMM),
        "not-online" => Fault::Code(NOT_ONLINE),
        "not-idle" => Fault::Code(NOT_IDLE),
        "not-ready" => Fault::Code(NOT_READY),
        "memory-full" => Fault::Code(MEMORY_FULL),
        "in-use" => Fault::Code(SEQ_IN_USE),
        "halted" => Fault::Code(HALTED),
        "init" => Fault::Code(ERROR_INIT),
        "unknown" => Fault::Code(ERROR_UNKNOWN),
        other => Fault::Slow(other.strip_prefix("slow-")?.parse().ok()?),
    };
    let (first, last) = match when.split_once("..") {
        None => (when.parse().ok()?, when.parse().ok()?),
        Some((first, "")) => (first.parse().ok()?, u64::MAX),
        Some((first, last)) => (first.parse().ok()?, last.parse().ok()?),
    };
    Some(Planned { fault, call: call.into(), first, last, seen: 0 })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fault_strikes_the_calls_that_it_names() {
        let mut plan = Plan::parse("comm@put=2..3; removed@any=6").unwrap();
        let struck: Vec<_> =
            ["put", "put", "start", "put", "put", "put"].map(|call| plan.strike(call)).into();
        let comm = Some(Fault::Code(ERROR_COMM));
        assert_eq!(struck, [None, comm, None, comm, None, Some(Fault::Removed)]);
        assert!(Plan::parse("comm@put").is_err() && Plan::parse("odd@put=1").is_err());
        assert_eq!(Plan::parse("slow-20@put=1..").unwrap().strike("put"), Some(Fault::Slow(20)));
    }
}
