//! What can be decoded from the frames that are there, and what is lost by those that are not.

use polscan_patterns::{Axis, AxisCode, Mode, Role};

use super::{
    sample::Sample,
    types::{DecodeError, DecodeSettings, SharedPlane},
};

/// The frames of one bit.
#[derive(Debug, Clone, Copy)]
pub(crate) enum BitFrames<'a, T> {
    /// Pattern and inverse.
    Pair(&'a [T], &'a [T]),
    /// Only one of them; `true` where it is the inverse. Decided against the middle of the references.
    Single(&'a [T], bool),
}

/// The frames of one axis: those of bits 0, 1, ... without a gap.
#[derive(Debug, Clone)]
pub(crate) struct AxisFrames<'a, T> {
    pub axis: Axis,
    pub code: PrefixCode,
    pub bits: Vec<BitFrames<'a, T>>,
}

/// A Gray code of which only the leading bits are known: a value then spans `2^shift` indices.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct PrefixCode {
    pub code: AxisCode,
    /// Number of known bits.
    pub bits: u8,
    /// Number of missing low bits.
    pub shift: u8,
}

impl PrefixCode {
    pub fn new(code: AxisCode, bits: u8) -> Self {
        Self { code, bits, shift: code.bits() - bits }
    }

    /// First and last index of the projector that `value` stands for, or `None` outside the projector.
    pub fn span(self, value: i32) -> Option<(i32, i32)> {
        let first = (value << self.shift) - self.code.offset() as i32;
        let last = first + (1 << self.shift) - 1;
        let (first, last) = (first.max(0), last.min(self.code.size() as i32 - 1));
        (first <= last).then_some((first, last))
    }

    /// Which of the known bits changes between `value` and `value + 1`.
    pub fn bit_of_boundary(self, value: i32) -> u8 {
        let step = |value: i32| value ^ (value >> 1);
        self.bits - 1 - (step(value) ^ step(value + 1)).trailing_zeros() as u8
    }

    /// Coordinate of the boundary between `value` and `value + 1`, in projector px.
    pub fn boundary(self, value: i32) -> f64 {
        f64::from((value + 1) << self.shift) - f64::from(self.code.offset()) - 0.5
    }
}

/// Where the two levels of the code at a pixel come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Levels {
    /// Both references.
    References,
    /// Only the bright reference; the dark one is the mean pair sum less it.
    HighOnly,
    /// Only the dark reference; the bright one is the mean pair sum less it.
    LowOnly,
    /// None: modulation is the mean of |P - Q|, its sign is taken to be positive.
    Pairs,
}

/// Everything that a decode reads, typed and in order.
pub(crate) struct Frames<'a, T> {
    pub width: usize,
    pub height: usize,
    /// Bright references (H, white) in the order in which they came.
    pub high: Vec<&'a [T]>,
    /// Dark references (V, black).
    pub low: Vec<&'a [T]>,
    pub levels: Levels,
    pub axes: Vec<AxisFrames<'a, T>>,
    pub losses: Vec<String>,
}

impl<T> Frames<'_, T> {
    /// Pairs of all axes in order of axis and bit.
    pub fn pairs(&self) -> impl Iterator<Item = (Axis, u8, &[T], &[T])> + Clone {
        self.axes.iter().flat_map(|axis| {
            axis.bits.iter().enumerate().filter_map(move |(bit, frames)| match *frames {
                BitFrames::Pair(p, q) => Some((axis.axis, bit as u8, p, q)),
                BitFrames::Single(..) => None,
            })
        })
    }

    /// Number of pairs.
    pub fn pair_count(&self) -> usize {
        self.pairs().count()
    }
}

/// Index of `axis` in the plan. Every pair of the plan belongs to one of its axes.
pub(crate) fn axis_position<T>(frames: &Frames<'_, T>, axis: Axis) -> usize {
    frames.axes.iter().position(|found| found.axis == axis).unwrap_or(0)
}

/// The references of a mode: dark, bright.
pub(crate) fn reference_roles(mode: Mode) -> (Role, Role) {
    if mode.is_polarized() { (Role::ReferenceV, Role::ReferenceH) } else { (Role::Black, Role::White) }
}

/// Sorts the frames and says what is missing.
pub(crate) fn plan<'a, T: Sample>(
    settings: &DecodeSettings,
    frames: &'a [(Role, SharedPlane)],
) -> Result<Frames<'a, T>, DecodeError> {
    let of_role = |wanted: Role| {
        frames.iter().filter(move |(role, _)| *role == wanted).filter_map(|(_, plane)| T::of(plane.plane()))
    };
    let mode = settings.mode;
    let mut losses = Vec::new();
    let (low_role, high_role) = reference_roles(mode);
    let low: Vec<&[T]> = of_role(low_role).collect();
    let mut high: Vec<&[T]> = of_role(high_role).collect();
    if mode == Mode::Paper {
        high.clear();
        if low.is_empty() {
            return Err(DecodeError::Missing { mode, missing: format!("the frame {low_role}") });
        }
    }
    let both = !high.is_empty() && !low.is_empty();
    let mut axes = Vec::new();
    for (axis, code) in [(Axis::Column, settings.column), (Axis::Row, settings.row)] {
        let wanted = axis == Axis::Column || mode != Mode::Fast;
        let coded = frames.iter().any(|(role, _)| matches!(role, Role::Code { axis: a, .. } if *a == axis));
        if !wanted {
            if coded {
                losses.push(format!("mode {mode} leaves the {axis} frames unused"));
            }
            continue;
        }
        let code_role = |bit, inverse| Role::Code { axis, bit, inverse };
        let found: Vec<Option<BitFrames<'a, T>>> = (0..code.bits())
            .map(|bit| {
                let (p, q) = (of_role(code_role(bit, false)).next(), of_role(code_role(bit, true)).next());
                match (p, q) {
                    (Some(p), Some(q)) => Some(BitFrames::Pair(p, q)),
                    (Some(p), None) if both => Some(BitFrames::Single(p, false)),
                    (None, Some(q)) if both => Some(BitFrames::Single(q, true)),
                    _ => None,
                }
            })
            .collect();
        let bits: Vec<_> = found.iter().map_while(|frames| *frames).collect();
        if bits.is_empty() && code.bits() > 0 {
            if axis == Axis::Column || coded {
                let what = format!("{} or both references", code_role(0, true));
                let missing = if coded { what } else { format!("the frames of the {axis}s") };
                return Err(DecodeError::Missing { mode, missing });
            }
            losses.push(format!("no {axis} frames: {axis}s are not decoded"));
            continue;
        }
        tell_losses(axis, code, &found, bits.len(), &mut losses);
        let code = PrefixCode::new(code, bits.len() as u8);
        axes.push(AxisFrames { axis, code, bits });
    }
    let levels = match (high.is_empty(), low.is_empty()) {
        _ if mode == Mode::Paper => Levels::Pairs,
        (false, false) => Levels::References,
        (false, true) => Levels::HighOnly,
        (true, false) => Levels::LowOnly,
        (true, true) => Levels::Pairs,
    };
    tell_levels(mode, levels, &mut losses);
    let plan = Frames { width: settings.width, height: settings.height, high, low, levels, axes, losses };
    if levels != Levels::References && plan.pair_count() == 0 {
        return Err(DecodeError::Missing {
            mode,
            missing: "references or pairs to tell lit pixels by".into(),
        });
    }
    Ok(plan)
}

fn tell_levels(mode: Mode, levels: Levels, losses: &mut Vec<String>) {
    let (low, high) = reference_roles(mode);
    match levels {
        Levels::References => {}
        Levels::HighOnly => losses.push(format!("no frame {low}: its level is the mean pair sum less {high}")),
        Levels::LowOnly => losses.push(format!("no frame {high}: its level is the mean pair sum less {low}")),
        Levels::Pairs if mode == Mode::Paper => losses.push(
            "mode paper has no H reference: inverted polarity (depolarising surfaces) cannot be seen, and lit pixels \
             are told by their pair differences"
                .into(),
        ),
        Levels::Pairs => losses.push(format!(
            "no frames {low} and {high}: lit pixels are told by their pair differences and inverted polarity cannot \
             be seen"
        )),
    }
}

fn tell_losses<T>(
    axis: Axis,
    code: AxisCode,
    found: &[Option<BitFrames<'_, T>>],
    leading: usize,
    losses: &mut Vec<String>,
) {
    let list = |bits: Vec<usize>| bits.iter().map(usize::to_string).collect::<Vec<_>>().join(", ");
    let single =
        (0..leading).filter(|&bit| matches!(found[bit], Some(BitFrames::Single(..)))).collect::<Vec<_>>();
    if !single.is_empty() {
        losses.push(format!(
            "{axis} bits {} have one frame of their pair only: decided against the middle of the references",
            list(single)
        ));
    }
    if leading < found.len() {
        let span = 1u32 << (usize::from(code.bits()) - leading);
        losses.push(format!(
            "{axis} bits {leading} and finer are missing or lack their inverse: a code spans {span} projector px and \
             the coordinate is the centre of the span"
        ));
        let unused = (leading..found.len()).filter(|&bit| found[bit].is_some()).collect::<Vec<_>>();
        if !unused.is_empty() {
            losses.push(format!("{axis} bits {} are of no use without bit {leading}", list(unused)));
        }
    }
}

/// Binary value of a reflected Gray word: each bit is the parity of the word's bits from the top down to it.
#[inline(always)]
pub(crate) fn binary_of_gray(word: u16) -> u16 {
    let value = word ^ (word >> 8);
    let value = value ^ (value >> 4);
    let value = value ^ (value >> 2);
    value ^ (value >> 1)
}
