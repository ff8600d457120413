//! The pixels of each pattern.

use std::{fmt, str::FromStr};

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::{Axis, ProjectorSize, Role, Sequence};

/// Code values of one projector pixel: red, green, blue.
pub type Rgb = [u8; 3];

const FULL: Rgb = [255; 3];
const OFF: Rgb = [0; 3];

/// Which colour channels of the projector carry one polarization state.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ChannelSet {
    /// Red panel.
    pub red: bool,
    /// Green panel.
    pub green: bool,
    /// Blue panel.
    pub blue: bool,
}

impl ChannelSet {
    /// Full drive of the channels of the set.
    pub fn rgb(self) -> Rgb {
        self.channels().map(|(on, _)| if on { 255 } else { 0 })
    }

    /// Whether no channel is in the set.
    pub fn is_empty(self) -> bool {
        self.channels().iter().all(|&(on, _)| !on)
    }

    fn channels(self) -> [(bool, &'static str); 3] {
        [(self.red, "red"), (self.green, "green"), (self.blue, "blue")]
    }
}

impl fmt::Display for ChannelSet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let names: Vec<&str> =
            self.channels().into_iter().filter(|&(on, _)| on).map(|(_, name)| name).collect();
        f.write_str(&if names.is_empty() { "no channel".into() } else { names.join("+") })
    }
}

/// Why channels cannot carry a polarization code.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
pub enum PolarizationError {
    /// One state has no light.
    #[error(
        "no colour channel has {state} polarization, so its pictures would be black: give it at least one"
    )]
    Empty {
        /// `horizontal` or `vertical`.
        state: &'static str,
    },
    /// One channel would carry both states.
    #[error("the {channel} channel has both horizontal and vertical polarization: a channel has one of them")]
    Shared {
        /// First channel that is in both sets.
        channel: &'static str,
    },
}

/// Which channels leave the projector horizontally and which vertically polarized.
///
/// The states are those of the light where the analyser horizontal passes. A channel may be in neither set; then it
/// stays dark in all polarized pictures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Polarization {
    /// Channels with horizontal polarization.
    pub horizontal: ChannelSet,
    /// Channels with vertical polarization.
    pub vertical: ChannelSet,
}

impl Polarization {
    /// The three-panel projector of the paper: green leaves it horizontally, red and blue vertically polarized.
    pub fn green_horizontal() -> Self {
        Self {
            horizontal: ChannelSet { red: false, green: true, blue: false },
            vertical: ChannelSet { red: true, green: false, blue: true },
        }
    }

    /// Checks that both states have light and share none.
    pub fn validate(self) -> Result<Self, PolarizationError> {
        for (set, state) in [(self.horizontal, "horizontal"), (self.vertical, "vertical")] {
            if set.is_empty() {
                return Err(PolarizationError::Empty { state });
            }
        }
        let pairs = self.horizontal.channels().into_iter().zip(self.vertical.channels());
        for ((horizontal, channel), (vertical, _)) in pairs {
            if horizontal && vertical {
                return Err(PolarizationError::Shared { channel });
            }
        }
        Ok(self)
    }
}

/// A picture of a projector's size in its most compact form.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Raster {
    /// One value everywhere.
    Uniform(Rgb),
    /// One value per column, the same in all rows.
    Columns(Vec<Rgb>),
    /// One value per row, the same in all columns.
    Rows(Vec<Rgb>),
    /// Row-major values of all pixels.
    Full(Vec<Rgb>),
}

impl Raster {
    /// Whether the picture is one of `size`. A uniform picture is of any size.
    pub fn fits(&self, size: ProjectorSize) -> bool {
        match self {
            Self::Uniform(_) => true,
            Self::Columns(values) => values.len() == size.width as usize,
            Self::Rows(values) => values.len() == size.height as usize,
            Self::Full(values) => values.len() == size.width as usize * size.height as usize,
        }
    }

    /// All pixels as bytes, row-major, `3 * width * height` of them: what an image file takes.
    ///
    /// # Panics
    /// Where the picture does not [fit](Self::fits) `size`; pictures made by this crate fit the size they were made for.
    pub fn to_rgb(&self, size: ProjectorSize) -> Vec<u8> {
        assert!(self.fits(size), "a picture of {}x{} px", size.width, size.height);
        let (width, height) = (size.width as usize, size.height as usize);
        match self {
            Self::Uniform(value) => value.repeat(width * height),
            Self::Columns(values) => values.as_flattened().repeat(height),
            Self::Rows(values) => values.iter().flat_map(|value| value.repeat(width)).collect(),
            Self::Full(values) => values.as_flattened().to_vec(),
        }
    }

    fn full(size: ProjectorSize, lit: impl Fn(u32, u32) -> bool) -> Self {
        let pixels = (0..size.height).flat_map(|y| (0..size.width).map(move |x| (x, y)));
        Self::Full(pixels.map(|(x, y)| if lit(x, y) { FULL } else { OFF }).collect())
    }
}

/// A still picture for set-up, held with `polscan show`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Picture {
    /// All channels full.
    White,
    /// All channels off.
    Black,
    /// Uniform horizontal polarization.
    H,
    /// Uniform vertical polarization.
    V,
    /// Fine detail in the centre and the corners, to focus on.
    Focus,
    /// Centre and border lines, to aim.
    Crosshair,
    /// Checker of single pixels, to prove 1:1 display.
    Checker,
}

impl Picture {
    /// All pictures, in the order of the documentation.
    pub const ALL: [Self; 7] =
        [Self::White, Self::H, Self::V, Self::Black, Self::Focus, Self::Crosshair, Self::Checker];

    /// Name used on the command line and in requests.
    pub fn name(self) -> &'static str {
        match self {
            Self::White => "white",
            Self::Black => "black",
            Self::H => "h",
            Self::V => "v",
            Self::Focus => "focus",
            Self::Crosshair => "crosshair",
            Self::Checker => "checker",
        }
    }

    /// The picture for a projector of `size`. `polarization` matters to [`Picture::H`] and [`Picture::V`] only.
    pub fn raster(self, size: ProjectorSize, polarization: Polarization) -> Raster {
        match self {
            Self::White => Raster::Uniform(FULL),
            Self::Black => Raster::Uniform(OFF),
            Self::H => Raster::Uniform(polarization.horizontal.rgb()),
            Self::V => Raster::Uniform(polarization.vertical.rgb()),
            Self::Focus => Raster::full(size, |x, y| focus(x, y, size)),
            Self::Crosshair => Raster::full(size, |x, y| on_guide(x, size.width) || on_guide(y, size.height)),
            Self::Checker => Raster::full(size, |x, y| (x + y) % 2 == 0),
        }
    }
}

impl fmt::Display for Picture {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Picture {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        Self::ALL
            .into_iter()
            .find(|picture| picture.name() == text)
            .ok_or_else(|| format!("picture `{text}` is none of {}", Self::ALL.map(Self::name).join(", ")))
    }
}

/// Whether `index` is on the border or in the middle; an even side has a middle of two pixels, so that the cross is
/// centred on the same point as the code.
fn on_guide(index: u32, side: u32) -> bool {
    index == 0 || index == side - 1 || index == (side - 1) / 2 || index == side / 2
}

/// Five patches (centre and corners), an eighth of the shorter side wide, each with quadrants of lines of 1 px (upright
/// and level) and of checkers of 2 and 4 px.
fn focus(x: u32, y: u32, size: ProjectorSize) -> bool {
    let patch = (size.width.min(size.height) / 8).max(1);
    let within = |index: u32, side: u32| {
        let starts = [0, (side - patch) / 2, side - patch];
        starts.into_iter().enumerate().find_map(|(place, start)| {
            (start..start + patch).contains(&index).then(|| (place, index - start))
        })
    };
    let (Some((column, u)), Some((row, v))) = (within(x, size.width), within(y, size.height)) else {
        return false;
    };
    if (column == 1) != (row == 1) {
        return false;
    }
    match (2 * u >= patch, 2 * v >= patch) {
        (false, false) => u % 2 == 0,
        (true, false) => v % 2 == 0,
        (false, true) => (u / 2 + v / 2) % 2 == 0,
        (true, true) => (u / 4 + v / 4) % 2 == 0,
    }
}

impl Sequence {
    /// The picture that frame `role` shows; `role` must be one that the sequence [can show](Self::can_show).
    /// `polarization` is unused by mode `gray`.
    pub fn raster(&self, role: Role, polarization: Polarization) -> Raster {
        match role {
            Role::ReferenceV => Raster::Uniform(polarization.vertical.rgb()),
            Role::ReferenceH => Raster::Uniform(polarization.horizontal.rgb()),
            Role::White => Raster::Uniform(FULL),
            Role::Black => Raster::Uniform(OFF),
            Role::Code { axis, bit, inverse } => {
                let (high, low) = match self.mode.is_polarized() {
                    true => (polarization.horizontal.rgb(), polarization.vertical.rgb()),
                    false => (FULL, OFF),
                };
                let code = self.code(axis);
                let values = (0..code.size())
                    .map(|index| if code.bit(index, bit) != inverse { high } else { low })
                    .collect();
                match axis {
                    Axis::Column => Raster::Columns(values),
                    Axis::Row => Raster::Rows(values),
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Mode;
    use proptest::prelude::*;

    fn size(width: u32, height: u32) -> ProjectorSize {
        ProjectorSize { width, height }
    }

    fn set(bits: u8) -> ChannelSet {
        ChannelSet { red: bits & 1 != 0, green: bits & 2 != 0, blue: bits & 4 != 0 }
    }

    /// Pixel (x, y) of a raster by the definition of its kinds.
    fn pixel(raster: &Raster, size: ProjectorSize, x: u32, y: u32) -> Rgb {
        match raster {
            Raster::Uniform(value) => *value,
            Raster::Columns(values) => values[x as usize],
            Raster::Rows(values) => values[y as usize],
            Raster::Full(values) => values[(y * size.width + x) as usize],
        }
    }

    fn assert_expands(raster: &Raster, size: ProjectorSize) {
        let bytes = raster.to_rgb(size);
        assert_eq!(bytes.len(), 3 * (size.width * size.height) as usize);
        for y in 0..size.height {
            for x in 0..size.width {
                let at = 3 * (y * size.width + x) as usize;
                assert_eq!(bytes[at..at + 3], pixel(raster, size, x, y), "{x},{y}");
            }
        }
    }

    /// Pictures as text, one line a row: `#` lit, `.` dark.
    fn drawn(picture: Picture, size: ProjectorSize) -> String {
        let raster = picture.raster(size, Polarization::green_horizontal());
        let row =
            |y| (0..size.width).map(|x| if pixel(&raster, size, x, y) == FULL { '#' } else { '.' }).collect();
        (0..size.height).map(row).collect::<Vec<String>>().join("\n")
    }

    #[test]
    fn pictures_are_what_their_names_say() {
        assert_eq!(drawn(Picture::Checker, size(3, 2)), "#.#\n.#.");
        assert_eq!(drawn(Picture::Crosshair, size(7, 5)), "#######\n#..#..#\n#######\n#..#..#\n#######");
        assert_eq!(drawn(Picture::Crosshair, size(6, 4)), "######\n######\n######\n######");
        assert_eq!(drawn(Picture::Crosshair, size(8, 1)), "########");
        let polarization = Polarization::green_horizontal();
        let uniform = |picture: Picture| picture.raster(size(4, 4), polarization);
        assert_eq!(uniform(Picture::White), Raster::Uniform([255, 255, 255]));
        assert_eq!(uniform(Picture::Black), Raster::Uniform([0, 0, 0]));
        assert_eq!(uniform(Picture::H), Raster::Uniform([0, 255, 0]));
        assert_eq!(uniform(Picture::V), Raster::Uniform([255, 0, 255]));
    }

    #[test]
    fn focus_has_detail_in_the_centre_and_each_corner_and_nowhere_else() {
        let (size, patch) = (size(1024, 768), 96);
        let raster = Picture::Focus.raster(size, Polarization::green_horizontal());
        let lit = |x0: u32, y0: u32, width: u32, height: u32| {
            (y0..y0 + height)
                .flat_map(|y| (x0..x0 + width).map(move |x| (x, y)))
                .filter(|&(x, y)| pixel(&raster, size, x, y) == FULL)
                .count()
        };
        let mut in_patches = 0;
        for (x, y) in [(0, 0), (1024 - patch, 0), (464, 336), (0, 768 - patch), (1024 - patch, 768 - patch)] {
            let count = lit(x, y, patch, patch);
            assert_eq!(count, (patch * patch / 2) as usize, "patch at {x},{y}");
            in_patches += count;
        }
        assert_eq!(lit(0, 0, 1024, 768), in_patches);
        assert_eq!(pixel(&raster, size, 464, 336), FULL);
        assert_eq!(pixel(&raster, size, 465, 336), OFF);
    }

    #[test]
    fn names_read_back() {
        for picture in Picture::ALL {
            assert_eq!(picture.name().parse(), Ok(picture));
            assert_eq!(serde_json::to_string(&picture).unwrap(), format!("\"{picture}\""));
        }
        let refusal = "grey".parse::<Picture>().unwrap_err();
        assert_eq!(refusal, "picture `grey` is none of white, h, v, black, focus, crosshair, checker");
    }

    #[test]
    fn polarization_needs_light_in_both_states_and_in_none_twice() {
        let polarization = |h, v| Polarization { horizontal: set(h), vertical: set(v) };
        for h in 0..8 {
            for v in 0..8 {
                assert_eq!(polarization(h, v).validate().is_ok(), h != 0 && v != 0 && h & v == 0, "{h} {v}");
            }
        }
        assert_eq!(polarization(2, 5).validate(), Ok(Polarization::green_horizontal()));
        assert_eq!(polarization(2, 0).validate(), Err(PolarizationError::Empty { state: "vertical" }));
        assert_eq!(polarization(3, 6).validate(), Err(PolarizationError::Shared { channel: "green" }));
        assert_eq!([set(0), set(5)].map(|set| set.to_string()), ["no channel", "red+blue"]);
    }

    #[test]
    #[should_panic(expected = "a picture of 4x3 px")]
    fn a_raster_of_another_size_is_not_stretched() {
        Raster::Columns(vec![OFF; 5]).to_rgb(size(4, 3));
    }

    proptest! {
        #[test]
        fn every_picture_of_every_size_expands_to_its_pixels(width in 1u32..40, height in 1u32..40, h in 1u8..7) {
            let size = size(width, height);
            let polarization = Polarization { horizontal: set(h), vertical: set(7 - h) }.validate().unwrap();
            for picture in Picture::ALL {
                assert_expands(&picture.raster(size, polarization), size);
            }
        }

        #[test]
        fn code_rasters_carry_the_word_of_each_column_and_row(
            width in 1u32..40, height in 1u32..40, h in 1u8..7, mode in proptest::sample::select(&Mode::ALL[..]),
        ) {
            let size = size(width, height);
            let polarization = Polarization { horizontal: set(h), vertical: set(7 - h) };
            let sequence = Sequence::new(mode, size).unwrap();
            let (high, low) = match mode {
                Mode::Gray => ([255; 3], [0; 3]),
                _ => (polarization.horizontal.rgb(), polarization.vertical.rgb()),
            };
            let mut words = [vec![0u32; width as usize], vec![0u32; height as usize]];
            for &role in &sequence.roles {
                let raster = sequence.raster(role, polarization);
                assert_expands(&raster, size);
                let Role::Code { axis, bit, inverse } = role else {
                    prop_assert!(matches!(raster, Raster::Uniform(_)));
                    continue;
                };
                let inverse_role = Role::Code { axis, bit, inverse: !inverse };
                let opposite = sequence.raster(inverse_role, polarization);
                for (index, word) in words[axis as usize].iter_mut().enumerate() {
                    let (x, y) = if axis == Axis::Column { (index as u32, 0) } else { (0, index as u32) };
                    let value = pixel(&raster, size, x, y);
                    prop_assert!(value == high || value == low);
                    prop_assert_ne!(value, pixel(&opposite, size, x, y));
                    if !inverse {
                        *word = *word << 1 | u32::from(value == high);
                    }
                }
            }
            let axes: &[Axis] = if mode == Mode::Fast { &[Axis::Column] } else { &[Axis::Column, Axis::Row] };
            for &axis in axes {
                for (index, &word) in words[axis as usize].iter().enumerate() {
                    prop_assert_eq!(sequence.code(axis).decode(word), Some(index as u32));
                }
            }
        }
    }
}
