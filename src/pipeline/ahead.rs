//! What the reconstruction needs of the calibration alone: prepared while the frames are captured.

use std::sync::{Arc, OnceLock};

use super::background_pool;
use crate::geometry::{Calibration, Triangulator};

/// A triangulator, made once for a scan.
#[derive(Debug, Clone, Default)]
pub struct Ahead(Arc<OnceLock<Option<Triangulator>>>);

impl Ahead {
    /// Begins to make it on one thread, where there is a calibration: the other cores, and the first turn on this one, are
    /// for whoever shows the patterns meanwhile. Without such a thread it is made when it is asked for.
    pub fn begin(&self, calibration: Option<&Calibration>) {
        let (Some(calibration), Ok(pool)) = (calibration.cloned(), background_pool(Some(1))) else { return };
        let ahead = self.clone();
        // The result waits in the cell; nobody waits for the thread, which ends when it is done.
        pool.spawn(move || {
            ahead.triangulator(Some(&calibration));
        });
    }

    /// The triangulator of `calibration`; `None` where it can triangulate nothing, which the reconstruction explains.
    pub fn triangulator(&self, calibration: Option<&Calibration>) -> Option<&Triangulator> {
        self.0
            .get_or_init(|| calibration.and_then(|calibration| Triangulator::new(calibration).ok()))
            .as_ref()
    }
}
