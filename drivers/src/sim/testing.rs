//! Descriptions for tests.

use super::{
    AmbientDescription, AnalyserDescription, CameraDescription, Pacing, PanelPolarization, PoseDescription,
    ProjectorDescription, RigDescription,
};

/// A rig like the paper's with a fifth of its pixels along each side, without noise, blur or distortion.
pub(crate) fn small_rig() -> RigDescription {
    RigDescription {
        scene: "none".to_owned(),
        pacing: Pacing::Fast,
        seed: 1,
        camera: CameraDescription {
            size: [320, 240],
            focal_px: 928.0,
            principal_point_px: None,
            k1: 0.0,
            k2: 0.0,
            p1: 0.0,
            p2: 0.0,
            k3: 0.0,
            blur_px: 0.0,
            full_well_e: 10_500.0,
            read_noise_e: 0.0,
            dark_current_e_per_s: 0.0,
            prnu_share: 0.0,
            dsnu_e: 0.0,
            bits: 12,
            black_level_share: 0.01,
            gamma: 1.0,
            reference_exposure_us: 2000.0,
            readout_us: 6100.0,
        },
        projector: ProjectorDescription {
            size: [256, 192],
            focal_px: 385.0,
            principal_point_px: Some([127.5, 185.7]),
            k1: 0.0,
            k2: 0.0,
            p1: 0.0,
            p2: 0.0,
            k3: 0.0,
            blur_px: 0.5,
            polarization: [
                PanelPolarization::Vertical,
                PanelPolarization::Horizontal,
                PanelPolarization::Vertical,
            ],
            extinction: [50.0; 3],
            response: [0.35, 1.0, 0.45],
            black_leak: 0.003,
            gamma: 2.2,
            panel_shift_px: [[0.0; 2]; 3],
            lcd_10_90_ms: 0.0,
            latency_refreshes: 0,
            refresh_hz: 60.0,
            states_timing: true,
        },
        pose: PoseDescription { baseline_mm: Some(52.4), aim_mm: Some(1000.0), ..PoseDescription::default() },
        analyser: Some(AnalyserDescription { azimuth_error_deg: 0.0, extinction: 500.0 }),
        ambient: AmbientDescription { electrons: 0.0 },
        flicker: None,
        faults: Vec::new(),
    }
}
