//! msgpack (github.com/msgpack/msgpack/blob/master/spec.md), as far as Pupil uses it: a reader over bytes that are
//! there, and a writer for its mock.
//!
//! The reader allocates nothing and does not recurse. Every element takes at least one byte, so no text can make it
//! work longer than its length.

/// The bytes are no msgpack, or not what was asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("its payload is no msgpack of the expected form")]
pub struct BadMsgpack;

/// Reads elements one after the other.
#[derive(Clone, Copy, Debug)]
pub struct ElementDecoder<'a> {
    rest: &'a [u8],
}

/// The head of an element.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Element<'a> {
    /// Nothing, or a truth value.
    Nil,
    /// A number, whatever its type. Whole numbers beyond 2^53 are rounded.
    Number(f64),
    /// A text, as bytes.
    Text(&'a [u8]),
    /// Bytes, or an extension.
    Bytes,
    /// So many elements follow.
    Array(u32),
    /// So many pairs of elements follow.
    Map(u32),
}

impl<'a> ElementDecoder<'a> {
    /// Reads `bytes` from their begin.
    pub fn new(bytes: &'a [u8]) -> Self {
        Self { rest: bytes }
    }

    /// True behind the last element.
    pub fn is_at_end(&self) -> bool {
        self.rest.is_empty()
    }

    fn take(&mut self, count: usize) -> Result<&'a [u8], BadMsgpack> {
        let (taken, rest) = self.rest.split_at_checked(count).ok_or(BadMsgpack)?;
        self.rest = rest;
        Ok(taken)
    }

    fn number<const N: usize>(&mut self) -> Result<[u8; N], BadMsgpack> {
        self.take(N)?.try_into().map_err(|_| BadMsgpack)
    }

    fn length(&mut self, bytes: u8) -> Result<u32, BadMsgpack> {
        Ok(match bytes {
            1 => u32::from(self.number::<1>()?[0]),
            2 => u32::from(u16::from_be_bytes(self.number()?)),
            _ => u32::from_be_bytes(self.number()?),
        })
    }

    fn bytes(&mut self, extra: usize, width: u8) -> Result<Element<'a>, BadMsgpack> {
        let length = self.length(width)? as usize;
        self.take(length.saturating_add(extra))?;
        Ok(Element::Bytes)
    }

    /// The next element; what it contains follows.
    ///
    /// # Errors
    /// The bytes end before it does, or begin with 0xc1, which nothing does.
    pub fn head(&mut self) -> Result<Element<'a>, BadMsgpack> {
        let [first] = self.number()?;
        Ok(match first {
            0x00..=0x7f => Element::Number(f64::from(first)),
            0x80..=0x8f => Element::Map(u32::from(first & 0x0f)),
            0x90..=0x9f => Element::Array(u32::from(first & 0x0f)),
            0xa0..=0xbf => Element::Text(self.take(usize::from(first & 0x1f))?),
            0xc0 | 0xc2 | 0xc3 => Element::Nil,
            0xc1 => return Err(BadMsgpack),
            0xc4 => self.bytes(0, 1)?,
            0xc5 => self.bytes(0, 2)?,
            0xc6 => self.bytes(0, 4)?,
            0xc7 => self.bytes(1, 1)?,
            0xc8 => self.bytes(1, 2)?,
            0xc9 => self.bytes(1, 4)?,
            0xca => Element::Number(f64::from(f32::from_be_bytes(self.number()?))),
            0xcb => Element::Number(f64::from_be_bytes(self.number()?)),
            0xcc => Element::Number(f64::from(self.number::<1>()?[0])),
            0xcd => Element::Number(f64::from(u16::from_be_bytes(self.number()?))),
            0xce => Element::Number(f64::from(u32::from_be_bytes(self.number()?))),
            0xcf => Element::Number(u64::from_be_bytes(self.number()?) as f64),
            0xd0 => Element::Number(f64::from(i8::from_be_bytes(self.number()?))),
            0xd1 => Element::Number(f64::from(i16::from_be_bytes(self.number()?))),
            0xd2 => Element::Number(f64::from(i32::from_be_bytes(self.number()?))),
            0xd3 => Element::Number(i64::from_be_bytes(self.number()?) as f64),
            0xd4..=0xd8 => {
                self.take(1 + (1 << (first - 0xd4)))?;
                Element::Bytes
            }
            0xd9..=0xdb => {
                let length = self.length(1 << (first - 0xd9))?;
                Element::Text(self.take(length as usize)?)
            }
            0xdc | 0xdd => Element::Array(self.length(if first == 0xdc { 2 } else { 4 })?),
            0xde | 0xdf => Element::Map(self.length(if first == 0xde { 2 } else { 4 })?),
            0xe0..=0xff => Element::Number(f64::from(first as i8)),
        })
    }

    /// Passes over the next element with all that it contains.
    ///
    /// # Errors
    /// As [`ElementDecoder::head`].
    pub fn skip(&mut self) -> Result<(), BadMsgpack> {
        let mut open = 1u64;
        while open > 0 {
            open -= 1;
            open += match self.head()? {
                Element::Array(count) => u64::from(count),
                Element::Map(count) => 2 * u64::from(count),
                _ => 0,
            };
        }
        Ok(())
    }

    /// The next element, which is a number.
    ///
    /// # Errors
    /// As [`ElementDecoder::head`], or it is none.
    pub fn f64(&mut self) -> Result<f64, BadMsgpack> {
        match self.head()? {
            Element::Number(number) => Ok(number),
            _ => Err(BadMsgpack),
        }
    }

    /// The next element, which is an array of three finite numbers.
    ///
    /// # Errors
    /// As [`ElementDecoder::head`], or it is none.
    pub fn vector(&mut self) -> Result<[f64; 3], BadMsgpack> {
        if self.head()? != Element::Array(3) {
            return Err(BadMsgpack);
        }
        let vector = [self.f64()?, self.f64()?, self.f64()?];
        vector.iter().all(|x| x.is_finite()).then_some(vector).ok_or(BadMsgpack)
    }

    /// The next element, which is a map: how many pairs follow.
    ///
    /// # Errors
    /// As [`ElementDecoder::head`], or it is none.
    pub fn map(&mut self) -> Result<u32, BadMsgpack> {
        match self.head()? {
            Element::Map(count) => Ok(count),
            _ => Err(BadMsgpack),
        }
    }
}

/// Puts the head of a map of `pairs` pairs, at most 15.
pub fn put_map(pairs: u8, out: &mut Vec<u8>) {
    out.push(0x80 | pairs.min(15));
}

/// Puts a text of at most 255 bytes; what is longer is cut.
pub fn put_text(text: &str, out: &mut Vec<u8>) {
    let bytes = &text.as_bytes()[..text.len().min(255)];
    if bytes.len() < 32 {
        out.push(0xa0 | bytes.len() as u8);
    } else {
        out.extend_from_slice(&[0xd9, bytes.len() as u8]);
    }
    out.extend_from_slice(bytes);
}

/// Puts a number.
pub fn put_f64(number: f64, out: &mut Vec<u8>) {
    out.push(0xcb);
    out.extend_from_slice(&number.to_be_bytes());
}

/// Puts an array of numbers, at most 15.
pub fn put_vector(numbers: &[f64], out: &mut Vec<u8>) {
    out.push(0x90 | numbers.len().min(15) as u8);
    numbers.iter().take(15).for_each(|number| put_f64(*number, out));
}

/// Puts a whole number from 0 to 127.
pub fn put_small(number: u8, out: &mut Vec<u8>) {
    out.push(number & 0x7f);
}
