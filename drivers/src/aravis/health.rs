//! How the cameras of this process have been doing, over openings and closings.

use std::{
    collections::{BTreeMap, btree_map::Entry},
    sync::{Arc, LazyLock, Mutex, MutexGuard, PoisonError},
};

use super::recovery::{Action, Event, Ladder};
use crate::clock::{Clock, MonotonicClock, Timestamp};

/// One for all drivers of a process: a camera is opened by a new driver each time.
static PROCESS: LazyLock<Health> = LazyLock::new(|| Health::new(Arc::new(MonotonicClock::start())));

/// Shared record of cameras by name.
#[derive(Debug, Clone)]
pub struct Health {
    clock: Arc<dyn Clock>,
    state: Arc<Mutex<State>>,
}

#[derive(Debug, Default)]
struct State {
    ladders: BTreeMap<String, Ladder>,
    /// Cameras that are taken, and whether they are lost and only being let go of.
    open: BTreeMap<String, bool>,
}

impl Health {
    fn new(clock: Arc<dyn Clock>) -> Self {
        Self { clock, state: Arc::default() }
    }

    /// That of the process.
    pub fn of_process() -> Self {
        PROCESS.clone()
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Enters what was seen of a camera.
    pub fn enter(&self, device: &str, event: Event) {
        let now = self.clock.now();
        let mut state = self.state();
        match event {
            // Most frames follow frames.
            Event::Delivered => drop(state.ladders.remove(device)),
            event => {
                if let Some(closing) = state.open.get_mut(device) {
                    *closing |= event == Event::Lost;
                }
                state.ladders.entry(device.to_owned()).or_default().enter(now, event);
            }
        }
    }

    /// What to do about a camera that is wanted, the time now, and how often it failed.
    pub fn next(&self, device: &str) -> (Action, Timestamp, u32) {
        let now = self.clock.now();
        let ladder = self.state().ladders.get(device).copied().unwrap_or_default();
        (ladder.next(now), now, ladder.failures())
    }

    /// Takes a camera for its only user in this process; why not where it is taken.
    pub fn take(&self, device: &str) -> Result<Taken, &'static str> {
        match self.state().open.entry(device.to_owned()) {
            Entry::Occupied(taken) if *taken.get() => Err(
                "was lost and is still being let go of, which takes some seconds; it is opened again by itself",
            ),
            Entry::Occupied(_) => Err("is open already; close it first"),
            Entry::Vacant(free) => {
                free.insert(false);
                Ok(Taken { health: self.clone(), device: device.to_owned() })
            }
        }
    }

    /// Whether a camera is taken.
    pub fn is_taken(&self, device: &str) -> bool {
        self.state().open.contains_key(device)
    }
}

/// A camera that is taken until this is dropped.
#[derive(Debug)]
pub struct Taken {
    health: Health,
    device: String,
}

impl Drop for Taken {
    fn drop(&mut self) {
        self.health.state().open.remove(&self.device);
    }
}
