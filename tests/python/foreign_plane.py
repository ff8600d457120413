"""An independent check of `polscan decode`: a rig that polscan has never seen, modelled here in numpy alone.

    foreign_plane.py POLSCAN_BINARY     check the model itself, then the program against it
    foreign_plane.py --model-only       check the model itself

A tilted plane is seen by a distorted camera and lit by a distorted, lens-shifted projector. The frames are rendered, written as a
foreign bundle, decoded by the program, and its column, row, depth, points, normals and sigmas are compared with the truth of the
model. Nothing is shared with the program but its published conventions:

  - pixel centres at integers, for camera and projector alike;
  - bit 0 of a code is its most significant bit, the word of index i is gray(i + offset), offset = floor((2^n - size) / 2);
  - x_p = R x_c + t takes a point from the camera to the projector; lenses are OpenCV's k1, k2, p1, p2, k3;
  - manifest.json, calibration.toml, maps.npz, cloud.ply and report.json as the documentation gives them.
"""

import hashlib
import json
import math
import os
import pathlib
import subprocess
import sys
import tempfile
import traceback

import numpy as np
import trimesh


# ---------------------------------------------------------------------------------------------------- the rig


class Lens:
    """A pinhole with OpenCV's distortion."""

    def __init__(self, size, fx, fy, cx, cy, distortion):
        self.width, self.height = size
        self.fx, self.fy, self.cx, self.cy = fx, fy, cx, cy
        self.distortion = distortion

    def distort(self, x, y):
        k1, k2, p1, p2, k3 = self.distortion
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        return (
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        )

    def pixel(self, points):
        """Where points (..., 3) of this lens's own frame appear."""
        x, y = self.distort(points[..., 0] / points[..., 2], points[..., 1] / points[..., 2])
        return self.fx * x + self.cx, self.fy * y + self.cy

    def ray(self, px, py):
        """Directions (..., 3) with z = 1 whose image is the pixel, by fixed-point iteration to convergence."""
        dx, dy = (px - self.cx) / self.fx, (py - self.cy) / self.fy
        x, y = dx, dy
        for _ in range(60):
            ex, ey = self.distort(x, y)
            x, y = x + (dx - ex), y + (dy - ey)
        return np.stack([x, y, np.ones_like(x)], axis=-1)

    def toml(self):
        matrix = [[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]]
        return f"size = [{self.width}, {self.height}]\nmatrix = {matrix}\ndistortion = {list(self.distortion)}\n"


def rotation(pitch_deg, yaw_deg, roll_deg):
    a, b, c = np.radians([pitch_deg, yaw_deg, roll_deg])
    about_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    about_z = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


# Odd sides, so that nothing may rely on a row being a multiple of a vector's length.
CAMERA = Lens((643, 479), 1203.0, 1197.5, 330.7, 231.2, (-0.21, 0.13, 8e-4, -6e-4, 0.05))
# Neither side is a power of two, so both codes have an offset; the principal point is near the lower edge.
PROJECTOR = Lens((800, 600), 622.0, 618.0, 405.3, 561.7, (0.03, -0.04, -5e-4, 4e-4, 0.0))
R = rotation(1.5, 6.0, -2.0)
PROJECTOR_CENTRE_MM = np.array([170.0, 85.0, -25.0])
T_MM = -R @ PROJECTOR_CENTRE_MM

PLANE_POINT_MM = np.array([0.0, 0.0, 800.0])
PLANE_NORMAL = np.array([0.25, -0.18, -1.0]) / np.linalg.norm([0.25, -0.18, -1.0])

BIT_DEPTH, BLACK_LEVEL_DN = 12, 41.0
GAIN_DN_PER_ELECTRON, READ_NOISE_DN = 0.39, 0.9
FULL_DN, AMBIENT_DN = 3300.0, 30.0
CAMERA_BLUR_PX, PROJECTOR_BLUR_PX = 0.55, 0.45
SUBSAMPLES, PAD = 4, 3

# Largest rms of a decoded projector coordinate.
COORDINATE_RMS_PX = 0.02

# A rectangle of camera pixels where the surface depolarises and turns the sign of the modulation (mode pse).
PATCH = (90, 60, 110, 90)
# A rectangle of the plane for `report.planes`, clear of the patch and of the projector's border.
REGION = (260, 40, 320, 280)


def bits_and_offset(size):
    bits = math.ceil(math.log2(size))
    return bits, (2**bits - size) // 2


AXES = {"column": PROJECTOR.width, "row": PROJECTOR.height}


def on_plane(rays):
    """Points where rays from the camera meet the plane."""
    depth = (PLANE_POINT_MM @ PLANE_NORMAL) / (rays @ PLANE_NORMAL)
    return rays * depth[..., None]


def into_projector(points):
    return PROJECTOR.pixel(points @ R.T + T_MM)


def camera_grid():
    return np.meshgrid(np.arange(CAMERA.width, dtype=float), np.arange(CAMERA.height, dtype=float))


class Truth:
    """What every camera pixel sees at its centre."""

    def __init__(self):
        self.rays = CAMERA.ray(*camera_grid())
        self.points = on_plane(self.rays)
        self.column, self.row = into_projector(self.points)
        self.depth = self.points[..., 2]
        nearer, _ = into_projector(self.points - 0.5 * self.rays)
        farther, _ = into_projector(self.points + 0.5 * self.rays)
        self.mm_per_column = 1 / np.abs(farther - nearer)
        inside = lambda value, size, margin: (value > margin - 0.5) & (value < size - 0.5 - margin)
        on_panel = lambda margin: inside(self.column, PROJECTOR.width, margin) & inside(self.row, PROJECTOR.height, margin)
        self.lit = on_panel(0)
        # Off the projector's border by more than any blur here reaches.
        self.inner = on_panel(3)
        self.near_border = ~on_panel(3) & on_panel(-3)
        self.patch = rectangle(PATCH, -4)
        self.near_patch_edge = rectangle(PATCH, 4) & ~self.patch

    def clear(self, mode):
        """Lit pixels away from the projector's border and, where the patch is there, from the patch's border."""
        return self.inner & ~self.near_patch_edge if mode == "pse" else self.inner


def rectangle(sides, grow):
    x, y, width, height = sides
    mask = np.zeros((CAMERA.height, CAMERA.width), bool)
    mask[y - grow : y + height + grow, x - grow : x + width + grow] = True
    return mask


# ---------------------------------------------------------------------------------------------------- rendering


def stripes(size, bit=None):
    """Light across one axis of the panel, pixels as boxes, blurred: returns a function of the projector coordinate."""
    per_px, margin = 64, 4
    level = np.ones(size)
    if bit is not None:
        bits, offset = bits_and_offset(size)
        value = np.arange(size) + offset
        level = ((value ^ (value >> 1)) >> (bits - 1 - bit)) & 1
    fine = np.repeat(np.pad(level.astype(float), margin), per_px)
    reach = np.arange(-4 * per_px, 4 * per_px + 1) / per_px
    kernel = np.exp(-0.5 * (reach / PROJECTOR_BLUR_PX) ** 2)
    fine = np.convolve(fine, kernel / kernel.sum(), mode="same")
    # Sample k lies at the middle of its share of a pixel, whose left side is at -0.5 - margin.
    at = (np.arange(fine.size) + 0.5) / per_px - 0.5 - margin
    return lambda coordinate: np.interp(coordinate, at, fine, left=0.0, right=0.0)


class Renderer:
    """Light at the camera's pixels in DN above black, without noise. Linear in the picture shown."""

    def __init__(self):
        self.down, self.across_pixels = self.weights(CAMERA.height), self.weights(CAMERA.width).T

        def samples(count):
            return (np.arange((count + 2 * PAD) * SUBSAMPLES) + 0.5) / SUBSAMPLES - 0.5 - PAD

        x, y = np.meshgrid(samples(CAMERA.width), samples(CAMERA.height))
        points = on_plane(CAMERA.ray(x, y))
        self.coordinate = dict(zip(("column", "row"), into_projector(points)))
        albedo = 0.66 + 0.24 * np.sin(points[..., 0] / 31) * np.cos(points[..., 1] / 23) + 0.1 * points[..., 0] / 250
        self.albedo = FULL_DN * np.clip(albedo, 0.1, 1.0)
        left, top, width, height = PATCH
        self.in_patch = (
            (x > left - 0.5) & (x < left + width - 0.5) & (y > top - 0.5) & (y < top + height - 0.5)
        )
        across = {axis: stripes(size)(self.coordinate[axis]) for axis, size in AXES.items()}
        self.panel = across["column"] * across["row"]
        self.across = {"column": across["row"], "row": across["column"]}

    @staticmethod
    def weights(count):
        """Share of each sub-sample (columns) in each pixel (rows): a Gaussian blur, then the average over the pixel."""
        at = (np.arange((count + 2 * PAD) * SUBSAMPLES) + 0.5) / SUBSAMPLES - 0.5 - PAD
        # Offsets from a pixel to a sub-sample repeat, so erf is evaluated once for each.
        steps = np.arange(-PAD * SUBSAMPLES, (PAD + 1) * SUBSAMPLES)
        reach = (steps + 0.5) / SUBSAMPLES - 0.5
        scale = CAMERA_BLUR_PX * math.sqrt(2)
        share = np.array([math.erf((value + 0.5) / scale) - math.erf((value - 0.5) / scale) for value in reach])
        weights = np.zeros((count, at.size))
        for pixel in range(count):
            first = pixel * SUBSAMPLES
            weights[pixel, first : first + share.size] = share / share.sum()
        assert np.allclose(weights @ at, np.arange(count)), "a pixel is centred at its own index"
        return weights

    def integrate(self, light):
        return self.down @ (light @ self.across_pixels)

    def frames(self, high, low):
        """Images of the low reference, the high reference and each code bit, for levels of the surface in 0..1."""
        swing = self.albedo * (high - low)
        dark = self.integrate(self.albedo * low * self.panel)
        images = {"low": dark, "high": dark + self.integrate(swing * self.panel)}
        for axis, size in AXES.items():
            for bit in range(bits_and_offset(size)[0]):
                light = swing * stripes(size, bit)(self.coordinate[axis]) * self.across[axis]
                images[axis, bit] = dark + self.integrate(light)
                images[axis, bit, "inverse"] = images["high"] + dark - images[axis, bit]
        return images


def expose(light_dn, rng):
    """One frame as the camera gives it: shot noise, read noise, black level, quantisation, clipping."""
    electrons = rng.poisson((light_dn + AMBIENT_DN) / GAIN_DN_PER_ELECTRON)
    signal = electrons * GAIN_DN_PER_ELECTRON + rng.normal(0.0, READ_NOISE_DN, light_dn.shape) + BLACK_LEVEL_DN
    return np.clip(np.rint(signal), 0, 2**BIT_DEPTH - 1).astype(np.uint16)


def make_bundle(folder, mode, renderer, seed):
    """Writes manifest.json, frames.npy and calibration.toml; returns frames and what each shows."""
    if mode == "gray":
        high, low = 1.0, 0.004
        low_role, high_role = {"role": "black"}, {"role": "white"}
    else:
        # An analyser that passes 2 % of the wrong polarization; the depolarising patch sends more of V than of H.
        high = np.where(renderer.in_patch, 0.10, 1.0)
        low = np.where(renderer.in_patch, 0.25, 0.02)
        low_role, high_role = {"role": "reference-v"}, {"role": "reference-h"}
    images = renderer.frames(high, low)

    shown = [("low", low_role), ("high", high_role)]
    for axis, size in AXES.items():
        for bit in range(bits_and_offset(size)[0]):
            role = {"role": "code", "axis": axis, "bit": bit}
            shown += [((axis, bit), role), ((axis, bit, "inverse"), {**role, "inverse": True})]
    shown += shown[:2]
    rng = np.random.default_rng(seed)
    frames = np.stack([expose(images[key], rng) for key, _ in shown])
    assert frames.shape == (44, CAMERA.height, CAMERA.width)

    camera = {"width": CAMERA.width, "height": CAMERA.height, "bit_depth": BIT_DEPTH, "black_level": BLACK_LEVEL_DN}
    manifest = {
        "schema": "polscan.bundle/1",
        "mode": mode,
        "projector": {"width": PROJECTOR.width, "height": PROJECTOR.height},
        "code_offset": {axis: bits_and_offset(size)[1] for axis, size in AXES.items()},
        "sequence": [role for _, role in shown],
        "frames": "frames.npy",
        "camera": camera,
        "calibration": "calibration.toml",
    }
    if mode == "gray":
        # The other bundle leaves out what has a default or can be estimated.
        manifest["code_bits"] = {axis: bits_and_offset(size)[0] for axis, size in AXES.items()}
        camera |= {
            "saturation": 2**BIT_DEPTH - 1,
            "gain_dn_per_electron": GAIN_DN_PER_ELECTRON,
            "read_noise_dn": READ_NOISE_DN,
        }
    folder.mkdir()
    np.save(folder / "frames.npy", frames)
    (folder / "manifest.json").write_text(json.dumps(manifest, indent=1))
    (folder / "calibration.toml").write_text(
        'schema = "polscan.calibration/1"\n'
        f"[camera]\n{CAMERA.toml()}[projector]\n{PROJECTOR.toml()}"
        f"[transform]\nrotation = {R.tolist()}\ntranslation_mm = {T_MM.tolist()}\n"
    )
    return frames, [key for key, _ in shown]


# ---------------------------------------------------------------------------------------------------- checks


class Checks:
    """Counts, prints, and goes on after a failure."""

    def __init__(self):
        self.passed = self.failed = 0

    def __call__(self, name, holds, detail=""):
        holds = bool(holds)
        self.passed += holds
        self.failed += not holds
        print(f"  {'ok  ' if holds else 'FAIL'} {name}{': ' if detail else ''}{detail}", flush=True)

    def below(self, name, value, limit, unit=""):
        self(name, value < limit, f"{value:.4g} < {limit:.4g} {unit}".rstrip())

    def section(self, name, body, *arguments):
        print(f"{name}", flush=True)
        try:
            return body(*arguments)
        except Exception:
            traceback.print_exc(file=sys.stdout)
            self(f"{name} could be read to its end", False)
            return None


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def check_geometry(check, truth):
    """The model against itself, the other way round: from the plane outwards instead of along camera rays."""
    x, y = camera_grid()
    px, py = CAMERA.pixel(truth.rays)
    check.below("camera rays return to their pixels", max(np.abs(px - x).max(), np.abs(py - y).max()), 1e-9, "px")
    across = np.cross(PLANE_NORMAL, [0.0, 1.0, 0.0])
    along = np.cross(PLANE_NORMAL, across)
    rng = np.random.default_rng(5)
    points = PLANE_POINT_MM + rng.uniform(-100, 100, (500, 1)) * across + rng.uniform(-100, 100, (500, 1)) * along
    again = into_projector(on_plane(CAMERA.ray(*CAMERA.pixel(points))))
    there = into_projector(points)
    check.below("points of the plane return to their projector pixels", np.abs(np.subtract(again, there)).max(), 1e-8, "px")
    check("the pose is a rotation", np.allclose(R @ R.T, np.eye(3)) and np.linalg.det(R) > 0)
    check("the view has lit and unlit parts", 0.85 < truth.lit.mean() < 0.99, f"lit {truth.lit.mean():.3f}")
    print(
        f"       columns {truth.column.min():.1f}..{truth.column.max():.1f}, rows {truth.row.min():.1f}..{truth.row.max():.1f}, "
        f"depth {truth.depth.min():.1f}..{truth.depth.max():.1f} mm, one column is {np.median(truth.mm_per_column):.2f} mm"
    )


def check_frames(check, truth, frames, shown, mode):
    """The rendered frames against the truth, by the plainest decode there is: which of the two is brighter."""
    at = {key: frames[index].astype(float) for index, key in enumerate(shown)}
    sign = np.where(truth.patch, -1.0, 1.0) if mode == "pse" else 1.0
    where = truth.clear(mode)
    for axis, size in AXES.items():
        bits, offset = bits_and_offset(size)
        value = np.zeros(truth.lit.shape, int)
        previous = 0
        for bit in range(bits):
            bright = (sign * (at[axis, bit] - at[axis, bit, "inverse"]) > 0).astype(int)
            previous = previous ^ bright
            value = value * 2 + previous
        error = (value - offset - getattr(truth, axis))[where]
        check.below(f"{mode}: {axis}: share of plain codes off by more than 1.5", np.mean(np.abs(error) > 1.5), 1e-4)
        # An integer code of a uniformly spread coordinate has rms 1/sqrt(12) = 0.289 and no bias.
        check.below(f"{mode}: {axis}: bias of plain codes", abs(np.median(error)), 0.01, "px")
        check.below(f"{mode}: {axis}: rms of plain codes", rms(error), 0.31, "px")
    # Zero crossings of the finest bit along image rows, against the boundaries where that bit changes.
    bits, offset = bits_and_offset(PROJECTOR.width)
    fringe = sign * (at["column", bits - 1] - at["column", bits - 1, "inverse"])
    left, right = fringe[:, :-1], fringe[:, 1:]
    crossing = (left * right < 0) & where[:, :-1] & where[:, 1:]
    share = (left / (left - right + (left == right)))[crossing]
    column = truth.column[:, :-1][crossing] * (1 - share) + truth.column[:, 1:][crossing] * share
    # The finest bit changes between 2m and 2m + 1 of the offset index, m any: at u = 2m + 0.5 - offset.
    error = (column + offset - 0.5 + 1) % 2 - 1
    check.below(f"{mode}: bias of the finest stripe's edges", abs(np.mean(error)), 0.01, "px")
    check.below(f"{mode}: rms of the finest stripe's edges", rms(error), 0.1, "px")
    check(f"{mode}: no frame is saturated", frames.max() < 2**BIT_DEPTH - 1, f"largest sample {frames.max()}")


def decode(binary, bundle, out, *arguments, threads=None):
    environment = {**os.environ, **({"RAYON_NUM_THREADS": str(threads)} if threads else {})}
    command = [binary, "decode", bundle, "--out", out, *arguments]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=600)


def sha256(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


def check_maps(check, truth, maps, mode):
    shape = truth.lit.shape
    types = {"column": "f4", "row": "f4", "depth": "f4", "modulation": "f4", "residual": "f4", "class": "u1", "mask": "?"}
    for name, kind in types.items():
        check(f"map {name} is {np.dtype(kind)} of the image's shape", maps[name].dtype == np.dtype(kind) and maps[name].shape == shape)
    mask = maps["mask"]
    for name in ("column", "row", "depth"):
        check(f"{name} is NaN exactly outside the mask", np.array_equal(np.isnan(maps[name]), ~mask))
    check("the mask is where the class is valid, edge or inverted", np.array_equal(mask, np.isin(maps["class"], (1, 2, 3))))
    unlit = ~truth.lit & ~truth.near_border
    check("nothing outside the projector's light is valid", not mask[unlit].any())
    check("what no light reaches is classed unlit", np.mean(maps["class"][unlit] == 0) > 0.999)

    where = truth.clear(mode)
    check("coverage of the lit plane", mask[where].mean() > 0.97, f"{mask[where].mean():.5f}")
    if mode == "pse":
        inside = truth.patch & truth.inner
        check("coverage of the depolarising patch", mask[inside].mean() > 0.97, f"{mask[inside].mean():.5f}")
        turned = maps["class"][inside & mask]
        check("its pixels are classed inverted", np.mean(turned == 3) > 0.99, f"{np.mean(turned == 3):.5f}")
        check("no other pixel is", not np.any(maps["class"][where & ~truth.patch] == 3))

    # An integer decoder has rms 0.289 in each axis. In these frames a single stripe edge is good to 0.012 px (the model's own
    # check above), and a fit over several edges of a smooth surface can only be better; the limit leaves room for a
    # decoder that fits nothing and for the patch, which is dark.
    seen = mask & where
    for axis in AXES:
        error = (maps[axis] - getattr(truth, axis))[seen]
        check.below(f"{axis}: share off by more than 1.5", np.mean(np.abs(error) > 1.5), 1e-5)
        check.below(f"{axis}: rms", rms(error), COORDINATE_RMS_PX, "px")
        # A convention that is off by half a pixel, or a lens whose terms are swapped, shows here at once.
        check.below(f"{axis}: bias", abs(float(np.mean(error))), 0.002, "px")
    error = (maps["depth"] - truth.depth)[seen]
    allowed_mm = (COORDINATE_RMS_PX * truth.mm_per_column)[seen]
    check.below("depth: rms", rms(error), rms(allowed_mm), "mm")
    check.below("depth: largest error", float(np.abs(error).max()), 0.5 * float(truth.mm_per_column.max()), "mm")
    check("modulation has the sign of the surface", np.all(maps["modulation"][seen & ~truth.patch] > 0))


PLY_PROPERTIES = [
    ("float", "x"), ("float", "y"), ("float", "z"), ("float", "nx"), ("float", "ny"), ("float", "nz"),
    ("uchar", "intensity"), ("float", "sigma_z"), ("uchar", "flags"),
]  # fmt: skip


def read_ply(path):
    data = path.read_bytes()
    header, body = data.split(b"end_header\n", 1)
    lines = [line.split() for line in header.decode("ascii").splitlines()]
    count = next(int(line[2]) for line in lines if line[:2] == ["element", "vertex"])
    properties = [(line[1], line[2]) for line in lines if line[0] == "property"]
    kinds = {"float": "<f4", "float32": "<f4", "uchar": "u1", "uint8": "u1"}
    record = np.dtype([(name, kinds[kind]) for kind, name in properties])
    return lines, properties, np.frombuffer(body, record, count), len(body) - count * record.itemsize


def check_cloud(check, truth, maps, path, mode):
    lines, properties, cloud, left_over = read_ply(path)
    check("the cloud is binary little endian", ["format", "binary_little_endian", "1.0"] in lines)
    check("the cloud has the documented properties", properties == PLY_PROPERTIES, str(properties))
    check("the cloud has one point per valid pixel", cloud.size == maps["mask"].sum() and left_over == 0, f"{cloud.size}")
    points = np.stack([cloud[name] for name in "xyz"], axis=-1).astype(float)
    loaded = trimesh.load(path)
    check("an ordinary reader finds the same points", np.allclose(np.asarray(loaded.vertices), points, atol=1e-3))

    # Seen from the camera, a point lies at the pixel that measured it: the camera half of the calibration is right.
    px, py = CAMERA.pixel(points)
    column, row = np.rint(px).astype(int), np.rint(py).astype(int)
    # float32 keeps 800 mm to 6e-5 mm, which is 1e-4 px; the program's own undistortion may add as much again.
    check.below("points lie on the rays of their pixels", float(np.hypot(px - column, py - row).max()), 2e-3, "px")
    inside = (column >= 0) & (column < CAMERA.width) & (row >= 0) & (row < CAMERA.height)
    check("each valid pixel has its point", inside.all() and np.unique(row * CAMERA.width + column).size == cloud.size)
    check("the cloud's z is the depth map", np.allclose(maps["depth"][row, column], cloud["z"], rtol=1e-6))

    clear = truth.clear(mode)[row, column]
    sigma = cloud["sigma_z"]
    error = (cloud["z"] - truth.depth[row, column])[clear]
    check("every sigma is a positive length", np.all(np.isfinite(sigma) & (sigma > 0)))
    # A quarter of a million points average their noise away: what remains is systematic, and must drown in the noise of one.
    check.below("depth: bias in sigmas", abs(float(np.median(error / sigma[clear]))), 0.25)
    ratio = 1.4826 * float(np.median(np.abs(error / sigma[clear] - np.median(error / sigma[clear]))))
    check("sigma_z tells the truth within a quarter", 0.8 < ratio < 1.25, f"observed / stated = {ratio:.3f}")

    normals = np.stack([cloud[name] for name in ("nx", "ny", "nz")], axis=-1).astype(float)
    length = np.linalg.norm(normals, axis=-1)
    check("normals are unit vectors or zero", np.all((np.abs(length - 1) < 1e-4) | (length == 0)))
    given = clear & (length > 0)
    check("most points have a normal", given.sum() > 0.9 * clear.sum(), f"{given.sum() / clear.sum():.4f}")
    cosine = normals[given] @ PLANE_NORMAL
    check("normals point towards the camera", np.mean(cosine > 0) > 0.99, f"{np.mean(cosine > 0):.5f}")
    # Local normals from points of a few tenths of a millimetre on a 0.7 mm grid are rough one by one, right on average.
    mean = normals[given].mean(axis=0)
    tilt_deg = math.degrees(math.acos(min(1.0, mean @ PLANE_NORMAL / np.linalg.norm(mean))))
    check.below("tilt of the mean normal", tilt_deg, 2.0, "deg")


def check_report(check, truth, maps, report, mode):
    check("report: schema", report["schema"] == "polscan.report/1")
    check("report: mode and number of frames", (report["mode"], report["frames"]) == (mode, 44))
    check("report: size", report["size"] == {"width": CAMERA.width, "height": CAMERA.height})
    # Turned polarity over a part of the view is worth telling, though the decode holds; else there is nothing to say.
    told = {reason["type"] for reason in report["reasons"]}
    allowed = {"polarization-inverted", "polarization-weak"} if mode == "pse" else set()
    check("report: no false diagnosis", told <= allowed, str(sorted(told)))
    check("report: the verdict is ok exactly without reasons", (report["verdict"] == "ok") == (not told), report["verdict"])
    pixels = report["pixels"]
    check("report: pixels in all", pixels["total"] == maps["mask"].size)
    check("report: lit pixels", pixels["lit"] == np.count_nonzero(maps["class"]), f"{pixels['lit']}")
    plane = next((plane for plane in report["planes"] if plane["name"] == "plate"), None)
    check("report: the named region is there", plane is not None)
    # A region is measured 2 px off its own border, as an object is off its silhouette.
    x, y, width, height = REGION
    window = np.s_[y + 2 : y + height - 2, x + 2 : x + width - 2]
    seen = maps["mask"][window]
    points = (truth.rays[window] * maps["depth"][window][..., None].astype(float))[seen]
    centred = points - points.mean(axis=0)
    values, vectors = np.linalg.eigh(centred.T @ centred / len(points))
    check("report: points of the plane", plane["points"] == len(points), f"{plane['points']} and {len(points)}")
    check("report: rms of the plane", math.isclose(plane["rmse_mm"], math.sqrt(values[0]), rel_tol=0.02), f"{plane['rmse_mm']:.4f} and {math.sqrt(values[0]):.4f} mm")
    tilt_deg = math.degrees(math.acos(min(1.0, abs(vectors[:, 0] @ PLANE_NORMAL))))
    check.below("the region's plane has the true tilt", tilt_deg, 0.05, "deg")
    residual = report["capture"]["pair_residual_sigma"]["median"]
    check("report: the pair sum holds within noise", 0.8 < residual < 1.25, f"{residual:.3f}")


def check_program(check, binary, folder, bundle, truth, mode):
    before = {path.name: sha256(path) for path in bundle.iterdir()}
    region = ["--region", "plate=" + ",".join(map(str, REGION))]
    out = folder / f"{mode}-out"
    run = decode(binary, bundle, out, *region)
    check("decode ends with 0", run.returncode == 0, run.stderr.strip()[-2000:] if run.returncode else "")
    check("it leaves the bundle as it was", before == {path.name: sha256(path) for path in bundle.iterdir()})
    with np.load(out / "maps.npz") as archive:
        maps = dict(archive)
    check.section(f"{mode}: maps", check_maps, check, truth, maps, mode)
    check.section(f"{mode}: cloud", check_cloud, check, truth, maps, out / "cloud.ply", mode)
    report = json.loads((out / "report.json").read_text())
    check.section(f"{mode}: report", check_report, check, truth, maps, report, mode)

    print(f"{mode}: repetition")
    manifest = json.loads((out / "manifest.json").read_text())
    check("the result has a manifest", manifest["schema"] == "polscan.bundle/1" and manifest["mode"] == mode)
    again = folder / f"{mode}-again"
    decode(binary, bundle, again, *region)
    check("decoded again: the same bytes of maps.npz", sha256(out / "maps.npz") == sha256(again / "maps.npz"))
    alone = folder / f"{mode}-one-thread"
    decode(binary, bundle, alone, *region, threads=1)
    check("with one thread: the same bytes of maps.npz", sha256(out / "maps.npz") == sha256(alone / "maps.npz"))
    check("with one thread: the same bytes of cloud.ply", sha256(out / "cloud.ply") == sha256(alone / "cloud.ply"))
    check("a result is never overwritten", decode(binary, bundle, out, *region).returncode == 74)


def check_uncalibrated(check, binary, folder, bundle, truth):
    bare = folder / "bare"
    bare.mkdir()
    manifest = json.loads((bundle / "manifest.json").read_text())
    del manifest["calibration"]
    (bare / "manifest.json").write_text(json.dumps(manifest))
    (bare / "frames.npy").symlink_to(bundle / "frames.npy")
    out = folder / "bare-out"
    run = decode(binary, bare, out)
    check("decode ends with 0", run.returncode == 0, run.stderr.strip()[-2000:] if run.returncode else "")
    check("there is no cloud", not (out / "cloud.ply").exists())
    with np.load(out / "maps.npz") as maps:
        check("there is no depth", np.isnan(maps["depth"]).all())
        seen = maps["mask"] & truth.inner
        check("columns are there", seen.sum() > 0.97 * truth.inner.sum())
        check.below("column: rms", rms((maps["column"] - truth.column)[seen]), COORDINATE_RMS_PX, "px")


def main():
    if len(sys.argv) != 2:
        sys.exit("usage: foreign_plane.py POLSCAN_BINARY | --model-only")
    check = Checks()
    truth = Truth()
    check.section("the model: geometry", check_geometry, check, truth)
    with tempfile.TemporaryDirectory(prefix="foreign-plane-") as name:
        folder = pathlib.Path(name)
        renderer = Renderer()
        bundles = {}
        for seed, mode in enumerate(("gray", "pse"), start=1):
            bundles[mode] = folder / mode
            frames, shown = make_bundle(bundles[mode], mode, renderer, seed)
            check.section(f"the model: frames of mode {mode}", check_frames, check, truth, frames, shown, mode)
        if check.failed:
            print("the model itself is wrong: the program was not checked")
        elif sys.argv[1] != "--model-only":
            binary = pathlib.Path(sys.argv[1]).resolve()
            for mode, bundle in bundles.items():
                check.section(f"{mode}: decode", check_program, check, binary, folder, bundle, truth, mode)
            check.section("without a calibration", check_uncalibrated, check, binary, folder, bundles["gray"], truth)
    print(f"foreign-plane: {check.passed} passed, {check.failed} failed")
    sys.exit(1 if check.failed else 0)


if __name__ == "__main__":
    main()
