//! A frame rate as the value of a key: a whole number, or a fraction in quotes.

use super::read::{ConfigValue, KeyReader, Limit, Within};
use super::source::{SourceNode, Value};
use dpm_device::time::FrameRate;

/// A bound on [`FrameRate`]: numerator and denominator.
#[derive(Clone, Copy)]
pub struct RateBound(pub u32, pub u32);

impl Limit<FrameRate> for Within<RateBound> {
    fn allows(&self, rate: &FrameRate) -> bool {
        let at_least =
            |a: (u32, u32), b: (u32, u32)| u64::from(a.0) * u64::from(b.1) >= u64::from(b.0) * u64::from(a.1);
        let rate = (rate.num(), rate.den());
        at_least(rate, (self.0 .0, self.0 .1)) && at_least((self.1 .0, self.1 .1), rate)
    }
    fn describe(&self) -> String {
        format!("{} to {}", self.0 .0, self.1 .0)
    }
}

impl ConfigValue for FrameRate {
    fn kind() -> String {
        "a whole number or a fraction in quotes".into()
    }

    fn read(node: &SourceNode, reader: &mut KeyReader, key: &str) -> Option<Self> {
        let parsed = match &node.value {
            Value::Integer(i) => u32::try_from(*i).ok().and_then(|n| FrameRate::new(n, 1)),
            Value::String(s) => {
                let (num, den) = s.split_once('/').unwrap_or((s, "1"));
                match (num.trim().parse(), den.trim().parse()) {
                    (Ok(num), Ok(den)) => FrameRate::new(num, den),
                    _ => None,
                }
            }
            Value::Float(_) => {
                let problem = "is a number with a decimal point, which no clock can keep exactly";
                let remedy = "write a fraction, for example \"60000/1001\" for 59.94";
                reader.refuse(&node.origin, key, problem, remedy);
                return None;
            }
            _ => None,
        };
        if parsed.is_none() {
            let shown = match &node.value {
                Value::String(s) => format!("{s:?}"),
                Value::Integer(i) => i.to_string(),
                other => other.kind().into(),
            };
            let remedy = "write 947 or a fraction of two whole numbers above 0 such as \"60000/1001\"";
            reader.refuse(&node.origin, key, format!("is {shown}, must be {}", Self::kind()), remedy);
        }
        parsed
    }

    fn show(&self) -> String {
        if self.den() == 1 {
            format!("\"{}\"", self.num())
        } else {
            format!("\"{}/{}\"", self.num(), self.den())
        }
    }
}
