//! The replaying projector.

use std::{
    sync::{Arc, atomic::Ordering},
    time::Duration,
};

use super::{MODEL, PROJECTOR, REMEMBERED_FLIPS, Shared, listing, take};
use crate::{
    camera::Listing,
    clock::Timestamp,
    error::DeviceError,
    projector::{
        PresentReceipt, Projector, ProjectorDriver, ProjectorInfo, ProjectorTiming, ReceiptMethod, Slide,
    },
};

/// Driver of a recording's projector.
#[derive(Debug, Clone)]
pub struct ReplayProjectors {
    pub(super) shared: Arc<Shared>,
}

impl ProjectorDriver for ReplayProjectors {
    fn list(&self) -> Result<Vec<Listing>, DeviceError> {
        Ok(listing(PROJECTOR))
    }

    fn open(&self, serial: Option<&str>) -> Result<Box<dyn Projector>, DeviceError> {
        take(&self.shared.projector_open, PROJECTOR, serial)?;
        let recording = &self.shared.recording;
        let info = ProjectorInfo {
            driver: "replay".to_owned(),
            model: MODEL.to_owned(),
            serial: PROJECTOR.to_owned(),
            width: recording.projector_size[0],
            height: recording.projector_size[1],
            refresh_period: recording.refresh_period,
            // A recording answers at once and completely.
            timing: Some(ProjectorTiming { latency: Duration::ZERO, settling: Duration::ZERO }),
            display: None,
        };
        Ok(Box::new(ReplayProjector { shared: self.shared.clone(), info, loaded: None }))
    }
}

struct ReplayProjector {
    shared: Arc<Shared>,
    info: ProjectorInfo,
    /// Recorded picture of each slide.
    loaded: Option<Vec<u32>>,
}

/// The recorded picture of each slide: of equal pictures the first slide is the first one, the second the second, and
/// where there are more slides, the last one again. The number of the first slide that was not recorded otherwise.
fn find_pictures(slides: &[Slide], pictures: &[Slide]) -> Result<Vec<u32>, usize> {
    let find = |(number, slide): (usize, &Slide)| {
        let earlier = slides[..number].iter().filter(|other| *other == slide).count();
        let mut equal = (0u32..).zip(pictures).filter(|(_, picture)| *picture == slide).map(|(at, _)| at);
        let last = equal.clone().last().ok_or(number)?;
        Ok(equal.nth(earlier).unwrap_or(last))
    };
    slides.iter().enumerate().map(find).collect()
}

impl ReplayProjector {
    fn flip(&self, slide: Option<u32>, picture: Option<u32>) -> PresentReceipt {
        let period = self.info.refresh_period.as_nanos() as u64;
        let (refresh, flipped) = {
            let mut flips = self.shared.flips();
            let refresh = self.shared.clock.now().0 / period + 1;
            let flipped = Timestamp(refresh * period);
            flips.push_back((flipped, picture));
            if flips.len() > REMEMBERED_FLIPS {
                flips.pop_front();
            }
            (refresh, flipped)
        };
        self.shared.clock.sleep_until(flipped);
        PresentReceipt { slide, flipped, refresh: Some(refresh), method: ReceiptMethod::Recorded }
    }
}

impl Projector for ReplayProjector {
    fn info(&self) -> &ProjectorInfo {
        &self.info
    }

    fn load(&mut self, slides: &[Slide]) -> Result<(), DeviceError> {
        for (number, slide) in slides.iter().enumerate() {
            crate::projector::check_slide(&self.info, number, slide)?;
        }
        let pictures = &self.shared.recording.pictures;
        let found = find_pictures(slides, pictures).map_err(|number| DeviceError::Refused {
            device: PROJECTOR.to_owned(),
            setting: "slides",
            requested: format!("{} slides, of which number {number} was not recorded", slides.len()),
            offered: format!(
                "{} recorded pictures; use the mode, size and channels of the recording",
                pictures.len()
            ),
        })?;
        self.loaded = Some(found);
        Ok(())
    }

    fn show(&mut self, index: u32) -> Result<PresentReceipt, DeviceError> {
        let Some(loaded) = &self.loaded else {
            return Err(DeviceError::OutOfOrder {
                device: PROJECTOR.to_owned(),
                operation: "show",
                state: "no slides are loaded",
            });
        };
        match loaded.get(index as usize) {
            Some(&picture) => Ok(self.flip(Some(index), Some(picture))),
            None => Err(crate::projector::no_such_slide(&self.info, index, loaded.len())),
        }
    }

    fn black(&mut self) -> Result<PresentReceipt, DeviceError> {
        Ok(self.flip(None, None))
    }
}

impl Drop for ReplayProjector {
    fn drop(&mut self) {
        self.shared.projector_open.store(false, Ordering::Release);
    }
}
