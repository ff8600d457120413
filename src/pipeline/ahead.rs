//! What the reconstruction needs of the calibration alone: prepared while the frames are captured.

use std::sync::{Arc, OnceLock};

use crate::geometry::{Calibration, Triangulator};

/// A triangulator, made once for a scan.
#[derive(Debug, Clone, Default)]
pub struct Ahead(Arc<OnceLock<Option<Triangulator>>>);

impl Ahead {
    /// Begins to make it on a thread of its own, where there is a calibration. Without such a thread it is made when it is
    /// asked for.
    pub fn begin(&self, calibration: Option<&Calibration>) {
        let Some(calibration) = calibration.cloned() else { return };
        let ahead = self.clone();
        let work = move || {
            ahead.triangulator(Some(&calibration));
        };
        // The result waits in the cell; nobody waits for the thread.
        let _ = std::thread::Builder::new().name("prepare".to_owned()).spawn(work);
    }

    /// The triangulator of `calibration`; `None` where it can triangulate nothing, which the reconstruction explains.
    pub fn triangulator(&self, calibration: Option<&Calibration>) -> Option<&Triangulator> {
        self.0
            .get_or_init(|| calibration.and_then(|calibration| Triangulator::new(calibration).ok()))
            .as_ref()
    }
}
