use std::{
    fs::File,
    io::Write,
    os::unix::fs::{PermissionsExt, symlink},
    sync::atomic::{AtomicUsize, Ordering},
};

use polscan_patterns::{Mode, ProjectorSize, Sequence};
use tempfile::TempDir;

use super::{
    super::{
        disk::DiskFile,
        frames::Limits,
        source::{Bundle, Policy},
    },
    *,
};
use crate::{grid::Grid, truth::TruthObject};

const SIZE: (usize, usize) = (4, 3);

fn sequence() -> Sequence {
    Sequence::new(Mode::Pse, ProjectorSize { width: 8, height: 4 }).unwrap()
}

fn manifest() -> Manifest {
    let mut manifest = Manifest::new(&sequence(), FrameFiles::Npy(FRAMES_FILE_NAME.to_owned()));
    manifest.camera = Some(manifest::Camera { bit_depth: Some(12), ..manifest::Camera::default() });
    manifest.truth_objects = Some(vec![TruthObject { name: "plate".to_owned(), planar: true }]);
    manifest
}

fn truth() -> Truth {
    Truth {
        column: Grid::from_vec(4, 3, (0..12).map(|index| index as f32).collect()),
        row: Grid::filled(4, 3, 2.0),
        depth_mm: Grid::filled(4, 3, 1000.5),
        object: Grid::filled(4, 3, 0),
        objects: vec![TruthObject { name: "plate".to_owned(), planar: true }],
    }
}

fn frame(index: usize) -> Vec<u16> {
    (0..12).map(|pixel| (index * 100 + pixel) as u16).collect()
}

fn fill(writer: &BundleWriter) -> Result<(), StorageError> {
    let mut frames = writer.frames(sequence().roles.len(), SIZE, 12)?;
    for index in 0..sequence().roles.len() {
        frames.push(Plane::U16(&frame(index)))?;
    }
    frames.finish()?;
    writer.truth(&truth())?;
    writer.bytes("report.json", b"{}\n")?;
    writer.png("maps/column.png", &image::RgbImage::new(4, 3))?;
    writer.png("maps/row.png", &image::RgbImage::new(4, 3))
}

fn names(folder: &Path) -> Vec<String> {
    let mut names: Vec<String> = fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    names
}

const ALL: [&str; 5] = ["frames.npy", "manifest.json", "maps", "report.json", "truth.npz"];

/// Loads and compares; the notes must be none.
fn verify(bundle: &Bundle) -> Result<(), crate::store::InputError> {
    let notes = bundle.verify(&bundle.frames(&Limits::default())?)?;
    assert!(notes.is_empty(), "{notes:?}");
    Ok(())
}

fn assert_whole(out: &Path) {
    assert_eq!(names(out), ALL);
    let bundle = Bundle::open(out, Policy::Upload, None).unwrap();
    verify(&bundle).unwrap();
    let listed: Vec<&String> = bundle.manifest().files.keys().collect();
    assert_eq!(listed, ["frames.npy", "maps/column.png", "maps/row.png", "report.json", "truth.npz"]);
    let frames = bundle.frames(&Limits::default()).unwrap();
    for (index, plane) in frames.planes.iter().enumerate() {
        assert!(matches!(plane.plane(), Plane::U16(samples) if samples == frame(index)));
    }
    let read = bundle.truth(SIZE).unwrap().unwrap();
    assert_eq!((read.column.data(), read.objects), (truth().column.data(), truth().objects));
}

#[test]
fn a_bundle_appears_whole_under_its_name() {
    let folder = TempDir::new().unwrap();
    let out = folder.path().join("made/on/the/way/scan");
    let writer = BundleWriter::create(&out, None, 1000).unwrap();
    fill(&writer).unwrap();
    assert!(!out.exists());
    let written = writer.finish(manifest()).unwrap();
    assert_whole(&out);
    assert_eq!(names(out.parent().unwrap()), ["scan"]);
    assert_eq!(Bundle::open(&out, Policy::Local, None).unwrap().manifest(), &written);
}

#[test]
fn an_empty_folder_becomes_the_bundle() {
    let folder = TempDir::new().unwrap();
    let out = folder.path().join("scan");
    fs::create_dir(&out).unwrap();
    let writer = BundleWriter::create(&out, None, 0).unwrap();
    fill(&writer).unwrap();
    assert!(names(&out).is_empty());
    writer.finish(manifest()).unwrap();
    assert_whole(&out);
}

#[test]
fn a_link_to_an_empty_folder_stays_a_link() {
    let folder = TempDir::new().unwrap();
    fs::create_dir(folder.path().join("real")).unwrap();
    let out = folder.path().join("link");
    symlink("real", &out).unwrap();
    let writer = BundleWriter::create(&out, None, 0).unwrap();
    fill(&writer).unwrap();
    writer.finish(manifest()).unwrap();
    assert_whole(&folder.path().join("real"));
    assert!(fs::symlink_metadata(&out).unwrap().is_symlink());
}

#[test]
fn dropping_it_unfinished_leaves_nothing() {
    let folder = TempDir::new().unwrap();
    for out in ["scan", "made/on/the/way"] {
        let writer = BundleWriter::create(&folder.path().join(out), None, 0).unwrap();
        fill(&writer).unwrap();
        drop(writer);
        assert!(names(folder.path()).is_empty(), "{out}");
    }
}

#[test]
fn a_target_that_holds_something_is_refused_and_untouched() {
    let folder = TempDir::new().unwrap();
    let out = folder.path().join("scan");
    fs::create_dir(&out).unwrap();
    fs::write(out.join("notes.txt"), "mine").unwrap();
    let refused = |path: &Path| match BundleWriter::create(path, None, 0) {
        Err(error @ StorageError::Occupied { .. }) => error.to_string(),
        other => panic!("{other:?}"),
    };
    assert!(refused(&out).contains("it holds notes.txt; name a folder"), "{}", refused(&out));
    assert!(refused(&out.join("notes.txt")).contains("it is a file"));
    symlink("nowhere", folder.path().join("dangling")).unwrap();
    assert!(refused(&folder.path().join("dangling")).contains("leads nowhere"));
    assert_eq!(names(folder.path()), ["dangling", "scan"]);
    assert_eq!(fs::read(out.join("notes.txt")).unwrap(), b"mine");
    let below_a_file = BundleWriter::create(&out.join("notes.txt/scan"), None, 0).unwrap_err().to_string();
    assert!(below_a_file.contains("a part of the path is a file"), "{below_a_file}");
    assert!(BundleWriter::create(&folder.path().join("none/../scan2"), None, 0).is_err());
}

#[test]
fn the_bundle_that_is_read_is_never_the_target() {
    let folder = TempDir::new().unwrap();
    let source = folder.path().join("source");
    fs::create_dir(&source).unwrap();
    fs::write(source.join("manifest.json"), "{}").unwrap();
    symlink(&source, folder.path().join("alias")).unwrap();
    for source in [source.clone(), source.join("manifest.json"), folder.path().join("alias")] {
        for out in ["source", "source/out", "source/a/b", "alias/out", "x/../source/out"] {
            fs::create_dir_all(folder.path().join("x")).unwrap();
            let error = BundleWriter::create(&folder.path().join(out), Some(&source), 0).unwrap_err();
            assert!(matches!(error, StorageError::InsideSource { .. }), "{out}: {error}");
        }
    }
    assert_eq!(names(&source), ["manifest.json"]);
    BundleWriter::create(&folder.path().join("source2"), Some(&source), 0).unwrap();
}

#[test]
fn two_writers_of_one_target_do_not_meet() {
    let folder = TempDir::new().unwrap();
    let out = folder.path().join("scan");
    let first = BundleWriter::create(&out, None, 0).unwrap();
    assert!(matches!(BundleWriter::create(&out, None, 0), Err(StorageError::Busy { .. })));
    drop(first);
    BundleWriter::create(&out, None, 0).unwrap();
}

#[test]
fn what_a_dead_process_left_is_recognised_and_replaced() {
    let folder = TempDir::new().unwrap();
    let partial = folder.path().join("scan.partial");
    fs::create_dir(&partial).unwrap();
    fs::write(partial.join(".polscan-partial"), "").unwrap();
    fs::write(partial.join("frames.npy"), "half").unwrap();
    let live = BundleWriter::create(&folder.path().join("live"), None, 0).unwrap();
    fs::create_dir(folder.path().join("thesis.partial")).unwrap();
    fs::write(folder.path().join("thesis.partial/chapter"), "mine").unwrap();
    assert_eq!(stale_partials(folder.path()).unwrap(), [partial]);
    let writer = BundleWriter::create(&folder.path().join("scan"), None, 0).unwrap();
    fill(&writer).unwrap();
    writer.finish(manifest()).unwrap();
    assert_whole(&folder.path().join("scan"));
    drop(live);
    // Somebody else's folder of that name is left alone.
    let writer = BundleWriter::create(&folder.path().join("thesis"), None, 0).unwrap();
    fill(&writer).unwrap();
    writer.finish(manifest()).unwrap();
    assert_eq!(names(folder.path()), ["scan", "thesis", "thesis.partial"]);
    assert_eq!(fs::read(folder.path().join("thesis.partial/chapter")).unwrap(), b"mine");
    assert!(remove_stale_partials(folder.path()).unwrap().is_empty());
}

#[test]
fn a_process_that_dies_before_the_last_rename_leaves_a_stale_folder() {
    let folder = TempDir::new().unwrap();
    let (out, partial) = (folder.path().join("scan"), folder.path().join("scan.partial"));
    let write = || {
        let writer = BundleWriter::create(&out, None, 0).unwrap();
        fill(&writer).unwrap();
        writer.finish(manifest()).unwrap();
    };
    write();
    fs::rename(&out, &partial).unwrap();
    fs::write(partial.join(".polscan-partial"), "").unwrap();
    assert_eq!(remove_stale_partials(folder.path()).unwrap(), std::slice::from_ref(&partial));
    assert!(names(folder.path()).is_empty());
    // A bundle that somebody named so has no marker, and is never removed.
    write();
    fs::rename(&out, &partial).unwrap();
    assert!(remove_stale_partials(folder.path()).unwrap().is_empty());
    write();
    assert_whole(&partial);
    assert_whole(&out);
}

#[test]
fn a_process_that_dies_after_the_last_rename_leaves_a_finished_bundle() {
    let folder = TempDir::new().unwrap();
    let out = folder.path().join("scan");
    let writer = BundleWriter::create(&out, None, 0).unwrap();
    fill(&writer).unwrap();
    writer.finish(manifest()).unwrap();
    fs::write(out.join(".polscan-partial"), "").unwrap();
    assert!(remove_stale_partials(folder.path()).unwrap().is_empty());
    assert!(matches!(BundleWriter::create(&out, None, 0), Err(StorageError::Occupied { .. })));
    let bundle = Bundle::open(&out, Policy::Upload, None).unwrap();
    verify(&bundle).unwrap();
    assert!(!bundle.manifest().files.contains_key(".polscan-partial"));
}

/// A disk that looks, right before and after each rename, for folders that a second process would take for stale.
struct Watched(Arc<AtomicUsize>);

impl Disk for Watched {
    fn create(&self, path: &Path) -> io::Result<Box<dyn DiskFile>> {
        RealDisk.create(path)
    }

    fn create_folder(&self, path: &Path) -> io::Result<()> {
        RealDisk.create_folder(path)
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        let folder = to.parent().unwrap();
        assert!(stale_partials(folder).unwrap().is_empty());
        assert!(matches!(BundleWriter::create(to, None, 0), Err(StorageError::Busy { .. })));
        self.0.fetch_add(1, Ordering::SeqCst);
        RealDisk.rename(from, to)?;
        assert!(stale_partials(folder).unwrap().is_empty());
        Ok(())
    }

    fn sync_folder(&self, path: &Path) -> io::Result<()> {
        RealDisk.sync_folder(path)
    }

    fn free_bytes(&self, path: &Path) -> io::Result<Option<u64>> {
        RealDisk.free_bytes(path)
    }
}

#[test]
fn a_finished_folder_is_never_stale_before_it_has_its_name() {
    let folder = TempDir::new().unwrap();
    let out = folder.path().join("scan");
    let renames = Arc::new(AtomicUsize::new(0));
    let writer = BundleWriter::create_on(Arc::new(Watched(Arc::clone(&renames))), &out, None, 0).unwrap();
    fill(&writer).unwrap();
    writer.finish(manifest()).unwrap();
    assert_eq!(renames.load(Ordering::SeqCst), 1);
    assert_whole(&out);
}

#[test]
fn a_truth_that_does_not_fit_the_frames_is_refused() {
    let folder = TempDir::new().unwrap();
    let out = folder.path().join("scan");
    let writer = BundleWriter::create(&out, None, 0).unwrap();
    fill(&writer).unwrap();
    writer.finish(manifest()).unwrap();
    let bundle = Bundle::open(&out, Policy::Local, None).unwrap();
    let with = |truth: &Truth, size| {
        let file = File::create(out.join(maps::TRUTH_FILE_NAME)).unwrap();
        maps::write_truth(file, truth).unwrap();
        bundle.truth(size).map(drop).map_err(|error| error.to_string())
    };
    let error = with(&truth(), (4, 4)).unwrap_err();
    assert!(error.contains("`column` is 4 x 3, the frames are 4 x 4"), "{error}");
    let error = with(&Truth { row: Grid::filled(3, 3, 0.0), ..truth() }, SIZE).unwrap_err();
    assert!(error.contains("`row` is 3 x 3"), "{error}");
    let error = with(&Truth { object: Grid::filled(4, 3, 1), ..truth() }, SIZE).unwrap_err();
    assert!(error.contains("`object` holds 1"), "{error}");
    with(&Truth { object: Grid::filled(4, 3, 255), ..truth() }, SIZE).unwrap();
}

#[test]
fn a_capture_that_was_cut_short_is_kept_and_cannot_be_decoded() {
    for count in [0, 1, 2] {
        let folder = TempDir::new().unwrap();
        let out = folder.path().join("scan");
        let writer = BundleWriter::create(&out, None, 0).unwrap();
        let mut frames = writer.frames(count, SIZE, 12).unwrap();
        (0..count).for_each(|index| frames.push(Plane::U16(&frame(index))).unwrap());
        frames.finish().unwrap();
        let mut short = Manifest { truth_objects: None, ..manifest() };
        short.sequence.truncate(count);
        assert!(!short.sequence.iter().any(|role| matches!(role, polscan_patterns::Role::Code { .. })));
        let written = writer.finish(short).unwrap();
        let bytes = fs::read(out.join(manifest::FILE_NAME)).unwrap();
        assert_eq!(Manifest::parse(&bytes).unwrap().manifest, written);
        let error = Bundle::open(&out, Policy::Local, None).unwrap_err().to_string();
        assert!(error.contains("no code frames") && error.contains("nothing can be decoded"), "{error}");
        let entry = &written.files[FRAMES_FILE_NAME];
        assert_eq!(fs::metadata(out.join(FRAMES_FILE_NAME)).unwrap().len(), entry.bytes);
    }
}

#[test]
fn names_that_are_none_are_refused() {
    let folder = TempDir::new().unwrap();
    let writer = BundleWriter::create(&folder.path().join("scan"), None, 0).unwrap();
    for name in ["", "manifest.json", "/etc/x", "../x", "a/../x", "."] {
        assert!(matches!(writer.bytes(name, b""), Err(StorageError::Refused { .. })), "{name}");
    }
    writer.bytes("a", b"1").unwrap();
    assert!(matches!(writer.bytes("a", b"2"), Err(StorageError::Refused { .. })));
}

#[test]
fn a_manifest_that_could_not_be_read_back_is_not_written() {
    let changes: [fn(&mut Manifest); 5] = [
        |manifest| manifest.sequence.clear(),
        |manifest| manifest.sequence.truncate(3),
        |manifest| manifest.calibration = Some("calibration.toml".to_owned()),
        |manifest| manifest.frames = FrameFiles::Npy("other.npy".to_owned()),
        |manifest| manifest.truth_objects = None,
    ];
    for change in changes {
        let folder = TempDir::new().unwrap();
        let writer = BundleWriter::create(&folder.path().join("scan"), None, 0).unwrap();
        fill(&writer).unwrap();
        let mut wrong = manifest();
        change(&mut wrong);
        assert!(matches!(writer.finish(wrong), Err(StorageError::Refused { .. })));
        assert!(names(folder.path()).is_empty());
    }
}

#[test]
fn what_was_not_committed_is_no_part() {
    let folder = TempDir::new().unwrap();
    let out = folder.path().join("scan");
    let writer = BundleWriter::create(&out, None, 0).unwrap();
    fill(&writer).unwrap();
    let mut half = writer.file("half").unwrap();
    half.write_all(&[1; 1 << 20]).unwrap();
    drop(half);
    assert!(writer.frames(1, SIZE, 12).is_err(), "written already");
    writer.finish(manifest()).unwrap();
    assert_whole(&out);
}

#[test]
fn hashes_are_those_of_the_bytes_however_they_are_cut() {
    let folder = TempDir::new().unwrap();
    let out = folder.path().join("scan");
    let writer = BundleWriter::create(&out, None, 0).unwrap();
    fill(&writer).unwrap();
    let data: Vec<u8> = (0..1_000_003u32).map(|index| (index * 31 % 251) as u8).collect();
    let write = |out: &mut BundleFile<'_>| {
        let mut rest = data.as_slice();
        for length in (1..).map(|step: usize| step * step * 7 % 300_000) {
            let (now, later) = rest.split_at(length.min(rest.len()));
            out.write_all(now)?;
            rest = later;
            if rest.is_empty() {
                return Ok(());
            }
        }
        Ok(())
    };
    writer.write_with("data", write).unwrap();
    writer.finish(manifest()).unwrap();
    assert_eq!(fs::read(out.join("data")).unwrap(), data);
    let bundle = Bundle::open(&out, Policy::Local, None).unwrap();
    assert_eq!(bundle.manifest().files["data"].bytes, data.len() as u64);
    verify(&bundle).unwrap();
    // What is not decoded is told, and stops nothing.
    let mut damaged = data;
    damaged[5] ^= 1;
    fs::write(out.join("data"), damaged).unwrap();
    fs::remove_file(out.join("report.json")).unwrap();
    let frames = bundle.frames(&Limits::default()).unwrap();
    let notes = bundle.verify(&frames).unwrap();
    assert_eq!(notes.len(), 2, "{notes:?}");
    assert!(notes[0].contains("`data`") && notes[0].contains("another content"), "{notes:?}");
    assert!(notes[1].contains("`report.json`"), "{notes:?}");
    // Wrong inputs are all found at once.
    drop(frames);
    File::options().append(true).open(out.join("truth.npz")).unwrap().write_all(b"x").unwrap();
    let mut bytes = fs::read(out.join("frames.npy")).unwrap();
    *bytes.last_mut().unwrap() ^= 1;
    fs::write(out.join("frames.npy"), bytes).unwrap();
    let error = verify(&bundle).unwrap_err().to_string();
    for part in ["`files.frames.npy`: has another content", "`files.truth.npz`: has "] {
        assert!(error.contains(part), "{error}");
    }
    assert!(!error.contains("files.data"), "{error}");
}

#[test]
fn a_calibration_that_was_changed_is_no_input() {
    let folder = TempDir::new().unwrap();
    let out = folder.path().join("scan");
    let writer = BundleWriter::create(&out, None, 0).unwrap();
    fill(&writer).unwrap();
    writer.bytes(CALIBRATION_FILE_NAME, b"text").unwrap();
    let named = Manifest { calibration: Some(format!("./{CALIBRATION_FILE_NAME}")), ..manifest() };
    assert!(writer.finish(named).is_err(), "own files are named as they are listed");
    let writer = BundleWriter::create(&out, None, 0).unwrap();
    fill(&writer).unwrap();
    writer.bytes(CALIBRATION_FILE_NAME, b"text").unwrap();
    writer.finish(Manifest { calibration: Some(CALIBRATION_FILE_NAME.to_owned()), ..manifest() }).unwrap();
    let bundle = Bundle::open(&out, Policy::Local, None).unwrap();
    verify(&bundle).unwrap();
    fs::write(out.join(CALIBRATION_FILE_NAME), b"test").unwrap();
    let error = verify(&bundle).unwrap_err().to_string();
    assert!(error.contains("`files.calibration.toml`: has another content"), "{error}");
}

#[test]
fn files_may_be_written_in_parallel() {
    let folder = TempDir::new().unwrap();
    let out = folder.path().join("scan");
    let writer = BundleWriter::create(&out, None, 0).unwrap();
    fill(&writer).unwrap();
    (0..40)
        .into_par_iter()
        .for_each(|index| writer.bytes(&format!("more/{}/{index}", index % 3), b"x").unwrap());
    writer.finish(manifest()).unwrap();
    let bundle = Bundle::open(&out, Policy::Local, None).unwrap();
    assert_eq!(bundle.manifest().files.len(), 45);
    verify(&bundle).unwrap();
}

#[test]
fn folders_get_the_rights_that_the_user_gives() {
    let folder = TempDir::new().unwrap();
    let out = folder.path().join("scan");
    let plain = folder.path().join("plain");
    fs::create_dir(&plain).unwrap();
    let writer = BundleWriter::create(&out, None, 0).unwrap();
    fill(&writer).unwrap();
    writer.finish(manifest()).unwrap();
    let mode = |path: &Path| fs::metadata(path).unwrap().permissions().mode();
    assert_eq!(mode(&out), mode(&plain));
}

/// A disk on which the operation with number `fails_at` fails, and all writes after it.
struct FailingDisk {
    done: Arc<AtomicUsize>,
    fails_at: usize,
    kind: io::ErrorKind,
}

struct FailingFile {
    file: File,
    done: Arc<AtomicUsize>,
    fails_at: usize,
    kind: io::ErrorKind,
}

fn step(done: &AtomicUsize, fails_at: usize, kind: io::ErrorKind) -> io::Result<()> {
    if done.fetch_add(1, Ordering::SeqCst) >= fails_at { Err(kind.into()) } else { Ok(()) }
}

impl Write for FailingFile {
    fn write(&mut self, data: &[u8]) -> io::Result<usize> {
        step(&self.done, self.fails_at, self.kind)?;
        // Short writes, as a disk gives them shortly before it is full.
        self.file.write(&data[..data.len().min(1000)])
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

impl DiskFile for FailingFile {
    fn sync(&mut self) -> io::Result<()> {
        step(&self.done, self.fails_at, self.kind)
    }
}

impl FailingDisk {
    fn new(fails_at: usize, kind: io::ErrorKind) -> Self {
        Self { done: Arc::default(), fails_at, kind }
    }

    fn step(&self) -> io::Result<()> {
        step(&self.done, self.fails_at, self.kind)
    }
}

impl Disk for FailingDisk {
    fn create(&self, path: &Path) -> io::Result<Box<dyn DiskFile>> {
        self.step()?;
        let file = File::create_new(path)?;
        Ok(Box::new(FailingFile {
            file,
            done: Arc::clone(&self.done),
            fails_at: self.fails_at,
            kind: self.kind,
        }))
    }

    fn create_folder(&self, path: &Path) -> io::Result<()> {
        self.step()?;
        RealDisk.create_folder(path)
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        self.step()?;
        RealDisk.rename(from, to)
    }

    fn sync_folder(&self, path: &Path) -> io::Result<()> {
        self.step()?;
        RealDisk.sync_folder(path)
    }

    fn free_bytes(&self, path: &Path) -> io::Result<Option<u64>> {
        RealDisk.free_bytes(path)
    }
}

fn write_on(disk: FailingDisk, out: &Path) -> Result<(), StorageError> {
    let writer = BundleWriter::create_on(Arc::new(disk), out, None, 0)?;
    fill(&writer)?;
    writer.finish(manifest()).map(drop)
}

/// Fails each operation in turn; `prepare` makes the target and `rest` is what must be left of it.
fn every_operation_may_fail(out: &Path, clean: impl Fn() -> bool) {
    let mut failures = 0;
    for fails_at in 0.. {
        let kind =
            if fails_at % 2 == 0 { io::ErrorKind::StorageFull } else { io::ErrorKind::ReadOnlyFilesystem };
        match write_on(FailingDisk::new(fails_at, kind), out) {
            Ok(()) => break,
            Err(error) => {
                assert!(clean(), "something is left after the failure of operation {fails_at}: {error}");
                let text = error.to_string();
                let expected = if fails_at % 2 == 0 { "the disk is full" } else { "is read-only" };
                assert!(text.contains(expected) && text.contains("/"), "{text}");
                assert!(matches!(error, StorageError::File { .. }));
                failures += 1;
            }
        }
    }
    assert!(failures > 20, "only {failures} operations were seen to fail");
    assert_whole(out);
}

#[test]
fn whichever_operation_fails_nothing_is_left_of_an_absent_target() {
    let folder = TempDir::new().unwrap();
    every_operation_may_fail(&folder.path().join("parent/scan"), || names(folder.path()).is_empty());
}

#[test]
fn whichever_operation_fails_an_empty_target_stays_empty() {
    let folder = TempDir::new().unwrap();
    let out = folder.path().join("scan");
    fs::create_dir(&out).unwrap();
    // Once the finished folder has replaced the empty one and only the last sync fails, the empty one is gone with it.
    every_operation_may_fail(&out, || {
        let rest = names(folder.path());
        rest.is_empty() || (rest == ["scan"] && names(&out).is_empty())
    });
}

#[test]
fn a_target_that_must_stay_is_filled_and_on_failure_emptied() {
    assert!(place::must_stay(Path::new("/proc")), "the root of a mount");
    assert!(place::must_stay(&fs::canonicalize(".").unwrap()), "where this process stands");
    // Neither is a folder to write to in a test, so a plain one is claimed the same way.
    let folder = TempDir::new().unwrap();
    let out = folder.path().join("scan");
    fs::create_dir(&out).unwrap();
    assert!(!place::must_stay(&out));
    let mut failures = 0;
    for fails_at in 0.. {
        let disk: Arc<dyn Disk> = Arc::new(FailingDisk::new(fails_at, io::ErrorKind::StorageFull));
        let result = Place::claim_inside(&*disk, &out).and_then(|place| {
            let writer = BundleWriter { disk, place, progress: Mutex::default(), finished: false };
            fill(&writer)?;
            writer.finish(manifest()).map(drop)
        });
        match result {
            Ok(()) => break,
            Err(error) => {
                assert!(names(&out).is_empty(), "{:?} is left after {fails_at}: {error}", names(&out));
                failures += 1;
            }
        }
    }
    assert!(failures > 20, "only {failures} operations were seen to fail");
    assert_whole(&out);
}

/// A disk on which only the folder `open` may be written to.
struct ClosedAround {
    open: PathBuf,
}

impl Disk for ClosedAround {
    fn create(&self, path: &Path) -> io::Result<Box<dyn DiskFile>> {
        RealDisk.create(path)
    }

    fn create_folder(&self, path: &Path) -> io::Result<()> {
        if path.starts_with(&self.open) {
            RealDisk.create_folder(path)
        } else {
            Err(io::ErrorKind::PermissionDenied.into())
        }
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        RealDisk.rename(from, to)
    }

    fn sync_folder(&self, path: &Path) -> io::Result<()> {
        RealDisk.sync_folder(path)
    }

    fn free_bytes(&self, path: &Path) -> io::Result<Option<u64>> {
        RealDisk.free_bytes(path)
    }
}

#[test]
fn an_empty_folder_in_one_that_is_closed_can_be_the_target() {
    let folder = TempDir::new().unwrap();
    let out = folder.path().join("scan");
    fs::create_dir(&out).unwrap();
    let create = |out: &Path| {
        let open = fs::canonicalize(folder.path()).unwrap().join("scan");
        BundleWriter::create_on(Arc::new(ClosedAround { open }), out, None, 0)
    };
    let writer = create(&out).unwrap();
    assert!(matches!(create(&out), Err(StorageError::Busy { .. })));
    fill(&writer).unwrap();
    writer.finish(manifest()).unwrap();
    assert_whole(&out);
    // An absent target needs the closed folder itself.
    let error = create(&folder.path().join("other")).unwrap_err().to_string();
    assert!(error.contains("the right to write there"), "{error}");
}

#[test]
fn a_real_file_system_that_is_full_is_told_before_it_is_filled() {
    let folder = TempDir::new().unwrap();
    let error = BundleWriter::create(&folder.path().join("scan"), None, u64::MAX / 2).unwrap_err();
    assert!(matches!(error, StorageError::Space { .. }), "{error}");
    assert!(names(folder.path()).is_empty());
}

/// Tells the child process below where to write.
const CHILD_TARGET: &str = "POLSCAN_TEST_KILLED_WRITER_TARGET";

#[test]
#[ignore = "started by the test that kills it"]
fn a_writer_that_waits_to_be_killed() {
    let out = std::env::var_os(CHILD_TARGET).expect("started by the test that kills it");
    let writer = BundleWriter::create(Path::new(&out), None, 0).unwrap();
    fill(&writer).unwrap();
    println!("written");
    std::thread::sleep(std::time::Duration::from_secs(600));
}

#[test]
fn a_killed_process_leaves_nothing_under_the_name_and_stops_nobody() {
    use std::io::{BufRead, BufReader};
    let folder = TempDir::new().unwrap();
    let out = folder.path().join("scan");
    let mut child = std::process::Command::new(std::env::current_exe().unwrap())
        .args([
            "--exact",
            "store::bundle::tests::a_writer_that_waits_to_be_killed",
            "--ignored",
            "--nocapture",
        ])
        .env(CHILD_TARGET, &out)
        .stdout(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    let lines = BufReader::new(child.stdout.take().unwrap()).lines();
    let written = lines.map_while(Result::ok).any(|line| line.contains("written"));
    let busy = matches!(BundleWriter::create(&out, None, 0), Err(StorageError::Busy { .. }));
    let seen_alive = stale_partials(folder.path()).unwrap();
    child.kill().unwrap();
    child.wait().unwrap();
    assert!(written && busy && seen_alive.is_empty());
    assert_eq!(names(folder.path()), ["scan.partial"]);
    assert_eq!(stale_partials(folder.path()).unwrap(), [folder.path().join("scan.partial")]);
    let writer = BundleWriter::create(&out, None, 0).unwrap();
    fill(&writer).unwrap();
    writer.finish(manifest()).unwrap();
    assert_whole(&out);
    assert_eq!(names(folder.path()), ["scan"]);
}
