//! What clients ask for.

use super::{news::CANCELLED, *};

impl Owner {
    pub(super) fn submit(&mut self, submit: &Submit) -> Result<(Vec<Arc<Record>>, bool), Denied> {
        if let Some((key, body)) = &submit.key {
            let used = self.index.key(key).map_err(|error| Denied::Storage(chain(&error)))?;
            if let Some(used) = used {
                return self.replay(&used, body);
            }
        }
        let source = submit.source.as_deref().map(|id| self.source(id)).transpose()?;
        let decision = match &source {
            Some(_) => self.admit_decode(),
            None => self.admit(submit),
        };
        let urgent = match decision {
            Decision::Start => !submit.queue,
            Decision::Queue(_) => false,
            Decision::Refuse(refusal) => return Err(Denied::Refused(refusal)),
        };
        let records = self.records(submit, source.as_deref());
        let first = records[0].id.clone();
        let used =
            submit.key.as_ref().map(|(key, body)| (key.as_str(), Key { body: body.clone(), scan: first }));
        let key = used.as_ref().map(|(key, used)| (*key, used, seconds_since_1970()));
        // Scans and key at once: a client that asks again after a crash gets what was begun, or nothing had begun.
        self.index.accept(&records, key).map_err(|error| Denied::Storage(chain(&error)))?;
        for record in records.iter().cloned() {
            let id = record.id.clone();
            self.accepted.insert(id.clone(), Instant::now());
            self.scans.insert(id.clone(), Arc::new(record));
            match &source {
                Some(source) => self.decode_again(&id, source, submit.mode),
                None => self.queue.push_back(Waiting { id, held: false, urgent }),
            }
        }
        if source.is_none() && decision == Decision::Start {
            // Those that are held back stay behind whoever starts now.
            let count = records.len();
            self.queue.rotate_right(count);
        }
        self.number_queue();
        for record in &records {
            self.touch(&record.id);
        }
        let ids = records.iter().map(|record| &record.id);
        Ok((ids.filter_map(|id| self.scans.get(id).cloned()).collect(), false))
    }

    /// The answer that the same request got before.
    pub(super) fn replay(&self, used: &Key, body: &str) -> Result<(Vec<Arc<Record>>, bool), Denied> {
        if used.body != body {
            return Err(Denied::KeyReused);
        }
        let first = match self.find(&used.scan) {
            Ok(record) => record,
            // A scan that was deleted since is still the answer: the request must not run twice.
            Err(Denied::Unknown) => {
                let mut gone = Record::new(used.scan.clone(), self.settings.mode.to_string(), now());
                gone.advance(State::Cancelled, now());
                gone.blame("deleted", "the scan was deleted since it was asked for");
                Arc::new(gone)
            }
            Err(denied) => return Err(denied),
        };
        let later = self.index.series(&used.scan).map_err(|error| Denied::Storage(chain(&error)))?;
        let later = later.into_iter().filter(|id| *id != used.scan).map(|id| self.find(&id));
        let records = std::iter::once(Ok(first)).chain(later).collect::<Result<_, _>>()?;
        Ok((records, true))
    }

    pub(super) fn records(&self, submit: &Submit, source: Option<&str>) -> Vec<Record> {
        let mode = submit.mode.unwrap_or(self.settings.mode).to_string();
        let origin = source.and_then(|id| self.find(id).ok());
        let mut records: Vec<Record> = (0..submit.repeat)
            .map(|_| {
                let mut record = Record::new(uuid::Uuid::now_v7().to_string(), mode.clone(), now());
                record.label = submit.label.clone();
                record.tags = submit.tags.clone();
                record.exposure_us = submit.exposure_us;
                record.source = source.map(str::to_owned);
                if let Some(origin) = &origin {
                    record.mode = submit.mode.map_or(origin.mode.clone(), |mode| mode.to_string());
                    record.label = record.label.or_else(|| origin.label.clone());
                    record.exposure_us = origin.exposure_us;
                }
                record
            })
            .collect();
        if records.len() > 1 {
            let (first, of) = (records[0].id.clone(), records.len());
            for (index, record) in records.iter_mut().enumerate() {
                record.series = Some(Series { index, of, first: first.clone() });
            }
        }
        records
    }

    pub(super) fn admit(&mut self, submit: &Submit) -> Decision {
        self.look_at_storage();
        self.make_room(submit.repeat as u64);
        admission::admit(&self.situation(), Ask { scans: submit.repeat, queue: submit.queue })
    }

    /// A decode needs no rig, but memory and disk.
    pub(super) fn admit_decode(&mut self) -> Decision {
        self.look_at_storage();
        self.make_room(1);
        let obstacles: Vec<Obstacle> = self
            .obstacles()
            .into_iter()
            .filter(|one| one.kind == "storage" || one.kind == "stopping")
            .collect();
        let capacity = self.settings.raw.scan.queue_capacity;
        match (obstacles.is_empty(), self.finishing.len() <= capacity) {
            (false, _) => Decision::Refuse(Refusal::NotReady(obstacles)),
            (true, false) => Decision::Refuse(Refusal::QueueFull { capacity }),
            (true, true) => Decision::Start,
        }
    }

    pub(super) fn situation(&self) -> Situation {
        let next = self.next_holder().map(|waiting| waiting.id.as_str());
        let scan = self.active.as_deref().or(next).and_then(|id| self.holder(id));
        let holder = self.calibration_holder().or(scan);
        let runnable = self.queue.iter().filter(|waiting| !waiting.held).count();
        Situation {
            obstacles: self.obstacles(),
            holder,
            finishing: self.finishing.len(),
            oldest_finishing: self.finishing.front().and_then(|id| self.holder(id)),
            // Who only waits for the rig to be opened takes no place of those that wait for others.
            runnable: runnable - usize::from(next.is_some()),
            held: self.queue.iter().filter(|waiting| waiting.held).count(),
            capacity: self.settings.raw.scan.queue_capacity,
        }
    }

    pub(super) fn holder(&self, id: &str) -> Option<Holder> {
        let record = self.scans.get(id)?;
        let Record { id, state, label, created, .. } = record.as_ref().clone();
        Some(Holder { id, state, label, created, calibration: None })
    }

    pub(super) fn obstacles(&self) -> Vec<Obstacle> {
        let mut found = Vec::new();
        if self.stopping {
            found.push(Obstacle::new("stopping", "the service is ending; ask again when it is back"));
        }
        if self.rig.state == RigState::Fault {
            let message = self.rig.message.clone().unwrap_or_default();
            found.push(Obstacle::new("rig", message));
        }
        if let Some(message) = &self.storage_fault {
            found.push(Obstacle::new("storage", message.clone()));
        }
        found
    }

    pub(super) fn find(&self, id: &str) -> Result<Arc<Record>, Denied> {
        if let Some(record) = self.scans.get(id) {
            return Ok(record.clone());
        }
        let found = self.index.get(id).map_err(|error| Denied::Storage(chain(&error)))?;
        found.map(Arc::new).ok_or(Denied::Unknown)
    }

    /// The scan that holds the frames of `id`, which may itself have been decoded from another's.
    pub(super) fn source(&self, id: &str) -> Result<String, Denied> {
        let record = self.find(id)?;
        if !record.state.is_terminal() {
            return Err(Denied::State(record.state));
        }
        if record.bytes.is_none() {
            return Err(Denied::NoBundle);
        }
        match &record.source {
            Some(source) => self.source(source),
            None => Ok(record.id.clone()),
        }
    }

    pub(super) fn decode_again(&mut self, id: &str, source: &str, mode: Option<Mode>) {
        let Some(record) = self.scans.get(id) else { return };
        let label = Label { id: id.to_owned(), label: record.label.clone(), tags: record.tags.clone() };
        let (source, bundle) = (self.library.bundle(source), self.library.bundle(id));
        let cancel = CancelFlag::default();
        self.cancel.insert(id.to_owned(), cancel.clone());
        self.finishing.push_back(id.to_owned());
        let _ = self.out.finish.send(Work::Recorded { label, source, mode, bundle, cancel });
    }

    pub(super) fn cancel(&mut self, id: &str) -> Result<Arc<Record>, Denied> {
        let record = self.find(id)?;
        match record.state {
            State::Cancelled => return Ok(record),
            state if state.is_terminal() => return Err(Denied::State(state)),
            _ => {}
        }
        let series = record.series.as_ref().map(|series| series.first.clone());
        // Who stops one of a series does not want the next to begin.
        let later: Vec<String> = self
            .queue
            .iter()
            .map(|waiting| waiting.id.clone())
            .filter(|other| {
                let other = self.scans.get(other);
                let theirs = other.and_then(|record| record.series.as_ref()).map(|series| &series.first);
                other.is_some_and(|other| other.id == id) || (series.is_some() && theirs == series.as_ref())
            })
            .collect();
        for id in &later {
            self.queue.retain(|waiting| waiting.id != *id);
            self.end(id, State::Cancelled, |record| record.blame(CANCELLED.0, CANCELLED.1));
        }
        if let Some(flag) = self.cancel.get(id) {
            flag.cancel();
        }
        if self.waits_to_be_decoded(id) {
            self.finishing.retain(|other| other != id);
            self.end(id, State::Cancelled, |record| record.blame(CANCELLED.0, CANCELLED.1));
        }
        self.number_queue();
        self.find(id)
    }

    /// Whether recorded frames have not begun to be decoded.
    fn waits_to_be_decoded(&self, id: &str) -> bool {
        let state = self.scans.get(id).map(|record| record.state);
        state == Some(State::Queued) && self.finishing.iter().any(|other| other == id)
    }

    pub(super) fn delete(&mut self, id: &str) -> Result<(), Denied> {
        let record = self.find(id)?;
        if !record.state.is_terminal() {
            return Err(Denied::State(record.state));
        }
        if record.pinned {
            return Err(Denied::Pinned);
        }
        if self.index.is_source(id).map_err(|error| Denied::Storage(chain(&error)))? {
            return Err(Denied::InUse);
        }
        let left = self.discard(&record).map_err(Denied::Storage)?;
        left.into_iter().for_each(|left| drop(self.out.disk.send(disk::Task::Remove(left))));
        self.look_at_storage();
        Ok(())
    }

    /// Removes a scan from disk and index. The folder's name goes first: without it the index forgets the scan at the
    /// next start in any case.
    pub(super) fn discard(&mut self, record: &Record) -> Result<Option<PathBuf>, String> {
        let left = self.library.discard(&record.id).map_err(|error| chain(&error))?;
        self.index.remove(&record.id).map_err(|error| chain(&error))?;
        self.scans.remove(&record.id);
        self.recent.retain(|id| *id != record.id);
        self.event("deleted", |_| serde_json::json!({ "id": record.id }).to_string());
        Ok(left)
    }

    pub(super) fn change(&mut self, id: &str, change: Change) -> Result<Arc<Record>, Denied> {
        let mut record = self.find(id)?.as_ref().clone();
        if let Some(label) = change.label {
            record.label = label;
        }
        if let Some(tags) = change.tags {
            record.tags = tags;
        }
        if let Some(pinned) = change.pinned {
            record.pinned = pinned;
        }
        let was_known = self.scans.contains_key(id);
        self.scans.insert(id.to_owned(), Arc::new(record));
        self.touch(id);
        let record = self.find(id)?;
        if !was_known {
            self.scans.remove(id);
        }
        self.library.write_record(&record).map_err(|error| Denied::Storage(chain(&error)))?;
        Ok(record)
    }

    pub(super) fn hold(&mut self, held: bool) -> usize {
        let ids: Vec<String> =
            self.queue.iter().filter(|one| one.held != held).map(|one| one.id.clone()).collect();
        self.queue.iter_mut().for_each(|waiting| waiting.held = held);
        for id in &ids {
            self.edit(id, |record| record.held = held);
            self.accepted.insert(id.clone(), Instant::now());
        }
        self.number_queue();
        ids.iter().for_each(|id| self.touch(id));
        ids.len()
    }

    /// Asks the rig, which answers with its news, or refuses at once.
    pub(super) fn show(&mut self, shown: Shown, name: String, reply: Reply<()>) -> Option<Answer> {
        let situation = self.situation();
        if let Some(obstacle) = situation.obstacles.iter().find(|one| one.kind != "storage") {
            return Some(answer(Err(Denied::Refused(Refusal::NotReady(vec![obstacle.clone()]))), reply));
        }
        if let Some(holder) = situation.holder {
            return Some(answer(Err(Denied::Refused(Refusal::Busy(holder))), reply));
        }
        let _ = self.out.rig.send(rig::Command::Show(shown, name, reply));
        None
    }

    pub(super) fn preview(&mut self) {
        let idle = self.rig.state == RigState::Ready && self.active.is_none() && !self.stopping;
        if idle && !self.previewing && self.queue.iter().all(|waiting| waiting.held) {
            self.previewing = self.out.rig.send(rig::Command::Preview).is_ok();
        }
    }

    pub(super) fn stop(&mut self, grace: Duration) {
        self.stopping = true;
        self.stop_by = Some(Instant::now() + grace);
        // A measurement has nothing that could be kept, and can be asked for again.
        self.calibrating.iter().chain(&self.stepping).for_each(|one| one.cancel.cancel());
        // Decodes that have not begun can be asked for again; queued scans stay queued.
        let waiting: Vec<String> =
            self.finishing.iter().filter(|id| self.waits_to_be_decoded(id)).cloned().collect();
        self.finishing.retain(|id| !waiting.contains(id));
        for id in &waiting {
            self.cancel.get(id).into_iter().for_each(CancelFlag::cancel);
            let message = "the service ended before the frames were decoded; ask for it again";
            self.end(id, State::Interrupted, |record| record.blame(Diagnosis::Interrupted.slug(), message));
        }
        tracing::info!(grace_s = grace.as_secs_f64(), "stopping");
    }
}
