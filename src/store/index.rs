//! The index of a store: what is listed, filtered and paged, events, and idempotency keys. Bundles are the truth about
//! scans; this file can be lost and made again from them.

use std::{
    path::{Path, PathBuf},
    time::Duration,
};

use rusqlite::{Connection, OpenFlags, OptionalExtension, Row, params, types::Value};
use thiserror::Error;

use crate::scanner::{MOST_REPEATS, Record, State};

/// Name of the index in its store.
pub const FILE_NAME: &str = "index.sqlite";

/// Layout of the tables; an index of another version is made again.
const VERSION: i64 = 1;

/// Longest wait for the other connections.
const BUSY: Duration = Duration::from_secs(2);

const TABLES: &str = "
    CREATE TABLE scans (
        id TEXT PRIMARY KEY, created TEXT NOT NULL, state TEXT NOT NULL, verdict TEXT, mode TEXT NOT NULL, label TEXT,
        pinned INTEGER NOT NULL, source TEXT, bytes INTEGER, record TEXT NOT NULL);
    CREATE INDEX scans_by_time ON scans (created, id);
    CREATE INDEX scans_by_state ON scans (state);
    CREATE TABLE tags (scan TEXT NOT NULL, tag TEXT NOT NULL, PRIMARY KEY (tag, scan));
    CREATE INDEX tags_by_scan ON tags (scan);
    CREATE TABLE events (id INTEGER PRIMARY KEY, kind TEXT NOT NULL, data TEXT NOT NULL);
    CREATE TABLE keys (key TEXT PRIMARY KEY, body TEXT NOT NULL, scan TEXT NOT NULL, created INTEGER NOT NULL);
    CREATE TABLE numbers (name TEXT PRIMARY KEY, value INTEGER NOT NULL);
";

/// The index cannot be used.
#[derive(Debug, Error)]
pub enum IndexError {
    /// SQLite says no.
    #[error("cannot {operation} in the index {}", path.display())]
    Sqlite {
        /// What was tried.
        operation: &'static str,
        /// The file.
        path: PathBuf,
        /// Why.
        #[source]
        source: rusqlite::Error,
    },
    /// It was written by another version, or holds something else.
    #[error("the index {} is not of this version or damaged: {detail}; it can be made again with `polscan store reindex`",
        path.display())]
    Unusable {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        detail: String,
    },
}

/// One event.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Event {
    /// Number; it only grows, over restarts as well.
    pub id: u64,
    /// What it is about.
    pub kind: String,
    /// JSON.
    pub data: String,
}

/// Which scans are wanted.
#[derive(Debug, Clone, Default)]
pub struct Filter {
    /// In one of these states; all where empty.
    pub states: Vec<State>,
    /// With this verdict.
    pub verdict: Option<String>,
    /// In this mode.
    pub mode: Option<String>,
    /// With this label.
    pub label: Option<String>,
    /// With all of these tags.
    pub tags: Vec<String>,
    /// Pinned or not.
    pub pinned: Option<bool>,
    /// Accepted at or after this time, RFC 3339.
    pub since: Option<String>,
    /// Accepted before this time, RFC 3339.
    pub until: Option<String>,
    /// Only scans before this one in the list.
    pub before: Option<(String, String)>,
}

/// A key that a client gave to a request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Key {
    /// Digest of the request.
    pub body: String,
    /// The scan that it was answered with.
    pub scan: String,
}

/// A connection to the index. Connections of one process may be used side by side, each by one thread.
#[derive(Debug)]
pub struct Index {
    path: PathBuf,
    connection: Connection,
}

type Result<T, E = IndexError> = std::result::Result<T, E>;

impl Index {
    /// Opens the index in `folder`, or makes an empty one. Says whether it is new.
    pub fn open(folder: &Path) -> Result<(Self, bool)> {
        let index = Self::connect(folder, OpenFlags::default())?;
        let run = |sql| index.connection.execute_batch(sql).map_err(|e| index.fail("set up tables", e));
        run("PRAGMA journal_mode = WAL; PRAGMA synchronous = NORMAL; PRAGMA wal_autocheckpoint = 500;")?;
        let number = |name| index.connection.pragma_query_value(None, name, |row| row.get::<_, i64>(0));
        let version = number("user_version").map_err(|e| index.fail("read the version", e))?;
        let tables: i64 = index
            .connection
            .query_row("SELECT count(*) FROM sqlite_master", [], |row| row.get(0))
            .map_err(|e| index.fail("read the tables", e))?;
        let new = version == 0 && tables == 0;
        if new {
            run(&format!("BEGIN; {TABLES} PRAGMA user_version = {VERSION}; COMMIT;"))?;
        } else if version != VERSION {
            return Err(index.unusable(format!("it has version {version}, expected {VERSION}")));
        } else {
            let check: String = index
                .connection
                .pragma_query_value(None, "quick_check", |row| row.get(0))
                .map_err(|e| index.fail("check the tables", e))?;
            if check != "ok" {
                return Err(index.unusable(check));
            }
        }
        Ok((index, new))
    }

    /// Opens an existing index to read it.
    pub fn open_read_only(folder: &Path) -> Result<Self> {
        Self::connect(folder, OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_NO_MUTEX)
    }

    fn connect(folder: &Path, flags: OpenFlags) -> Result<Self> {
        let path = folder.join(FILE_NAME);
        let fail = |source| IndexError::Sqlite { operation: "open", path: path.clone(), source };
        let connection = Connection::open_with_flags(&path, flags).map_err(fail)?;
        connection.busy_timeout(BUSY).map_err(fail)?;
        Ok(Self { path, connection })
    }

    fn fail(&self, operation: &'static str, source: rusqlite::Error) -> IndexError {
        IndexError::Sqlite { operation, path: self.path.clone(), source }
    }

    fn unusable(&self, detail: impl Into<String>) -> IndexError {
        IndexError::Unusable { path: self.path.clone(), detail: detail.into() }
    }

    fn execute(&self, operation: &'static str, sql: &str, values: impl rusqlite::Params) -> Result<usize> {
        let run = || self.connection.prepare_cached(sql)?.execute(values);
        run().map_err(|error| self.fail(operation, error))
    }

    fn rows<T>(
        &self,
        operation: &'static str,
        sql: &str,
        values: impl rusqlite::Params,
        read: impl FnMut(&Row<'_>) -> rusqlite::Result<T>,
    ) -> Result<Vec<T>> {
        let run =
            || self.connection.prepare_cached(sql)?.query_map(values, read)?.collect::<rusqlite::Result<_>>();
        run().map_err(|error| self.fail(operation, error))
    }

    fn records(
        &self,
        operation: &'static str,
        sql: &str,
        values: impl rusqlite::Params,
    ) -> Result<Vec<Record>> {
        let texts: Vec<String> = self.rows(operation, sql, values, |row| row.get(0))?;
        let parse = |text: String| serde_json::from_str(&text).map_err(|e| self.unusable(e.to_string()));
        texts.into_iter().map(parse).collect()
    }

    /// Writes what is known of a scan, in place of what was known before.
    pub fn put(&self, record: &Record) -> Result<()> {
        self.at_once("write a scan", || self.write(record))
    }

    /// Writes scans that were just accepted, and what their key was used for, all or nothing. Key: its text, what it was
    /// used for, the time in seconds since 1970.
    pub fn accept(&self, records: &[Record], key: Option<(&str, &Key, u64)>) -> Result<()> {
        self.at_once("write new scans", || {
            records.iter().try_for_each(|record| self.write(record))?;
            key.map_or(Ok(()), |(key, used, now)| self.set_key(key, used, now))
        })
    }

    fn at_once(&self, operation: &'static str, write: impl FnOnce() -> Result<()>) -> Result<()> {
        let fail = |error| self.fail(operation, error);
        // Dropped without a commit, it undoes what was written.
        let transaction = self.connection.unchecked_transaction().map_err(fail)?;
        write()?;
        transaction.commit().map_err(fail)
    }

    fn write(&self, record: &Record) -> Result<()> {
        let text = serde_json::to_string(record).map_err(|error| self.unusable(error.to_string()))?;
        self.execute(
            "write a scan",
            "INSERT OR REPLACE INTO scans (id, created, state, verdict, mode, label, pinned, source, bytes, record)
             VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8, ?9, ?10)",
            params![
                record.id,
                record.created,
                record.state.name(),
                record.verdict,
                record.mode,
                record.label,
                record.pinned,
                record.source,
                record.bytes.map(|bytes| bytes as i64),
                text
            ],
        )?;
        self.execute("write tags", "DELETE FROM tags WHERE scan = ?1", [&record.id])?;
        for tag in &record.tags {
            self.execute(
                "write tags",
                "INSERT OR IGNORE INTO tags (scan, tag) VALUES (?1, ?2)",
                [&record.id, tag],
            )?;
        }
        Ok(())
    }

    /// One scan.
    pub fn get(&self, id: &str) -> Result<Option<Record>> {
        Ok(self.records("read a scan", "SELECT record FROM scans WHERE id = ?1", [id])?.pop())
    }

    /// Identities of the scans that were asked for at once with the scan `first`, in their order, without those that were
    /// deleted since. Identities grow, and nobody else's lie between those of one request.
    pub fn series(&self, first: &str) -> Result<Vec<String>> {
        let sql = "SELECT id FROM (SELECT id, record FROM scans WHERE id >= ?1 ORDER BY id LIMIT ?2)
                   WHERE json_extract(record, '$.series.first') = ?1 ORDER BY id";
        self.rows("look for a series", sql, params![first, MOST_REPEATS as i64], |row| row.get(0))
    }

    /// Forgets a scan.
    pub fn remove(&self, id: &str) -> Result<()> {
        self.execute("remove a scan", "DELETE FROM tags WHERE scan = ?1", [id])?;
        self.execute("remove a scan", "DELETE FROM scans WHERE id = ?1", [id]).map(|_| ())
    }

    /// At most `limit` scans, the newest first.
    pub fn list(&self, filter: &Filter, limit: usize) -> Result<Vec<Record>> {
        let mut sql = String::from("SELECT record FROM scans WHERE 1");
        let mut values: Vec<Value> = Vec::new();
        if !filter.states.is_empty() {
            let marks = vec!["?"; filter.states.len()].join(", ");
            // The plus keeps SQLite from collecting all of these states and sorting them for every page.
            sql.push_str(&format!(" AND +state IN ({marks})"));
            values.extend(filter.states.iter().map(|state| Value::from(state.name().to_owned())));
        }
        let equal = [("verdict", &filter.verdict), ("mode", &filter.mode), ("label", &filter.label)];
        for (column, value) in equal {
            if let Some(value) = value {
                sql.push_str(&format!(" AND {column} = ?"));
                values.push(value.clone().into());
            }
        }
        for tag in &filter.tags {
            sql.push_str(" AND EXISTS (SELECT 1 FROM tags WHERE scan = scans.id AND tag = ?)");
            values.push(tag.clone().into());
        }
        if let Some(pinned) = filter.pinned {
            sql.push_str(" AND pinned = ?");
            values.push(Value::from(i64::from(pinned)));
        }
        for (comparison, value) in [("created >= ?", &filter.since), ("created < ?", &filter.until)] {
            if let Some(value) = value {
                sql.push_str(&format!(" AND {comparison}"));
                values.push(value.clone().into());
            }
        }
        if let Some((created, id)) = &filter.before {
            sql.push_str(" AND (created, id) < (?, ?)");
            values.extend([created.clone().into(), id.clone().into()]);
        }
        sql.push_str(" ORDER BY created DESC, id DESC LIMIT ?");
        values.push(Value::from(i64::try_from(limit).unwrap_or(i64::MAX)));
        self.records("list scans", &sql, rusqlite::params_from_iter(values))
    }

    /// Scans that have not come to their end, the oldest first.
    pub fn unfinished(&self) -> Result<Vec<Record>> {
        let sql = "SELECT record FROM scans WHERE state NOT IN ('done', 'failed', 'cancelled', 'interrupted')
                   ORDER BY created, id";
        self.records("list unfinished scans", sql, [])
    }

    /// Bytes of all bundles.
    pub fn bytes(&self) -> Result<u64> {
        let sum =
            self.rows("sum up sizes", "SELECT coalesce(sum(bytes), 0) FROM scans", [], |row| row.get(0))?;
        Ok(sum.first().map_or(0, |bytes: &i64| (*bytes).max(0) as u64))
    }

    /// Identities of all scans, and whether each has a bundle.
    pub fn ids(&self) -> Result<Vec<(String, bool)>> {
        self.rows("list scans", "SELECT id, bytes IS NOT NULL FROM scans", [], |row| {
            Ok((row.get(0)?, row.get(1)?))
        })
    }

    /// Whether another scan was decoded from the frames of `id`.
    pub fn is_source(&self, id: &str) -> Result<bool> {
        let found =
            self.rows("look for scans", "SELECT 1 FROM scans WHERE source = ?1 LIMIT 1", [id], |_| Ok(()))?;
        Ok(!found.is_empty())
    }

    /// Scans that retention may delete, the oldest first: at their end, not pinned, with a bundle of their own that no
    /// other needs.
    pub fn deletable(&self, before: Option<&str>) -> Result<Vec<Record>> {
        let sql =
            "SELECT record FROM scans AS one WHERE state IN ('done', 'failed', 'cancelled', 'interrupted')
                   AND NOT pinned AND bytes IS NOT NULL AND created < coalesce(?1, '9999')
                   AND NOT EXISTS (SELECT 1 FROM scans AS other WHERE other.source = one.id)
                   ORDER BY created, id";
        self.records("list deletable scans", sql, [before])
    }

    /// Stores an event.
    pub fn add_event(&self, event: &Event) -> Result<()> {
        let sql = "INSERT OR REPLACE INTO events (id, kind, data) VALUES (?1, ?2, ?3)";
        self.execute("store an event", sql, params![event.id as i64, event.kind, event.data]).map(|_| ())
    }

    /// Events after `id`, the oldest first.
    pub fn events_after(&self, id: u64, limit: usize) -> Result<Vec<Event>> {
        let sql = "SELECT id, kind, data FROM events WHERE id > ?1 ORDER BY id LIMIT ?2";
        let id = i64::try_from(id).unwrap_or(i64::MAX);
        self.rows("read events", sql, params![id, limit as i64], |row| {
            Ok(Event { id: row.get::<_, i64>(0)? as u64, kind: row.get(1)?, data: row.get(2)? })
        })
    }

    /// The oldest and the newest event.
    pub fn event_range(&self) -> Result<Option<(u64, u64)>> {
        let found = self.rows("read events", "SELECT min(id), max(id) FROM events", [], |row| {
            Ok((row.get::<_, Option<i64>>(0)?, row.get::<_, Option<i64>>(1)?))
        })?;
        Ok(found
            .first()
            .and_then(|(low, high)| Some((low.as_ref().copied()? as u64, high.as_ref().copied()? as u64))))
    }

    /// Forgets all but the newest events.
    pub fn prune_events(&self, keep: u64) -> Result<()> {
        let sql = "DELETE FROM events WHERE id <= (SELECT max(id) FROM events) - ?1";
        self.execute("forget events", sql, [keep as i64]).map(|_| ())
    }

    /// A number by its name.
    pub fn number(&self, name: &str) -> Result<Option<u64>> {
        let query = || {
            let mut statement =
                self.connection.prepare_cached("SELECT value FROM numbers WHERE name = ?1")?;
            statement.query_row([name], |row| row.get::<_, i64>(0)).optional()
        };
        let found = query().map_err(|error| self.fail("read a number", error))?;
        Ok(found.map(|value| value as u64))
    }

    /// Sets a number.
    pub fn set_number(&self, name: &str, value: u64) -> Result<()> {
        let sql = "INSERT OR REPLACE INTO numbers (name, value) VALUES (?1, ?2)";
        self.execute("write a number", sql, params![name, value as i64]).map(|_| ())
    }

    /// What a key was used for.
    pub fn key(&self, key: &str) -> Result<Option<Key>> {
        let sql = "SELECT body, scan FROM keys WHERE key = ?1";
        let read = |row: &Row<'_>| Ok(Key { body: row.get(0)?, scan: row.get(1)? });
        Ok(self.rows("look for a key", sql, [key], read)?.pop())
    }

    /// Remembers what a key was used for; `now` in seconds since 1970.
    pub fn set_key(&self, key: &str, used: &Key, now: u64) -> Result<()> {
        let sql = "INSERT OR REPLACE INTO keys (key, body, scan, created) VALUES (?1, ?2, ?3, ?4)";
        self.execute("remember a key", sql, params![key, used.body, used.scan, now as i64]).map(|_| ())
    }

    /// Forgets keys older than `before`, in seconds since 1970.
    pub fn prune_keys(&self, before: u64) -> Result<()> {
        self.execute("forget keys", "DELETE FROM keys WHERE created < ?1", [before as i64]).map(|_| ())
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn record(id: usize, state: State) -> Record {
        let mut record =
            Record::new(format!("scan-{id:03}"), "pse".into(), format!("2026-01-01T00:00:{:02}Z", id / 2));
        record.state = state;
        record.label = Some(format!("label {}", id % 3));
        record.tags = (0..id % 4).map(|tag| format!("tag {tag}")).collect();
        record.pinned = id.is_multiple_of(5);
        record.bytes = (id.is_multiple_of(2)).then_some(10);
        record
    }

    fn filled(count: usize) -> (tempfile::TempDir, Index, Vec<Record>) {
        let folder = tempfile::tempdir().unwrap();
        let (index, new) = Index::open(folder.path()).unwrap();
        assert!(new);
        let records: Vec<_> = (0..count).map(|id| record(id, State::ALL[id % State::ALL.len()])).collect();
        records.iter().for_each(|record| index.put(record).unwrap());
        (folder, index, records)
    }

    #[test]
    fn scans_and_their_key_are_written_together_or_not_at_all() {
        let (folder, index, records) = filled(2);
        let new = [record(7, State::Queued), record(8, State::Queued)];
        let used = Key { body: "digest".into(), scan: new[0].id.clone() };
        index.connection.execute_batch("ALTER TABLE keys RENAME TO keys_gone").unwrap();
        assert!(index.accept(&new, Some(("k", &used, 1))).is_err());
        assert_eq!(index.ids().unwrap().len(), records.len(), "nothing is left of what failed");
        index.connection.execute_batch("ALTER TABLE keys_gone RENAME TO keys").unwrap();
        index.accept(&new, Some(("k", &used, 1))).unwrap();
        index.accept(&[record(9, State::Queued)], None).unwrap();
        let other = Index::open_read_only(folder.path()).unwrap();
        assert_eq!(other.key("k").unwrap(), Some(used));
        assert_eq!(other.ids().unwrap().len(), records.len() + 3);
    }

    #[test]
    fn what_was_put_is_there_after_opening_again() {
        let (folder, index, records) = filled(20);
        drop(index);
        let (index, new) = Index::open(folder.path()).unwrap();
        assert!(!new);
        for record in &records {
            assert_eq!(index.get(&record.id).unwrap().as_ref(), Some(record));
        }
        assert_eq!(index.get("nothing").unwrap(), None);
        index.remove(&records[3].id).unwrap();
        assert_eq!(index.get(&records[3].id).unwrap(), None);
        assert_eq!(Index::open_read_only(folder.path()).unwrap().ids().unwrap().len(), 19);
    }

    #[test]
    fn another_version_and_damage_are_refused() {
        let (folder, index, _) = filled(1);
        index.connection.execute_batch("PRAGMA user_version = 99").unwrap();
        drop(index);
        assert!(matches!(Index::open(folder.path()), Err(IndexError::Unusable { .. })));
        std::fs::write(folder.path().join(FILE_NAME), vec![7; 5000]).unwrap();
        assert!(Index::open(folder.path()).is_err());
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]

        /// Filtering and paging against the same on a list in memory.
        #[test]
        fn lists_agree_with_a_walk_over_all_records(
            count in 0usize..40,
            states in prop::collection::btree_set(0usize..8, 0..4),
            label in prop::option::of(0usize..4),
            tags in prop::collection::btree_set(0usize..4, 0..3),
            pinned in prop::option::of(any::<bool>()),
            page in 1usize..7,
        ) {
            let (_folder, index, records) = filled(count);
            let filter = Filter {
                states: states.iter().map(|at| State::ALL[*at]).collect(),
                label: label.map(|label| format!("label {label}")),
                tags: tags.iter().map(|tag| format!("tag {tag}")).collect(),
                pinned,
                ..Filter::default()
            };
            let mut expected: Vec<&Record> = records
                .iter()
                .filter(|record| filter.states.is_empty() || filter.states.contains(&record.state))
                .filter(|record| filter.label.is_none() || record.label == filter.label)
                .filter(|record| filter.tags.iter().all(|tag| record.tags.contains(tag)))
                .filter(|record| pinned.is_none_or(|pinned| record.pinned == pinned))
                .collect();
            expected.sort_by(|one, other| (&other.created, &other.id).cmp(&(&one.created, &one.id)));
            let mut found = Vec::new();
            let mut next = filter;
            loop {
                let part = index.list(&next, page).unwrap();
                prop_assert!(part.len() <= page);
                let Some(last) = part.last() else { break };
                next.before = Some((last.created.clone(), last.id.clone()));
                found.extend(part);
            }
            prop_assert_eq!(found.iter().collect::<Vec<_>>(), expected);
        }
    }

    #[test]
    fn retention_is_offered_only_what_nobody_needs() {
        let folder = tempfile::tempdir().unwrap();
        let (index, _) = Index::open(folder.path()).unwrap();
        let mut plain = record(2, State::Done);
        let mut pinned = record(4, State::Done);
        let mut source = record(6, State::Done);
        let mut derived = record(8, State::Failed);
        let running = record(12, State::Decoding);
        let empty = record(13, State::Failed);
        plain.pinned = false;
        pinned.pinned = true;
        source.pinned = false;
        derived.pinned = false;
        derived.source = Some(source.id.clone());
        for record in [&plain, &pinned, &source, &derived, &running, &empty] {
            index.put(record).unwrap();
        }
        let ids = |before| -> Vec<String> {
            index.deletable(before).unwrap().into_iter().map(|record| record.id).collect()
        };
        assert_eq!(ids(None), [plain.id.clone(), derived.id.clone()]);
        assert_eq!(ids(Some(&derived.created)), [plain.id]);
        assert!(index.is_source(&source.id).unwrap());
        index.remove(&derived.id).unwrap();
        assert!(ids(None).contains(&source.id));
        assert_eq!(index.unfinished().unwrap(), [running]);
    }

    #[test]
    fn events_keys_and_numbers() {
        let (_folder, index, _) = filled(0);
        assert_eq!(index.event_range().unwrap(), None);
        for id in 1..=10 {
            index.add_event(&Event { id, kind: "k".into(), data: format!("{id}") }).unwrap();
        }
        let ids = |after, limit| -> Vec<u64> {
            index.events_after(after, limit).unwrap().into_iter().map(|event| event.id).collect()
        };
        assert_eq!(ids(0, 3), [1, 2, 3]);
        assert_eq!(ids(8, 30), [9, 10]);
        assert!(ids(u64::MAX, 30).is_empty());
        index.prune_events(4).unwrap();
        assert_eq!(index.event_range().unwrap(), Some((7, 10)));

        let used = Key { body: "digest".into(), scan: "a".into() };
        index.set_key("k", &used, 100).unwrap();
        assert_eq!(index.key("k").unwrap(), Some(used));
        assert_eq!(index.key("other").unwrap(), None);
        index.prune_keys(101).unwrap();
        assert_eq!(index.key("k").unwrap(), None);

        assert_eq!(index.number("n").unwrap(), None);
        index.set_number("n", 7).unwrap();
        assert_eq!(index.number("n").unwrap(), Some(7));
    }
}
