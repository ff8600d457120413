"""The sources: types, lints, the client that is made from the other, and what a wheel holds."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
import zipfile
from importlib.metadata import distribution, distributions
from pathlib import Path

import pytest

import polscan

PACKAGE = Path(__file__).resolve().parents[1]


@pytest.mark.parametrize(
    "command",
    [
        ["-m", "mypy"],
        ["-m", "ruff", "check", "--no-cache", "."],
        ["-m", "ruff", "format", "--no-cache", "--check", "."],
        ["tools/unasync.py", "--check"],
    ],
    ids=["mypy", "ruff-check", "ruff-format", "unasync"],
)
def test_it_is_clean(command: list[str]) -> None:
    done = subprocess.run([sys.executable, *command], cwd=PACKAGE, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_wheel_is_typed_and_holds_the_package_alone(tmp_path: Path) -> None:
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(build, cwd=PACKAGE, check=True, capture_output=True)
    (wheel,) = tmp_path.iterdir()
    names = set(zipfile.ZipFile(wheel).namelist())
    sources = {f"polscan/{path.name}" for path in (PACKAGE / "src" / "polscan").iterdir() if path.is_file()}
    assert "polscan/py.typed" in sources
    assert {name for name in names if ".dist-info/" not in name} == sources


def test_versions_agree() -> None:
    package = tomllib.loads((PACKAGE / "pyproject.toml").read_text())["project"]
    rust = tomllib.loads((PACKAGE.parent / "Cargo.toml").read_text())
    assert package["version"] == polscan.__version__ == rust["workspace"]["package"]["version"]


def test_the_client_itself_needs_no_more_than_httpx_and_numpy() -> None:
    code = (
        "import sys, polscan; print(*sorted({name.partition('.')[0] for name in sys.modules}"
        " & {'h5py', 'bluesky', 'ophyd_async', 'PIL', 'matplotlib'}))"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.strip() == ""


def test_nothing_that_is_pinned_has_a_licence_that_binds_others() -> None:
    text = (PACKAGE / "requirements.txt").read_text()
    pinned = dict(re.findall(r"^([\w.-]+)==(\S+)$", text, re.MULTILINE))
    assert len(pinned) > 20
    here = {one.name for one in distributions()}
    for name, version in pinned.items():
        assert distribution(name).version == version
        said = distribution(name).metadata.json
        told = [str(said.get("license_expression") or said.get("license") or "").partition("\n")[0]]
        told += [one for one in said.get("classifier") or [] if one.startswith("License")]
        licence = " ".join(told)
        assert not re.search(r"(?i)\b[AL]?GPL|General Public", licence), f"{name}: {licence}"
    assert "polscan" in here
