"""The converter, its files read by h5py alone."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
from service import Service

import polscan
from polscan import Bundle, Scanner, nexus


@pytest.fixture(scope="module")
def bundle(service: Service, tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    with Scanner(service.url) as scanner:
        scan = scanner.scan(mode="pse", label="part 7", queue=True)
        return scan.download(tmp_path_factory.mktemp("nexus") / "scan")


def test_maps_have_axes_units_and_uncertainties(bundle: Bundle, tmp_path: Path) -> None:
    assert nexus.main([str(bundle.path), str(tmp_path / "scan.nxs")]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["scan.nxs"]
    with h5py.File(tmp_path / "scan.nxs") as file, np.load(bundle.path / "maps.npz") as maps:
        data = file[file.attrs["default"]]
        assert data.attrs["NX_class"] == "NXentry"
        data = data[data.attrs["default"]]
        assert data.attrs["NX_class"] == "NXdata"
        signal = data[data.attrs["signal"]]
        np.testing.assert_array_equal(signal, maps["depth"])
        assert signal.attrs["units"] == "mm"
        for axis, length in zip(data.attrs["axes"], signal.shape, strict=True):
            np.testing.assert_array_equal(data[axis], np.arange(length))
            assert data[axis].attrs["units"] == "pixel"
        errors = data["depth_errors"][()]
        np.testing.assert_array_equal(np.isfinite(errors), maps["mask"])
        assert data["depth_errors"].attrs["units"] == "mm"
        # What is called one standard deviation is one, on a rig that knows the truth.
        with np.load(bundle.path / "truth.npz") as truth:
            white = maps["mask"] & (truth["object"] == truth["object"][maps["mask"]].min())
            ratio = (maps["depth"][white] - truth["depth"][white]) / errors[white]
        assert 0.5 < 1.4826 * np.median(np.abs(ratio)) < 2
        for name, stored in (("column", "projector_column"), ("row", "projector_row"), ("class", "class")):
            np.testing.assert_array_equal(data[stored], maps[name])
        np.testing.assert_array_equal(data["mask"][()].astype(bool), maps["mask"])


def test_points_are_those_of_the_cloud(bundle: Bundle, tmp_path: Path) -> None:
    nexus.convert(bundle, tmp_path / "scan.nxs")
    # Read as bytes, without the reader that the converter uses.
    data = (bundle.path / "cloud.ply").read_bytes().partition(b"end_header\n")[2]
    points = np.frombuffer(data, np.uint8).reshape(-1, 30)
    with h5py.File(tmp_path / "scan.nxs") as file:
        cloud = file["entry/cloud"]
        for index, name in enumerate(("x", "y", "z")):
            expected = points[:, 4 * index : 4 * index + 4].copy().view("<f4")[:, 0]
            np.testing.assert_array_equal(cloud[name], expected)
            assert cloud[name].attrs["units"] == "mm"
        np.testing.assert_array_equal(cloud["z_errors"], points[:, 25:29].copy().view("<f4")[:, 0])
        np.testing.assert_array_equal(cloud["flags"], points[:, 29])
        assert cloud["normals"].shape == (len(points), 3)
        assert cloud["frame"][()].decode().startswith("camera frame")


def test_where_it_comes_from_is_told(bundle: Bundle, tmp_path: Path) -> None:
    nexus.convert(bundle, tmp_path / "scan.nxs", frames=True)
    manifest = json.loads((bundle.path / "manifest.json").read_bytes())
    with h5py.File(tmp_path / "scan.nxs") as file:
        entry = file["entry"]
        assert entry["title"][()].decode() == "part 7"
        assert entry["entry_identifier"][()].decode() == manifest["id"]
        assert entry["process/program"][()].decode() == "polscan"
        assert entry["process/verdict"][()].decode() == "ok"
        assert json.loads(entry["process/manifest/data"][()]) == manifest
        report = json.loads((bundle.path / "report.json").read_bytes())
        assert json.loads(entry["process/report/data"][()]) == report
        assert entry["process/report/sha256"][()].decode() == manifest["files"]["report.json"]["sha256"]
        camera = entry["instrument/camera"]
        assert camera["count_time"][()] == pytest.approx(manifest["settings"]["applied"]["exposure_us"] / 1e6)
        assert camera["count_time"].attrs["units"] == "s"
        np.testing.assert_array_equal(camera["data"], np.load(bundle.path / "frames.npy"))
        matrix = entry["instrument/calibration/camera_matrix"]
        assert matrix.shape == (3, 3)
        assert matrix.attrs["units"] == "pixel"
        assert entry["instrument/calibration/projector_from_camera_translation"].attrs["units"] == "mm"


def test_nothing_is_overwritten_unless_it_is_said(
    bundle: Bundle, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "scan.nxs"
    out.write_bytes(b"mine")
    assert nexus.main([str(bundle.path), str(out)]) == 65
    assert "exists already" in capsys.readouterr().err
    assert out.read_bytes() == b"mine"
    assert nexus.main([str(bundle.path), str(out), "--force"]) == 0
    assert h5py.is_hdf5(out)


def test_a_damaged_bundle_leaves_no_file(
    bundle: Bundle, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert nexus.main([str(tmp_path), str(tmp_path / "scan.nxs")]) == 65
    copy = tmp_path / "copy"
    shutil.copytree(bundle.path, copy)
    (copy / "cloud.ply").write_bytes((copy / "cloud.ply").read_bytes()[:-7])
    assert nexus.main([str(copy), str(tmp_path / "scan.nxs")]) == 65
    assert "cloud.ply" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["copy"]
    assert nexus.main([str(bundle.path), "/proc/nowhere/scan.nxs"]) == 74


def test_a_scan_that_failed_is_converted_with_its_reasons(service: Service, tmp_path: Path) -> None:
    with Scanner(service.url) as scanner:
        scan = scanner.scan(exposure_us=1, queue=True)
        failed = scan.download(tmp_path / "scan")
    nexus.convert(failed, tmp_path / "scan.nxs")
    with h5py.File(tmp_path / "scan.nxs") as file:
        assert file["entry/process/verdict"][()].decode() == "failed"
        assert "lens cap" in file["entry/process/reasons"][()].decode()
        assert file["entry/cloud/z"].shape == (0,)
    assert polscan.open_bundle(tmp_path / "scan").report().verdict == "failed"
