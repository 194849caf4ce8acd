//! The text of a plan into faults.

use ash::vk;
use std::str::FromStr;

/// What is counted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Call {
    /// `vkCreateInstance`.
    Instance,
    /// `vkCreateDevice`.
    Device,
    /// `vkAllocateMemory`.
    Memory,
    /// `vkCreateBuffer`.
    Buffer,
    /// `vkCreateComputePipelines`.
    Pipeline,
    /// Every call that makes, allocates, binds, maps or records something.
    Create,
    /// `vkQueueSubmit`.
    Submit,
    /// `vkQueueSubmit` of command buffers with an indirect dispatch.
    Frame,
    /// `vkWaitForFences`.
    Wait,
    /// `vkGetFenceStatus`.
    Status,
    /// `vkCmdPipelineBarrier`.
    Barrier,
    /// `vkQueueSubmit` on a device that was lost before: no plan can name it, but it is counted.
    SubmitAfterLoss,
}

impl Call {
    /// All of them.
    pub const ALL: [Self; 12] = [
        Self::Instance,
        Self::Device,
        Self::Memory,
        Self::Buffer,
        Self::Pipeline,
        Self::Create,
        Self::Submit,
        Self::Frame,
        Self::Wait,
        Self::Status,
        Self::Barrier,
        Self::SubmitAfterLoss,
    ];

    /// Its word in plans and logs.
    pub const fn word(self) -> &'static str {
        match self {
            Self::Instance => "instance",
            Self::Device => "device",
            Self::Memory => "memory",
            Self::Buffer => "buffer",
            Self::Pipeline => "pipeline",
            Self::Create => "create",
            Self::Submit => "submit",
            Self::Frame => "frame",
            Self::Wait => "wait",
            Self::Status => "status",
            Self::Barrier => "barrier",
            Self::SubmitAfterLoss => "submit-after-loss",
        }
    }

    const fn is_submission(self) -> bool {
        matches!(self, Self::Submit | Self::Frame)
    }
}

/// What goes wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// The device is lost, for good.
    Lost,
    /// The submission is swallowed.
    Hang,
    /// The call does not return.
    Block,
    /// The fence is signalled late.
    Late,
    /// Buffers are filled with floats that are not numbers.
    Poison,
    /// The call does nothing.
    Skip,
    /// The call answers so and does nothing.
    Fail(vk::Result),
}

impl Kind {
    const ALL: [Self; 9] = [
        Self::Lost,
        Self::Hang,
        Self::Block,
        Self::Late,
        Self::Poison,
        Self::Skip,
        Self::Fail(vk::Result::ERROR_OUT_OF_DEVICE_MEMORY),
        Self::Fail(vk::Result::ERROR_OUT_OF_HOST_MEMORY),
        Self::Fail(vk::Result::ERROR_INITIALIZATION_FAILED),
    ];

    /// Its word in plans and logs.
    pub const fn word(self) -> &'static str {
        match self {
            Self::Lost => "lost",
            Self::Hang => "submit-hang",
            Self::Block => "submit-block",
            Self::Late => "late",
            Self::Poison => "poison",
            Self::Skip => "skip",
            Self::Fail(vk::Result::ERROR_OUT_OF_DEVICE_MEMORY) => "oom-device",
            Self::Fail(vk::Result::ERROR_OUT_OF_HOST_MEMORY) => "oom-host",
            Self::Fail(_) => "init-failed",
        }
    }

    const fn strikes(self, call: Call) -> bool {
        match self {
            Self::Lost => call.is_submission() || matches!(call, Call::Wait | Call::Status),
            Self::Hang | Self::Block | Self::Late | Self::Poison => call.is_submission(),
            Self::Skip => matches!(call, Call::Barrier),
            Self::Fail(_) => !matches!(call, Call::Status | Call::Barrier | Call::SubmitAfterLoss),
        }
    }
}

/// One fault of a plan.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Fault {
    /// What goes wrong.
    pub kind: Kind,
    /// At which call.
    pub call: Call,
    /// Number of the first call that it strikes, counted from 1.
    pub first: u64,
    /// Number of the last one; [`u64::MAX`]: none is the last.
    pub last: u64,
    /// Milliseconds, where the kind has any.
    pub ms: Option<u64>,
    /// Size of the buffers to poison, bytes.
    pub bytes: u64,
    /// Only this device of the loader's list, counted from 1.
    pub gpu: Option<u64>,
}

/// Faults, in the order of the text: where several strike a call, the first does.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Plan {
    faults: Vec<Fault>,
}

/// What is wrong with a plan's text.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PlanError(String);

impl std::fmt::Display for PlanError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for PlanError {}

impl Plan {
    /// The fault that strikes the call with this number; `gpu` is the device of the loader's list that it is for, where the call has one.
    pub fn fault(&self, call: Call, number: u64, gpu: Option<u64>) -> Option<Fault> {
        let strikes = |f: &&Fault| {
            f.call == call
                && (f.first..=f.last).contains(&number)
                && f.gpu.is_none_or(|only| gpu == Some(only))
        };
        self.faults.iter().find(strikes).copied()
    }
}

impl FromStr for Plan {
    type Err = PlanError;

    fn from_str(text: &str) -> Result<Self, PlanError> {
        let parts = text.split(';').map(str::trim).filter(|part| !part.is_empty());
        Ok(Self { faults: parts.map(fault).collect::<Result<_, _>>()? })
    }
}

fn fault(text: &str) -> Result<Fault, PlanError> {
    let wrong = |what: &str| PlanError(format!("{text:?}: {what}"));
    let mut parts = text.split(',').map(str::trim);
    let head = parts.next().unwrap_or_default();
    let (kind, place) = head.split_once('@').ok_or_else(|| wrong("no @ behind the kind"))?;
    let (call, when) = place.split_once('=').ok_or_else(|| wrong("no = behind the call"))?;
    let kind = (Kind::ALL.into_iter())
        .find(|k| k.word() == kind.trim())
        .ok_or_else(|| wrong("there is no such kind of fault"))?;
    let call = (Call::ALL.into_iter())
        .find(|c| c.word() == call.trim())
        .ok_or_else(|| wrong("there is no such call"))?;
    if !kind.strikes(call) {
        return Err(wrong("this kind does not strike that call"));
    }
    let number = |text: &str| {
        text.trim().parse::<u64>().ok().filter(|n| *n > 0).ok_or_else(|| wrong("not a number from 1 on"))
    };
    let (first, last) = match when.split_once("..") {
        None => (number(when)?, number(when)?),
        Some((first, last)) if last.trim().is_empty() => (number(first)?, u64::MAX),
        Some((first, last)) => (number(first)?, number(last)?),
    };
    let mut fault = Fault { kind, call, first, last, ms: None, bytes: 0, gpu: None };
    for option in parts {
        match option.split_once('=') {
            Some(("ms", value)) => fault.ms = Some(number(value)?),
            Some(("bytes", value)) => fault.bytes = number(value)?,
            Some(("gpu", value)) => fault.gpu = Some(number(value)?),
            _ => return Err(wrong("options are ms=T, bytes=B and gpu=K")),
        }
    }
    if kind == Kind::Late && fault.ms.is_none() {
        return Err(wrong("late needs ms=T"));
    }
    if (kind == Kind::Poison) != (fault.bytes > 0) {
        return Err(wrong("bytes=B belongs to poison, and poison needs it"));
    }
    if fault.ms.is_some() && !matches!(kind, Kind::Hang | Kind::Block | Kind::Late) {
        return Err(wrong("ms=T belongs to submit-hang, submit-block and late"));
    }
    if fault.gpu.is_some() && call != Call::Device {
        return Err(wrong("gpu=K belongs to the call device"));
    }
    if last < first {
        return Err(wrong("the last is before the first"));
    }
    Ok(fault)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plan_strikes_the_calls_that_it_names_and_no_other() {
        let plan: Plan = "lost@frame=3; oom-device@create=2..4 ;late@submit=7..,ms=20;submit-hang@frame=3"
            .parse()
            .unwrap();
        let struck =
            |call| -> Vec<u64> { (1..12).filter(|&n| plan.fault(call, n, None).is_some()).collect() };
        assert_eq!(struck(Call::Frame), [3]);
        assert_eq!(plan.fault(Call::Frame, 3, None).unwrap().kind, Kind::Lost, "the first of the text wins");
        assert_eq!(struck(Call::Create), [2, 3, 4]);
        assert_eq!(struck(Call::Submit), [7, 8, 9, 10, 11]);
        assert_eq!(plan.fault(Call::Submit, u64::MAX, None).unwrap().ms, Some(20));
        for call in [Call::Wait, Call::Memory, Call::Device, Call::SubmitAfterLoss] {
            assert!(struck(call).is_empty(), "{call:?}");
        }
        let second: Plan = "init-failed@device=1..,gpu=2".parse().unwrap();
        assert!(
            second.fault(Call::Device, 3, Some(2)).is_some()
                && second.fault(Call::Device, 3, Some(1)).is_none()
        );
        assert_eq!("".parse::<Plan>(), Ok(Plan::default()));
        assert_eq!(" ; ;".parse::<Plan>(), Ok(Plan::default()));
    }

    #[test]
    fn every_kind_and_every_call_has_a_word_of_its_own_that_is_read_back() {
        for kind in Kind::ALL {
            let mut accepted = 0;
            for call in Call::ALL {
                let more = match kind {
                    Kind::Late => ",ms=5",
                    Kind::Poison => ",bytes=64",
                    _ => "",
                };
                let plan = format!("{}@{}=9{more}", kind.word(), call.word()).parse::<Plan>();
                assert_eq!(plan.is_ok(), kind.strikes(call), "{kind:?} {call:?}");
                if let Ok(plan) = plan {
                    let fault = plan.fault(call, 9, None).unwrap();
                    assert_eq!((fault.kind, fault.call, fault.first, fault.last), (kind, call, 9, 9));
                    accepted += 1;
                }
            }
            assert!(accepted > 0, "{kind:?} strikes nothing");
        }
    }

    /// A plan that is not understood must not pass for one without faults.
    #[test]
    fn what_is_not_a_plan_is_refused() {
        for text in [
            "lost",
            "lost@frame",
            "lost@frame=",
            "lost@frame=0",
            "lost@frame=-1",
            "lost@frame=5..4",
            "lost@frame=x..",
            "lost@buffer=1",
            "gone@frame=1",
            "lost@picture=1",
            "lost@frame=1,ms=3",
            "late@frame=1",
            "late@wait=1,ms=1",
            "oom-host@memory=1,gpu=1",
            "poison@frame=1",
            "skip@frame=1",
            "lost@barrier=1",
            "submit-hang@frame=1,bytes=3",
            "submit-hang@frame=1,s=3",
            "lost@frame=1; nonsense",
        ] {
            let error = text.parse::<Plan>().expect_err(text);
            assert!(!error.to_string().is_empty());
        }
    }
}
