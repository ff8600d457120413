"""Checks what the documents say, against the sources and the program.

    documents.py BINARY [--self-test]

Links and anchors resolve; every page is in the book; blocks of code parse; command lines are accepted by the program's own
parser; paths of REST exist in docs/openapi.json and targets in the Makefile; docs/report.md has every key of the report, every
class and every flag. The `sh` and `python` blocks of docs/rest.md and docs/getting-started.md are run, on a small simulated rig.
`--self-test` tries each rule on a made-up offender instead.
"""

import json
import os
import re
import shlex
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path

import small_twin

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
ADDRESS = "http://127.0.0.1:8631"
FENCE = re.compile(r"^\s*```(\S*)")
# Mode, role and axis are values, not objects, or have no key of their own.
TYPES = {
    "src/report/types.rs": None,
    "src/report/accuracy.rs": ["Accuracy"],
    "src/report/diagnosis/mod.rs": ["Reason"],
    "src/sequencer/record.rs": ["Retake", "ReferenceRetake", "Finding"],
    "src/sequencer/synchrony.rs": ["Synchrony", "PhaseError"],
    "reconstruction/src/decode/types.rs": ["NoiseModel"],
}


def pages():
    return [*sorted(DOCS.glob("*.md")), ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "python" / "README.md"]


def split(text):
    """Prose by line, code blanked; and language, first line and code of each block."""
    prose, blocks, block = [], [], None
    for number, line in enumerate(text.splitlines(), 1):
        fence = FENCE.match(line)
        if fence and block is None:
            block = [fence[1], number + 1, []]
        elif fence:
            blocks.append((block[0], block[1], "\n".join(block[2]) + "\n"))
            block = None
        elif block is not None:
            block[2].append(line)
        prose.append("" if fence or block is not None else line)
    return prose, blocks, block is None


def anchors(text):
    """Anchors of the headings, as mdBook and code hosts make them."""
    found, seen = set(), {}
    for line in split(text)[0]:
        if heading := re.match(r"#+\s+(.*)", line):
            title = re.sub(r"[`*]|\[([^]]*)\]\([^)]*\)", lambda one: one[1] or "", heading[1]).strip().lower()
            name = re.sub(r"\s", "-", re.sub(r"[^\w\s-]", "", title))
            count = seen.get(name, 0)
            seen[name] = count + 1
            found.add(f"{name}-{count}" if count else name)
    return found


def check_links(path, text):
    for number, line in enumerate(split(text)[0], 1):
        for target in re.findall(r"\]\(([^)\s]+)\)", re.sub(r"`[^`]*`", "", line)):
            if re.match(r"[a-z]+:", target):
                continue
            name, _, anchor = target.partition("#")
            file = (path.parent / name).resolve() if name else path
            if not file.exists():
                yield f"{number}: {target}: there is no such file"
            elif path.parent == DOCS and not file.is_relative_to(DOCS):
                yield f"{number}: {target}: leads out of the book"
            elif anchor and anchor not in anchors(text if file == path else file.read_text()):
                yield f"{number}: {target}: there is no such heading"


def check_mentions(text):
    """Files of docs/ that are named in prose or comments."""
    for name in re.findall(r"\bdocs/[\w-]+\.(?:md|json|toml)\b", text):
        if not (ROOT / name).exists():
            yield f"{name}: there is no such page"


def check_summary(summary, names):
    listed = set(re.findall(r"\]\(([\w-]+\.md)\)", summary))
    yield from (f"{name} is not in SUMMARY.md" for name in sorted(names - listed - {"SUMMARY.md"}))
    yield from (f"SUMMARY.md names {name}, which is not there" for name in sorted(listed - names))


def help_of(binary, words):
    return subprocess.run([binary, *words, "--help"], capture_output=True, text=True, cwd=ROOT)


def check_command(binary, command):
    """Whether the program's own parser takes a command line. Placeholders stand for files, which are not opened."""
    try:
        words = shlex.split(command, comments=True)
    except ValueError as error:
        yield f"{command}: {error}"
        return
    words = words[1:]
    for stop in ("|", "&", "&&", ">", ";", "||"):
        if stop in words:
            words = words[: words.index(stop)]
    words = [word.rstrip(".") if word.endswith("...") else word for word in words]
    if not words or words[-1] in ("--help", "--version"):
        words = words[:-1]
    asked = help_of(binary, words)
    if asked.returncode != 0:
        yield f"`{command}`: {asked.stderr.strip().splitlines()[0]}"


def check_request(paths, command):
    """Whether path and method of a curl command are in the API document."""
    method = re.search(r"-X (\w+)", command)
    method = method[1].lower() if method else "get"
    for url in re.findall(r"(?:localhost:8631|127\.0\.0\.1:8631|\$url)(\$href[\w/.-]*|/[^\s'\"]*)", command):
        path = url.replace("$href", "/v1/scans/ID").split("?")[0]
        known = [one for one in paths if re.fullmatch(re.sub(r"\{\w+\}", "[^/]+", one), path)]
        if path not in ("/", "/docs") and not any(method in paths[one] for one in known):
            yield f"{method.upper()} {path} is not in docs/openapi.json"


def check_target(makefile, line):
    for target in re.findall(r"(?:^|`|\$ |&& )make ([a-z][\w-]*)", line):
        if not re.search(rf"^{target}:", makefile, re.MULTILINE):
            yield f"make {target} is not in the Makefile"


def check_toml(binary, code):
    try:
        value = tomllib.loads(code)
    except tomllib.TOMLDecodeError as error:
        yield f"no TOML: {error}"
        return
    known = set(tomllib.loads((ROOT / "config" / "default.toml").read_text())) | {"sim"}
    if set(value) <= known:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "polscan.toml"
            # Pieces of a simulated rig go with the one that there is.
            rig = set(value) == {"sim"} and not {"scene", "camera"} <= set(value["sim"])
            file.write_text(small_twin.write(folder).read_text() + code if rig else code)
            asked = subprocess.run([binary, "check-config", str(file)], capture_output=True, text=True)
        # Files that it names are the reader's.
        lines = asked.stderr.splitlines()
        faults = [line for line in lines[1:] if ": cannot read " not in line]
        if asked.returncode != 0 and (faults or len(lines) < 2):
            yield f"check-config refuses it: {' '.join(faults or lines)}"


def check_block(context, language, code):
    binary, paths, makefile = context
    try:
        if language == "json":
            json.loads(code)
        elif language == "python":
            compile(code, "block", "exec")
    except (ValueError, SyntaxError) as error:
        yield f"no {language}: {error}"
    if language == "toml":
        yield from check_toml(binary, code)
    if language in ("", "sh", "console"):
        for line in re.sub(r"\\\n\s*", " ", code).splitlines():
            line = re.sub(r"^\s*\$ ", "", line).strip()
            if line.startswith("polscan "):
                yield from check_command(binary, line)
            if "curl " in line:
                yield from check_request(paths, line)
            yield from check_target(makefile, line)
    if language == "sh":
        asked = subprocess.run(["bash", "-n"], input=code, capture_output=True, text=True)
        if asked.returncode != 0:
            yield f"no shell: {asked.stderr.strip()}"
    if language not in ("", "sh", "console", "json", "toml", "python", "text", "matlab", "ini", "xml"):
        yield f"nobody checks blocks of {language}"


def check_inline(context, line):
    binary, _, makefile = context
    for code in re.findall(r"`([^`]+)`", line):
        if re.match(r"polscan [a-z-]+( |$)", code) and not re.search(r"\.\.\.|[|\[]", code):
            # An option may be named without its value.
            found = list(check_command(binary, code))
            yield from (list(check_command(binary, f"{code} VALUE")) if found and "--" in code.split()[-1] else found)
        yield from check_target(makefile, f"`{code}")


def fields(source, names=None):
    """Public keys of the structures of a Rust source, as serde writes them."""
    found = set()
    for name, body in re.findall(r"^pub struct (\w+) \{\n(.*?)^\}", source, re.MULTILINE | re.DOTALL):
        if names is not None and name not in names:
            continue
        attributes = ""
        for line in body.splitlines():
            if "#[serde" in line:
                attributes = line
            elif field := re.match(r"\s+pub (\w+):", line):
                renamed = re.search(r'rename = "(\w+)"', attributes)
                if "flatten" not in attributes:
                    found.add(renamed[1] if renamed else field[1])
                attributes = ""
    return found


def documented(page):
    """Whole keys of the tables, and their parts."""
    whole = set()
    for line in split(page)[0]:
        if line.startswith("|"):
            whole |= set(re.findall(r"`([\w.\[\]]+)`", line))
    return whole, {part for one in whole for part in one.replace("[]", "").split(".")}


def check_keys(page, keys):
    known = documented(page)[1]
    yield from (f"the key `{key}` of the report is not explained" for key in sorted(keys - known))


def written(value, before=""):
    """Paths of a report as it was written."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from written(inner, f"{before}.{key}" if before else key)
    elif isinstance(value, list) and value and isinstance(value[0], dict):
        for inner in value:
            yield from written(inner, f"{before}[]")
    else:
        yield before


def check_paths(page, report):
    whole, parts = documented(page)
    for path in sorted(set(written(report))):
        # Inside of these there are keys that are explained elsewhere or once for all.
        if re.match(r"reasons\[\]\.evidence|planes\[\]\.truth|capture\.(retaken|references_retaken|discarded)", path):
            continue
        if path not in whole and not (path.startswith("capture.pair_residual_sigma.worst_pair") and path.split(".")[-1] in parts):
            yield f"the key `{path}` of a report is not explained"


def check_numbers(page, classes, flags):
    rows = [line for line in split(page)[0] if line.startswith("|")]
    for name, number in classes:
        if not any(re.match(rf"\| `pixels\.\w+` \| {number} \|", row) for row in rows):
            yield f"class {number} ({name}) is not explained"
    for name, bit in flags:
        if not any(row.startswith(f"| {bit} | {1 << int(bit)} | `{name}` |") for row in rows):
            yield f"flag {name} is not explained as bit {bit}"


def sources():
    keys = set()
    for file, names in TYPES.items():
        keys |= fields((ROOT / file).read_text(), names)
    types = (ROOT / "reconstruction/src/decode/types.rs").read_text()
    classes = re.findall(r"^    (\w+) = (\d+),$", types[types.index("pub enum Class") :], re.MULTILINE)
    flags = re.findall(r"pub const (\w+): u8 = 1 << (\d);", (ROOT / "reconstruction/src/cloud/mod.rs").read_text())
    flags += [(name, "0") for name in re.findall(r"pub const (\w+): u8 = 1;", (ROOT / "reconstruction/src/cloud/mod.rs").read_text())]
    assert len(keys) > 80 and len(classes) == 12 and len(flags) == 5, (len(keys), classes, flags)
    return keys, classes, flags


def run_blocks(name, folder, environment, url=ADDRESS):
    """Runs the blocks of a page in order, in one folder: those of one language in a row, in one process."""
    text = (DOCS / name).read_text()
    runs = []
    for language, line, code in split(text)[1]:
        if language in ("sh", "python"):
            if runs and runs[-1][0] == language:
                runs[-1][2] += code
            else:
                runs.append([language, line, code])
    assert runs, f"{name} has nothing to run"
    for language, line, code in runs:
        code = code.replace(ADDRESS, url)
        command = ["bash", "-euo", "pipefail", "-c", code] if language == "sh" else [sys.executable, "-c", code]
        asked = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=600)
        if asked.returncode != 0:
            yield f"{line}: {language} ends with {asked.returncode}\n{asked.stdout[-2000:]}{asked.stderr[-2000:]}"


def run_pages(binary):
    """The two pages that are run, and the report that came of it."""
    with tempfile.TemporaryDirectory() as scratch:
        scratch = Path(scratch)
        rig = small_twin.write(
            scratch / "config", 8.0,
            [("store.dir", json.dumps(str(scratch / "store"))), ("store.min_free_gib", "0.0"), ("api.listen", '"127.0.0.1:0"')],
        )
        # What the page calls by the names of the project.
        (scratch / "config" / "sim.toml").write_text(rig.read_text())
        (scratch / "bin").mkdir()
        (scratch / "bin" / "polscan").symlink_to(binary)
        environment = {**os.environ, "PATH": f"{scratch / 'bin'}:{os.environ['PATH']}"}
        yield from (f"getting-started.md: {one}" for one in run_blocks("getting-started.md", scratch, environment))
        report = scratch / "first" / "report.json"
        if report.exists():
            yield from (f"report.md: {one}" for one in check_paths((DOCS / "report.md").read_text(), json.loads(report.read_text())))
        where = scratch / "address"
        with (scratch / "log").open("wb") as log:
            service = subprocess.Popen([binary, "serve", "--config", str(rig), "--address-file", str(where)], stdout=log, stderr=log)
        try:
            end = time.monotonic() + 60
            while not (where.exists() and where.read_text().strip()):
                if service.poll() is not None or time.monotonic() > end:
                    raise SystemExit(f"the service does not listen:\n{(scratch / 'log').read_text()}")
                time.sleep(0.05)
            url = f"http://{where.read_text().strip()}"
            for _ in range(600):
                if subprocess.run(["curl", "-s", "--fail", f"{url}/readyz"], capture_output=True).returncode == 0:
                    break
                time.sleep(0.1)
            yield from (f"rest.md: {one}" for one in run_blocks("rest.md", scratch, environment, url))
        finally:
            service.terminate()
            service.wait(60)


def everything(binary):
    paths = json.loads((DOCS / "openapi.json").read_text())["paths"]
    context = binary, paths, (ROOT / "Makefile").read_text()
    for path in pages():
        text, name = path.read_text(), path.relative_to(ROOT)
        prose, blocks, closed = split(text)
        found = [*check_links(path, text), *check_mentions(text)] + ([] if closed else ["a block of code has no end"])
        for number, line in enumerate(prose, 1):
            found += [f"{number}: {one}" for one in check_inline(context, line)]
        for language, number, code in blocks:
            found += [f"{number}: {one}" for one in check_block(context, language, code)]
        yield from (f"{name}:{one}" for one in found)
    for file in [*ROOT.glob("src/**/*.rs"), *ROOT.glob("scripts/*"), *ROOT.glob("config/*.toml"), ROOT / "Cargo.toml"]:
        yield from (f"{file.relative_to(ROOT)}: {one}" for one in check_mentions(file.read_text()))
    yield from check_summary((DOCS / "SUMMARY.md").read_text(), {file.name for file in DOCS.glob("*.md")})
    keys, classes, flags = sources()
    report = (DOCS / "report.md").read_text()
    yield from (f"report.md: {one}" for one in [*check_keys(report, keys), *check_numbers(report, classes, flags)])
    yield from run_pages(binary)


def self_test(binary):
    """Each rule finds its offender, and nothing in what is right."""
    context = binary, {"/v1/scans/{id}": {"get": {}}}, "run: ## build\n"
    page = DOCS / "page.md"
    cases = {
        "file": (check_links(page, "[a](nowhere.md)"), check_links(page, "[a](rest.md)")),
        "anchor": (check_links(page, "# One\n[a](#two)"), check_links(page, "# One\n[a](#one)")),
        "out of the book": (check_links(page, "[a](../README.md)"), check_links(page, "[a](https://example.org)")),
        "mention": (check_mentions("see docs/nowhere.md"), check_mentions("see docs/rest.md")),
        "summary": (check_summary("[a](a.md)", {"a.md", "b.md"}), check_summary("[a](a.md)", {"a.md"})),
        "summary, no page": (check_summary("[a](a.md)", set()), check_summary("", set())),
        "option": (check_block(context, "sh", "polscan scan --bogus\n"), check_block(context, "sh", "polscan scan --out a\n")),
        "subcommand": (check_inline(context, "`polscan sacn`"), check_inline(context, "`polscan scan`")),
        "target": (check_block(context, "", "make nothing\n"), check_block(context, "", "make run\n")),
        "path": (check_block(context, "sh", "curl localhost:8631/v1/scan\n"), check_block(context, "sh", "curl localhost:8631/v1/scans/ID\n")),
        "method": (check_block(context, "sh", "curl -X PUT $url/v1/scans/$id\n"), check_block(context, "sh", "curl $url/v1/scans/$id\n")),
        "shell": (check_block(context, "sh", "if\n"), check_block(context, "sh", "true\n")),
        "json": (check_block(context, "json", "{a}"), check_block(context, "json", "{}")),
        "python": (check_block(context, "python", "a ="), check_block(context, "python", "a = 1")),
        "toml": (check_block(context, "toml", "a ="), check_block(context, "toml", "[other]\na = 1")),
        "configuration": (check_block(context, "toml", "[camera]\nbogus = 1"), check_block(context, "toml", "[camera]\nexposure_us = 10.0")),
        "language": (check_block(context, "cobol", ""), check_block(context, "text", "")),
        "key": (check_keys("| `a.b` |", {"b", "c"}), check_keys("| `a.b` |", {"b"})),
        "path of a report": (check_paths("| `a.b` |", {"a": {"c": 1}}), check_paths("| `a.b` |", {"a": {"b": 1}})),
        "class": (check_numbers("| `pixels.a` | 1 |", [("B", "2")], []), check_numbers("| `pixels.a` | 1 |", [("A", "1")], [])),
        "flag": (check_numbers("| 1 | 4 | `A` |", [], [("A", "1")]), check_numbers("| 1 | 2 | `A` |", [], [("A", "1")])),
    }
    for name, (offender, right) in cases.items():
        if not list(offender):
            yield f"the rule on {name} finds nothing in its offender"
        yield from (f"the rule on {name} finds in what is right: {one}" for one in right)


def main():
    if len(sys.argv) < 2:
        raise SystemExit(__doc__)
    binary = str(Path(sys.argv[1]).resolve())
    testing = "--self-test" in sys.argv
    found = list(self_test(binary) if testing else everything(binary))
    fine = "each rule finds its offender" if testing else "everything that they name is there, and what they show runs"
    print("\n".join(found) or f"documents: {fine}")
    raise SystemExit(bool(found))


if __name__ == "__main__":
    main()
