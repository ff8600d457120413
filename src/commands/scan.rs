//! `polscan scan`: one scan on the configured rig.

use std::path::Path;

use super::{print_result, progress::Bar};
use crate::{
    app::Rig,
    config::Settings,
    engine::{Failure, Label, Scan, new_id, rig_failure},
    report::{NamedRegion, Report},
    sequencer::{CancelFlag, Progress},
    store::BundleWriter,
};

/// Scans, writes and prints; returns the exit code.
pub fn scan(settings: &Settings, regions: &[NamedRegion], out: &Path, json: bool) -> Result<u8, Failure> {
    Ok(print_result(&take(settings, regions, out)?, out, json))
}

/// Scans and writes.
pub(super) fn take(settings: &Settings, regions: &[NamedRegion], out: &Path) -> Result<Report, Failure> {
    // Checked again with the size of the scan, but an occupied folder is refused before the rig is touched.
    drop(create_writer(out, 0)?);
    let mut rig = Rig::open(settings).map_err(rig_failure)?;
    let scan = Scan::prepare(settings, regions, &mut rig)?;
    let writer = create_writer(out, scan.bytes())?;
    let bar = Bar::new(scan.frames() as u64);
    let cancel = CancelFlag::default();
    cancel_on_interrupt(&cancel);
    let mut progress = |progress: Progress<'_>| match progress {
        Progress::Started { .. } => bar.say("projecting"),
        Progress::Captured { done, .. } => bar.frames(done as u64),
        Progress::Accepted(_) => {}
        Progress::Retaking { roles, .. } => {
            let names: Vec<String> = roles.iter().map(ToString::to_string).collect();
            bar.say(format!("again: {}", names.join(", ")));
        }
    };
    let taken = scan.capture(&mut rig, &mut progress, &cancel);
    bar.say("decoding");
    let report = scan.finish(&taken, Label { id: new_id(), ..Label::default() }, writer, &cancel)?;
    drop(bar);
    Ok(report)
}

/// An interrupt from the terminal cancels the capture, which leaves the projector black, or what is made of its frames,
/// which are kept. A second one ends the program.
pub(super) fn cancel_on_interrupt(cancel: &CancelFlag) {
    let cancel = cancel.clone();
    let installed = ctrlc::set_handler(move || {
        if cancel.is_cancelled() {
            std::process::exit(130);
        }
        cancel.cancel();
        eprintln!("polscan: stopping; interrupt again to end at once");
    });
    if let Err(error) = installed {
        tracing::warn!(%error, "an interrupt will end the program without a black projector");
    }
}

fn create_writer(out: &Path, bytes: u64) -> Result<BundleWriter, Failure> {
    BundleWriter::create(out, None, bytes).map_err(|error| Failure::storage("write the result", error))
}
