//! What the service and the process with the window say to each other, as bytes. Nothing here reads or writes.
//!
//! A message is its length as a 32-bit number, a byte that says what it is, and its fields in order. Numbers are little
//! endian; texts are UTF-8 after their length. Both sides run the same program in the same version, except where a seat's
//! unit was not restarted after an update: [`VERSION`] is the first field of the first message of each side.

use std::sync::Arc;

pub use super::wire::BadMessage;
use super::wire::{Reader, Writer};
use crate::projector::{ReceiptMethod, Rgb, Slide};

/// Version of the messages.
pub const VERSION: u16 = 1;

/// Most bytes of one message: a slide of 8192 x 8192 pixels and a little more.
pub const MESSAGE_MAX: usize = 3 * 8192 * 8192 + 64;

/// Bytes before the fields of a message.
pub const HEADER: usize = 5;

/// What the service asks.
#[derive(Debug, Clone, PartialEq)]
pub enum Request {
    /// Which displays are there? Allowed at any time, also while another client has the window.
    List {
        /// [`VERSION`] of who asks.
        version: u16,
    },
    /// Open the window. Answered by [`Reply::Hello`].
    Open {
        /// [`VERSION`] of who asks.
        version: u16,
        /// Which display.
        want: Want,
    },
    /// So many slides follow and replace those of before. [`Reply::Loaded`] comes after the last one.
    Load {
        /// Number of slides.
        count: u32,
    },
    /// One slide of the set.
    Slide(Slide),
    /// Show a slide of the set, or black. Answered by [`Reply::Shown`].
    Show(Option<u32>),
}

/// Which display, and what it must be like.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Want {
    /// Connector, or name or serial number of the display; empty for the only one there is.
    pub display: String,
    /// Columns and rows, where the mode is given.
    pub size: Option<(u32, u32)>,
    /// Refreshes per second, where they are given.
    pub refresh_hz: Option<f64>,
}

/// What the window answers.
#[derive(Debug, Clone, PartialEq)]
pub enum Reply {
    /// Displays that were found.
    Displays(Vec<DisplayLine>),
    /// The window is open and every check passed.
    Hello(Hello),
    /// The set is loaded.
    Loaded {
        /// Number of slides.
        count: u32,
    },
    /// A picture was shown.
    Shown(Shown),
    /// The last request failed.
    Failed(Fault),
}

/// A display as it is listed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DisplayLine {
    /// Connector, to select it by.
    pub connector: String,
    /// Maker, model and mode.
    pub model: String,
    /// Why it cannot be used; empty where it can.
    pub unusable: String,
}

/// What is known of the open window.
#[derive(Debug, Clone, PartialEq)]
pub struct Hello {
    /// [`VERSION`] of who answers.
    pub version: u16,
    /// Connector.
    pub connector: String,
    /// Maker and model.
    pub model: String,
    /// Columns of window, mode and surface, which are equal.
    pub width: u32,
    /// Rows likewise.
    pub height: u32,
    /// Time between refreshes in nanoseconds.
    pub period_ns: u64,
    /// Format of the surface.
    pub format: String,
    /// GPU and its driver.
    pub adapter: String,
    /// What this display's flips can be known by.
    pub method: ReceiptMethod,
    /// What a person should know of the display: why flips are only guessed, what bends code values.
    pub findings: Vec<String>,
}

/// Evidence of a flip.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shown {
    /// Slide, `None` for black.
    pub slide: Option<u32>,
    /// When, in nanoseconds of the machine's monotonic clock, which all processes share.
    pub flipped_ns: u64,
    /// Number of the refresh, where it is known.
    pub refresh: Option<u64>,
    /// How the above is known.
    pub method: ReceiptMethod,
}

/// Why a request failed, by what the user can do about it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Fault {
    /// There is no such display, no X server, no GPU; or it went away.
    Unavailable(String),
    /// The display is not as it was asked for.
    Refused {
        /// What was asked for.
        what: Asked,
        /// How it was asked for.
        requested: String,
        /// How it is.
        offered: String,
    },
    /// The picture did not get to the display in so many milliseconds.
    Timeout(u64),
    /// Something happened that must not, in words.
    Broken(String),
}

/// What of a display can be asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Asked {
    /// Columns and rows.
    Size,
    /// Refreshes per second.
    Refresh,
    /// One pixel of the window on one of the display.
    Scale,
    /// Eight bits per channel, passed on as they are.
    Format,
    /// The version of the messages.
    Version,
    /// Number of a slide.
    Slide,
}

impl Asked {
    const ALL: [Self; 6] = [Self::Size, Self::Refresh, Self::Scale, Self::Format, Self::Version, Self::Slide];

    /// Its name in an error.
    pub fn name(self) -> &'static str {
        match self {
            Self::Size => "display mode (columns x rows)",
            Self::Refresh => "refresh rate (Hz)",
            Self::Scale => "one pixel per pixel",
            Self::Format => "surface format",
            Self::Version => "version of the projector process",
            Self::Slide => "slide number",
        }
    }
}

/// Length and kind of the message that begins with `header`: bytes of its fields, and what it is.
pub fn parse_header(header: [u8; HEADER]) -> Result<(usize, u8), BadMessage> {
    let [a, b, c, d, kind] = header;
    let length = u32::from_le_bytes([a, b, c, d]) as usize;
    if length > MESSAGE_MAX { Err(BadMessage::TooLong(length)) } else { Ok((length, kind)) }
}

impl Request {
    /// The message as bytes.
    pub fn encode(&self) -> Vec<u8> {
        match self {
            Self::List { version } => Writer::new(1).u16(*version).done(),
            Self::Open { version, want } => Writer::new(2)
                .u16(*version)
                .text(&want.display)
                .option(want.size, |out, (width, height)| out.u32(width).u32(height))
                .option(want.refresh_hz, |out, hz| out.u64(hz.to_bits()))
                .done(),
            Self::Load { count } => Writer::new(3).u32(*count).done(),
            Self::Slide(slide) => encode_slide(slide),
            Self::Show(slide) => Writer::new(5).option(*slide, Writer::u32).done(),
        }
    }

    /// The message of `kind` with these fields.
    pub fn decode(kind: u8, fields: &[u8]) -> Result<Self, BadMessage> {
        let mut fields = Reader { kind, rest: fields };
        let message = match kind {
            1 => Self::List { version: fields.u16()? },
            2 => Self::Open {
                version: fields.u16()?,
                want: Want {
                    display: fields.text()?,
                    size: fields.option(|fields| Ok((fields.u32()?, fields.u32()?)))?,
                    refresh_hz: fields.option(|fields| Ok(f64::from_bits(fields.u64()?)))?,
                },
            },
            3 => Self::Load { count: fields.u32()? },
            4 => Self::Slide(decode_slide(&mut fields)?),
            5 => Self::Show(fields.option(Reader::u32)?),
            _ => return Err(BadMessage::Kind(kind)),
        };
        fields.end(message)
    }
}

impl Reply {
    /// The message as bytes.
    pub fn encode(&self) -> Vec<u8> {
        match self {
            Self::Displays(lines) => Writer::new(129)
                .list(lines, |out, line| out.text(&line.connector).text(&line.model).text(&line.unusable))
                .done(),
            Self::Hello(hello) => Writer::new(130)
                .u16(hello.version)
                .text(&hello.connector)
                .text(&hello.model)
                .u32(hello.width)
                .u32(hello.height)
                .u64(hello.period_ns)
                .text(&hello.format)
                .text(&hello.adapter)
                .method(hello.method)
                .list(&hello.findings, |out, finding| out.text(finding))
                .done(),
            Self::Loaded { count } => Writer::new(131).u32(*count).done(),
            Self::Shown(shown) => Writer::new(132)
                .option(shown.slide, Writer::u32)
                .u64(shown.flipped_ns)
                .option(shown.refresh, Writer::u64)
                .method(shown.method)
                .done(),
            Self::Failed(fault) => {
                let out = Writer::new(133);
                match fault {
                    Fault::Unavailable(detail) => out.u8(0).text(detail).done(),
                    Fault::Refused { what, requested, offered } => {
                        let number = Asked::ALL.iter().position(|asked| asked == what).unwrap_or_default();
                        out.u8(1).u8(number as u8).text(requested).text(offered).done()
                    }
                    Fault::Timeout(ms) => out.u8(2).u64(*ms).done(),
                    Fault::Broken(detail) => out.u8(3).text(detail).done(),
                }
            }
        }
    }

    /// The message of `kind` with these fields.
    pub fn decode(kind: u8, fields: &[u8]) -> Result<Self, BadMessage> {
        let mut fields = Reader { kind, rest: fields };
        let message = match kind {
            129 => Self::Displays(fields.list(|fields| {
                Ok(DisplayLine { connector: fields.text()?, model: fields.text()?, unusable: fields.text()? })
            })?),
            130 => Self::Hello(Hello {
                version: fields.u16()?,
                connector: fields.text()?,
                model: fields.text()?,
                width: fields.u32()?,
                height: fields.u32()?,
                period_ns: fields.u64()?,
                format: fields.text()?,
                adapter: fields.text()?,
                method: fields.method()?,
                findings: fields.list(Reader::text)?,
            }),
            131 => Self::Loaded { count: fields.u32()? },
            132 => Self::Shown(Shown {
                slide: fields.option(Reader::u32)?,
                flipped_ns: fields.u64()?,
                refresh: fields.option(Reader::u64)?,
                method: fields.method()?,
            }),
            133 => Self::Failed(match fields.u8()? {
                0 => Fault::Unavailable(fields.text()?),
                1 => Fault::Refused {
                    what: *Asked::ALL.get(usize::from(fields.u8()?)).ok_or(BadMessage::Value(kind))?,
                    requested: fields.text()?,
                    offered: fields.text()?,
                },
                2 => Fault::Timeout(fields.u64()?),
                3 => Fault::Broken(fields.text()?),
                _ => return Err(BadMessage::Value(kind)),
            }),
            _ => return Err(BadMessage::Kind(kind)),
        };
        fields.end(message)
    }
}

/// A slide as a message, without building a [`Request`] around a copy of its pixels.
pub fn encode_slide(slide: &Slide) -> Vec<u8> {
    let (form, values): (u8, &[Rgb]) = match slide {
        Slide::Uniform(value) => (0, std::slice::from_ref(value)),
        Slide::Columns(values) => (1, values),
        Slide::Rows(values) => (2, values),
        Slide::Full(values) => (3, values),
    };
    let mut out = Writer::new(4).u8(form);
    out.bytes.extend_from_slice(values.as_flattened());
    out.done()
}

fn decode_slide(fields: &mut Reader<'_>) -> Result<Slide, BadMessage> {
    let form = fields.u8()?;
    let bytes = std::mem::take(&mut fields.rest);
    let (values, rest) = bytes.as_chunks::<3>();
    if !rest.is_empty() {
        return Err(BadMessage::Short(fields.kind));
    }
    let shared = || Arc::<[Rgb]>::from(values);
    match (form, values) {
        (0, [value]) => Ok(Slide::Uniform(*value)),
        (1, _) => Ok(Slide::Columns(shared())),
        (2, _) => Ok(Slide::Rows(shared())),
        (3, _) => Ok(Slide::Full(shared())),
        _ => Err(BadMessage::Value(fields.kind)),
    }
}

#[cfg(test)]
mod tests {
    use proptest::{collection::vec, option, prelude::*};

    use super::*;
    use crate::window::wire::METHODS;

    fn slide() -> impl Strategy<Value = Slide> {
        let values = || vec(any::<Rgb>(), 0..50).prop_map(Arc::from);
        prop_oneof![
            any::<Rgb>().prop_map(Slide::Uniform),
            values().prop_map(Slide::Columns),
            values().prop_map(Slide::Rows),
            values().prop_map(Slide::Full),
        ]
    }

    fn want() -> impl Strategy<Value = Want> {
        (".*", option::of(any::<(u32, u32)>()), option::of(-1e9..1e9))
            .prop_map(|(display, size, refresh_hz)| Want { display, size, refresh_hz })
    }

    fn request() -> impl Strategy<Value = Request> {
        prop_oneof![
            any::<u16>().prop_map(|version| Request::List { version }),
            (any::<u16>(), want()).prop_map(|(version, want)| Request::Open { version, want }),
            any::<u32>().prop_map(|count| Request::Load { count }),
            slide().prop_map(Request::Slide),
            option::of(any::<u32>()).prop_map(Request::Show),
        ]
    }

    fn method() -> impl Strategy<Value = ReceiptMethod> {
        prop::sample::select(METHODS.to_vec())
    }

    fn fault() -> impl Strategy<Value = Fault> {
        let what = prop::sample::select(Asked::ALL.to_vec());
        prop_oneof![
            ".*".prop_map(Fault::Unavailable),
            (what, ".*", ".*").prop_map(|(what, requested, offered)| Fault::Refused {
                what,
                requested,
                offered
            }),
            any::<u64>().prop_map(Fault::Timeout),
            ".*".prop_map(Fault::Broken),
        ]
    }

    fn reply() -> impl Strategy<Value = Reply> {
        let line = (".*", ".*", ".*").prop_map(|(connector, model, unusable)| DisplayLine {
            connector,
            model,
            unusable,
        });
        let texts = (".*", ".*", ".*", ".*", vec(".*", 0..4));
        let hello = (texts, any::<(u16, u32, u32, u64)>(), method()).prop_map(|(texts, numbers, method)| {
            let (connector, model, format, adapter, findings) = texts;
            let (version, width, height, period_ns) = numbers;
            Hello { version, connector, model, width, height, period_ns, format, adapter, method, findings }
        });
        let shown = (option::of(any::<u32>()), any::<u64>(), option::of(any::<u64>()), method())
            .prop_map(|(slide, flipped_ns, refresh, method)| Shown { slide, flipped_ns, refresh, method });
        prop_oneof![
            vec(line, 0..4).prop_map(Reply::Displays),
            hello.prop_map(Reply::Hello),
            any::<u32>().prop_map(|count| Reply::Loaded { count }),
            shown.prop_map(Reply::Shown),
            fault().prop_map(Reply::Failed),
        ]
    }

    /// Kind and fields of whole messages.
    fn split(message: &[u8]) -> (u8, &[u8]) {
        let (header, fields) = message.split_first_chunk().expect("a header");
        let (length, kind) = parse_header(*header).expect("a header");
        assert_eq!(length, fields.len());
        (kind, fields)
    }

    proptest! {
        #[test]
        fn requests_come_back(request in request()) {
            let message = request.encode();
            let (kind, fields) = split(&message);
            prop_assert_eq!(Request::decode(kind, fields), Ok(request));
        }

        #[test]
        fn replies_come_back(reply in reply()) {
            let message = reply.encode();
            let (kind, fields) = split(&message);
            prop_assert_eq!(Reply::decode(kind, fields), Ok(reply));
        }

        #[test]
        fn no_part_of_a_message_is_one(reply in reply(), cut in any::<prop::sample::Index>()) {
            let message = reply.encode();
            let (kind, fields) = split(&message);
            prop_assume!(!fields.is_empty());
            prop_assert!(Reply::decode(kind, &fields[..cut.index(fields.len())]).is_err());
            prop_assert_eq!(Reply::decode(kind, &[fields, &[0]].concat()), Err(BadMessage::Long(kind)));
        }

        #[test]
        fn noise_is_refused_without_harm(kind in any::<u8>(), noise in vec(any::<u8>(), 0..200)) {
            // What is accepted says the same again.
            if let Ok(request) = Request::decode(kind, &noise) {
                let message = request.encode();
                prop_assert_eq!(split(&message), (kind, &noise[..]));
            }
            if let Ok(reply) = Reply::decode(kind, &noise) {
                let message = reply.encode();
                prop_assert_eq!(split(&message), (kind, &noise[..]));
            }
        }
    }

    #[test]
    fn the_largest_slide_is_a_message_and_nothing_beyond() {
        let header = |length: usize| {
            let [a, b, c, d] = (length as u32).to_le_bytes();
            [a, b, c, d, 4]
        };
        assert_eq!(parse_header(header(3 * 8192 * 8192 + 1)), Ok((3 * 8192 * 8192 + 1, 4)));
        assert_eq!(parse_header(header(MESSAGE_MAX + 1)), Err(BadMessage::TooLong(MESSAGE_MAX + 1)));
    }
}
