//! What monitoring may know. Base units, no identities as labels.

use std::{
    collections::BTreeMap,
    sync::{Mutex, PoisonError, atomic::AtomicU64},
};

use polscan_drivers::camera::StreamStatistics;
use prometheus_client::{
    encoding::text::encode,
    metrics::{counter::Counter, family::Family, gauge::Gauge, histogram::Histogram, info::Info},
    registry::{Registry, Unit},
};

type Labels<const N: usize> = [(&'static str, String); N];
type Seconds = Gauge<f64, AtomicU64>;

/// All metrics.
#[derive(Debug)]
pub struct Metrics {
    registry: Registry,
    scans: Family<Labels<1>, Counter>,
    frames: Family<Labels<2>, Counter>,
    requests: Family<Labels<2>, Counter>,
    stream: Family<Labels<2>, Counter>,
    /// The same since the start, for people.
    stream_totals: Mutex<BTreeMap<String, u64>>,
    /// From the POST of a scan, or the release of a queued one, to its end.
    pub scan_duration: Histogram,
    /// From trigger to frame in memory.
    pub trigger_to_frame: Histogram,
    /// How far a flip was off the grid of refreshes.
    pub present_phase_error: Seconds,
    /// Whether the camera is open.
    pub camera_up: Gauge,
    /// Whether the projector is open.
    pub projector_up: Gauge,
    /// How often the rig was opened again.
    pub camera_reconnects: Counter,
    /// Free bytes on the disk of the store.
    pub storage_free: Gauge,
    /// Bytes of all bundles.
    pub storage_used: Gauge,
    /// Scans that wait.
    pub queue_depth: Gauge,
    /// Scans that were deleted by retention.
    pub retention_deleted: Counter,
}

impl Default for Metrics {
    fn default() -> Self {
        let scan_buckets = [0.5, 1.0, 2.0, 3.0, 5.0, 8.0, 13.0, 20.0, 40.0, 80.0];
        let frame_buckets = [0.002, 0.005, 0.01, 0.02, 0.04, 0.08, 0.16, 0.5, 2.0];
        let mut metrics = Self {
            registry: Registry::with_prefix("polscan"),
            scans: Family::default(),
            frames: Family::default(),
            requests: Family::default(),
            stream: Family::default(),
            stream_totals: Mutex::default(),
            scan_duration: Histogram::new(scan_buckets),
            trigger_to_frame: Histogram::new(frame_buckets),
            present_phase_error: Seconds::default(),
            camera_up: Gauge::default(),
            projector_up: Gauge::default(),
            camera_reconnects: Counter::default(),
            storage_free: Gauge::default(),
            storage_used: Gauge::default(),
            queue_depth: Gauge::default(),
            retention_deleted: Counter::default(),
        };
        metrics.register();
        metrics
    }
}

impl Metrics {
    fn register(&mut self) {
        let registry = &mut self.registry;
        registry.register("scans", "Scans by result", self.scans.clone());
        registry.register("frames", "Frames by camera and status", self.frames.clone());
        registry.register("http_requests", "Requests by route and status", self.requests.clone());
        registry.register("camera_stream", "What the camera's driver counted", self.stream.clone());
        let duration = "From acceptance to result";
        registry.register_with_unit("scan_duration", duration, Unit::Seconds, self.scan_duration.clone());
        let latency = "From trigger to frame in memory";
        registry.register_with_unit(
            "trigger_to_frame",
            latency,
            Unit::Seconds,
            self.trigger_to_frame.clone(),
        );
        let phase = "How far the last flip was off the grid of refreshes";
        registry.register_with_unit(
            "present_phase_error",
            phase,
            Unit::Seconds,
            self.present_phase_error.clone(),
        );
        registry.register("camera_up", "Whether the camera is open", self.camera_up.clone());
        registry.register("projector_up", "Whether the projector is open", self.projector_up.clone());
        registry.register(
            "camera_reconnects",
            "Times that the rig was opened again",
            self.camera_reconnects.clone(),
        );
        let free = "Free space on the disk of the store";
        registry.register_with_unit("storage_free", free, Unit::Bytes, self.storage_free.clone());
        registry.register_with_unit(
            "storage_used",
            "Space taken by scans",
            Unit::Bytes,
            self.storage_used.clone(),
        );
        registry.register("queue_depth", "Scans that wait", self.queue_depth.clone());
        registry.register(
            "retention_deleted_scans",
            "Scans deleted by retention",
            self.retention_deleted.clone(),
        );
        let build = Info::new([("version", env!("CARGO_PKG_VERSION"))]);
        registry.register("build", "The program", build);
    }

    /// Counts a scan that came to its end.
    pub fn scan(&self, result: &str) {
        self.scans.get_or_create(&[("result", result.to_owned())]).inc();
    }

    /// Counts frames.
    pub fn frames(&self, camera: &str, status: &str, count: u64) {
        self.frames
            .get_or_create(&[("camera", camera.to_owned()), ("status", status.to_owned())])
            .inc_by(count);
    }

    /// Counts what a camera's stream counted from arming to disarming.
    pub fn stream(&self, camera: &str, statistics: &StreamStatistics) {
        let StreamStatistics { triggers, frames, failed, counters } = statistics;
        let own = [("triggers", *triggers), ("frames", *frames), ("failed", *failed)];
        let all = own.into_iter().chain(counters.iter().map(|(name, count)| (name.as_str(), *count)));
        let mut totals = self.stream_totals.lock().unwrap_or_else(PoisonError::into_inner);
        for (name, count) in all {
            let labels = [("camera", camera.to_owned()), ("name", name.to_owned())];
            self.stream.get_or_create(&labels).inc_by(count);
            let total = totals.entry(name.to_owned()).or_default();
            *total = total.saturating_add(count);
        }
    }

    /// What all streams counted so far, by name.
    pub fn stream_totals(&self) -> BTreeMap<String, u64> {
        self.stream_totals.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Counts a request.
    pub fn request(&self, route: &str, status: u16) {
        self.requests.get_or_create(&[("route", route.to_owned()), ("status", status.to_string())]).inc();
    }

    /// All metrics in the text format of OpenMetrics, which Prometheus reads.
    pub fn text(&self) -> String {
        let mut text = String::new();
        // Writing to a string cannot fail.
        let _ = encode(&mut text, &self.registry);
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_those_that_are_documented() {
        let metrics = Metrics::default();
        metrics.scan("done");
        metrics.frames("sim-0", "ok", 44);
        metrics.request("/v1/scans", 202);
        let counters = BTreeMap::from([("n_missing_packets".to_owned(), 5)]);
        let statistics = StreamStatistics { triggers: 44, frames: 43, failed: 1, counters };
        metrics.stream("sim-0", &statistics);
        metrics.stream("sim-0", &statistics);
        assert_eq!(metrics.stream_totals()["failed"], 2);
        let text = metrics.text();
        for line in [
            "polscan_scans_total{result=\"done\"} 1",
            "polscan_frames_total{camera=\"sim-0\",status=\"ok\"} 44",
            "polscan_camera_stream_total{camera=\"sim-0\",name=\"n_missing_packets\"} 10",
            "polscan_camera_stream_total{camera=\"sim-0\",name=\"triggers\"} 88",
            "polscan_scan_duration_seconds_count 0",
            "polscan_trigger_to_frame_seconds_count 0",
            "polscan_present_phase_error_seconds 0",
            "polscan_camera_up 0",
            "polscan_camera_reconnects_total 0",
            "polscan_projector_up 0",
            "polscan_storage_free_bytes 0",
            "polscan_queue_depth 0",
            "polscan_build_info{version=",
        ] {
            assert!(text.contains(line), "{line} in\n{text}");
        }
    }
}
