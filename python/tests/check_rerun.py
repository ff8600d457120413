"""Scans in recordings of Rerun, read with its own reader. In an environment of its own: scripts/rerun."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
import pytest
from rerun.chunk import RrdReader
from service import Service

from polscan import Scanner, rerun

VIEWER = Path(sys.executable).with_name("rerun")


def rows(path: Path) -> dict[str, list[dict[str, Any]]]:
    """What a recording holds of each entity, one after the other: time and columns."""
    found: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for chunk in RrdReader(path).stream().collect().stream():
        batch = chunk.to_record_batch()
        # Times as nanoseconds, which no datetime has.
        columns = {
            name: (values.cast("int64") if pyarrow.types.is_temporal(values.type) else values).to_pylist()
            for name, values in zip(batch.schema.names, batch.columns, strict=True)
        }
        for values in zip(*columns.values(), strict=True):
            found[str(chunk.entity_path)].append(dict(zip(columns, values, strict=True)))
    for of_entity in found.values():
        of_entity.sort(key=lambda row: row.get("acquired") or 0)
    return found


def column(row: dict[str, Any], name: str) -> Any:  # noqa: ANN401 - whatever was shown
    """The value of a column that is called so at its end."""
    return next(value for key, value in row.items() if key.endswith(name))


def test_a_recording_holds_points_verdicts_and_figures(
    service: Service, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with Scanner(service.url) as scanner:
        first = scanner.scan(mode="pse", label="part 7", queue=True).done()
        dark = scanner.scan(exposure_us=1, label="in the dark", queue=True).done(check=False)
        third = scanner.scan(mode="fast", queue=True).done()
        scans = [scanner.get(info.id) for info in (first, dark, third)]
        path = tmp_path / "scans.rrd"
        assert (
            rerun.main([service.url, "--save", str(path), "--last", "3", "--count", "3", "--points", "700"])
            == 0
        )
        assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == [
            scan.id for scan in scans
        ]
        found = rows(path)
        times = [row["acquired"] for row in found["/verdict"]]
        assert times == sorted(times)
        assert scans[0].info.acquired is not None
        assert times[0] == pytest.approx(scans[0].info.acquired.timestamp() * 1e9, abs=1e6)
        assert [column(row, ":text")[0].split(":")[0] for row in found["/verdict"]] == [
            "part 7",
            "in the dark",
            third.id,
        ]
        assert scans[1].info.reasons[0].type in column(found["/verdict"][1], ":text")[0]
        assert [column(row, ":level")[0] for row in found["/verdict"]][:2] == ["INFO", "ERROR"]

        shown = [row for row in found["/cloud"] if row.get("Points3D:positions")]
        assert len(shown) == 2, "the scan in the dark has none"
        for row, scan in zip(shown, (scans[0], scans[2]), strict=True):
            sample = scan.sample(700)
            expected = np.stack([sample["x"], sample["y"], sample["z"]], axis=-1)
            np.testing.assert_array_equal(np.array(row["Points3D:positions"], np.float32), expected)
            np.testing.assert_array_equal(np.array(column(row, "sigma_z_mm"), np.float32), sample["sigma_z"])
            np.testing.assert_array_equal(np.array(column(row, "flags"), np.uint8), sample["flags"])
            assert len(set(column(row, "Points3D:colors"))) > 50, "near and far look different"
        cleared = [
            row for row in found["/cloud"] if any("Clear" in key and value for key, value in row.items())
        ]
        assert [row["acquired"] for row in cleared] == [found["/verdict"][1]["acquired"]]
        flatness = {name: value for name, value in found.items() if name.startswith("/figures/flatness_mm/")}
        planes = {
            plane.name: plane.rmse_mm for plane in scans[0].report().planes if plane.rmse_mm is not None
        }
        assert {name.rsplit("/")[-1] for name in flatness} == set(planes)
        for name, rmse_mm in planes.items():
            assert column(flatness[f"/figures/flatness_mm/{name}"][0], ":scalars")[0] == rmse_mm


def test_a_viewer_that_is_open_gets_scans_as_they_end(service: Service, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    path = tmp_path / "viewer.rrd"
    # The viewer without its window: it listens, and keeps what comes.
    viewer = subprocess.Popen(
        [VIEWER, "--save", path, "--bind", "127.0.0.1", "--port", str(port)],
    )
    processes: list[subprocess.Popen[Any]] = [viewer]
    try:
        address = f"rerun+http://127.0.0.1:{port}/proxy"
        shower = subprocess.Popen(
            [
                sys.executable,
                "-m",
                "polscan.rerun",
                service.url,
                "--last",
                "0",
                "--count",
                "2",
                "--connect",
                address,
            ],
            stdout=subprocess.PIPE,
            text=True,
        )
        processes.append(shower)
        with Scanner(service.url) as scanner:
            while not (path.exists() and path.stat().st_size > 0):
                # The program is listening to events by then, or will hear of these.
                assert viewer.poll() is None
                time.sleep(0.1)
            taken = []
            while shower.poll() is None:
                scan = scanner.scan(mode="fast", queue=True)
                scan.done()
                taken.append(scan)
        lines = (shower.communicate()[0]).splitlines()
        assert shower.returncode == 0
        assert len(lines) == 2
        assert {line.split()[0] for line in lines} <= {scan.id for scan in taken}
        deadline = time.monotonic() + 20
        while len([1 for row in rows(path)["/cloud"] if row.get("Points3D:positions")]) < 2:
            assert time.monotonic() < deadline, "the viewer has both clouds"
            time.sleep(0.2)
    finally:
        for process in processes:
            process.kill()
            process.wait()


def test_what_cannot_be_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    there = tmp_path / "there.rrd"
    there.touch()
    assert rerun.main(["http://127.0.0.1:9", "--save", str(there)]) == 1
    assert "exists already" in capsys.readouterr().err
    with socket.create_server(("127.0.0.1", 0)) as probe:
        free = probe.getsockname()[1]
    absent = tmp_path / "absent.rrd"
    assert rerun.main([f"http://127.0.0.1:{free}", "--save", str(absent)]) == 1
    assert "polscan-rerun: " in capsys.readouterr().err
    assert not absent.exists()


def test_colours_go_from_blue_to_yellow_and_endure_what_is_no_number() -> None:
    shades = rerun.colours(np.array([0.0, 0.5, 1.0, np.nan]))
    assert shades.shape == (4, 3)
    assert (shades[0] == shades[3]).all()
    assert shades[0][2] > shades[0][0]
    assert shades[2][0] > shades[2][2]
    assert rerun.colours(np.array([np.nan])).shape == (1, 3)
    assert rerun.colours(np.array([])).shape == (0, 3)
