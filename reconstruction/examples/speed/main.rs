//! Measures how fast frames are decoded and writes `docs/speed.md`: each stage, and the whole against a plain read of
//! the same memory, OpenCV and numpy in the same run. With the name of a stage, prints that stage alone. Run by
//! `make bench`.

mod measure;

use std::{fmt::Write, fs, path::Path};

use measure::{Others, Outcome, Times, bundles, others, times};

/// Sensor of the scans that are measured.
const SENSOR: (usize, usize) = (1600, 1200);

fn main() -> Outcome<()> {
    let only = std::env::args().nth(1);
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().ok_or("this crate lies in no workspace")?;
    eprintln!("speed: rendering frames");
    let both = bundles(SENSOR.0, SENSOR.1)?;
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
    let page = page(&measured, &others)?;
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
