//! From a share of a range to a colour.

/// Red, green, blue, as sRGB code values.
pub type Rgb = [u8; 3];

/// A way to show values as colours.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Colormap {
    /// Blue over cyan, green and yellow to red: for indices, where many hues tell neighbours apart.
    Jet,
    /// Indigo over teal to yellow, growing lighter all the way: for measures. Looks like MATLAB's map of that name.
    Parula,
    /// Black to white.
    Gray,
}

/// Colours at equal distances, chosen by eye for an even change of lightness.
const PARULA: [[f32; 3]; 9] = [
    [58.0, 40.0, 146.0],
    [62.0, 72.0, 210.0],
    [46.0, 108.0, 234.0],
    [28.0, 144.0, 218.0],
    [24.0, 173.0, 192.0],
    [66.0, 192.0, 146.0],
    [156.0, 199.0, 84.0],
    [238.0, 192.0, 62.0],
    [250.0, 250.0, 28.0],
];

impl Colormap {
    /// Colour of `share` in 0..=1; beyond, that of the nearer end. NaN has no colour: treat it before.
    pub fn color(self, share: f32) -> Rgb {
        let share = share.clamp(0.0, 1.0);
        match self {
            Self::Gray => [byte(255.0 * share); 3],
            Self::Jet => [3.0, 2.0, 1.0].map(|peak: f32| byte(255.0 * (1.5 - (4.0 * share - peak).abs()))),
            Self::Parula => {
                let place = share * (PARULA.len() - 1) as f32;
                let index = (place as usize).min(PARULA.len() - 2);
                let fraction = place - index as f32;
                let (low, high) = (PARULA[index], PARULA[index + 1]);
                std::array::from_fn(|channel| byte(low[channel] + fraction * (high[channel] - low[channel])))
            }
        }
    }

    /// The colours of 1024 equal steps, for whole images.
    pub fn table(self) -> Vec<Rgb> {
        (0..TABLE_STEPS).map(|step| self.color(step as f32 / (TABLE_STEPS - 1) as f32)).collect()
    }
}

/// Length of [`Colormap::table`].
pub const TABLE_STEPS: usize = 1024;

fn byte(value: f32) -> u8 {
    value.round().clamp(0.0, 255.0) as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lightness(color: Rgb) -> f32 {
        0.2126 * f32::from(color[0]) + 0.7152 * f32::from(color[1]) + 0.0722 * f32::from(color[2])
    }

    #[test]
    fn jet_has_its_well_known_landmarks() {
        assert_eq!(Colormap::Jet.color(0.0), [0, 0, 128]);
        assert_eq!(Colormap::Jet.color(0.125), [0, 0, 255]);
        assert_eq!(Colormap::Jet.color(0.375), [0, 255, 255]);
        assert_eq!(Colormap::Jet.color(0.5), [128, 255, 128]);
        assert_eq!(Colormap::Jet.color(0.625), [255, 255, 0]);
        assert_eq!(Colormap::Jet.color(0.875), [255, 0, 0]);
        assert_eq!(Colormap::Jet.color(1.0), [128, 0, 0]);
    }

    #[test]
    fn parula_and_gray_grow_lighter_all_the_way() {
        for map in [Colormap::Parula, Colormap::Gray] {
            for pair in map.table().windows(2) {
                assert!(lightness(pair[1]) >= lightness(pair[0]) - 0.75, "{map:?} {pair:?}");
            }
        }
        let ends = [0.0, 0.5, 1.0].map(|share| lightness(Colormap::Parula.color(share)));
        assert!(ends[0] < 70.0 && (110.0..170.0).contains(&ends[1]) && ends[2] > 220.0, "{ends:?}");
    }

    #[test]
    fn what_lies_beyond_has_the_colour_of_the_end() {
        for map in [Colormap::Jet, Colormap::Parula, Colormap::Gray] {
            assert_eq!(map.color(-3.0), map.color(0.0));
            assert_eq!(map.color(f32::INFINITY), map.color(1.0));
            assert_eq!(map.table()[TABLE_STEPS - 1], map.color(1.0));
        }
    }
}
