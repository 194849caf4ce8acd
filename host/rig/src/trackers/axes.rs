//! `tracker.transform.axes`: which axes of a tracker are the world's.

use dpm_common::keys::read::{ConfigValue, KeyReader};
use dpm_common::keys::source::{SourceNode, Value};
use glam::{DMat3, DVec3};

/// Which axes of the tracker point along the world's x, y and z.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Axes(DMat3);

impl Default for Axes {
    fn default() -> Self {
        Self(DMat3::IDENTITY)
    }
}

impl Axes {
    /// The matrix that takes the tracker's coordinates to the world's: one entry of 1 or -1 in each row and column. Its
    /// determinant is -1 if the tracker is left-handed.
    pub fn matrix(&self) -> DMat3 {
        self.0
    }

    /// From a text such as "x z -y".
    fn parse(text: &str) -> Option<Self> {
        let mut rows = [DVec3::ZERO; 3];
        let mut words = text.split([' ', ',']).filter(|w| !w.is_empty());
        for row in &mut rows {
            let word = words.next()?;
            let (sign, axis) = match word.strip_prefix('-') {
                Some(axis) => (-1.0, axis),
                None => (1.0, word.strip_prefix('+').unwrap_or(word)),
            };
            let axis = match axis {
                "x" | "X" => DVec3::X,
                "y" | "Y" => DVec3::Y,
                "z" | "Z" => DVec3::Z,
                _ => return None,
            };
            *row = axis * sign;
        }
        let matrix = DMat3::from_cols(rows[0], rows[1], rows[2]).transpose();
        (words.next().is_none() && matrix.determinant() != 0.0).then_some(Self(matrix))
    }
}

impl ConfigValue for Axes {
    fn kind() -> String {
        "a string of three axes".into()
    }

    fn read(node: &SourceNode, reader: &mut KeyReader, key: &str) -> Option<Self> {
        let parsed = match &node.value {
            Value::String(text) => Self::parse(text),
            _ => None,
        };
        if parsed.is_none() {
            reader.refuse(
                &node.origin,
                key,
                "must name each of x, y and z once, with or without a sign",
                "write for example \"x z -y\" for a tracker whose z points up",
            );
        }
        parsed
    }

    fn show(&self) -> String {
        let name = |row: DVec3| {
            let axis = ["x", "y", "z"][row.abs().to_array().iter().position(|v| *v > 0.5).unwrap_or(0)];
            format!("{}{axis}", if row.element_sum() < 0.0 { "-" } else { "" })
        };
        let rows = self.0.transpose();
        format!("\"{} {} {}\"", name(rows.x_axis), name(rows.y_axis), name(rows.z_axis))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn axes_are_a_signed_exchange_that_reads_as_it_is_written() {
        let z_up = Axes::parse("x z -y").unwrap();
        assert_eq!(z_up.matrix() * DVec3::new(1.0, 2.0, 3.0), DVec3::new(1.0, 3.0, -2.0));
        assert_eq!(z_up.matrix().determinant(), 1.0);
        assert_eq!(Axes::parse("x y -z").unwrap().matrix().determinant(), -1.0);
        for text in ["\"x y z\"", "\"-z x y\"", "\"x z -y\""] {
            assert_eq!(Axes::parse(text.trim_matches('"')).unwrap().show(), text);
        }
        for wrong in ["", "x y", "x y z x", "x x y", "x y w", "x -y --z"] {
            assert_eq!(Axes::parse(wrong), None, "{wrong}");
        }
    }
}
