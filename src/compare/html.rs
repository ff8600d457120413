//! Markup that cannot go wrong: names are constants, and everything else is escaped on its way in.

use std::fmt::Write;

/// HTML or SVG that is being written.
#[derive(Debug, Default)]
pub struct Markup {
    out: String,
}

/// Names and values of attributes.
pub type Attributes<'a> = &'a [(&'static str, &'a str)];

impl Markup {
    /// Nothing yet.
    pub fn new() -> Self {
        Self::default()
    }

    /// An element with what `inside` writes.
    pub fn element(
        &mut self,
        name: &'static str,
        attributes: Attributes<'_>,
        inside: impl FnOnce(&mut Self),
    ) -> &mut Self {
        self.start(name, attributes);
        inside(self);
        self.out.push_str("</");
        self.out.push_str(name);
        self.out.push('>');
        self
    }

    /// An element of text.
    pub fn leaf(&mut self, name: &'static str, attributes: Attributes<'_>, text: &str) -> &mut Self {
        self.element(name, attributes, |inside| {
            inside.text(text);
        })
    }

    /// An element that holds nothing and has no end, such as `img`.
    pub fn void(&mut self, name: &'static str, attributes: Attributes<'_>) -> &mut Self {
        self.start(name, attributes);
        self
    }

    /// Text.
    pub fn text(&mut self, text: &str) -> &mut Self {
        escape(text, &mut self.out);
        self
    }

    /// The document type and a style sheet are the only markup that is taken as it is, and both are constants.
    pub fn constant(&mut self, markup: &'static str) -> &mut Self {
        self.out.push_str(markup);
        self
    }

    /// Another piece, escaped already.
    pub fn append(&mut self, other: Markup) -> &mut Self {
        self.out.push_str(&other.out);
        self
    }

    /// All that was written.
    pub fn finish(self) -> String {
        self.out
    }

    fn start(&mut self, name: &'static str, attributes: Attributes<'_>) {
        self.out.push('<');
        self.out.push_str(name);
        for (key, value) in attributes {
            self.out.push(' ');
            self.out.push_str(key);
            self.out.push_str("=\"");
            escape(value, &mut self.out);
            self.out.push('"');
        }
        self.out.push('>');
    }
}

/// Escapes for text and for attributes in double quotes. Control characters, which no document may hold, become the
/// replacement character.
fn escape(text: &str, out: &mut String) {
    for letter in text.chars() {
        match letter {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            '\'' => out.push_str("&#39;"),
            '\t' | '\n' => out.push(letter),
            control if control.is_control() => out.push('\u{fffd}'),
            letter => out.push(letter),
        }
    }
}

/// Bytes as an address that holds them.
pub fn data_uri(media_type: &'static str, bytes: &[u8]) -> String {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut out = String::with_capacity(32 + bytes.len().div_ceil(3) * 4);
    // Writing to a string cannot fail.
    let _ = write!(out, "data:{media_type};base64,");
    for three in bytes.chunks(3) {
        let word =
            three.iter().enumerate().fold(0u32, |word, (i, &byte)| word | u32::from(byte) << (16 - 8 * i));
        for digit in 0..4 {
            let is_there = digit <= three.len();
            let index = (word >> (18 - 6 * digit) & 63) as usize;
            out.push(if is_there { DIGITS[index] as char } else { '=' });
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn values_cannot_become_markup() {
        let mut page = Markup::new();
        page.element("p", &[("title", "\"><script>'")], |p| {
            p.leaf("b", &[], "1 < 2 & \u{0}\u{1b}[0m");
            p.void("br", &[]);
        });
        let expected =
            "<p title=\"&quot;&gt;&lt;script&gt;&#39;\"><b>1 &lt; 2 &amp; \u{fffd}\u{fffd}[0m</b><br></p>";
        assert_eq!(page.finish(), expected);
    }

    #[test]
    fn data_uris_are_base64() {
        for (bytes, expected) in [
            ("", ""),
            ("f", "Zg=="),
            ("fo", "Zm8="),
            ("foo", "Zm9v"),
            ("foob", "Zm9vYg=="),
            ("foobar", "Zm9vYmFy"),
        ] {
            assert_eq!(data_uri("a/b", bytes.as_bytes()), format!("data:a/b;base64,{expected}"));
        }
    }

    proptest! {
        #[test]
        fn no_text_opens_an_element(text in any::<String>()) {
            let mut page = Markup::new();
            page.text(&text);
            prop_assert!(!page.finish().contains(['<', '>', '"', '\'']));
        }
    }
}
