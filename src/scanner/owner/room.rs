//! Room for scans: places in the queue, space on the disk, and what retention makes.

use super::*;

impl Owner {
    /// The scan that takes the rig as soon as it can, where none has it: while the rig is opened, say.
    pub(super) fn next_holder(&self) -> Option<&Waiting> {
        self.queue.iter().find(|waiting| !waiting.held).filter(|_| self.active.is_none())
    }

    /// Gives those that wait their places, behind whoever has the rig or takes it next.
    pub(super) fn number_queue(&mut self) {
        let holder = self.next_holder().map(|waiting| waiting.id.clone());
        let order: Vec<String> = self.queue.iter().map(|waiting| waiting.id.clone()).collect();
        let others = order.iter().filter(|id| holder.as_ref() != Some(id));
        let places = others.enumerate().map(|(place, id)| (id, Some(place)));
        for (id, place) in places.chain(holder.iter().map(|id| (id, None))) {
            if self.scans.get(id).is_some_and(|record| record.queue_position != place) {
                self.edit(id, |record| record.queue_position = place);
            }
        }
        self.out.metrics.queue_depth.set(order.len() as i64);
    }

    pub(super) fn housekeep(&mut self) {
        self.housekept = Some(Instant::now());
        self.delete_expired();
        self.look_at_storage();
        let hours = self.settings.raw.api.idempotency_hours;
        let before = seconds_since_1970().saturating_sub((hours * 3600.0) as u64);
        let pruned = self.index.prune_keys(before).and_then(|()| self.index.prune_events(IN_INDEX));
        if let Err(error) = pruned {
            tracing::warn!(error = chain(&error), "the index cannot be pruned");
        }
    }

    pub(super) fn delete_expired(&mut self) {
        let days = self.settings.raw.store.keep_days;
        if days <= 0.0 {
            return;
        }
        let age = Duration::from_secs_f64(days * 86_400.0);
        let Some(limit) = SystemTime::now().checked_sub(age) else { return };
        for record in self.index.deletable(Some(&rfc3339_utc(limit))).unwrap_or_default() {
            self.retire(&record);
        }
    }

    /// Deletes a scan here and now: its space is wanted.
    pub(super) fn retire(&mut self, record: &Record) {
        let removed = self.discard(record).and_then(|left| match left {
            Some(left) => std::fs::remove_dir_all(left).map_err(|error| error.to_string()),
            None => Ok(()),
        });
        match removed {
            Ok(()) => {
                tracing::info!(id = record.id, created = record.created, "deleted by retention");
                self.out.metrics.retention_deleted.inc();
            }
            Err(error) => tracing::warn!(id = record.id, error, "retention cannot delete a scan"),
        }
    }

    /// Deletes the oldest scans until `scans` more have room, where the configuration wants that.
    pub(super) fn make_room(&mut self, scans: u64) {
        if !self.settings.raw.store.delete_oldest || self.shortage(scans).is_none() {
            return;
        }
        for record in self.index.deletable(None).unwrap_or_default() {
            if self.shortage(scans).is_none() {
                break;
            }
            self.retire(&record);
            self.measure_storage();
        }
        self.storage_fault = self.shortage(1);
    }

    /// What is short for `scans` more, besides those under way.
    pub(super) fn shortage(&self, scans: u64) -> Option<String> {
        let StorageStatus { free_bytes, used_bytes, quota_bytes, min_free_bytes, scan_bytes } = self.storage;
        let under_way = (self.finishing.len() + usize::from(self.active.is_some())) as u64;
        let needed = scan_bytes.saturating_mul(scans + under_way);
        let advice = "delete scans that are no longer needed, or set store.delete_oldest";
        if let Some(free) = free_bytes.filter(|&free| free < needed.saturating_add(min_free_bytes)) {
            return Some(format!(
                "{free} bytes are free on the disk of the scans, {needed} are needed and {min_free_bytes} must stay \
                 free: {advice}"
            ));
        }
        let quota = quota_bytes.filter(|&quota| used_bytes.saturating_add(needed) > quota)?;
        Some(format!(
            "scans take {used_bytes} of the {quota} bytes of their quota, {needed} more are needed: {advice}"
        ))
    }

    pub(super) fn look_at_storage(&mut self) {
        self.measure_storage();
        self.storage_fault = match self.settings.raw.store.delete_oldest {
            // What retention can delete is as good as free.
            true => self
                .index
                .deletable(None)
                .is_ok_and(|found| found.is_empty())
                .then(|| self.shortage(1))
                .flatten(),
            false => self.shortage(1),
        };
    }

    pub(super) fn measure_storage(&mut self) {
        match self.library.free_bytes() {
            Ok(free) => self.storage.free_bytes = free,
            Err(error) => tracing::warn!(%error, "free space is not known"),
        }
        match self.index.bytes() {
            Ok(used) => self.storage.used_bytes = used,
            Err(error) => tracing::warn!(error = chain(&error), "used space is not known"),
        }
        self.out.metrics.storage_free.set(self.storage.free_bytes.unwrap_or(0) as i64);
        self.out.metrics.storage_used.set(self.storage.used_bytes as i64);
    }
}
