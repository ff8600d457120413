//! Reads the sources and holds the rules of the architecture that a machine can hold.
//!
//! Each rule is a function from one file to its violations, tried on a made-up offender, then run on the tree.
//! Rules look at code only: comments and the contents of literals are blanked first.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    path::Path,
};

/// Modules of the crate `reconstruction` that compute and do nothing else, in the order in which data flows: each may use itself and
/// those before it.
const PURE: [&str; 5] = ["grid", "simd", "decode", "geometry", "cloud"];

/// What code that only computes has no business with.
const IMPURE: [&str; 9] = [
    "std::fs",
    "std::env",
    "std::net",
    "std::process",
    "std::time",
    "tokio",
    "tracing",
    "memmap2",
    "polscan_drivers",
];

/// Macros of the same kind.
const IMPURE_MACROS: [&str; 4] = ["println", "print", "eprintln", "eprint"];

/// Modules of `drivers` that are the seam; every other one is a concrete driver.
const SEAM: [&str; 5] = ["camera", "clock", "error", "frame", "projector"];

/// The only place that names concrete drivers.
const JOINT: &str = "src/app";

/// Plain data of the simulated rig that a user writes into a configuration file: read and validated there, given to
/// the driver unopened.
const DESCRIBED: [(&str, [&str; 2]); 1] =
    [("src/config/", ["polscan_drivers::sim::RigDescription", "polscan_drivers::sim::Scene"])];

/// The only files that may say `unsafe`, each with what for.
const UNSAFE: [&str; 6] = [
    "drivers/src/aravis/buffers.rs", // reads frames where the camera library put them
    "drivers/src/aravis/fake.rs",    // paints frames for the library's camera in software
    "drivers/src/aravis/library.rs", // finds cameras
    "drivers/src/v4l2/kernel.rs",    // asks the kernel and maps its buffers
    "reconstruction/src/simd.rs",    // calls code compiled for registers that the processor was asked for
    "src/store/frames.rs",           // maps a file of frames into memory
];

/// Soft limit of lines before tests.
const LINES_MAX: usize = 450;

/// As many equal lines in a row are a copy.
const COPY_LINES: usize = 5;

// ------------------------------------------------------------------------------------------------- reading

/// One source file.
struct Source {
    /// Relative to the project, with forward slashes.
    path: String,
    text: String,
}

impl Source {
    fn new(path: &str, text: &str) -> Self {
        Self { path: path.into(), text: text.into() }
    }

    /// Whether the whole file is tests: `tests.rs` beside a module, or below a folder `tests`. The rule
    /// [`untested_tests`] makes sure that such a module is compiled for tests only.
    fn is_tests(&self) -> bool {
        self.path.ends_with("/tests.rs") || self.path.contains("/tests/")
    }

    /// The text before the module of tests at its end.
    fn before_tests(&self) -> &str {
        if self.is_tests() {
            return "";
        }
        let inline = |at: &usize| {
            let rest = &self.text[*at..];
            let item = &rest[..rest.find(['{', ';']).map_or(rest.len(), |end| end + 1)];
            item.ends_with('{') && item.lines().any(|line| line.starts_with("mod "))
        };
        let tests = self.text.match_indices("\n#[cfg(test)]\n").map(|(at, _)| at + 1).find(inline);
        tests.map_or(&self.text, |at| &self.text[..at])
    }

    /// Code before the tests, with comments and literals blanked; lines keep their numbers.
    fn code(&self) -> String {
        blank(self.before_tests())
    }
}

/// All `.rs` files under the named folders of the project.
fn sources(folders: &[&str]) -> Vec<Source> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut open: Vec<_> = folders.iter().map(|folder| root.join(folder)).collect();
    let mut found = Vec::new();
    while let Some(folder) = open.pop() {
        for entry in fs::read_dir(&folder).unwrap_or_else(|e| panic!("{}: {e}", folder.display())) {
            let path = entry.expect("an entry of a source folder").path();
            if path.is_dir() {
                open.push(path);
            } else if path.extension().is_some_and(|extension| extension == "rs") {
                let name = path.strip_prefix(root).expect("a path under the project");
                let text = fs::read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
                found.push(Source::new(&name.to_string_lossy(), &text));
            }
        }
    }
    assert!(!found.is_empty(), "no source under {folders:?}");
    found.sort_by(|a, b| a.path.cmp(&b.path));
    found
}

/// Replaces comments and the contents of string and character literals by spaces.
fn blank(text: &str) -> String {
    let bytes = text.as_bytes();
    let mut out = bytes.to_vec();
    let mut at = 0;
    while at < bytes.len() {
        let end = at + literal_or_comment(&bytes[at..], at > 0 && is_word(bytes[at - 1]));
        for byte in &mut out[at..end] {
            if *byte != b'\n' {
                *byte = b' ';
            }
        }
        at = end.max(at + 1);
    }
    String::from_utf8(out).expect("whole characters were blanked")
}

/// Length of the comment or literal that starts here, 0 if none does.
fn literal_or_comment(rest: &[u8], after_word: bool) -> usize {
    let until = |from: usize, end: &[u8]| {
        let found = rest[from..].windows(end.len()).position(|window| window == end);
        found.map_or(rest.len(), |position| from + position + end.len())
    };
    let quoted = |from: usize, quote: u8| {
        let mut at = from;
        while at < rest.len() && rest[at] != quote {
            at += if rest[at] == b'\\' { 2 } else { 1 };
        }
        (at + 1).min(rest.len())
    };
    match rest {
        [b'/', b'/', ..] => until(0, b"\n").max(1),
        [b'/', b'*', ..] => block_comment(rest),
        [b'"', ..] => quoted(1, b'"'),
        [b'b' | b'c', b'"', ..] if !after_word => quoted(2, b'"'),
        [b'r', ..] | [b'b' | b'c', b'r', ..] if !after_word => {
            let prefix = if rest[0] == b'r' { 1 } else { 2 };
            let hashes = rest[prefix..].iter().take_while(|&&byte| byte == b'#').count();
            if rest.get(prefix + hashes) != Some(&b'"') {
                return 0;
            }
            until(prefix + hashes + 1, &[b"\"", "#".repeat(hashes).as_bytes()].concat())
        }
        // A lifetime has no closing quote after its first character.
        [b'\'', b'\\', ..] => quoted(1, b'\''),
        [b'\'', rest @ ..] => {
            let width = std::str::from_utf8(&rest[..rest.len().min(4)])
                .map_or_else(|e| std::str::from_utf8(&rest[..e.valid_up_to()]), Ok)
                .ok()
                .and_then(|text| text.chars().next())
                .map_or(0, char::len_utf8);
            if width > 0 && rest.get(width) == Some(&b'\'') { width + 2 } else { 0 }
        }
        _ => 0,
    }
}

/// Length of a block comment with those inside it.
fn block_comment(rest: &[u8]) -> usize {
    let (mut depth, mut at) = (0, 0);
    while at < rest.len() {
        match &rest[at..] {
            [b'/', b'*', ..] => (depth, at) = (depth + 1, at + 2),
            [b'*', b'/', ..] => (depth, at) = (depth - 1, at + 2),
            _ => at += 1,
        }
        if depth == 0 {
            break;
        }
    }
    at
}

fn is_word(byte: u8) -> bool {
    byte.is_ascii_alphanumeric() || byte == b'_'
}

/// Byte offsets of `word` in `code` where it is not part of a longer word.
fn words<'a>(code: &'a str, word: &'a str) -> impl Iterator<Item = usize> + 'a {
    let bytes = code.as_bytes();
    code.match_indices(word).map(|(at, _)| at).filter(move |&at| {
        let before = at.checked_sub(1).is_some_and(|before| is_word(bytes[before]));
        let after = bytes.get(at + word.len()).is_some_and(|&after| is_word(after));
        !before && !after
    })
}

fn line_of(code: &str, at: usize) -> usize {
    code[..at].matches('\n').count() + 1
}

/// All paths that the code names, `use` trees spelled out: `use a::{b, c::d}` gives `a::b` and `a::c::d`.
fn paths(code: &str) -> BTreeMap<String, usize> {
    let mut found = BTreeMap::new();
    let mut rest = String::with_capacity(code.len());
    let mut at = 0;
    for start in words(code, "use") {
        let Some(length) = code[start..].find(';') else { continue };
        if start < at {
            continue;
        }
        let tree: String = code[start + 3..start + length].split_whitespace().collect::<Vec<_>>().join(" ");
        for path in expand(&tree) {
            found.entry(path).or_insert(line_of(code, start));
        }
        rest.push_str(&code[at..start]);
        // Keep the line numbers of what follows.
        rest.extend(code[start..start + length].matches('\n'));
        at = start + length;
    }
    rest.push_str(&code[at..]);

    let is_path = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == ':';
    let mut offset = 0;
    for piece in rest.split(|c| !is_path(c)) {
        let path = piece.trim_matches(':');
        if path.contains("::") {
            found.entry(path.to_owned()).or_insert(line_of(&rest, offset));
        }
        offset += piece.len();
        offset += rest[offset..].chars().next().map_or(0, char::len_utf8);
    }
    found
}

fn expand(tree: &str) -> Vec<String> {
    let tree = tree.trim();
    let Some((prefix, inner)) = tree.split_once('{') else {
        let path = tree.split(" as ").next().unwrap_or(tree).trim();
        return vec![path.trim_end_matches("::self").trim_start_matches("::").to_owned()];
    };
    let inner = inner.strip_suffix('}').unwrap_or(inner);
    let (mut depth, mut start, mut parts) = (0, 0, Vec::new());
    for (at, c) in inner.char_indices() {
        match c {
            '{' => depth += 1,
            '}' => depth -= 1,
            ',' if depth == 0 => {
                parts.push(&inner[start..at]);
                start = at + 1;
            }
            _ => {}
        }
    }
    parts.push(&inner[start..]);
    let prefix = prefix.trim();
    let named = parts.into_iter().filter(|part| !part.trim().is_empty());
    named
        .flat_map(expand)
        .map(
            |part| {
                if part == "self" { prefix.trim_end_matches("::").into() } else { format!("{prefix}{part}") }
            },
        )
        .collect()
}

/// Whether `path` is `root` or lies under it.
fn is_under(path: &str, root: &str) -> bool {
    path.strip_prefix(root).is_some_and(|rest| rest.is_empty() || rest.starts_with("::"))
}

// --------------------------------------------------------------------------------------------------- rules

/// Code that only computes knows no files, clocks, loggers, runtimes or devices, and nothing further down the flow.
fn impurities(source: &Source) -> Vec<String> {
    let module =
        |path: &str| path.strip_prefix("reconstruction/src/")?.split(['/', '.']).next().map(str::to_owned);
    let layer = module(&source.path).and_then(|module| PURE.iter().position(|pure| *pure == module));
    let in_leaf = ["calibration/src/", "patterns/src/"].iter().any(|leaf| source.path.starts_with(leaf));
    if layer.is_none() && !in_leaf {
        return Vec::new();
    }
    let code = source.code();
    let mut violations = Vec::new();
    for (path, line) in paths(&code) {
        if IMPURE.iter().any(|impure| is_under(&path, impure)) {
            violations.push(format!("{}:{line}: {path} in code that only computes", source.path));
        }
        let target = path.strip_prefix("crate::").and_then(|path| path.split("::").next());
        if let (Some(layer), Some(target)) = (layer, target)
            && !PURE[..=layer].contains(&target)
        {
            violations.push(format!("{}:{line}: {path} is not upstream of {}", source.path, PURE[layer]));
        }
    }
    for name in IMPURE_MACROS {
        for at in words(&code, name).filter(|at| code[at + name.len()..].starts_with('!')) {
            violations.push(format!(
                "{}:{}: {name}! in code that only computes",
                source.path,
                line_of(&code, at)
            ));
        }
    }
    violations
}

/// Outside `drivers`, concrete drivers are named in one place only.
fn concrete_drivers(source: &Source, drivers: &BTreeSet<String>) -> Vec<String> {
    if !source.path.starts_with("src/") || source.path.starts_with(JOINT) {
        return Vec::new();
    }
    let named = |path: &str| {
        let module = path.strip_prefix("polscan_drivers::").and_then(|path| path.split("::").next());
        module.is_some_and(|module| module == "*" || drivers.contains(module))
    };
    let described = |path: &str| {
        let mut places = DESCRIBED.iter().filter(|(folder, _)| source.path.starts_with(folder));
        places.any(|(_, types)| types.contains(&path))
    };
    let found = paths(&source.code()).into_iter().filter(|(path, _)| named(path) && !described(path));
    found.map(|(path, line)| format!("{}:{line}: {path} is named outside {JOINT}.rs", source.path)).collect()
}

/// `unsafe` only where it is expected, and never without saying why it is sound.
fn unsafety(source: &Source) -> Vec<String> {
    let code = blank(&source.text);
    let lines: Vec<_> = source.text.lines().collect();
    let mut violations = Vec::new();
    for at in words(&code, "unsafe") {
        let line = line_of(&code, at);
        let place = format!("{}:{line}", source.path);
        if !UNSAFE.contains(&source.path.as_str()) {
            violations.push(format!("{place}: unsafe in a file that is not listed for it"));
        }
        // The note stands in the unbroken run of comments and attributes right above, or on the statement's first lines.
        let above = lines[..line - 1].iter().rev().take(8).take_while(|line| !line.trim().is_empty());
        if !above.into_iter().any(|line| line.trim_start().starts_with("// SAFETY:")) {
            violations.push(format!("{place}: unsafe without a // SAFETY: comment above it"));
        }
    }
    violations
}

/// Nothing is left for later.
fn unfinished(source: &Source) -> Vec<String> {
    let code = blank(&source.text);
    let mut violations = Vec::new();
    for name in ["todo", "unimplemented"] {
        for at in words(&code, name).filter(|at| code[at + name.len()..].starts_with('!')) {
            violations.push(format!("{}:{}: {name}!", source.path, line_of(&code, at)));
        }
    }
    violations
}

/// A long file says why it is one.
fn overlong(source: &Source) -> Vec<String> {
    let lines = source.before_tests().lines().count();
    let header = source.text.lines().map_while(|line| line.strip_prefix("//!"));
    let words: Vec<_> = header.flat_map(str::split_whitespace).collect();
    let excused = words.join(" ").contains("long because");
    if lines <= LINES_MAX || excused {
        return Vec::new();
    }
    vec![format!(
        "{}: {lines} lines before tests; split it, or say in its header \"long because ...\"",
        source.path
    )]
}

/// A module called `tests` is left out of the program.
fn untested_tests(source: &Source) -> Vec<String> {
    let code = blank(&source.text);
    let lines: Vec<_> = code.lines().map(str::trim).collect();
    let declares = |line: &str| {
        let name = line.strip_prefix("mod ").or_else(|| line.strip_prefix("pub mod "));
        name.is_some_and(|name| name.trim_end_matches([';', '{', ' ']) == "tests")
    };
    let marked = |at: usize| {
        lines[..at].iter().rev().take_while(|line| line.starts_with("#[")).any(|line| *line == "#[cfg(test)]")
    };
    let found = (0..lines.len()).filter(|&at| declares(lines[at]) && !marked(at));
    found.map(|at| format!("{}:{}: tests without #[cfg(test)]", source.path, at + 1)).collect()
}

/// Nothing is pulled in around the crates' borders.
fn smuggled(source: &Source) -> Vec<String> {
    let code = blank(&source.text);
    let include = words(&code, "include").filter(|at| code[at + "include".len()..].starts_with('!'));
    let path = words(&code, "path").filter(|&at| code[..at].trim_end().ends_with("#["));
    include
        .chain(path)
        .map(|at| format!("{}:{}: source from another place", source.path, line_of(&code, at)))
        .collect()
}

/// Stretches of lines that stand in both files.
fn copies(one: &Source, other: &Source) -> Vec<String> {
    let meaningful = |source: &Source| -> Vec<(usize, String)> {
        let code = source.code();
        let lines = code.lines().map(str::trim).zip(1..);
        // Closing braces and the like repeat in any two files.
        lines
            .filter(|(line, _)| line.len() > 3 && !line.starts_with("use "))
            .map(|(line, n)| (n, line.into()))
            .collect()
    };
    let (one_lines, other_lines) = (meaningful(one), meaningful(other));
    let text = |window: &[(usize, String)]| window.iter().map(|(_, line)| line.clone()).collect::<Vec<_>>();
    let known: BTreeMap<_, _> =
        other_lines.windows(COPY_LINES).map(|window| (text(window), window[0].0)).collect();
    let shared = one_lines
        .windows(COPY_LINES)
        .filter_map(|window| known.get(&text(window)).map(|at| (window[0].0, at)));
    shared.map(|(here, there)| format!("{}:{here} repeats {}:{there}", one.path, other.path)).collect()
}

/// Names of our own crates among the dependencies of a manifest.
fn own_dependencies(manifest: &str) -> Vec<String> {
    fn collect(table: &toml::Table, found: &mut Vec<String>) {
        for (key, value) in table {
            let Some(inner) = value.as_table() else { continue };
            if key.ends_with("dependencies") {
                let real = |name: &String, value: &toml::Value| {
                    value.get("package").and_then(toml::Value::as_str).unwrap_or(name).to_owned()
                };
                found.extend(
                    inner
                        .iter()
                        .map(|(name, value)| real(name, value))
                        .filter(|name| name.starts_with("polscan")),
                );
            } else {
                collect(inner, found);
            }
        }
    }
    let mut found = Vec::new();
    collect(&manifest.parse().expect("a manifest is TOML"), &mut found);
    found
}

/// Modules that the drivers' crate declares besides the seam.
fn driver_modules() -> BTreeSet<String> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("drivers/src/lib.rs");
    let code = blank(&fs::read_to_string(root).expect("drivers/src/lib.rs"));
    let declared = words(&code, "mod").map(|at| {
        let name = code[at + 3..].trim_start();
        name[..name.find(|c: char| !c.is_ascii_alphanumeric() && c != '_').unwrap_or(name.len())].to_owned()
    });
    let drivers: BTreeSet<_> = declared.filter(|module| !SEAM.contains(&module.as_str())).collect();
    assert!(drivers.contains("sim"), "the simulated rig is a driver: {drivers:?}");
    drivers
}

#[track_caller]
fn check(violations: impl IntoIterator<Item = String>) {
    let violations: Vec<_> = violations.into_iter().collect();
    assert!(violations.is_empty(), "{} violations:\n{}", violations.len(), violations.join("\n"));
}

// --------------------------------------------------------------------------------------------------- tests

mod tree {
    use super::*;

    const CODE: [&str; 5] = ["src", "calibration/src", "drivers/src", "patterns/src", "reconstruction/src"];

    #[test]
    fn computing_code_is_pure_and_data_flows_one_way() {
        check(
            sources(&["calibration/src", "reconstruction/src", "patterns/src"]).iter().flat_map(impurities),
        );
    }

    #[test]
    fn leaves_do_not_depend_on_each_other_or_on_the_scanner() {
        for (leaf, known) in [
            ("drivers", &[][..]),
            ("patterns", &[]),
            ("reconstruction", &["polscan-patterns"]),
            ("calibration", &["polscan-patterns", "polscan-reconstruction"]),
        ] {
            let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(leaf).join("Cargo.toml");
            let manifest = fs::read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
            let strangers =
                own_dependencies(&manifest).into_iter().filter(|name| !known.contains(&name.as_str()));
            check(strangers.map(|name| format!("{leaf} depends on {name}")));
        }
        check(
            sources(&["calibration/src", "drivers/src", "patterns/src", "reconstruction/src"])
                .iter()
                .flat_map(smuggled),
        );
    }

    #[test]
    fn concrete_drivers_are_named_in_one_place() {
        let drivers = driver_modules();
        check(sources(&["src"]).iter().flat_map(|source| concrete_drivers(source, &drivers)));
    }

    #[test]
    fn unsafe_is_expected_and_explained() {
        check(sources(&CODE).iter().flat_map(unsafety));
    }

    #[test]
    fn nothing_is_left_unfinished() {
        check(
            sources(&["src", "calibration", "drivers", "patterns", "reconstruction", "tests"])
                .iter()
                .flat_map(unfinished),
        );
    }

    #[test]
    fn long_files_say_why() {
        check(sources(&CODE).iter().flat_map(overlong));
    }

    #[test]
    fn tests_are_left_out_of_the_program() {
        check(sources(&CODE).iter().flat_map(untested_tests));
    }

    /// An error in the scanner's geometry must not be able to hide in the twin that it is tested with.
    #[test]
    fn twin_and_geometry_share_no_code() {
        let (twin, geometry) = (sources(&["drivers/src/sim"]), sources(&["reconstruction/src/geometry"]));
        check(twin.iter().flat_map(|one| geometry.iter().flat_map(|other| copies(one, other))));
    }
}

mod rules {
    use super::*;

    /// Number of violations of `rule` in a made-up file.
    fn count(rule: impl Fn(&Source) -> Vec<String>, path: &str, text: &str) -> usize {
        rule(&Source::new(path, text)).len()
    }

    #[test]
    fn comments_and_literals_are_not_code() {
        let text = "a /* b /* c */ d */ e // f\n\"g \\\" h\" r#\"i \" j\"# 'k' '\\'' b\"l\" fn m<'n>(o: &'n p) 'é' q";
        let left: Vec<_> = blank(text)
            .split(|c: char| !c.is_alphanumeric())
            .filter(|s| !s.is_empty())
            .map(str::to_owned)
            .collect();
        assert_eq!(left, ["a", "e", "fn", "m", "n", "o", "n", "p", "q"]);
        assert_eq!(blank(text).matches('\n').count(), 1);
    }

    #[test]
    fn use_trees_are_spelled_out() {
        let code = "use std::{\n  fs,\n  io::{self, Read as _},\n};\npub(crate) use a::b as c;\nlet x = d::e::f(g);\n";
        let found: Vec<_> = paths(code).into_iter().collect();
        let expected = [("a::b", 5), ("d::e::f", 6), ("std::fs", 1), ("std::io", 1), ("std::io::Read", 1)];
        assert_eq!(found, expected.map(|(path, line)| (path.to_owned(), line)));
    }

    #[test]
    fn impurity_is_found() {
        let bad = |text| count(impurities, "reconstruction/src/decode/kernel.rs", text);
        assert_eq!(bad("use std::{fs, path::Path};"), 1);
        assert_eq!(bad("fn f() { let t = std::time::Instant::now(); }"), 1);
        assert_eq!(bad("use tracing::info;\nfn f() { println!(\"x\"); }"), 2);
        assert_eq!(bad("use crate::geometry::Lens;"), 1, "decode comes before geometry");
        assert_eq!(bad("use crate::{decode::Class, grid::Grid};\n// std::fs"), 0);
        assert_eq!(bad("fn f() {}\n\n#[cfg(test)]\nmod tests {\n    use std::fs;\n}\n"), 0, "tests may");
        let oracle = "#[cfg(test)]\nmod oracle;\nuse std::fs;\n";
        assert_eq!(
            bad(&format!("//! Header.\n{oracle}")),
            1,
            "a module of tests in another file ends nothing"
        );
        assert_eq!(count(impurities, "reconstruction/src/cloud/mod.rs", "use crate::geometry::Lens;"), 0);
        assert_eq!(count(impurities, "src/store/mod.rs", "use std::fs;"), 0, "the store may");
        assert_eq!(count(impurities, "patterns/src/code.rs", "use tokio::spawn;"), 1);
    }

    #[test]
    fn concrete_driver_is_found() {
        let drivers = BTreeSet::from(["sim".to_owned()]);
        let bad = |path, text| count(|source| concrete_drivers(source, &drivers), path, text);
        assert_eq!(bad("src/cli.rs", "use polscan_drivers::{camera::Camera, sim::Rig};"), 1);
        assert_eq!(bad("src/cli.rs", "let rig = polscan_drivers::sim::Rig::new();"), 1);
        assert_eq!(bad("src/cli.rs", "use polscan_drivers::*;"), 1);
        assert_eq!(bad("src/cli.rs", "use polscan_drivers::camera::Camera;"), 0);
        assert_eq!(bad("src/app.rs", "use polscan_drivers::sim::Rig;"), 0);
        assert_eq!(
            bad("src/config/raw.rs", "use polscan_drivers::sim::{Rig, Scene};"),
            1,
            "the rig, not its scene"
        );
        assert_eq!(bad("src/cli.rs", "use polscan_drivers::sim::Scene;"), 1);
    }

    #[test]
    fn unsafety_is_found() {
        let explained =
            "// SAFETY: the file is not written to while it is mapped.\nlet m = unsafe { map() };\n";
        assert_eq!(count(unsafety, UNSAFE[4], explained), 0);
        assert_eq!(count(unsafety, UNSAFE[4], "let m = unsafe { map() };"), 1);
        assert_eq!(count(unsafety, "src/other.rs", explained), 1);
        assert_eq!(count(unsafety, "src/other.rs", "#![forbid(unsafe_code)] // unsafe"), 0);
    }

    #[test]
    fn unfinished_code_is_found() {
        let call = ["todo", "!()"].concat();
        assert_eq!(count(unfinished, "src/a.rs", &format!("fn f() {{ {call} }}")), 1);
        assert_eq!(count(unfinished, "src/a.rs", &format!("// {call}")), 0);
    }

    #[test]
    fn overlong_file_is_found() {
        let long = "fn f() {}\n".repeat(LINES_MAX + 1);
        assert_eq!(count(overlong, "src/a.rs", &long), 1);
        assert_eq!(
            count(overlong, "src/a.rs", &format!("//! A table, long\n//! because it lists all.\n{long}")),
            0
        );
        let tested = format!("fn f() {{}}\n\n#[cfg(test)]\nmod tests {{\n{long}}}\n");
        assert_eq!(count(overlong, "src/a.rs", &tested), 0);
    }

    #[test]
    fn file_of_tests_is_judged_as_tests() {
        assert_eq!(count(impurities, "reconstruction/src/decode/tests.rs", "use std::fs;"), 0);
        assert_eq!(count(impurities, "reconstruction/src/decode/tests/bench.rs", "use std::fs;"), 0);
        assert_eq!(count(impurities, "reconstruction/src/decode/contests.rs", "use std::fs;"), 1);
        assert_eq!(
            count(
                untested_tests,
                "reconstruction/src/decode/mod.rs",
                "#[cfg(test)]\n#[rustfmt::skip]\nmod tests;"
            ),
            0
        );
        assert_eq!(count(untested_tests, "reconstruction/src/decode/mod.rs", "mod tests;\nmod contests;"), 1);
    }

    #[test]
    fn copy_is_found() {
        let body: String = (0..COPY_LINES).map(|n| format!("    let value_{n} = {n};\n")).collect();
        let one = Source::new("a.rs", &format!("fn f() {{\n{body}}}\n"));
        let other = Source::new("b.rs", &format!("fn g() {{\n    let first = 0;\n{body}}}\n"));
        let third = Source::new("c.rs", &format!("fn g() {{\n{}}}\n", body.replace("value_2", "value_x")));
        assert_eq!(copies(&one, &other).len(), 1);
        assert_eq!(copies(&one, &third).len(), 0);
    }

    #[test]
    fn own_dependency_is_found() {
        let manifest = "[dev-dependencies]\nserde = \"1\"\npolscan-patterns = { path = \"../patterns\" }\n[target.'cfg(unix)'.dependencies]\nx = { package = \"polscan\" }\n";
        assert_eq!(own_dependencies(manifest), ["polscan-patterns", "polscan"]);
    }

    #[test]
    fn smuggled_source_is_found() {
        assert_eq!(count(smuggled, "a.rs", "#[path = \"../x.rs\"]\nmod x;\ninclude!(\"y.rs\");"), 2);
        assert_eq!(count(smuggled, "a.rs", "let path = 1; include_str!(\"y.txt\");"), 0);
    }
}
