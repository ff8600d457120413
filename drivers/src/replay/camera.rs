//! The replaying camera.

use std::{
    collections::VecDeque,
    sync::{Arc, atomic::Ordering},
    time::Duration,
};

use super::{CAMERA, MODEL, Recording, Shared, bad_data, listing, microseconds, take};
use crate::{
    camera::{
        AppliedSettings, Camera, CameraDriver, CameraInfo, CameraSettings, Listing, Region, StreamStatistics,
    },
    clock::Timestamp,
    error::DeviceError,
    frame::{Frame, FrameStamp},
};

/// Driver of a recording's camera.
#[derive(Debug, Clone)]
pub struct ReplayCameras {
    pub(super) shared: Arc<Shared>,
}

impl CameraDriver for ReplayCameras {
    fn list(&self) -> Result<Vec<Listing>, DeviceError> {
        Ok(listing(CAMERA))
    }

    fn open(&self, serial: Option<&str>) -> Result<Box<dyn Camera>, DeviceError> {
        take(&self.shared.camera_open, CAMERA, serial)?;
        let recording = &self.shared.recording;
        // The recorded region is all that is known of the sensor.
        let whole = Region { x: 0, y: 0, width: recording.width, height: recording.height };
        let region = recording.applied.settings.region.unwrap_or(whole);
        let info = CameraInfo {
            driver: "replay".to_owned(),
            model: MODEL.to_owned(),
            serial: CAMERA.to_owned(),
            sensor_width: region.x + region.width,
            sensor_height: region.y + region.height,
            triggered: true,
            // Times of a recording are made up, so that there is nothing to be gained.
            overlap: None,
        };
        Ok(Box::new(ReplayCamera { shared: self.shared.clone(), info, applied: false, stream: None }))
    }
}

struct ReplayCamera {
    shared: Arc<Shared>,
    info: CameraInfo,
    applied: bool,
    stream: Option<Stream>,
}

#[derive(Default)]
struct Stream {
    statistics: StreamStatistics,
    pending: VecDeque<(u64, Timestamp)>,
    busy_until: Timestamp,
}

impl ReplayCamera {
    fn out_of_order(operation: &'static str, state: &'static str) -> DeviceError {
        DeviceError::OutOfOrder { device: CAMERA.to_owned(), operation, state }
    }
}

/// The first setting that differs from the recorded ones.
fn first_difference(asked: &CameraSettings, recorded: &CameraSettings) -> Option<DeviceError> {
    let settings = [
        ("exposure_us", asked.exposure_us.to_string(), recorded.exposure_us.to_string()),
        ("gain_db", asked.gain_db.to_string(), recorded.gain_db.to_string()),
        ("gamma", asked.gamma.to_string(), recorded.gamma.to_string()),
        ("region", format!("{:?}", asked.region), format!("{:?}", recorded.region)),
        ("format", format!("{:?}", asked.format), format!("{:?}", recorded.format)),
        ("trigger", format!("{:?}", asked.trigger), format!("{:?}", recorded.trigger)),
    ];
    settings.into_iter().find(|(_, asked, recorded)| asked != recorded).map(
        |(setting, requested, offered)| DeviceError::Refused {
            device: CAMERA.to_owned(),
            setting,
            requested,
            offered: format!("{offered}, as recorded"),
        },
    )
}

impl Camera for ReplayCamera {
    fn info(&self) -> &CameraInfo {
        &self.info
    }

    fn apply(&mut self, settings: &CameraSettings) -> Result<AppliedSettings, DeviceError> {
        if self.stream.is_some() {
            return Err(Self::out_of_order("apply", "armed"));
        }
        let recorded = &self.shared.recording.applied;
        if let Some(refusal) = first_difference(settings, &recorded.settings) {
            return Err(refusal);
        }
        self.applied = true;
        Ok(recorded.clone())
    }

    fn arm(&mut self, _frames: usize) -> Result<(), DeviceError> {
        if self.stream.is_some() {
            return Err(Self::out_of_order("arm", "armed"));
        }
        if !self.applied {
            return Err(Self::out_of_order("arm", "no settings are applied"));
        }
        self.stream = Some(Stream::default());
        Ok(())
    }

    fn trigger(&mut self, at: Timestamp) -> Result<Timestamp, DeviceError> {
        let exposure = microseconds(self.shared.recording.applied.settings.exposure_us);
        let now = self.shared.clock.now();
        let Some(stream) = &mut self.stream else {
            return Err(Self::out_of_order("trigger", "not armed"));
        };
        let start = at.max(now).max(stream.busy_until);
        stream.busy_until = start + exposure;
        stream.pending.push_back((stream.statistics.triggers, start));
        stream.statistics.triggers += 1;
        Ok(start)
    }

    fn next_frame(&mut self, timeout: Duration) -> Result<Frame, DeviceError> {
        let shared = self.shared.clone();
        let Recording { width, height, bit_depth, frames, applied, .. } = &shared.recording;
        let Some(stream) = &mut self.stream else {
            return Err(Self::out_of_order("next_frame", "not armed"));
        };
        let deadline = shared.clock.now() + timeout;
        let taken = microseconds(applied.settings.exposure_us) + microseconds(applied.readout_us);
        let Some(&(trigger, start)) = stream.pending.front().filter(|(_, start)| *start + taken <= deadline)
        else {
            shared.clock.sleep_until(deadline);
            return Err(DeviceError::Timeout {
                device: CAMERA.to_owned(),
                awaited: "frame",
                timeout_ms: timeout.as_millis() as u64,
            });
        };
        stream.pending.pop_front();
        shared.clock.sleep_until(start + taken);
        let slide = shared.slide_at(start);
        let Some(store) = slide.and_then(|slide| frames.get(slide as usize)) else {
            stream.statistics.failed += 1;
            let glass = slide.map_or("black".to_owned(), |slide| format!("picture {slide}"));
            let detail = format!(
                "exposure {trigger} started under {glass}, of which there is no recorded frame; show one of the {} recorded pictures",
                frames.len()
            );
            return Err(bad_data(CAMERA, detail));
        };
        stream.statistics.frames += 1;
        Ok(Frame {
            width: *width,
            height: *height,
            bit_depth: *bit_depth,
            stamp: FrameStamp {
                frame_id: trigger,
                trigger,
                exposure_start: start,
                received: start + taken,
                device_time_ns: None,
            },
            store: store.clone(),
        })
    }

    fn disarm(&mut self) -> Result<StreamStatistics, DeviceError> {
        let stream = self.stream.take().ok_or_else(|| Self::out_of_order("disarm", "not armed"))?;
        Ok(stream.statistics)
    }
}

impl Drop for ReplayCamera {
    fn drop(&mut self) {
        self.shared.camera_open.store(false, Ordering::Release);
    }
}
