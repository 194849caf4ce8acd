//! Reads numbers through buffer views and accessors; every bound is checked once, in 64 bits, before any byte is read.

use super::super::{Limits, SceneError};
use super::json::Item;

/// Storage type of a component.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Component {
    /// 5120.
    I8,
    /// 5121.
    U8,
    /// 5122.
    I16,
    /// 5123.
    U16,
    /// 5125.
    U32,
    /// 5126.
    F32,
}

impl Component {
    fn from_code(code: u64) -> Option<Self> {
        Some(match code {
            5120 => Self::I8,
            5121 => Self::U8,
            5122 => Self::I16,
            5123 => Self::U16,
            5125 => Self::U32,
            5126 => Self::F32,
            _ => return None,
        })
    }

    fn size(self) -> u64 {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::U32 | Self::F32 => 4,
        }
    }

    /// True for the three types that indices may have.
    pub(crate) fn is_unsigned(self) -> bool {
        matches!(self, Self::U8 | Self::U16 | Self::U32)
    }
}

/// A checked range of a buffer.
#[derive(Clone, Copy, Debug)]
struct BufferRange {
    buffer: usize,
    start: u64,
    length: u64,
    stride: Option<u64>,
}

/// The place of an accessor's elements: `start + i * step` in a buffer.
#[derive(Clone, Copy, Debug)]
struct ElementRun {
    buffer: usize,
    start: u64,
    step: u64,
}

/// Elements that replace those of the base array.
#[derive(Clone, Copy, Debug)]
struct Sparse {
    count: u64,
    index_type: Component,
    indices: ElementRun,
    values: ElementRun,
}

/// A checked accessor.
#[derive(Clone, Debug)]
pub(crate) struct Accessor {
    /// Its name in messages: "accessor 3".
    pub name: String,
    /// Storage of one component.
    pub component: Component,
    /// Components of an element.
    pub dimensions: u64,
    /// Integers represent 0..1 or -1..1.
    pub normalized: bool,
    /// Elements; at least 1.
    pub count: u64,
    base: Option<ElementRun>,
    sparse: Option<Sparse>,
}

/// The buffers of a file with its checked accessors.
#[derive(Debug)]
pub(super) struct Data {
    buffers: Vec<Vec<u8>>,
    views: Vec<BufferRange>,
    /// In the order of the file.
    pub accessors: Vec<Accessor>,
}

/// The range of a buffer view, or of an object with the same members: buffer, first byte, and number of bytes, which are there.
pub(super) fn range_of(item: &Item, buffers: &[Vec<u8>]) -> Result<(usize, u64, u64), SceneError> {
    let buffer =
        item.index("buffer", buffers.len(), "buffer")?.ok_or_else(|| item.error("has no 'buffer'"))?;
    let start = item.whole("byteOffset")?.unwrap_or(0);
    let length = item.whole("byteLength")?.ok_or_else(|| item.error("has no 'byteLength'"))?;
    let available = buffers[buffer].len() as u64;
    let end = start.checked_add(length).filter(|&end| end <= available);
    if end.is_none() {
        return Err(
            item.error(format!("covers {length} bytes from {start}, but buffer {buffer} has {available}"))
        );
    }
    Ok((buffer, start, length))
}

impl Data {
    /// Checks all buffer views and accessors of `root` against the buffers.
    pub(super) fn new(root: &Item, buffers: Vec<Vec<u8>>, limits: &Limits) -> Result<Self, SceneError> {
        let mut data = Self { buffers, views: vec![], accessors: vec![] };
        for item in root.list("bufferViews", "bufferView", limits.objects)? {
            let view = data.check_view(&item)?;
            data.views.push(view);
        }
        for item in root.list("accessors", "accessor", limits.objects)? {
            let accessor = data.check_accessor(&item)?;
            data.accessors.push(accessor);
        }
        Ok(data)
    }

    /// The bytes of a buffer view.
    pub(crate) fn view_bytes(&self, view: usize) -> Option<&[u8]> {
        let v = self.views.get(view)?;
        self.buffers[v.buffer].get(v.start as usize..(v.start + v.length) as usize)
    }

    fn check_view(&self, item: &Item) -> Result<BufferRange, SceneError> {
        let (buffer, start, length) = range_of(item, &self.buffers)?;
        let stride = item.whole("byteStride")?;
        if let Some(stride) = stride.filter(|s| !(4..=252).contains(s) || s % 4 != 0) {
            return Err(
                item.error(format!("'byteStride' is {stride}; it must be a multiple of 4 from 4 to 252"))
            );
        }
        Ok(BufferRange { buffer, start, length, stride })
    }

    fn check_accessor(&self, item: &Item) -> Result<Accessor, SceneError> {
        let component = self.component(item)?;
        let kind = item.text("type")?.unwrap_or("missing");
        let dimensions = match kind {
            "SCALAR" => 1,
            "VEC2" => 2,
            "VEC3" => 3,
            "VEC4" | "MAT2" => 4,
            "MAT3" => 9,
            "MAT4" => 16,
            other => {
                return Err(item.error(format!(
                    "'type' is {}; it must be SCALAR, VEC2..VEC4 or MAT2..MAT4",
                    super::json::shorten(other)
                )))
            }
        };
        let count = item.whole("count")?.ok_or_else(|| item.error("has no 'count'"))?;
        if count == 0 {
            return Err(item.error("'count' is 0; an accessor needs at least one element"));
        }
        let size = component.size() * dimensions;
        let offset = item.whole("byteOffset")?.unwrap_or(0);
        let base = match item.index("bufferView", self.views.len(), "bufferView")? {
            Some(view) => Some(self.run(item, view, offset, count, size, self.views[view].stride)?),
            None => None,
        };
        let sparse = match item.object("sparse")? {
            Some(sparse) => Some(self.check_sparse(&sparse, count, size)?),
            None => None,
        };
        if base.is_none() && sparse.is_none() {
            return Err(item.error(
                "has neither a 'bufferView' nor 'sparse' data, so that all its numbers are 0: re-export the mesh",
            ));
        }
        Ok(Accessor {
            name: item.name.clone(),
            component,
            dimensions,
            normalized: item.flag("normalized")?,
            count,
            base,
            sparse,
        })
    }

    fn component(&self, item: &Item) -> Result<Component, SceneError> {
        let code = item.whole("componentType")?.ok_or_else(|| item.error("has no 'componentType'"))?;
        Component::from_code(code).ok_or_else(|| {
            item.error(format!("'componentType' is {code}; it must be 5120 to 5123, 5125 or 5126"))
        })
    }

    /// Checks that `count` elements of `size` bytes from `offset` lie inside a view.
    fn run(
        &self,
        item: &Item,
        view: usize,
        offset: u64,
        count: u64,
        size: u64,
        stride: Option<u64>,
    ) -> Result<ElementRun, SceneError> {
        let v = self.views[view];
        let step = stride.unwrap_or(size);
        if step < size {
            return Err(item.error(format!(
                "has elements of {size} bytes, but bufferView {view} puts them {step} bytes apart"
            )));
        }
        let needed = (count - 1)
            .checked_mul(step)
            .and_then(|n| n.checked_add(size))
            .and_then(|n| n.checked_add(offset));
        match needed {
            Some(n) if n <= v.length => Ok(ElementRun { buffer: v.buffer, start: v.start + offset, step }),
            Some(n) => Err(item.error(format!("needs {n} bytes, but bufferView {view} has {}", v.length))),
            None => {
                Err(item.error(format!("'count' {count} with 'byteOffset' {offset} is beyond any buffer")))
            }
        }
    }

    fn check_sparse(&self, item: &Item, count: u64, size: u64) -> Result<Sparse, SceneError> {
        let replaced = item.whole("count")?.ok_or_else(|| item.error("has no 'count'"))?;
        if replaced == 0 || replaced > count {
            return Err(
                item.error(format!("'count' is {replaced}; it must be from 1 to the accessor's {count}"))
            );
        }
        let part = |key: &str| item.object(key)?.ok_or_else(|| item.error(format!("has no '{key}'")));
        let (indices, values) = (part("indices")?, part("values")?);
        let index_type = self.component(&indices)?;
        if !index_type.is_unsigned() {
            return Err(indices.error("'componentType' must be an unsigned integer"));
        }
        let run = |part: &Item, size| {
            let view = part
                .index("bufferView", self.views.len(), "bufferView")?
                .ok_or_else(|| part.error("has no 'bufferView'"))?;
            self.run(part, view, part.whole("byteOffset")?.unwrap_or(0), replaced, size, None)
        };
        let sparse = Sparse {
            count: replaced,
            index_type,
            indices: run(&indices, index_type.size())?,
            values: run(&values, size)?,
        };
        let mut last = None;
        for k in 0..replaced {
            let i = self.unsigned(index_type, sparse.indices, k);
            if i >= count {
                return Err(indices.error(format!("points at element {i}, but the accessor has {count}")));
            }
            if last.is_some_and(|last| i <= last) {
                return Err(indices.error(format!(
                    "must rise from one to the next, but {i} follows {}",
                    last.unwrap_or(0)
                )));
            }
            last = Some(i);
        }
        Ok(sparse)
    }

    /// `N` bytes at an element of a run. The run was checked, so the bytes exist.
    fn bytes<const N: usize>(&self, run: ElementRun, element: u64, offset: u64) -> [u8; N] {
        let at = (run.start + element * run.step + offset) as usize;
        let mut out = [0; N];
        out.copy_from_slice(&self.buffers[run.buffer][at..at + N]);
        out
    }

    fn unsigned(&self, component: Component, run: ElementRun, element: u64) -> u64 {
        match component {
            Component::U8 => self.bytes::<1>(run, element, 0)[0].into(),
            Component::U16 => u16::from_le_bytes(self.bytes(run, element, 0)).into(),
            _ => u32::from_le_bytes(self.bytes(run, element, 0)).into(),
        }
    }

    /// The place of an element after sparse replacement; `None` reads as zero.
    fn locate(&self, accessor: &Accessor, element: u64) -> Option<(ElementRun, u64)> {
        if let Some(sparse) = accessor.sparse {
            let (mut low, mut high) = (0, sparse.count);
            while low < high {
                let middle = low + (high - low) / 2;
                match self.unsigned(sparse.index_type, sparse.indices, middle).cmp(&element) {
                    std::cmp::Ordering::Equal => return Some((sparse.values, middle)),
                    std::cmp::Ordering::Less => low = middle + 1,
                    std::cmp::Ordering::Greater => high = middle,
                }
            }
        }
        accessor.base.map(|run| (run, element))
    }

    /// An index. `element` must be below the accessor's count.
    pub(super) fn index(&self, accessor: &Accessor, element: u64) -> u64 {
        self.locate(accessor, element).map_or(0, |(run, i)| self.unsigned(accessor.component, run, i))
    }

    /// The first `N` components of an element as floats, integers scaled according to `normalized`. `element` must be
    /// below the count.
    pub(super) fn floats<const N: usize>(&self, accessor: &Accessor, element: u64) -> [f32; N] {
        let Some((run, i)) = self.locate(accessor, element) else { return [0.0; N] };
        let scale = |x: f32, greatest: f32| if accessor.normalized { (x / greatest).max(-1.0) } else { x };
        let mut out = [0.0; N];
        for (k, o) in out.iter_mut().enumerate().take(accessor.dimensions as usize) {
            let at = k as u64 * accessor.component.size();
            *o = match accessor.component {
                Component::F32 => f32::from_le_bytes(self.bytes(run, i, at)),
                Component::I8 => scale(f32::from(self.bytes::<1>(run, i, at)[0] as i8), 127.0),
                Component::U8 => scale(f32::from(self.bytes::<1>(run, i, at)[0]), 255.0),
                Component::I16 => scale(f32::from(i16::from_le_bytes(self.bytes(run, i, at))), 32767.0),
                Component::U16 => scale(f32::from(u16::from_le_bytes(self.bytes(run, i, at))), 65535.0),
                Component::U32 => u32::from_le_bytes(self.bytes(run, i, at)) as f32,
            };
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::{json, Value};

    fn data(root: &Value, bytes: &[u8]) -> Result<Data, SceneError> {
        Data::new(&Item::new(root, "document".into()).unwrap(), vec![bytes.to_vec()], &Limits::default())
    }

    #[test]
    fn every_component_type_reads_its_golden_bytes() {
        let bytes =
            [0x80, 0x7f, 0xff, 0x00, 0x00, 0x80, 0xff, 0x7f, 0x01, 0x00, 0x00, 0x00, 0x00, 0x00, 0x80, 0x3f];
        let cases = [
            (5120, true, 0, [-1.0, 1.0]),
            (5120, false, 0, [-128.0, 127.0]),
            (5121, true, 2, [1.0, 0.0]),
            (5122, true, 4, [-1.0, 1.0]),
            (5123, false, 4, [32768.0, 32767.0]),
            (5125, false, 8, [1.0, 1_065_353_216.0]),
            (5126, false, 8, [1e-45, 1.0]),
        ];
        for (component, normalized, offset, expected) in cases {
            let root = json!({
                "bufferViews": [{"buffer": 0, "byteLength": 16}],
                "accessors": [{"bufferView": 0, "byteOffset": offset, "componentType": component, "normalized": normalized, "type": "VEC2", "count": 1}]});
            let d = data(&root, &bytes).unwrap();
            assert_eq!(d.floats::<2>(&d.accessors[0], 0), expected, "{component} {normalized}");
        }
    }

    #[test]
    fn stride_and_sparse_replacement() {
        let mut bytes = vec![];
        for x in [1.0f32, 9.0, 2.0, 9.0, 3.0, 9.0, 7.0] {
            bytes.extend(x.to_le_bytes());
        }
        bytes.extend([1u8, 0, 0, 0]);
        let root = json!({
            "bufferViews": [{"buffer": 0, "byteLength": 24, "byteStride": 8}, {"buffer": 0, "byteOffset": 24, "byteLength": 8}],
            "accessors": [{"bufferView": 0, "componentType": 5126, "type": "SCALAR", "count": 3, "sparse": {"count": 1,
                "indices": {"bufferView": 1, "byteOffset": 4, "componentType": 5121}, "values": {"bufferView": 1}}}]});
        let d = data(&root, &bytes).unwrap();
        let read: Vec<f32> = (0..3).map(|i| d.floats::<1>(&d.accessors[0], i)[0]).collect();
        assert_eq!(read, [1.0, 7.0, 3.0]);
    }

    #[test]
    fn sizes_near_the_edges_of_64_bits_are_refused() {
        for (count, offset) in
            [(u64::MAX, 0), (1 << 62, 0), (1 << 32, 4), (1, u64::MAX), (2, 1 << 63), (5, 0), (4, 1)]
        {
            let root = json!({
                "bufferViews": [{"buffer": 0, "byteLength": 16}],
                "accessors": [{"bufferView": 0, "byteOffset": offset, "componentType": 5126, "type": "SCALAR", "count": count}]});
            assert!(
                data(&root, &[0; 16]).unwrap_err().to_string().contains("accessor 0"),
                "{count} {offset}"
            );
        }
        for (offset, length) in [(u64::MAX, 1), (1, u64::MAX), (0, 17), (17, 0)] {
            let root = json!({"bufferViews": [{"buffer": 0, "byteOffset": offset, "byteLength": length}]});
            assert!(data(&root, &[0; 16]).unwrap_err().to_string().contains("buffer 0 has 16"));
        }
    }
}
