//! What stands behind the question mark of a request.

/// Longest query that is read, bytes.
pub(crate) const MAX_QUERY: usize = 2048;

/// The value of `key` in a query, without percent encoding; `None` if it is missing, no text, or the query too long.
pub(crate) fn part(query: &str, key: &str) -> Option<String> {
    if query.len() > MAX_QUERY {
        return None;
    }
    decoded(query.split('&').find_map(|part| part.strip_prefix(key)?.strip_prefix('='))?)
}

/// Text without percent encoding; `None` if it is none.
fn decoded(text: &str) -> Option<String> {
    let mut bytes = Vec::with_capacity(text.len());
    let mut rest = text.bytes();
    while let Some(byte) = rest.next() {
        bytes.push(match byte {
            b'%' => {
                let mut digit = || char::from(rest.next()?).to_digit(16);
                (digit()? * 16 + digit()?) as u8
            }
            b'+' => b' ',
            plain => plain,
        });
    }
    String::from_utf8(bytes).ok()
}
