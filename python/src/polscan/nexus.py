"""A bundle as a NeXus file (HDF5). Needs the extra `polscan[nexus]`.

    polscan-nexus BUNDLE OUT.nxs [--frames] [--force]

`/entry/depth` holds the maps on the camera's pixels, `/entry/cloud` the points, `/entry/instrument` the rig with its calibration,
`/entry/process` what made them, with report and manifest in full. Every number has its unit, every uncertainty lies
beside its value as `*_errors`, one standard deviation.
"""

from __future__ import annotations

import argparse
import json
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ._requests import written_whole
from .bundle import CLASSES, Bundle, open_bundle
from .errors import BundleError, PolscanError

try:
    import h5py
except ImportError as error:
    raise ImportError("NeXus files are written by h5py: pip install 'polscan[nexus]'") from error

_MAPS = {
    "column": ("projector_column", "pixel", "projector column that lit the pixel, centres of pixels at integers"),
    "row": ("projector_row", "pixel", "projector row that lit the pixel, centres of pixels at integers"),
    "modulation": ("modulation", "DN", "light of H less that of V (white less black in mode gray)"),
    "residual": ("residual", "", "what pairs of frames miss the references by, root mean square in standard deviations"),
    "class": ("class", "", "; ".join(f"{number} {name}" for number, name in enumerate(CLASSES))),
    "mask": ("mask", "", "1 where the pixel was measured"),
}  # fmt: skip
"""Map of a bundle: its name in the file, its unit, what it is."""


def convert(bundle: Bundle, to: str | Path, *, frames: bool = False, force: bool = False) -> Path:
    """Writes a bundle as a NeXus file, with the raw frames if `frames`. It is there in full or not at all."""
    path = Path(to)
    if path.exists() and not force:
        raise BundleError(f"{path} exists already; choose another name, or --force")
    with written_whole(path) as file, h5py.File(file, "w") as root:
        root.attrs["default"] = "entry"
        entry = _group(root, "entry", "NXentry")
        entry.attrs["default"] = "depth"
        _describe(entry, bundle)
        _instrument(entry, bundle, frames)
        _depth(entry, bundle)
        _cloud(entry, bundle)
        _process(entry, bundle)
    return path


def _group(parent: Any, name: str, kind: str) -> Any:  # noqa: ANN401 - h5py has no types
    group = parent.create_group(name)
    group.attrs["NX_class"] = kind
    return group


def _field(group: Any, name: str, value: Any, units: str = "", about: str = "") -> None:  # noqa: ANN401 - as above
    if value is None:
        return
    packed = (
        {"compression": "gzip", "compression_opts": 1, "shuffle": True}
        if np.ndim(value) and np.size(value)
        else {}
    )
    field = group.create_dataset(name, data=value, **packed)
    if units:
        field.attrs["units"] = units
    if about:
        field.attrs["long_name"] = about


def _describe(entry: Any, bundle: Bundle) -> None:  # noqa: ANN401
    manifest = bundle.manifest
    _field(entry, "title", manifest.get("label") or f"polscan {manifest.get('mode', '')} scan")
    _field(entry, "entry_identifier", manifest.get("id"))
    _field(entry, "start_time", manifest.get("created"))


def _instrument(entry: Any, bundle: Bundle, frames: bool) -> None:  # noqa: ANN401
    manifest = bundle.manifest
    rig, camera = manifest.get("rig") or {}, manifest.get("camera") or {}
    applied = (manifest.get("settings") or {}).get("applied") or {}
    instrument = _group(entry, "instrument", "NXinstrument")
    _field(instrument, "name", rig.get("name"))
    detector = _group(instrument, "camera", "NXdetector")
    device = rig.get("camera") or {}
    _field(detector, "description", device.get("model"))
    _field(detector, "serial_number", device.get("serial"))
    exposure_us = applied.get("exposure_us")
    _field(
        detector, "count_time", None if exposure_us is None else exposure_us / 1e6, "s", "exposure of a frame"
    )
    _field(detector, "bit_depth_readout", camera.get("bit_depth"))
    _field(detector, "saturation_value", camera.get("saturation"), "DN")
    _field(detector, "dark_level", camera.get("black_level"), "DN")
    _field(detector, "gain", camera.get("gain_dn_per_electron"), "DN/electron")
    _field(detector, "read_noise", camera.get("read_noise_dn"), "DN", "standard deviation")
    if frames:
        _field(
            detector,
            "data",
            bundle.frames(),
            "DN",
            "raw frames, in the order of the sequence in the manifest",
        )
    projector = _group(instrument, "projector", "NXcollection")
    device = rig.get("projector") or {}
    for name, value in {**(manifest.get("projector") or {}), **device}.items():
        if name in ("width", "height"):
            _field(projector, name, value, "pixel")
        elif name in ("model", "serial"):
            _field(projector, name, value)
    path = bundle.path / "calibration.toml"
    if path.is_file():
        _calibration(instrument, path)


def _calibration(instrument: Any, path: Path) -> None:  # noqa: ANN401
    try:
        text = path.read_text()
        said = tomllib.loads(text)
    except (OSError, ValueError) as error:
        raise BundleError(f"cannot read {path}: {error}") from error
    group = _group(instrument, "calibration", "NXcollection")
    for device in ("camera", "projector"):
        lens = said.get(device) or {}
        _field(group, f"{device}_matrix", lens.get("matrix"), "pixel")
        _field(
            group, f"{device}_distortion", lens.get("distortion"), "", "k1, k2, p1, p2, k3 as OpenCV has them"
        )
    transform = said.get("transform") or {}
    _field(group, "projector_from_camera_rotation", transform.get("rotation"))
    _field(group, "projector_from_camera_translation", transform.get("translation_mm"), "mm")
    _field(group, "toml", text, "", "calibration.toml in full")


def _depth(entry: Any, bundle: Bundle) -> None:  # noqa: ANN401
    maps = bundle.maps()
    depth = maps["depth"]
    data = _group(entry, "depth", "NXdata")
    data.attrs["signal"] = "depth"
    data.attrs["axes"] = ["y_pixel", "x_pixel"]
    _field(data, "depth", depth, "mm", "z in the frame of the camera; NaN where nothing was measured")
    _field(data, "y_pixel", np.arange(depth.shape[0], dtype="<i4"), "pixel", "row of the camera's image")
    _field(data, "x_pixel", np.arange(depth.shape[1], dtype="<i4"), "pixel", "column of the camera's image")
    _field(data, "depth_errors", _sigma(bundle, depth, maps["mask"]), "mm", "standard deviation of depth")
    for name, (field, units, about) in _MAPS.items():
        if name in maps:
            value = maps[name]
            _field(data, field, value.astype("u1") if value.dtype == bool else value, units, about)


def _sigma(bundle: Bundle, depth: NDArray[Any], mask: NDArray[Any]) -> NDArray[Any] | None:
    """The standard deviation of every pixel's depth, where the points are those of the pixels."""
    if not (bundle.path / "cloud.ply").is_file():
        return None
    cloud = bundle.cloud()
    # Points follow the pixels; those in another frame than the camera's have another z, and are left with their points.
    if len(cloud) != np.count_nonzero(mask) or not np.array_equal(cloud["z"], depth[mask]):
        return None
    sigma = np.full(depth.shape, np.nan, "<f4")
    sigma[mask] = cloud["sigma_z"]
    return sigma


def _cloud(entry: Any, bundle: Bundle) -> None:  # noqa: ANN401
    path = bundle.path / "cloud.ply"
    if not path.is_file():
        return
    cloud = bundle.cloud()
    data = _group(entry, "cloud", "NXdata")
    data.attrs["signal"] = "z"
    data.attrs["axes"] = ["."]
    with path.open("rb") as file:
        lines = file.read(4096).partition(b"end_header")[0].decode("latin-1").splitlines()
    frame = next(
        (line.removeprefix("comment frame ") for line in lines if line.startswith("comment frame ")), ""
    )
    _field(data, "frame", frame or None)
    for name in ("x", "y", "z"):
        _field(data, name, cloud[name], "mm")
    _field(
        data, "z_errors", cloud["sigma_z"], "mm", "standard deviation of the depth along the camera's axis"
    )
    normals = np.stack([cloud["nx"], cloud["ny"], cloud["nz"]], axis=-1)
    _field(data, "normals", normals, "", "unit normals, 0 0 0 where there is none")
    _field(data, "intensity", cloud["intensity"], "", "brightness for the eye, 0 to 255")
    flags = "bits: 1 edge, 2 half saturated, 4 inverted, 8 interpolated, 16 near a silhouette"
    _field(data, "flags", cloud["flags"], "", flags)


def _process(entry: Any, bundle: Bundle) -> None:  # noqa: ANN401
    manifest, report = bundle.manifest, bundle.report()
    program, _, version = str(manifest.get("software", "polscan")).partition(" ")
    process = _group(entry, "process", "NXprocess")
    _field(process, "program", program)
    _field(process, "version", version)
    _field(process, "date", manifest.get("created"))
    _field(process, "mode", report.mode)
    _field(process, "verdict", report.verdict)
    _field(process, "reasons", "; ".join(reason.message for reason in report.reasons))
    _field(process, "calibration_id", (report.calibration or {}).get("id"), "", "SHA-256 of the calibration")
    for name, document in (("report", report.raw), ("manifest", manifest)):
        note = _group(process, name, "NXnote")
        _field(note, "type", "application/json")
        _field(note, "data", json.dumps(document))
        hashed = (manifest.get("files") or {}).get(f"{name}.json") or {}
        _field(note, "sha256", hashed.get("sha256"), "", "of the file in the bundle")


def main(arguments: list[str] | None = None) -> int:
    """The command `polscan-nexus`."""
    parser = argparse.ArgumentParser(
        prog="polscan-nexus", description="Writes a bundle as a NeXus file (HDF5)."
    )
    parser.add_argument("bundle", type=Path, help="folder of a scan")
    parser.add_argument("out", type=Path, help="file to write")
    parser.add_argument("--frames", action="store_true", help="with the raw frames")
    parser.add_argument("--force", action="store_true", help="replace a file that exists")
    given = parser.parse_args(arguments)
    try:
        convert(open_bundle(given.bundle), given.out, frames=given.frames, force=given.force)
    except PolscanError as error:
        print(f"polscan-nexus: {error}", file=sys.stderr)
        return 65
    except OSError as error:
        print(f"polscan-nexus: cannot write {given.out}: {error}", file=sys.stderr)
        return 74
    return 0


if __name__ == "__main__":
    sys.exit(main())
