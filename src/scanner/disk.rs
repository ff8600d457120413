//! The thread that spools frames and removes what is no longer needed, so that nobody waits for the disk who must not.

use std::{
    collections::HashMap,
    fs,
    path::PathBuf,
    sync::mpsc::{Receiver, Sender, channel},
    thread::JoinHandle,
};

use crate::{sequencer::CapturedFrame, store::spool::SpoolWriter};

/// What is to be done.
pub enum Task {
    /// A spool begins.
    Begin {
        /// Scan.
        id: String,
        /// Folder of the spool.
        folder: PathBuf,
        /// Manifest that it begins with.
        manifest: Vec<u8>,
        /// Calibration of the rig.
        calibration: Option<String>,
    },
    /// A frame of a spool.
    Frame {
        /// Scan.
        id: String,
        /// The frame, which shares its memory.
        frame: Box<CapturedFrame>,
    },
    /// A spool is no longer needed.
    End {
        /// Scan.
        id: String,
    },
    /// A folder is no longer needed.
    Remove(PathBuf),
}

/// Starts the thread; it ends when all senders are gone.
pub fn start() -> std::io::Result<(Sender<Task>, JoinHandle<()>)> {
    let (sender, tasks) = channel();
    let thread = std::thread::Builder::new().name("disk".to_owned()).spawn(move || run(&tasks))?;
    Ok((sender, thread))
}

fn run(tasks: &Receiver<Task>) {
    let mut spools: HashMap<String, SpoolWriter> = HashMap::new();
    for task in tasks {
        match task {
            Task::Begin { id, folder, manifest, calibration } => {
                match SpoolWriter::create(&folder, &manifest, calibration.as_deref()) {
                    Ok(spool) => drop(spools.insert(id, spool)),
                    Err(error) => warn(&id, &error),
                }
            }
            Task::Frame { id, frame } => {
                if let Some(spool) = spools.get_mut(&id)
                    && let Err(error) = spool.push(&frame)
                {
                    // Space that a broken spool takes is better left to the result.
                    warn(&id, &error);
                    end(&mut spools, &id);
                }
            }
            Task::End { id } => end(&mut spools, &id),
            Task::Remove(folder) => {
                if let Err(error) = fs::remove_dir_all(&folder) {
                    tracing::warn!(folder = %folder.display(), %error, "a deleted scan still takes space");
                }
            }
        }
    }
}

fn warn(id: &str, error: &std::io::Error) {
    tracing::warn!(id, %error, "frames are not spooled: a crash would lose them");
}

fn end(spools: &mut HashMap<String, SpoolWriter>, id: &str) {
    if let Some(spool) = spools.remove(id)
        && let Err(error) = spool.remove()
    {
        tracing::warn!(id, %error, "a spool that is done with still takes space");
    }
}
