//! `polscan export`: a scan in the formats of other programs, as one file or as a folder of them.

use std::{
    io::{self, Write},
    path::{Path, PathBuf},
};

use clap::ValueEnum;
use rayon::prelude::*;
use serde::Serialize;

use super::{
    failure::{USAGE, print_usage},
    say,
};
use crate::{
    engine::Failure,
    export::{Content, Item, MapName, PictureFormat, PointFormat, Scan},
    store::{BundleWriter, StorageError, manifest, single},
};

/// What a folder's files hold, in the folder itself.
const KEY_FILE_NAME: &str = "export.json";

/// Formats as they are asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Format {
    /// cloud.e57: points in metres with normals, rows and columns of the camera.
    E57,
    /// cloud.pcd: one place per camera pixel, binary, mm.
    Pcd,
    /// cloud.xyz: text, mm.
    Xyz,
    /// mesh.obj: triangles, mm.
    Obj,
    /// Maps of 16 bits with scale and offset; class and mask of 8.
    Tiff,
    /// Maps of 32-bit floats.
    TiffF32,
    /// As tiff.
    Png,
}

impl Format {
    fn from_extension(path: &Path) -> Option<Self> {
        match path.extension()?.to_str()?.to_ascii_lowercase().as_str() {
            "e57" => Some(Self::E57),
            "pcd" => Some(Self::Pcd),
            "xyz" => Some(Self::Xyz),
            "obj" => Some(Self::Obj),
            // As exports are called: the name says that it holds the values themselves.
            "tif" | "tiff" if path.file_stem()?.to_str()?.to_ascii_lowercase().ends_with(".f32") => {
                Some(Self::TiffF32)
            }
            "tif" | "tiff" => Some(Self::Tiff),
            "png" => Some(Self::Png),
            _ => None,
        }
    }

    fn kind(self) -> Kind {
        match self {
            Self::E57 => Kind::Cloud(PointFormat::E57),
            Self::Pcd => Kind::Cloud(PointFormat::Pcd),
            Self::Xyz => Kind::Cloud(PointFormat::Xyz),
            Self::Obj => Kind::Cloud(PointFormat::Obj),
            Self::Tiff => Kind::Map(PictureFormat::Tiff),
            Self::TiffF32 => Kind::Map(PictureFormat::TiffF32),
            Self::Png => Kind::Map(PictureFormat::Png),
        }
    }

    /// Whether a file of this format may have the extension of `other`.
    fn is_named_as(self, other: Self) -> bool {
        self == other || (self == Self::TiffF32 && other == Self::Tiff)
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Cloud(PointFormat),
    Map(PictureFormat),
}

/// Arguments of `polscan export`.
#[derive(Debug, clap::Args)]
pub struct ExportArgs {
    /// Folder of a scan with its manifest.json, or the manifest itself.
    bundle: PathBuf,
    /// Formats to write, separated by commas. Left out: that of the extension of --out, or all where it has none.
    #[arg(long, value_delimiter = ',', value_name = "FORMAT")]
    format: Vec<Format>,
    /// Maps to write, separated by commas. Left out: for a folder all, for one file that of its name, as in depth.tiff.
    #[arg(long, value_delimiter = ',', value_name = "MAP")]
    map: Vec<MapName>,
    /// One file, if its extension is that of the one format, else a folder for all of them. A file must be absent, a folder
    /// absent or empty; neither may lie in the bundle.
    #[arg(long, value_name = "FILE|DIR")]
    out: PathBuf,
}

/// What is to be written.
#[derive(Debug, PartialEq, Eq)]
enum Plan {
    /// `--out` is the one file.
    File(Item),
    /// `--out` is a folder. What was named must be there; what was not is left out where the scan does not have it.
    Folder { items: Vec<Item>, named: bool },
}

/// One file that was written.
#[derive(Debug, Serialize)]
struct Written {
    name: String,
    bytes: u64,
    #[serde(flatten)]
    content: Content,
}

/// One file that could not be made of the scan.
#[derive(Debug, Serialize)]
struct Skipped {
    name: String,
    reason: String,
}

/// Reads, writes and prints; returns the exit code.
pub fn export(args: &ExportArgs, json: bool) -> Result<u8, Failure> {
    let plan = match plan(args) {
        Ok(plan) => plan,
        Err(message) => {
            print_usage(&format!("error: {message}\n"), json);
            return Ok(USAGE);
        }
    };
    let bundle = folder_of(&args.bundle);
    let scan = Scan::read(bundle)?;
    let (written, skipped) = match plan {
        Plan::File(item) => (vec![write_file(&scan, item, bundle, &args.out)?], Vec::new()),
        Plan::Folder { items, named } => write_folder(&scan, items, named, bundle, &args.out)?,
    };
    if json {
        say(serde_json::json!({ "out": args.out, "files": written, "skipped": skipped }));
    } else {
        written.iter().for_each(|file| say(line(file)));
        skipped.iter().for_each(|file| say(format_args!("{}: left out, {}", file.name, file.reason)));
        say(format_args!("in {}", args.out.display()));
    }
    Ok(0)
}

/// The folder of a bundle that may be named by its manifest.
fn folder_of(bundle: &Path) -> &Path {
    let is_manifest = bundle.file_name().is_some_and(|name| name == manifest::FILE_NAME) && bundle.is_file();
    match bundle.parent().filter(|_| is_manifest) {
        Some(folder) if folder.as_os_str().is_empty() => Path::new("."),
        Some(folder) => folder,
        None => bundle,
    }
}

/// What the arguments ask for. The error says what is wrong with them.
fn plan(args: &ExportArgs) -> Result<Plan, String> {
    let extension = Format::from_extension(&args.out).filter(|_| !args.out.is_dir());
    let out = args.out.display();
    match (args.format.as_slice(), extension) {
        ([], Some(format)) => file(format, args),
        ([], None) if args.out.extension().is_some() && !args.out.is_dir() => Err(format!(
            "the extension of {out} is none of e57, pcd, xyz, obj, tiff, png; give --format for a folder of that name"
        )),
        ([format], Some(extension)) if format.is_named_as(extension) => file(*format, args),
        ([_], Some(_)) => Err(format!("--format and the extension of {out} contradict each other")),
        (_, Some(_)) => Err(format!("several formats make a folder, and {out} has the name of a file")),
        (formats, None) => folder(formats, &args.map),
    }
}

fn file(format: Format, args: &ExportArgs) -> Result<Plan, String> {
    let of_name = || {
        let stem = args.out.file_stem()?.to_str()?;
        MapName::ALL.into_iter().find(|map| stem.to_ascii_lowercase().trim_end_matches(".f32") == map.name())
    };
    let item = match (format.kind(), args.map.as_slice()) {
        (Kind::Cloud(format), []) => Item::Cloud(format),
        (Kind::Cloud(_), _) => return Err("--map is for tiff, tiff-f32 and png".to_owned()),
        (Kind::Map(format), [map]) => Item::Map(*map, format),
        (Kind::Map(format), []) => {
            let map = of_name().ok_or_else(|| {
                format!("which map goes to {}? give --map, such as --map depth", args.out.display())
            })?;
            Item::Map(map, format)
        }
        (Kind::Map(_), _) => return Err("one file holds one map; name a folder for several".to_owned()),
    };
    match item.exists() {
        true => Ok(Plan::File(item)),
        false => Err("class and mask are whole numbers; write them as tiff or png".to_owned()),
    }
}

fn folder(formats: &[Format], maps: &[MapName]) -> Result<Plan, String> {
    let kinds: Vec<Kind> = formats.iter().map(|format| format.kind()).collect();
    if !maps.is_empty() && !kinds.is_empty() && !kinds.iter().any(|kind| matches!(kind, Kind::Map(_))) {
        return Err("--map is for tiff, tiff-f32 and png".to_owned());
    }
    let wanted = |item: &Item| match item {
        Item::Cloud(format) => kinds.is_empty() || kinds.contains(&Kind::Cloud(*format)),
        Item::Map(map, format) => {
            (kinds.is_empty() || kinds.contains(&Kind::Map(*format)))
                && (maps.is_empty() || maps.contains(map))
        }
    };
    let items: Vec<Item> = Item::all().filter(wanted).collect();
    match items.is_empty() {
        true => Err("class and mask are whole numbers; write them as tiff or png".to_owned()),
        false => Ok(Plan::Folder { items, named: !kinds.is_empty() }),
    }
}

/// Fails by name for what was asked for and cannot be made.
fn refuse(scan: &Scan, item: Item) -> Result<(), Failure> {
    let refused = |reason: String| Failure::data(format!("export {}", item.file_name()), reason);
    scan.lacks(item).map_or(Ok(()), |reason| Err(refused(reason)))
}

fn failed(error: StorageError) -> Failure {
    Failure::storage("export the scan", error)
}

fn write_file(scan: &Scan, item: Item, bundle: &Path, out: &Path) -> Result<Written, Failure> {
    refuse(scan, item)?;
    let name = out.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let write = |out: &mut dyn Write| counted(scan, item, name, out);
    single::write_new(out, bundle, write).map_err(failed)
}

/// Writes all of `items` that the scan has, and a file that says what each holds.
fn write_folder(
    scan: &Scan,
    items: Vec<Item>,
    named: bool,
    bundle: &Path,
    out: &Path,
) -> Result<(Vec<Written>, Vec<Skipped>), Failure> {
    let mut skipped = Vec::new();
    let mut there = Vec::new();
    for item in items {
        match scan.lacks(item) {
            None => there.push(item),
            // A map without values is left out of all maps; a cloud that was asked for by its format is not.
            Some(_) if named && matches!(item, Item::Cloud(_)) => refuse(scan, item)?,
            Some(reason) => skipped.push(Skipped { name: item.file_name(), reason }),
        }
    }
    let writer = BundleWriter::create(out, Some(bundle), 0).map_err(failed)?;
    let write = |item: &Item| {
        let name = item.file_name();
        let mut written = None;
        writer.write_with(&name, |out| {
            written = Some(counted(scan, *item, name.clone(), out)?);
            Ok(())
        })?;
        Ok(written)
    };
    let written: Result<Vec<Option<Written>>, StorageError> = there.par_iter().map(write).collect();
    let written: Vec<Written> = written.map_err(failed)?.into_iter().flatten().collect();
    let key = serde_json::json!({ "scan": scan.origin.id, "files": written, "skipped": skipped });
    writer.bytes(KEY_FILE_NAME, format!("{key:#}\n").as_bytes()).map_err(failed)?;
    writer.finish_plain().map_err(failed)?;
    Ok((written, skipped))
}

fn counted(scan: &Scan, item: Item, name: String, out: &mut dyn Write) -> io::Result<Written> {
    let mut out = Counted { out, bytes: 0 };
    let content = scan.write(item, &mut out)?;
    Ok(Written { name, bytes: out.bytes, content })
}

/// Counts what goes through.
struct Counted<'a> {
    out: &'a mut dyn Write,
    bytes: u64,
}

impl Write for Counted<'_> {
    fn write(&mut self, data: &[u8]) -> io::Result<usize> {
        let written = self.out.write(data)?;
        self.bytes += written as u64;
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.out.flush()
    }
}

fn line(file: &Written) -> String {
    let Content { points, triangles, map } = &file.content;
    let mut text = format!("{}: {:.1} MB", file.name, file.bytes as f64 / 1e6);
    if let Some(points) = points {
        text.push_str(&format!(", {points} points"));
    }
    if let Some(triangles) = triangles {
        text.push_str(&format!(", {triangles} triangles"));
    }
    if let Some(key) = map.as_ref().filter(|key| key.bits == 16) {
        text.push_str(&format!(
            ", {} in {} = {} + {} * sample",
            key.map, key.unit, key.scale.offset, key.scale.scale
        ));
    }
    text
}

#[cfg(test)]
mod tests {
    use clap::{Args as _, FromArgMatches};

    use super::*;

    fn planned(line: &str) -> Result<Plan, String> {
        let command = ExportArgs::augment_args(clap::Command::new("export"));
        let matches = command.try_get_matches_from(["export", "bundle"].into_iter().chain(line.split(' ')));
        plan(&ExportArgs::from_arg_matches(&matches.expect("arguments that clap takes")).expect("arguments"))
    }

    #[test]
    fn the_extension_chooses_the_format() {
        let one = [
            ("--out a/b.e57", Item::Cloud(PointFormat::E57)),
            ("--out b.PCD", Item::Cloud(PointFormat::Pcd)),
            ("--out b.xyz --format xyz", Item::Cloud(PointFormat::Xyz)),
            ("--out b.obj", Item::Cloud(PointFormat::Obj)),
            ("--out depth.tif", Item::Map(MapName::Depth, PictureFormat::Tiff)),
            ("--out b.png --map mask", Item::Map(MapName::Mask, PictureFormat::Png)),
            ("--out b.tiff --format tiff-f32 --map row", Item::Map(MapName::Row, PictureFormat::TiffF32)),
            ("--out row.f32.tiff --format tiff-f32", Item::Map(MapName::Row, PictureFormat::TiffF32)),
            ("--out row.f32.tiff", Item::Map(MapName::Row, PictureFormat::TiffF32)),
            ("--out a/row.F32.TIF", Item::Map(MapName::Row, PictureFormat::TiffF32)),
        ];
        for (line, item) in one {
            assert_eq!(planned(line), Ok(Plan::File(item)), "{line}");
        }
    }

    #[test]
    fn a_folder_holds_what_was_asked_for() {
        let all = Item::all().collect();
        assert_eq!(planned("--out folder"), Ok(Plan::Folder { items: all, named: false }));
        let Ok(Plan::Folder { items, named: true }) =
            planned("--out folder.d --format e57,tiff-f32,png --map depth,class")
        else {
            panic!("a folder")
        };
        let names: Vec<String> = items.into_iter().map(Item::file_name).collect();
        assert_eq!(names, ["cloud.e57", "depth.f32.tiff", "depth.png", "class.png"]);
    }

    #[test]
    fn contradictions_are_wrong_usage() {
        let wrong = [
            "--out a.e57 --format pcd",
            "--out a.e57 --format e57,pcd",
            "--out a.las",
            "--out a.tiff",
            "--out a.tiff --map depth,row",
            "--out a.e57 --map depth",
            "--out mask.tiff --format tiff-f32",
            "--out mask.f32.tiff",
            "--out depth.f32.tiff --format tiff",
            "--out folder --format tiff-f32 --map mask",
            "--out folder --format e57 --map depth",
        ];
        for line in wrong {
            assert!(planned(line).is_err(), "{line}");
        }
    }
}
