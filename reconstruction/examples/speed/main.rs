//! Measures how fast frames are decoded and writes `docs/speed.md`: each stage, and the whole against a plain read of
//! the same memory, OpenCV and numpy in the same run. With the name of a stage, prints that stage alone. Run by
//! `make bench`.

mod measure;

use std::{fmt::Write, fs, path::Path};

use measure::{Bundle, Others, Outcome, Times, bundles, decode_times, others, stacked, times};
use polscan_patterns::ProjectorSize;

/// Sensor of the scans that are measured.
const SENSOR: (usize, usize) = (1600, 1200);
const PROJECTOR: ProjectorSize = ProjectorSize { width: 1024, height: 768 };
/// Camera pixels of the scaling table, in sensors.
const STACKS: [usize; 5] = [1, 2, 4, 8, 16];
/// Projectors of the other one.
const PROJECTORS: [[u32; 2]; 4] = [[512, 384], [1024, 768], [2048, 1080], [4096, 2160]];

fn main() -> Outcome<()> {
    let only = std::env::args().nth(1);
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().ok_or("this crate lies in no workspace")?;
    eprintln!("speed: rendering frames");
    let both = bundles(SENSOR, PROJECTOR)?;
    let mut measured = Vec::new();
    for bundle in &both {
        for threads in [1, 2] {
            eprintln!("speed: {} on {threads} threads", bundle.name);
            measured.push(times(bundle, threads, only.as_deref())?);
        }
    }
    if let Some(only) = only {
        for times in &measured {
            let (_, ms) = times.stages.first().ok_or(format!("there is no stage {only:?}"))?;
            println!(
                "{only}, {}, {} threads: {ms:.2} ms, {:.2} plain reads",
                times.name,
                times.threads,
                ms / times.read_ms
            );
        }
        return Ok(());
    }
    eprintln!("speed: OpenCV and numpy");
    let others = others(root, &both[0], 5)?;
    let mut page = page(&measured, &others)?;
    eprintln!("speed: more pixels");
    page.push_str(&more_pixels(&both)?);
    eprintln!("speed: other projectors");
    page.push_str(&other_projectors()?);
    print!("{page}");
    fs::write(root.join("docs/speed.md"), page)?;
    Ok(())
}

fn page(measured: &[Times], others: &Others) -> Result<String, std::fmt::Error> {
    let mut out = String::from(INTRODUCTION);
    let cpu = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let model = cpu.lines().find_map(|line| line.strip_prefix("model name")?.split(": ").nth(1));
    let cores = std::thread::available_parallelism().map_or(0, usize::from);
    writeln!(
        out,
        "Machine: {}, {cores} cores. {}.\n",
        model.unwrap_or("unknown processor"),
        others.versions
    )?;
    writeln!(out, "## Whole decode\n")?;
    writeln!(
        out,
        "| frames | threads | plain read, ms | GB/s | codes, ms | GB/s | codes / read | with sub-pixel, ms |"
    )?;
    writeln!(out, "|---|---|---|---|---|---|---|---|")?;
    for times in measured {
        let Times { name, threads, bytes, read_ms, codes_ms, decode_ms, .. } = times;
        let rate = |ms: f64| *bytes as f64 / ms / 1e6;
        writeln!(
            out,
            "| {name} | {threads} | {read_ms:.1} | {:.1} | {codes_ms:.1} | {:.1} | {:.2} | {decode_ms:.1} |",
            rate(*read_ms),
            rate(*codes_ms),
            codes_ms / read_ms,
        )?;
    }
    writeln!(out, "\n## Against others, 8 bit\n")?;
    writeln!(out, "| | ms | times the codes on 1 thread | on 2 threads |")?;
    writeln!(out, "|---|---|---|---|")?;
    for (name, ms) in [("OpenCV, one camera", others.opencv_ms), ("numpy", others.numpy_ms)] {
        let times = |threads: usize| {
            let ours = measured.iter().find(|times| times.name == "8 bit" && times.threads == threads);
            ours.map_or(f64::NAN, |ours| ms / ours.codes_ms)
        };
        writeln!(out, "| {name} | {ms:.0} | {:.0} | {:.0} |", times(1), times(2))?;
    }
    writeln!(out, "\n## Stages, ms\n")?;
    write!(out, "| stage |")?;
    for times in measured {
        write!(out, " {}, {} |", times.name, times.threads)?;
    }
    writeln!(out, "\n|---|{}", "---|".repeat(measured.len()))?;
    for (index, (name, _)) in measured.first().map_or(&[][..], |times| &times.stages).iter().enumerate() {
        write!(out, "| {name} |")?;
        for times in measured {
            write!(out, " {:.1} |", times.stages.get(index).map_or(f64::NAN, |(_, ms)| *ms))?;
        }
        writeln!(out)?;
    }
    out.push_str(STAGES);
    Ok(out)
}

/// Times of as many pixels and more.
fn more_pixels(both: &[Bundle]) -> Outcome<String> {
    let mut out = String::from(MORE_PIXELS);
    for bundle in both {
        let mut rows = Vec::new();
        for stack in STACKS {
            let stacked = stacked(bundle, stack);
            rows.push((stack, [decode_times(&stacked, 1)?.0, decode_times(&stacked, 2)?.0]));
        }
        for (stack, found) in &rows {
            write!(out, "| {} | x{stack} |", bundle.name)?;
            for (at, [read_ms, codes_ms, decode_ms]) in found.iter().enumerate() {
                let once = |kind: usize| rows[0].1[at][kind] * *stack as f64;
                write!(out, " {read_ms:.1} | {codes_ms:.0} ({:.2}) |", codes_ms / once(1))?;
                write!(out, " {decode_ms:.0} ({:.2}) |", decode_ms / once(2))?;
            }
            writeln!(out)?;
        }
    }
    Ok(out)
}

/// Times of other projectors, which take other numbers of frames.
fn other_projectors() -> Outcome<String> {
    let mut out = String::from(OTHER_PROJECTORS);
    for [width, height] in PROJECTORS {
        let [bytes, _] = bundles(SENSOR, ProjectorSize { width, height })?;
        let frames = bytes.frames.len();
        let mut row = format!("| {width}x{height} | {frames} |");
        let mut share = 0.0;
        for threads in [1, 2] {
            let ([read_ms, codes_ms, decode_ms], valid) = decode_times(&bytes, threads)?;
            share = valid;
            let per_frame = codes_ms / frames as f64;
            write!(row, " {read_ms:.1} | {codes_ms:.1} | {per_frame:.2} | {decode_ms:.0} |")?;
        }
        writeln!(out, "{row} {:.0} |", 100.0 * share)?;
    }
    Ok(out)
}

const MORE_PIXELS: &str = "
## More pixels, ms

The same scan stacked, so that everything but the size is equal. In brackets the time over as many times the first
row's: 1 is linear.

| frames | pixels | read, 1 thread | codes | with sub-pixel | read, 2 threads | codes | with sub-pixel |
|---|---|---|---|---|---|---|---|
";

const OTHER_PROJECTORS: &str = "
## Other projectors, 8 bit, ms

The same camera of 1600x1200 px, which does not resolve the finest stripes of the largest.

| projector | frames | read, 1 thread | codes | codes per frame | with sub-pixel | read, 2 threads | codes | codes per frame | with sub-pixel | pixels decoded, % |
|---|---|---|---|---|---|---|---|---|---|---|
";

const INTRODUCTION: &str = "# Speed

Written by `make bench`; `make bench STAGE=words` measures one stage alone and prints it. A scan of 44 frames of
1600x1200 px, 1024x768 projector, in memory. All times are the least of many repetitions in one run, so that other
work on the machine counts as little as possible; compare ratios rather than times. A plain read sums all samples
once, on the same threads and row by row as the decode does. *Codes* are columns, rows, classes and quality after all
gates; *with sub-pixel* is the decode up to complete maps. OpenCV decodes two cameras that see the same, of which half
is given; it finds columns, rows and its shadow mask. numpy finds columns, rows and a mask by vectorised comparisons.

";

const STAGES: &str = "
`noise`: camera noise from the frames, where no calibration gives it. `words`: references, pair accumulation, noise
gates, Gray decode and classes in one pass over all frames, into maps that lie in memory already (getting 60 MB from the
system takes as long again; it counts in *codes*). `pair-sums`: the proof that the frames show what was projected.
`gates`: legal boundaries, vote, interreflection. `subpixel-*`: coordinates finer than a pixel, columns and rows.
`triangulator`: what is prepared once for a calibration. `cloud`: points, gates, normals and flags. `ply`: the point
cloud as a file in memory. `contrast`: the picture contrast of the report.
";
