"""An independent check of `polscan export`: every file is opened with a reader that others wrote, and every value is compared with
the bundle's own maps.npz and cloud.ply.

    exports.py POLSCAN_BINARY [BUNDLE]     on a small simulated rig, or on the scan in BUNDLE

E57 is read with pye57 (libE57Format), PCD with pypcd4, TIFF with tifffile, PNG with Pillow; XYZ,
OBJ and PLY are text and records that numpy reads.
"""

import json
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path

import numpy as np
import PIL.Image
import pye57
import tifffile
from pypcd4 import PointCloud

import small_twin

SCALE = 5.0
NORMALS = "http://www.libe57.org/E57_NOR_surface_normals.txt"
# Where the bench of the second half of this check has its origin.
WORLD = """
[world]
rotation = [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
translation_mm = [250.0, -40.0, 1300.0]
"""
# As documented: neighbours are one surface up to a slope of 75 degrees and 3.5 sigma of each.
STEEPEST, JUMP_SIGMAS = 3.732, 3.5


def run(program, *arguments, code=0):
    done = subprocess.run([program, *map(str, arguments)], capture_output=True, text=True)
    assert done.returncode == code, f"{arguments}: {done.returncode}, not {code}\n{done.stdout}{done.stderr}"
    return done.stdout


class Bundle:
    """What the scan itself says."""

    def __init__(self, folder):
        self.folder = folder
        self.maps = dict(np.load(folder / "maps.npz"))
        self.mask = self.maps["mask"]
        ply = (folder / "cloud.ply").read_bytes()
        head, body = ply.split(b"end_header\n", 1)
        kinds = {b"float": "<f4", b"uchar": "u1"}
        lines = [line.split() for line in head.splitlines() if line.startswith(b"property ")]
        self.points = np.frombuffer(body, [(name.decode(), kinds[kind]) for _, kind, name in lines])
        assert len(self.points) == self.mask.sum() > 1000
        self.xyz, self.normals = self.columns("x", "y", "z"), self.columns("nx", "ny", "nz")
        world = tomllib.loads((folder / "calibration.toml").read_text()).get("world")
        self.rotation = np.array(world["rotation"]) if world else np.eye(3)
        self.translation = np.array(world["translation_mm"]) if world else np.zeros(3)
        # Rows of points, so that the inverse turn is a product from the right.
        self.in_camera = (self.xyz.astype(float) - self.translation) @ self.rotation

    def columns(self, *names):
        return np.stack([self.points[name] for name in names], axis=-1)


def same(what, found, expected, tolerance=0.0):
    found, expected = np.asarray(found), np.asarray(expected)
    assert found.shape == expected.shape, f"{what}: shape {found.shape}, not {expected.shape}"
    if tolerance == 0.0:
        nan = np.issubdtype(found.dtype, np.floating)
        assert np.array_equal(found, expected, equal_nan=nan), f"{what} differs"
    else:
        worst = np.abs(found.astype(float) - expected.astype(float)).max()
        assert worst <= tolerance, f"{what} is off by {worst}, allowed {tolerance}"


def quaternion_matrix(q):
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def check_e57(bundle, folder):
    file = pye57.E57(str(folder / "cloud.e57"))
    assert file.scan_count == 1
    header = file.get_header(0)
    fields = set(header.point_fields)
    wanted = {"cartesianX", "cartesianY", "cartesianZ", "intensity", "rowIndex", "columnIndex"}
    wanted |= {"nor:normalX", "nor:normalY", "nor:normalZ"}
    assert fields == wanted, fields
    raw = file.read_scan_raw(0, ignore_unsupported_fields=True)
    assert file.image_file.extensionsUri(0) == NORMALS
    for axis in "XYZ":
        raw[f"nor:normal{axis}"] = values = np.empty(header.point_count, np.float32)
        buffers = pye57.libe57.VectorSourceDestBuffer()
        name = f"nor:normal{axis}"
        buffers.append(pye57.libe57.SourceDestBuffer(file.image_file, name, values, len(values), True, True))
        header.points.reader(buffers).read()
    rows, columns = np.nonzero(bundle.mask)
    same("E57 rows", raw["rowIndex"], rows)
    same("E57 columns", raw["columnIndex"], columns)
    same("E57 intensity", raw["intensity"], bundle.points["intensity"])
    found = np.stack([raw[f"cartesian{axis}"] for axis in "XYZ"], axis=-1)
    # Metres as floats; points in a world have been rounded there once more.
    same("E57 points in the camera frame", found, bundle.in_camera / 1000, 3e-7)
    same("E57 normals", np.stack([raw[f"nor:normal{axis}"] for axis in "XYZ"], axis=-1), bundle.normals @ bundle.rotation, 3e-7)
    same("E57 depth", found[:, 2], bundle.maps["depth"][bundle.mask] / 1000, 3e-7)
    same("E57 position", header.translation, bundle.translation / 1000, 1e-12)
    same("E57 orientation", quaternion_matrix(header.rotation), bundle.rotation, 1e-9)
    limits = header["intensityLimits"]
    assert (limits["intensityMinimum"].value(), limits["intensityMaximum"].value()) == (0, 255)
    bounds = header["indexBounds"]
    assert (bounds["rowMaximum"].value(), bounds["columnMaximum"].value()) == (rows.max(), columns.max())
    # With the pose applied, as a viewer does, the points are those of the cloud.
    placed = file.read_scan(0, intensity=True, ignore_missing_fields=True)
    found = np.stack([placed[f"cartesian{axis}"] for axis in "XYZ"], axis=-1)
    same("E57 points in their place", found * 1000, bundle.xyz, 1e-3)
    manifest = json.loads((bundle.folder / "manifest.json").read_text())
    assert header["sensorModel"].value() == manifest["rig"]["camera"]["model"]
    assert manifest["id"] in header["description"].value()
    created = time.strptime(manifest["created"].split(".")[0], "%Y-%m-%dT%H:%M:%S")
    # GPS time counts from 1980-01-06 without leap seconds, of which there have been 18.
    gps = np.datetime64(int(time.mktime(created) - time.timezone), "s") - np.datetime64("1980-01-06") + 18
    assert abs(header["acquisitionStart"]["dateTimeValue"].value() - gps.astype(int)) < 1
    return len(found)


def check_pcd(bundle, folder):
    cloud = PointCloud.from_path(folder / "cloud.pcd")
    height, width = bundle.mask.shape
    assert (cloud.metadata.width, cloud.metadata.height) == (width, height)
    names = ("x", "y", "z", "normal_x", "normal_y", "normal_z", "intensity", "sigma_z", "flags")
    assert cloud.fields == names, cloud.fields
    data = {name: cloud.pc_data[name].reshape(height, width) for name in names}
    for name in names[:-1]:
        same(f"PCD places of {name}", np.isfinite(data[name]), bundle.mask)
    assert not data["flags"][~bundle.mask].any()
    for name, of in zip(names, ("x", "y", "z", "nx", "ny", "nz", "intensity", "sigma_z", "flags")):
        same(f"PCD {name}", data[name][bundle.mask], bundle.points[of].astype(data[name].dtype))
    viewpoint = [float(number) for number in cloud.metadata.viewpoint]
    same("PCD position", viewpoint[:3], bundle.translation, 1e-9)
    same("PCD orientation", quaternion_matrix(viewpoint[3:]), bundle.rotation, 1e-9)
    return len(bundle.points)


def check_xyz(bundle, folder):
    rows = np.loadtxt(folder / "cloud.xyz", dtype=np.float32)
    names = ("x", "y", "z", "nx", "ny", "nz", "intensity", "sigma_z")
    for column, name in zip(rows.T, names, strict=True):
        same(f"XYZ {name}", column, bundle.points[name].astype(np.float32))
    return len(rows)


def check_obj(bundle, folder):
    lines = {"v": [], "vn": [], "f": []}
    for line in (folder / "mesh.obj").read_text().splitlines():
        word, *rest = line.split()
        if word != "#":
            lines[word].append(rest)
    same("OBJ vertices", np.array(lines["v"], dtype=np.float32), bundle.xyz)
    normals = np.array(lines["vn"], dtype=np.float32)
    corners = [[corner.split("//") for corner in face] for face in lines["f"]]
    faces, of_normals = np.moveaxis(np.array(corners, dtype=int) - 1, -1, 0)
    same("OBJ normals of corners", of_normals, faces)
    own = bundle.normals.any(axis=1)
    same("OBJ normals", normals[own], bundle.normals[own])
    used = np.unique(faces)
    same("lengths of OBJ normals", np.linalg.norm(normals[used], axis=1), np.ones(len(used)), 1e-5)

    rows, columns = np.nonzero(bundle.mask)
    for of, name in ((rows, "rows"), (columns, "columns")):
        assert (np.ptp(of[faces], axis=1) == 1).all(), f"a triangle of the OBJ spans other than two {name}"
    points, sigma = bundle.in_camera, bundle.points["sigma_z"].astype(float)
    corner = points[faces]
    facing = np.einsum("ij,ij->i", np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), corner[:, 0])
    # A sliver may be turned over by its noise; nothing else faces away.
    assert (facing < 0).mean() > 0.999, f"{(facing >= 0).sum()} triangles face away from the camera"

    def joined(a, b):
        rays = points[:, :2] / points[:, 2:]
        footprint = 0.5 * (points[a, 2] + points[b, 2]) * np.linalg.norm(rays[a] - rays[b], axis=-1)
        jump = np.abs(points[a, 2] - points[b, 2])
        # Sides of the bound are told apart to the last digits of a float only.
        bound = STEEPEST * footprint + JUMP_SIGMAS * (sigma[a] + sigma[b])
        return jump <= bound * (1 + 1e-4), jump <= bound * (1 - 1e-4)

    for first, second in ((0, 1), (1, 2), (2, 0)):
        assert joined(faces[:, first], faces[:, second])[0].all(), "a triangle of the OBJ crosses a jump"
    # Wherever all four pixels of a square hang together, there are two triangles.
    number = np.full(bundle.mask.shape, -1)
    number[bundle.mask] = np.arange(len(points))
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
    whole = (a >= 0) & (b >= 0) & (c >= 0) & (d >= 0)
    a, b, c, d = a[whole], b[whole], c[whole], d[whole]
    flat = np.ones(len(a), bool)
    for one, other in ((a, b), (a, c), (b, d), (c, d), (b, c), (a, d)):
        flat &= joined(one, other)[1]
    squares = np.zeros(bundle.mask.shape, int)
    np.add.at(squares, (rows[faces].min(axis=1), columns[faces].min(axis=1)), 1)
    assert squares.max() <= 2
    same("triangles of whole squares", squares[:-1, :-1][whole][flat], np.full(flat.sum(), 2))
    return len(faces)


def description(picture, name):
    if name.endswith(".png"):
        return json.loads(picture.text["Description"])
    return json.loads(picture.pages[0].description)


def check_maps(bundle, folder, listed):
    seen = 0
    for name in sorted(path.name for path in folder.iterdir() if path.suffix in (".tiff", ".png")):
        map_name = name.split(".")[0]
        if name.endswith(".png"):
            picture = PIL.Image.open(folder / name)
            samples = np.array(picture)
        else:
            picture = tifffile.TiffFile(folder / name)
            samples = picture.asarray()
        key, values = description(picture, name), bundle.maps[map_name]
        assert key["map"] == map_name and key["program"] == "polscan"
        for field in ("map", "unit", "scale", "offset", "values", "bits"):
            assert key[field] == listed[name][field], f"{name}: {field}"
        if name.endswith(".f32.tiff"):
            assert samples.dtype == np.float32
            same(name, samples, values)
        elif map_name == "class":
            same(name, samples, values)
        elif map_name == "mask":
            same(name, samples, values * np.uint8(255))
        else:
            # Pillow gives 16-bit greys as uint16 or int32.
            assert samples.dtype.itemsize >= 2 and samples.max() > 255, samples.dtype
            there = np.isfinite(values)
            assert key["no_value"] == 0 and key["values"] == there.sum()
            same(f"places of {name}", samples != 0, there)
            read = key["offset"] + key["scale"] * samples[there].astype(float)
            same(name, read, values[there], 0.5001 * key["scale"])
        seen += 1
    assert seen == 19, f"{seen} pictures"
    return seen


def check(program, bundle_folder, folder):
    folder.mkdir()
    started = time.monotonic()
    answer = json.loads(run(program, "export", bundle_folder, "--out", folder / "all", "--json"))
    took = time.monotonic() - started
    again = folder / "again.e57"
    run(program, "export", bundle_folder, "--out", again)
    assert again.read_bytes() == (folder / "all" / "cloud.e57").read_bytes(), "equal scans give unequal E57 files"
    listed = {file["name"]: file for file in answer["files"]}
    assert json.loads((folder / "all" / "export.json").read_text())["files"] == answer["files"]
    assert answer["skipped"] == [], answer["skipped"]
    bundle = Bundle(bundle_folder)
    points = [each(bundle, folder / "all") for each in (check_e57, check_pcd, check_xyz)]
    assert set(points) == {len(bundle.points)}
    assert all(listed[name]["points"] == points[0] for name in ("cloud.e57", "cloud.pcd", "cloud.xyz", "mesh.obj"))
    triangles = check_obj(bundle, folder / "all")
    assert listed["mesh.obj"]["triangles"] == triangles
    pictures = check_maps(bundle, folder / "all", listed)
    print(f"{bundle_folder.name}: {points[0]} points, {triangles} triangles and {pictures} pictures agree; export took {took:.1f} s")


def main():
    program = Path(sys.argv[1]).resolve()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if len(sys.argv) > 2:
            check(program, Path(sys.argv[2]), folder / "given-exports")
            return
        config = small_twin.write(folder, SCALE, [])
        camera, world = folder / "camera", folder / "world"
        run(program, "scan", "--config", config, "--mode", "fast", "--out", camera)
        check(program, camera, folder / "camera-exports")
        calibration = folder / "world.toml"
        calibration.write_text((camera / "calibration.toml").read_text() + WORLD)
        run(program, "decode", camera, "--calibration", calibration, "--out", world)
        check(program, world, folder / "world-exports")


if __name__ == "__main__":
    main()
