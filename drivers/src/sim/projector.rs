//! The simulated projector.

use std::{sync::Arc, time::Duration};

use super::{
    rig::{Device, Shared, Taken},
    timeline::settling_s,
};
use crate::{
    camera::Listing,
    error::DeviceError,
    projector::{
        PresentReceipt, Projector, ProjectorDriver, ProjectorInfo, ProjectorTiming, ReceiptMethod, Slide,
        check_slide, no_such_slide,
    },
};

const SERIAL: &str = "sim-projector-0";
const MODEL: &str = "simulated LCD projector";
/// What is left of the previous picture when a projector counts as settled.
const SETTLED_SHARE: f64 = 1e-3;

/// Driver of a simulated rig's projector.
#[derive(Debug, Clone)]
pub struct SimProjectors {
    shared: Arc<Shared>,
}

impl SimProjectors {
    pub(crate) fn new(shared: Arc<Shared>) -> Self {
        Self { shared }
    }
}

impl ProjectorDriver for SimProjectors {
    fn list(&self) -> Result<Vec<Listing>, DeviceError> {
        Ok(vec![Listing {
            driver: "sim".to_owned(),
            model: MODEL.to_owned(),
            serial: SERIAL.to_owned(),
            unusable: None,
        }])
    }

    fn open(&self, serial: Option<&str>) -> Result<Box<dyn Projector>, DeviceError> {
        let taken = self.shared.take(Device::Projector, SERIAL, serial)?;
        Ok(Box::new(SimProjector::new(taken)))
    }
}

struct SimProjector {
    taken: Taken,
    info: ProjectorInfo,
    slides: Option<Vec<Arc<Slide>>>,
}

impl SimProjector {
    fn new(taken: Taken) -> Self {
        let projector = &taken.shared.description.projector;
        let timeline = taken.shared.timeline();
        let timing = projector.states_timing.then(|| ProjectorTiming {
            latency: Duration::from_nanos(u64::from(projector.latency_refreshes) * timeline.period_ns()),
            settling: Duration::from_secs_f64(settling_s(projector.lcd_10_90_ms, SETTLED_SHARE)),
        });
        let info = ProjectorInfo {
            driver: "sim".to_owned(),
            model: MODEL.to_owned(),
            serial: SERIAL.to_owned(),
            width: projector.size[0],
            height: projector.size[1],
            refresh_period: Duration::from_nanos(timeline.period_ns()),
            timing,
            display: None,
        };
        drop(timeline);
        Self { taken, info, slides: None }
    }

    /// Flips at the next refresh and waits for it. The receipt tells what was asked for, `slide` is what is shown.
    fn flip(&mut self, index: Option<u32>, slide: Option<Arc<Slide>>) -> PresentReceipt {
        let shared = &self.taken.shared;
        let (refresh, flipped) = {
            // The clock is read under the lock: whoever looks up a past exposure has then seen all of its flips.
            let mut timeline = shared.timeline();
            timeline.flip(shared.clock.now(), slide)
        };
        shared.clock.sleep_until(flipped);
        PresentReceipt { slide: index, flipped, refresh: Some(refresh), method: ReceiptMethod::Simulated }
    }
}

impl Projector for SimProjector {
    fn info(&self) -> &ProjectorInfo {
        &self.info
    }

    fn load(&mut self, slides: &[Slide]) -> Result<(), DeviceError> {
        for (number, slide) in slides.iter().enumerate() {
            check_slide(&self.info, number, slide)?;
        }
        let slides: Vec<Arc<Slide>> = slides.iter().cloned().map(Arc::new).collect();
        self.taken.shared.set_loaded(slides.clone());
        self.slides = Some(slides);
        Ok(())
    }

    fn show(&mut self, index: u32) -> Result<PresentReceipt, DeviceError> {
        let Some(slides) = &self.slides else {
            return Err(DeviceError::OutOfOrder {
                device: self.info.serial.clone(),
                operation: "show",
                state: "no slides are loaded",
            });
        };
        let shown = self.taken.shared.script.shown(index, slides.len() as u32);
        let asked = slides.get(index as usize).and_then(|_| slides.get(shown as usize));
        let slide = asked.cloned().ok_or_else(|| no_such_slide(&self.info, index, slides.len()))?;
        Ok(self.flip(Some(index), Some(slide)))
    }

    fn black(&mut self) -> Result<PresentReceipt, DeviceError> {
        Ok(self.flip(None, None))
    }
}
