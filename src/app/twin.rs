//! What only a simulated rig can do: take its own polarizer off.

use polscan_patterns::Mode;

use crate::config::Settings;

/// The settings of the same simulated rig for ordinary Gray code: no polarizer before the camera, and an exposure that
/// takes as much light of a white picture as the configured one takes of a uniform H picture behind the polarizer. Also
/// returns what was changed, in words. `None` where no simulated rig is configured.
pub fn without_analyser(settings: &Settings) -> Option<(Settings, Vec<String>)> {
    let mut changed = settings.clone();
    let description = &mut changed.sim.as_mut()?.0;
    let (response, polarization) = (description.projector.response, settings.polarization);
    let share = |red: bool, green: bool, blue: bool| -> f64 {
        [red, green, blue].into_iter().zip(response).filter(|(on, _)| *on).map(|(_, response)| response).sum()
    };
    let horizontal = polarization.horizontal;
    let light = share(true, true, true) / share(horizontal.red, horizontal.green, horizontal.blue);
    let mut remarks = Vec::new();
    if let Some(analyser) = description.analyser.take() {
        // Of unpolarized light a polarizer passes half, and of the other half what its extinction leaves.
        let passes = 0.5 * (1.0 + 1.0 / analyser.extinction);
        description.ambient.electrons /= passes;
        remarks.push(format!(
            "the polarizer before the camera is taken off; it held back {:.0} % of the ambient light",
            100.0 * (1.0 - passes)
        ));
    }
    changed.camera.exposure_us = settings.camera.exposure_us / light;
    changed.mode = Mode::Gray;
    remarks.push(format!(
        "the exposure is {:.0} us instead of {:.0} us: white is {light:.2} times as bright as H, and the brightest pixels \
         shall be as far from saturation in both",
        changed.camera.exposure_us, settings.camera.exposure_us
    ));
    remarks.push(
        "the scene's levels are defined by the light that reaches the camera under H, with or without a polarizer: the \
         lamp is the same up to the few percent that the polarizer takes from the scene's depolarised light"
            .into(),
    );
    Some((changed, remarks))
}
