#!/usr/bin/env python3
"""Checks a bundle folder against its public description, with nothing but Python and numpy.

usage: check_bundle.py DIR [DIR...]

Prints every fault and exits 1 if there is one.
"""

import hashlib
import json
import re
import struct
import sys
import zipfile
from pathlib import Path

import numpy

VALID = (1, 2, 3)
MAPS = {
    "column": "float32",
    "row": "float32",
    "depth": "float32",
    "modulation": "float32",
    "residual": "float32",
    "class": "uint8",
    "mask": "bool",
}
TRUTH = {"column": "float32", "row": "float32", "depth": "float32", "object": "uint8"}
PLY = [
    "property float x",
    "property float y",
    "property float z",
    "property float nx",
    "property float ny",
    "property float nz",
    "property uchar intensity",
    "property float sigma_z",
    "property uchar flags",
]
PICTURES = ("dolp", "column", "row", "depth", "class", "residual")
REPORT = ("schema", "mode", "frames", "size", "verdict", "reasons", "pixels", "capture", "timings_ms")


class Check:
    def __init__(self, folder):
        self.folder = Path(folder)
        self.faults = []

    def expect(self, holds, message):
        if not holds:
            self.faults.append(message)
        return holds

    def run(self):
        path = self.folder / "manifest.json"
        if not self.expect(path.is_file(), "manifest.json is missing"):
            return
        manifest = json.loads(path.read_text(encoding="utf-8"))
        self.step("manifest.json", self.manifest, manifest)
        self.step("files", self.files, manifest)
        size = self.step("frames.npy", self.frames, manifest)
        mask = self.step("maps.npz", self.maps, size)
        self.step("cloud.ply", self.cloud, mask)
        self.step("report.json", self.report, manifest)
        self.step("truth.npz", self.truth, manifest, size)

    def step(self, name, check, *given):
        """Runs one check; what cannot even be read is a fault as well, and does not hide the next."""
        try:
            return check(*given)
        except Exception as error:  # noqa: BLE001 - a damaged file can fail in any way
            self.expect(False, f"{name} cannot be checked: {type(error).__name__}: {error}")
            return None

    def truth(self, manifest, size):
        if not (self.folder / "truth.npz").exists():
            return
        truth = self.archive("truth.npz", TRUTH, size)
        if truth:
            objects = manifest.get("truth_objects") or []
            indices = set(numpy.unique(truth["object"])) - {255}
            self.expect(max(indices, default=-1) < len(objects), "truth.npz has objects without a name")

    def manifest(self, manifest):
        self.expect(manifest.get("schema") == "polscan.bundle/1", "manifest: wrong schema")
        self.expect(manifest.get("mode") in ("paper", "pse", "fast", "gray"), "manifest: wrong mode")
        for key in ("id", "created", "software", "sequence", "frames", "projector", "files"):
            self.expect(key in manifest, f"manifest: {key} is missing")
        created = manifest.get("created", "")
        self.expect(re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d+)?Z", created), f"manifest: created {created!r}")
        seen = set()
        for index, entry in enumerate(manifest.get("sequence", [])):
            name = f"manifest: sequence[{index}]"
            role = entry.get("role")
            if role == "code":
                known = {"role", "axis", "bit", "inverse"}
                key = (entry.get("axis"), entry.get("bit"), entry.get("inverse", False))
                self.expect(key[0] in ("column", "row") and isinstance(key[1], int), f"{name} is no code")
                self.expect(key not in seen, f"{name} occurs twice")
                seen.add(key)
            else:
                known = {"role"}
                self.expect(role in ("reference-v", "reference-h", "white", "black"), f"{name} has role {role!r}")
            self.expect(set(entry) <= known, f"{name} has unknown keys")
        if "source" in manifest:
            for file in manifest["source"]["frames"]:
                self.expect(re.fullmatch("[0-9a-f]{64}", file["sha256"]), f"manifest: hash of {file['path']}")
        else:
            for key in ("rig", "settings", "capture"):
                self.expect(key in manifest, f"manifest: {key} is missing")
            self.expect({"requested", "applied"} <= set(manifest.get("settings", {})), "manifest: settings")
            evidence = manifest.get("capture", {}).get("frames", [])
            self.expect(len(evidence) == len(manifest["sequence"]), "manifest: not one record for each frame")
            for index, frame in enumerate(evidence):
                self.expect({"receipt", "triggered_ns", "stamp"} <= set(frame), f"manifest: capture.frames[{index}]")

    def files(self, manifest):
        listed = manifest.get("files", {})
        for name, entry in listed.items():
            path = self.folder / name
            if not self.expect(path.is_file(), f"{name} is listed but missing"):
                continue
            data = path.read_bytes()
            self.expect(len(data) == entry["bytes"], f"{name} has {len(data)} bytes, listed {entry['bytes']}")
            self.expect(hashlib.sha256(data).hexdigest() == entry["sha256"], f"{name} has another hash than listed")
        found = {str(path.relative_to(self.folder)) for path in self.folder.rglob("*") if not path.is_dir()}
        for name in sorted(found - set(listed) - {"manifest.json"}):
            self.expect(False, f"{name} is not listed")
        for picture in PICTURES:
            path = self.folder / "maps" / f"{picture}.png"
            if self.expect(path.is_file(), f"maps/{picture}.png is missing"):
                self.expect(path.read_bytes().startswith(b"\x89PNG\r\n\x1a\n"), f"maps/{picture}.png is no PNG")
        calibration = manifest.get("calibration")
        if calibration is not None:
            self.expect(calibration in listed, f"{calibration} is named but not listed")
        self.expect((calibration is None) or (self.folder / "cloud.ply").exists(), "cloud.ply is missing")

    def frames(self, manifest):
        camera = manifest.get("camera", {})
        size = (camera.get("height"), camera.get("width"))
        if "source" in manifest:
            return size
        if not self.expect(manifest["frames"] == "frames.npy", "manifest: frames is not frames.npy"):
            return size
        frames = numpy.load(self.folder / "frames.npy", mmap_mode="r", allow_pickle=False)
        self.expect(frames.dtype in (numpy.uint8, numpy.dtype("<u2")), f"frames.npy has type {frames.dtype}")
        self.expect(frames.flags.c_contiguous and frames.ndim == 3, "frames.npy is not (frames, height, width)")
        self.expect(len(frames) == len(manifest["sequence"]), "frames.npy has another length than the sequence")
        self.expect(frames.shape[1:] == size, f"frames.npy has shape {frames.shape}, camera {size}")
        self.expect(frames.offset % 64 == 0, "frames.npy is not aligned")
        self.expect(int(frames.max()) < 1 << camera.get("bit_depth", 16), "frames.npy exceeds its bit depth")
        return frames.shape[1:]

    def archive(self, name, arrays, size):
        path = self.folder / name
        if not self.expect(path.is_file(), f"{name} is missing"):
            return None
        with zipfile.ZipFile(path) as archive:
            self.expect(archive.testzip() is None, f"{name} is damaged")
            for entry in archive.infolist():
                self.expect(entry.compress_type == zipfile.ZIP_STORED, f"{name}: {entry.filename} is compressed")
                self.expect(entry.date_time == (1980, 1, 1, 0, 0, 0), f"{name}: {entry.filename} has a time stamp")
        with numpy.load(path, allow_pickle=False) as archive:
            values = {key: archive[key] for key in archive.files}
        if not self.expect(set(arrays) <= set(values), f"{name} has {sorted(values)}, expected {sorted(arrays)}"):
            return None
        for key, dtype in arrays.items():
            self.expect(values[key].dtype == dtype, f"{name}: {key} has type {values[key].dtype}, expected {dtype}")
            self.expect(size is None or values[key].shape == tuple(size), f"{name}: {key} has shape {values[key].shape}, frames {size}")
        return values

    def maps(self, size):
        maps = self.archive("maps.npz", MAPS, size)
        if maps is None:
            return None
        mask = maps["mask"]
        self.expect(maps["class"].max(initial=0) <= 11, "maps.npz has classes above 11")
        self.expect(numpy.array_equal(mask, numpy.isin(maps["class"], VALID)), "maps.npz: mask and class differ")
        for key in ("column", "row", "depth"):
            absent = numpy.isnan(maps[key])
            # Rows are not always coded, and depth needs a calibration.
            if key != "column" and absent.all():
                continue
            self.expect(numpy.array_equal(absent, ~mask), f"maps.npz: {key} is not NaN exactly where mask is false")
        return mask

    def cloud(self, mask):
        path = self.folder / "cloud.ply"
        if not path.exists():
            return
        data = path.read_bytes()
        head, found, body = data.partition(b"end_header\n")
        if not self.expect(found, "cloud.ply has no end of its header"):
            return
        lines = head.decode("ascii").split("\n")
        self.expect(lines[:2] == ["ply", "format binary_little_endian 1.0"], "cloud.ply has another format")
        count = next((int(line.split()[2]) for line in lines if line.startswith("element vertex ")), 0)
        self.expect([line for line in lines if line.startswith("property ")] == PLY, "cloud.ply has other properties")
        record = struct.calcsize("<6fBfB")
        if not self.expect(len(body) == count * record, f"cloud.ply has {len(body)} bytes for {count} points"):
            return
        names = [line.split()[2] for line in PLY]
        types = [{"float": "<f4", "uchar": "u1"}[line.split()[1]] for line in PLY]
        points = numpy.frombuffer(body, dtype=list(zip(names, types)))
        for name in names:
            self.expect(numpy.isfinite(points[name]).all(), f"cloud.ply: {name} is not finite")
        length = numpy.sqrt(sum(points[name].astype(float) ** 2 for name in ("nx", "ny", "nz")))
        self.expect(((length == 0) | (abs(length - 1) < 1e-3)).all(), "cloud.ply: normals are neither 0 nor unit")
        self.expect((points["flags"] < 32).all(), "cloud.ply: unknown flags")
        if mask is not None:
            self.expect(count == int(mask.sum()), f"cloud.ply has {count} points, mask {int(mask.sum())}")

    def report(self, manifest):
        path = self.folder / "report.json"
        if not self.expect(path.is_file(), "report.json is missing"):
            return
        report = json.loads(path.read_text(encoding="utf-8"))
        self.expect(report.get("schema") == "polscan.report/1", "report.json: wrong schema")
        for key in REPORT:
            self.expect(key in report, f"report.json: {key} is missing")
        self.expect(report.get("verdict") in ("ok", "degraded", "failed"), "report.json: wrong verdict")
        self.expect((report.get("verdict") == "ok") == (not report.get("reasons")), "report.json: verdict and reasons")
        for reason in report.get("reasons", []):
            self.expect({"type", "message", "evidence"} <= set(reason), "report.json: a reason lacks a key")
        self.expect(report.get("mode") == manifest.get("mode"), "report.json: mode differs from the manifest")


def main(folders):
    if not folders:
        print(__doc__.strip(), file=sys.stderr)
        return 2
    failed = False
    for folder in folders:
        check = Check(folder)
        check.run()
        for fault in check.faults:
            print(f"{folder}: {fault}")
        failed |= bool(check.faults)
        if not check.faults:
            print(f"{folder}: ok")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
