//! Events: everything that changes, in order, with numbers that survive a restart.
//!
//! The newest are kept in memory; the index has more of them. Each reader has a cursor of its own, so that none takes
//! an event away from another and a slow one delays nobody.

use std::{
    collections::VecDeque,
    sync::{Arc, Mutex, PoisonError},
};

use tokio::sync::watch;

use crate::store::index::Event;

/// Events that are kept in memory.
const IN_MEMORY: usize = 4096;

/// Events that are kept in the index.
pub const IN_INDEX: u64 = 50_000;

/// Numbers are reserved in blocks, so that none is given out twice even where an event could not be stored.
pub const BLOCK: u64 = 10_000;

/// The events of this process.
#[derive(Debug)]
pub struct EventLog {
    recent: Mutex<Recent>,
    latest: watch::Sender<u64>,
}

#[derive(Debug)]
struct Recent {
    events: VecDeque<Arc<Event>>,
    /// Number of the first event that can be in `events`.
    first: u64,
    /// Number of the next event.
    next: u64,
    /// Number of the latest event that readers may have.
    told: u64,
}

impl EventLog {
    /// A log whose first event will have the number `next`.
    pub fn new(next: u64) -> Self {
        let next = next.max(1);
        let recent = Recent { events: VecDeque::new(), first: next, next, told: next - 1 };
        Self { recent: Mutex::new(recent), latest: watch::Sender::new(next - 1) }
    }

    /// Adds an event, which must have the number that [`next`](Self::next) gave: there is one that adds. Nobody sees it
    /// before [`tell`](Self::tell).
    pub fn add(&self, event: Event) {
        let id = event.id;
        let mut recent = self.recent.lock().unwrap_or_else(PoisonError::into_inner);
        debug_assert_eq!(id, recent.next, "events are numbered without gaps");
        recent.next = id + 1;
        recent.events.push_back(Arc::new(event));
        if recent.events.len() > IN_MEMORY {
            recent.events.pop_front();
            recent.first += 1;
        }
    }

    /// Lets readers have all events so far, once everybody can see what they tell of.
    pub fn tell(&self) {
        let mut recent = self.recent.lock().unwrap_or_else(PoisonError::into_inner);
        let latest = recent.next - 1;
        let news = std::mem::replace(&mut recent.told, latest) != latest;
        drop(recent);
        if news {
            self.latest.send_replace(latest);
        }
    }

    /// Number of the next event.
    pub fn next(&self) -> u64 {
        self.recent.lock().unwrap_or_else(PoisonError::into_inner).next
    }

    /// Number of the oldest event that memory can have.
    pub fn oldest(&self) -> u64 {
        self.recent.lock().unwrap_or_else(PoisonError::into_inner).first
    }

    /// The events after `cursor`, or `None` where memory does not reach back that far.
    pub fn after(&self, cursor: u64) -> Option<Vec<Arc<Event>>> {
        let recent = self.recent.lock().unwrap_or_else(PoisonError::into_inner);
        if cursor + 1 < recent.first {
            return None;
        }
        let skip = usize::try_from(cursor + 1 - recent.first).unwrap_or(usize::MAX);
        let told = |event: &&Arc<Event>| event.id <= recent.told;
        Some(recent.events.iter().skip(skip).take_while(told).cloned().collect())
    }

    /// Number of the latest event, now and whenever there is a new one.
    pub fn latest(&self) -> watch::Receiver<u64> {
        self.latest.subscribe()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn event(id: u64) -> Event {
        Event { id, kind: "k".into(), data: String::new() }
    }

    #[test]
    fn readers_have_cursors_of_their_own() {
        let log = EventLog::new(101);
        assert_eq!(*log.latest().borrow(), 100);
        assert_eq!(log.after(99), None, "before this process");
        assert_eq!(log.after(100), Some(Vec::new()));
        for id in 101..106 {
            log.add(event(id));
        }
        assert_eq!((log.after(100), *log.latest().borrow()), (Some(Vec::new()), 100), "not yet told");
        log.tell();
        assert_eq!(*log.latest().borrow(), 105);
        let ids =
            |cursor| log.after(cursor).map(|events| events.iter().map(|event| event.id).collect::<Vec<_>>());
        assert_eq!(ids(100), Some(vec![101, 102, 103, 104, 105]));
        assert_eq!(ids(103), Some(vec![104, 105]));
        assert_eq!(ids(105), Some(vec![]));
        assert_eq!(ids(9999), Some(vec![]), "the future");
        assert_eq!(log.next(), 106);
    }

    #[test]
    fn memory_is_bounded_and_says_so() {
        let log = EventLog::new(1);
        for id in 1..=IN_MEMORY as u64 + 10 {
            log.add(event(id));
        }
        log.tell();
        assert_eq!(log.after(9), None);
        let all = log.after(10).unwrap();
        assert_eq!((all.len(), all[0].id), (IN_MEMORY, 11));
    }
}
