//! The latest frame, for people to look at. Lossy: a frame that nobody fetched in time is gone.

use std::sync::{Arc, Mutex, PoisonError};

use image::codecs::jpeg::JpegEncoder;
use polscan_drivers::{camera::AppliedSettings, frame::Frame};
use tokio::sync::watch;

/// Longest side of the pictures; more would cost time and show no more.
const LONGEST_SIDE: u32 = 1280;
const QUALITY: u8 = 80;

/// Shares of pixels beyond which a frame counts as over-exposed, or none of which reaches a tenth of full scale.
const OVER_SHARE: f64 = 0.005;
const UNDER_LEVEL: f64 = 0.1;
const UNDER_SHARE: f64 = 0.001;

/// Whether a frame has the right amount of light.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Exposure {
    /// As it should be.
    Good,
    /// Pixels are saturated.
    Over,
    /// Next to no pixel reaches a tenth of full scale.
    Under,
}

impl Exposure {
    /// Name in answers.
    pub fn name(self) -> &'static str {
        match self {
            Self::Good => "good",
            Self::Over => "over",
            Self::Under => "under",
        }
    }
}

/// A frame and what it takes to draw it.
#[derive(Debug, Clone)]
struct Shot {
    number: u64,
    frame: Frame,
    saturation_dn: u16,
    black_dn: f64,
}

/// A frame as JPEG.
#[derive(Debug)]
pub struct Picture {
    /// Number of the frame, counting from 1.
    pub number: u64,
    /// The file; saturated pixels are red.
    pub jpeg: Vec<u8>,
    /// Whether the light is right.
    pub exposure: Exposure,
    /// Share of the pixels that are saturated.
    pub saturated_share: f64,
}

/// The latest frame.
#[derive(Debug, Default)]
pub struct Preview {
    shot: Mutex<Option<Shot>>,
    picture: Mutex<Option<Arc<Picture>>>,
    number: watch::Sender<u64>,
}

impl Preview {
    /// Takes over a frame. Costs a lock and no copy, so that it may be called while a scan runs.
    pub fn offer(&self, frame: &Frame, applied: &AppliedSettings) {
        let number = *self.number.borrow() + 1;
        let shot = Shot {
            number,
            frame: frame.clone(),
            saturation_dn: applied.saturation_dn,
            black_dn: applied.black_level_dn.unwrap_or(0.0),
        };
        *self.shot.lock().unwrap_or_else(PoisonError::into_inner) = Some(shot);
        self.number.send_replace(number);
    }

    /// Number of the latest frame, now and whenever there is a new one; 0 before the first.
    pub fn number(&self) -> watch::Receiver<u64> {
        self.number.subscribe()
    }

    /// The latest frame as JPEG, encoded once for all who ask. Takes tens of milliseconds.
    pub fn picture(&self) -> Option<Arc<Picture>> {
        // Whoever comes while another encodes waits for his picture.
        let mut picture = self.picture.lock().unwrap_or_else(PoisonError::into_inner);
        let shot = self.shot.lock().unwrap_or_else(PoisonError::into_inner).clone()?;
        if let Some(picture) = picture.as_ref().filter(|picture| picture.number == shot.number) {
            return Some(picture.clone());
        }
        let drawn = Arc::new(draw(&shot)?);
        *picture = Some(drawn.clone());
        Some(drawn)
    }
}

/// Draws every n-th pixel, from black level to saturation.
fn draw(shot: &Shot) -> Option<Picture> {
    let Frame { width, height, .. } = shot.frame;
    let pixels = shot.frame.pixels();
    let step = width.max(height).div_ceil(LONGEST_SIDE).max(1);
    let (columns, rows) = (width / step, height / step);
    let range = (f64::from(shot.saturation_dn) - shot.black_dn).max(1.0);
    let (mut saturated, mut bright) = (0u64, 0u64);
    let mut rgb = Vec::with_capacity(3 * columns as usize * rows as usize);
    for row in 0..rows {
        for column in 0..columns {
            let value = pixels.get((row * step) as usize * width as usize + (column * step) as usize);
            let level = ((f64::from(value) - shot.black_dn) / range).clamp(0.0, 1.0);
            bright += u64::from(level > UNDER_LEVEL);
            if value >= shot.saturation_dn {
                saturated += 1;
                rgb.extend([255, 0, 0]);
            } else {
                // Closer to what the eye expects than linear light.
                rgb.extend([(255.0 * level.sqrt()) as u8; 3]);
            }
        }
    }
    let total = (u64::from(columns) * u64::from(rows)).max(1) as f64;
    let saturated_share = saturated as f64 / total;
    let exposure = match (saturated_share > OVER_SHARE, (bright as f64 / total) < UNDER_SHARE) {
        (true, _) => Exposure::Over,
        (false, true) => Exposure::Under,
        (false, false) => Exposure::Good,
    };
    let mut jpeg = Vec::new();
    let encoded = JpegEncoder::new_with_quality(&mut jpeg, QUALITY).encode(
        &rgb,
        columns,
        rows,
        image::ExtendedColorType::Rgb8,
    );
    if let Err(error) = encoded {
        tracing::warn!(%error, "a frame could not be encoded for the preview");
        return None;
    }
    Some(Picture { number: shot.number, jpeg, exposure, saturated_share })
}

#[cfg(test)]
mod tests {
    use polscan_drivers::{clock::Timestamp, frame::FrameStamp};

    use super::*;

    fn shot(width: u32, height: u32, value: impl Fn(usize) -> u16) -> Shot {
        let samples: Vec<u16> = (0..width as usize * height as usize).map(value).collect();
        let stamp = FrameStamp {
            frame_id: 0,
            trigger: 0,
            exposure_start: Timestamp(0),
            received: Timestamp(0),
            device_time_ns: None,
        };
        let frame = Frame { width, height, bit_depth: 12, stamp, store: Arc::new(samples) };
        Shot { number: 1, frame, saturation_dn: 4000, black_dn: 40.0 }
    }

    #[test]
    fn exposure_is_judged_and_the_picture_can_be_read() {
        let cases = [
            (shot(64, 48, |_| 2000), Exposure::Good),
            (shot(64, 48, |at| if at % 50 == 0 { 4095 } else { 100 }), Exposure::Over),
            (shot(64, 48, |_| 60), Exposure::Under),
            (shot(4000, 30, |_| 2000), Exposure::Good),
        ];
        for (shot, expected) in cases {
            let picture = draw(&shot).unwrap();
            assert_eq!(picture.exposure, expected);
            let read = image::load_from_memory(&picture.jpeg).unwrap();
            assert!(read.width() <= LONGEST_SIDE && read.width() > 0);
        }
    }

    #[test]
    fn a_frame_is_encoded_once() {
        let preview = Preview::default();
        assert!(preview.picture().is_none());
        *preview.shot.lock().unwrap() = Some(shot(8, 8, |_| 7));
        let (one, other) = (preview.picture().unwrap(), preview.picture().unwrap());
        assert!(Arc::ptr_eq(&one, &other));
    }
}
