//! Bytes into pictures: a row of PPM or PAM images (netpbm's P6 and P7), or of RGBA texels alone.

use super::fit::fitted;

/// Longest header of an image, with its comments.
const LONGEST_HEADER: usize = 1024;
/// Longest side of an image, and most of its texels.
const LONGEST_SIDE: u32 = 8192;
const MOST_TEXELS: u64 = 1 << 24;

/// What a source sends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum StreamForm {
    /// PPM or PAM images, each with its own size.
    Netpbm,
    /// RGBA texels of pictures that have the size of the texture.
    Rgba,
}

/// Collects bytes into pictures.
pub(super) struct Decoder {
    form: StreamForm,
    size: [u32; 2],
    /// What has come of the next picture.
    bytes: Vec<u8>,
    /// The size of the last picture that was sent.
    sent: [u32; 2],
    picture: Vec<[u8; 4]>,
}

/// The header of an image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Header {
    /// Its length in bytes.
    len: usize,
    size: [u32; 2],
    /// Bytes of a texel: 3 or 4.
    depth: usize,
}

impl Header {
    fn image_len(&self) -> usize {
        self.size[0] as usize * self.size[1] as usize * self.depth
    }
}

impl Decoder {
    /// For textures of `size` texels (columns, rows).
    pub(super) fn new(form: StreamForm, size: [u32; 2]) -> Self {
        Self { form, size, bytes: Vec::new(), sent: size, picture: Vec::new() }
    }

    /// The size of the last picture that was sent, before it was fitted to the texture.
    pub(super) fn sent(&self) -> [u32; 2] {
        self.sent
    }

    /// The next bytes. Calls `show` for every picture that they complete, with as many texels as the texture has.
    ///
    /// # Errors
    /// They are no images of this form. Nothing that follows can be read.
    pub(super) fn push(&mut self, bytes: &[u8], mut show: impl FnMut(&[[u8; 4]])) -> Result<(), String> {
        self.bytes.extend_from_slice(bytes);
        let mut begin = 0;
        while let Some(header) = self.header(begin)? {
            let image = begin + header.len;
            let end = image + header.image_len();
            if self.bytes.len() < end {
                break;
            }
            self.sent = header.size;
            let texels = &self.bytes[image..end];
            self.picture.clear();
            match header.depth {
                4 => self.picture.extend(texels.chunks_exact(4).map(|c| [c[0], c[1], c[2], 255])),
                _ => self.picture.extend(texels.chunks_exact(3).map(|c| [c[0], c[1], c[2], 255])),
            }
            if header.size != self.size {
                self.picture = fitted(&self.picture, header.size, self.size);
            }
            show(&self.picture);
            begin = end;
        }
        self.bytes.drain(..begin);
        Ok(())
    }

    /// The header of the picture whose bytes begin at `begin`; `None` if not all of it has come.
    fn header(&self, begin: usize) -> Result<Option<Header>, String> {
        if self.bytes.len() == begin {
            return Ok(None);
        }
        match self.form {
            StreamForm::Rgba => Ok(Some(Header { len: 0, size: self.size, depth: 4 })),
            StreamForm::Netpbm => netpbm(&self.bytes[begin..]),
        }
    }
}

/// The header of a PPM or PAM image; `None` if it has not come to its end.
fn netpbm(bytes: &[u8]) -> Result<Option<Header>, String> {
    let known = &bytes[..bytes.len().min(LONGEST_HEADER)];
    let read = match known {
        [b'P'] => None,
        [b'P', b'6', ..] => ppm(known)?,
        [b'P', b'7', ..] => pam(known)?,
        _ => {
            return Err(
                "what comes is neither PPM (P6) nor PAM (P7); with ffmpeg write `-f image2pipe -c:v ppm`"
                    .into(),
            )
        }
    };
    let Some(header) = read else {
        let is_long = bytes.len() >= LONGEST_HEADER;
        return if is_long { Err("an image's header has no end".into()) } else { Ok(None) };
    };
    let [width, height] = header.size;
    if width == 0 || height == 0 {
        return Err(format!("an image has {width} x {height} pixels"));
    }
    if width.max(height) > LONGEST_SIDE || u64::from(width) * u64::from(height) > MOST_TEXELS {
        return Err(format!(
            "an image has {width} x {height} pixels; at most {MOST_TEXELS} are read, and {LONGEST_SIDE} along a side"
        ));
    }
    Ok(Some(header))
}

/// "P6", width, height and greatest value, with white space and comments between them, and one white space behind.
fn ppm(bytes: &[u8]) -> Result<Option<Header>, String> {
    let (mut at, mut numbers) = (2, [0u32; 3]);
    for number in &mut numbers {
        let begin = at;
        loop {
            match bytes.get(at) {
                None => return Ok(None),
                Some(b'#') => match bytes[at..].iter().position(|b| *b == b'\n') {
                    Some(end) => at += end,
                    None => return Ok(None),
                },
                Some(b) if b.is_ascii_whitespace() => at += 1,
                Some(b) if b.is_ascii_digit() && at > begin => break,
                Some(_) => return Err("a PPM image's header has no number where one has to be".into()),
            }
        }
        while let Some(digit) = bytes.get(at).filter(|b| b.is_ascii_digit()) {
            *number = number.saturating_mul(10).saturating_add(u32::from(digit - b'0'));
            at += 1;
        }
    }
    match bytes.get(at) {
        None => return Ok(None),
        Some(b) if b.is_ascii_whitespace() => {}
        Some(_) => return Err("a PPM image's header does not end with white space".into()),
    }
    let [width, height, greatest] = numbers;
    check_greatest(greatest)?;
    Ok(Some(Header { len: at + 1, size: [width, height], depth: 3 }))
}

/// "P7" and lines of a word with a value, up to ENDHDR.
fn pam(bytes: &[u8]) -> Result<Option<Header>, String> {
    let mut at = 0;
    let (mut width, mut height, mut depth, mut greatest) = (0, 0, 0, 0);
    while let Some(end) = bytes[at..].iter().position(|b| *b == b'\n') {
        let line = String::from_utf8_lossy(&bytes[at..at + end]);
        at += end + 1;
        let mut words = line.split_ascii_whitespace();
        let number = |word: Option<&str>| {
            word.and_then(|word| word.parse::<u32>().ok())
                .ok_or_else(|| format!("a PAM image's header says {line:?}"))
        };
        match words.next() {
            Some("WIDTH") => width = number(words.next())?,
            Some("HEIGHT") => height = number(words.next())?,
            Some("DEPTH") => depth = number(words.next())?,
            Some("MAXVAL") => greatest = number(words.next())?,
            Some("ENDHDR") => {
                check_greatest(greatest)?;
                if depth != 3 && depth != 4 {
                    return Err(format!(
                        "a PAM image has {depth} channels; 3 (RGB) and 4 (RGB_ALPHA) are read"
                    ));
                }
                return Ok(Some(Header { len: at, size: [width, height], depth: depth as usize }));
            }
            // The kind of tuples follows from their length; comments and empty lines mean nothing.
            _ => {}
        }
    }
    Ok(None)
}

fn check_greatest(value: u32) -> Result<(), String> {
    if value == 255 {
        return Ok(());
    }
    Err(format!("an image's greatest value is {value}; 8 bits are read, which is 255"))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// All pictures of `bytes`, pushed in pieces of `piece`.
    fn decoded(
        form: StreamForm,
        size: [u32; 2],
        bytes: &[u8],
        piece: usize,
    ) -> Result<Vec<Vec<[u8; 4]>>, String> {
        let (mut decoder, mut pictures) = (Decoder::new(form, size), vec![]);
        for part in bytes.chunks(piece) {
            decoder.push(part, |picture| pictures.push(picture.to_vec()))?;
        }
        Ok(pictures)
    }

    const RGB: [[u8; 4]; 6] = [
        [1, 2, 3, 255],
        [4, 5, 6, 255],
        [7, 8, 9, 255],
        [35, 10, 80, 255],
        [55, 54, 10, 255],
        [0, 0, 255, 255],
    ];

    /// Two PPM images and a PAM image with alpha, which is left out.
    fn sequence() -> Vec<u8> {
        let rgb: Vec<u8> = RGB.iter().flat_map(|c| [c[0], c[1], c[2]]).collect();
        let rgba: Vec<u8> = RGB.iter().flat_map(|c| [c[0], c[1], c[2], 7]).collect();
        [
            &b"P6\n3 2\n255\n"[..],
            &rgb,
            b"P6 # a comment\n#another 9\n  3\t2 \n255 ",
            &rgb,
            b"P7\nWIDTH 3\nHEIGHT 2\nDEPTH 4\nMAXVAL 255\nTUPLTYPE RGB_ALPHA\nENDHDR\n",
            &rgba,
        ]
        .concat()
    }

    #[test]
    fn images_follow_each_other_however_they_are_cut() {
        let bytes = sequence();
        for piece in 1..=bytes.len() {
            let pictures = decoded(StreamForm::Netpbm, [3, 2], &bytes, piece).unwrap();
            assert_eq!(pictures, vec![RGB.to_vec(); 3], "in pieces of {piece}");
        }
        let raw: Vec<u8> = RGB.iter().flat_map(|c| [c[0], c[1], c[2], 9]).collect();
        let twice = [&raw[..], &raw, &raw[..5]].concat();
        for piece in 1..=twice.len() {
            assert_eq!(decoded(StreamForm::Rgba, [3, 2], &twice, piece).unwrap(), vec![RGB.to_vec(); 2]);
        }
    }

    /// An even picture stays even at any size, and halving a picture takes means.
    #[test]
    fn other_sizes_are_fitted() {
        let even = [&b"P6 5 4 255 "[..], &[9, 200, 31].repeat(20)].concat();
        for size in [[1, 1], [2, 3], [5, 4], [16, 9]] {
            let mut decoder = Decoder::new(StreamForm::Netpbm, size);
            let mut count = 0;
            let shown = |picture: &[[u8; 4]]| {
                assert_eq!(picture, vec![[9, 200, 31, 255]; (size[0] * size[1]) as usize]);
                count += 1;
            };
            decoder.push(&even, shown).unwrap();
            assert_eq!((count, decoder.sent()), (1, [5, 4]));
        }
        let halves = [&b"P6 8 2 255 "[..], &[0, 0, 0, 200, 200, 200].repeat(8)].concat();
        let pictures = decoded(StreamForm::Netpbm, [1, 1], &halves, 100).unwrap();
        assert_eq!(pictures, [[[100, 100, 100, 255]]]);
    }

    #[test]
    fn what_is_no_image_is_refused_with_its_reason() {
        let long = [&b"P6 "[..], &[b' '; 2000]].concat();
        let cases: [(&[u8], &str); 9] = [
            (b"YUV4MPEG2 W4 H4", "neither PPM (P6) nor PAM (P7)"),
            (b"P6 4 x", "no number"),
            (b"P6 4 4 65535 ", "65535; 8 bits"),
            (b"P6 4 4 255x", "does not end with white space"),
            (b"P6 0 4 255 ", "0 x 4 pixels"),
            (b"P6 99999999999 4 255 ", "4294967295 x 4 pixels; at most"),
            (b"P6 8000 8000 255 ", "8000 x 8000 pixels; at most"),
            (b"P7\nWIDTH 1\nHEIGHT 1\nDEPTH 1\nMAXVAL 255\nENDHDR\n", "1 channels"),
            (&long, "no end"),
        ];
        for (bytes, reason) in cases {
            let told = decoded(StreamForm::Netpbm, [4, 4], bytes, 7).unwrap_err();
            assert!(told.contains(reason), "{told}");
        }
        // A header that is still to come is no error.
        for bytes in [&b"P"[..], b"P6", b"P6 4", b"P6 4 4 255", b"P7\nWIDTH 4", b"P6 # what"] {
            assert_eq!(decoded(StreamForm::Netpbm, [4, 4], bytes, 1), Ok(vec![]));
        }
    }

    /// No bytes make it panic, or keep more than an image and what was pushed.
    #[test]
    fn no_bytes_panic_or_pile_up() {
        let mut random = 1u64;
        let mut next = move || {
            random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (random >> 33) as usize
        };
        for _ in 0..2000 {
            let mut bytes = sequence();
            for _ in 0..next() % 6 {
                let at = next() % bytes.len();
                bytes[at] = next() as u8;
            }
            let mut decoder = Decoder::new(StreamForm::Netpbm, [3, 2]);
            for part in bytes.chunks(1 + next() % 50) {
                if decoder.push(part, |picture| assert_eq!(picture.len(), 6)).is_err() {
                    break;
                }
                assert!(decoder.bytes.len() <= bytes.len());
            }
        }
    }
}
