"""A bundle: one scan in one folder. Needs no service."""

from __future__ import annotations

import hashlib
import json
import struct
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import BundleError
from .report import Report

CLOUD: np.dtype[np.void] = np.dtype(
    [
        *((name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")),
        ("intensity", "u1"), ("sigma_z", "<f4"), ("flags", "u1"),
    ]
)  # fmt: skip
"""A point: position in mm, normal (0 where there is none), brightness, standard deviation of z in mm, flags."""

EDGE, HALF_SATURATED, INVERTED, INTERPOLATED, SILHOUETTE = 1, 2, 4, 8, 16
"""Bits of `flags`."""

CLASSES = (
    "unlit", "valid", "edge", "inverted", "saturated", "ambiguous", "off-boundary", "out of projector",
    "out of volume", "row gate", "vote", "interreflection",
)  # fmt: skip
"""What the values of the map `class` mean."""

_PLY_TYPES = {"float": "<f4", "double": "<f8", "uchar": "u1", "ushort": "<u2", "uint": "<u4", "int": "<i4"}


def read_cloud(path: str | Path) -> NDArray[np.void]:
    """The points of a `cloud.ply`, one after the other in the order of the camera's pixels, with the fields of `CLOUD`.

    Mapped into memory rather than read: what is changed stays in memory, and the file as it is.
    """
    path = Path(path)
    with path.open("rb") as file:
        names: list[tuple[str, str]] = []
        count = -1
        if file.readline(16).strip() != b"ply":
            raise BundleError(f"{path} is no PLY file")
        while True:
            words = file.readline(1024).decode("latin-1").split()
            match words:
                case []:
                    raise BundleError(f"{path} ends within its header")
                case ["end_header"]:
                    break
                case ["format", kind, _] if kind != "binary_little_endian":
                    raise BundleError(f"{path} is a PLY file of the format {kind}, not binary_little_endian")
                case ["element", "vertex", number] if number.isdecimal():
                    count = int(number)
                case ["element", *_]:
                    raise BundleError(f"{path} has more than points: {' '.join(words)}")
                case ["property", kind, name] if kind in _PLY_TYPES:
                    names.append((name, _PLY_TYPES[kind]))
                case ["property", *_]:
                    raise BundleError(f"{path} has a property that is not understood: {' '.join(words)}")
                case _:
                    pass
        start = file.tell()
    point = np.dtype(names)
    length = path.stat().st_size - start
    if count < 0 or length != count * point.itemsize:
        raise BundleError(
            f"{path} should hold {count} points of {point.itemsize} bytes, but {length} bytes follow"
        )
    if count == 0:
        return np.empty(0, point)
    return np.memmap(path, point, "c", start, (count,))


class Maps(Mapping[str, NDArray[Any]]):
    """Maps by name, of shape (height, width): `depth` (z in mm, NaN where nothing was measured), `column`, `row`,
    `modulation`, `residual`, `class` (see `CLASSES`), `mask`.

    Each is mapped into memory when it is asked for: what is changed stays in memory, and the file as it is.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        try:
            with zipfile.ZipFile(self.path) as archive:
                self._members = {one.filename.removesuffix(".npy"): one for one in archive.infolist()}
        except (OSError, zipfile.BadZipFile) as error:
            raise BundleError(f"cannot read {self.path}: {error}") from error

    def __getitem__(self, name: str) -> NDArray[Any]:
        member = self._members[name]
        if member.compress_type != zipfile.ZIP_STORED:
            with np.load(self.path) as arrays:
                return np.asarray(arrays[name])
        try:
            with self.path.open("rb") as file:
                # The lengths of name and extra field in front of the data may differ from those in the directory.
                file.seek(member.header_offset + 26)
                name_length, extra_length = struct.unpack("<HH", file.read(4))
                file.seek(name_length + extra_length, 1)
                version = np.lib.format.read_magic(file)
                header = (
                    np.lib.format.read_array_header_1_0
                    if version == (1, 0)
                    else np.lib.format.read_array_header_2_0
                )
                shape, fortran, kind = header(file)
                return np.memmap(self.path, kind, "c", file.tell(), shape, "F" if fortran else "C")
        except (OSError, ValueError, struct.error) as error:
            raise BundleError(f"cannot read the map {name} of {self.path}: {error}") from error

    def __iter__(self) -> Iterator[str]:
        return iter(self._members)

    def __len__(self) -> int:
        return len(self._members)

    def __repr__(self) -> str:
        return f"Maps({', '.join(self)})"


class Bundle:
    """The files of one scan in a folder, or of one decode."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.manifest: dict[str, Any] = self._json("manifest.json")
        schema = str(self.manifest.get("schema"))
        if schema.partition("/")[0] != "polscan.bundle":
            raise BundleError(f"{self.path} is no bundle: its manifest.json has the schema {schema}")
        if schema != "polscan.bundle/1":
            raise BundleError(
                f"{self.path} is a bundle of another version, {schema}; use a newer polscan package"
            )

    def __repr__(self) -> str:
        return f"Bundle({str(self.path)!r})"

    def _json(self, name: str) -> dict[str, Any]:
        path = self.path / name
        try:
            document = json.loads(path.read_bytes())
        except FileNotFoundError as error:
            raise BundleError(f"there is no {path}; a bundle is the whole folder of a scan") from error
        except (OSError, ValueError) as error:
            raise BundleError(f"cannot read {path}: {error}") from error
        if not isinstance(document, dict):
            raise BundleError(f"{path} holds no object")
        return document

    def _file(self, name: str) -> Path:
        path = self.path / name
        if not path.is_file():
            raise BundleError(f"there is no {path}; was the bundle copied in full?")
        return path

    @property
    def id(self) -> str | None:
        """Identity of the scan."""
        return self.manifest.get("id")

    def cloud(self) -> NDArray[np.void]:
        """The points, with the fields of `CLOUD`; see `read_cloud`."""
        return read_cloud(self._file("cloud.ply"))

    def maps(self) -> Maps:
        """The maps; see `Maps`."""
        return Maps(self._file("maps.npz"))

    def truth(self) -> Maps:
        """What a simulated rig knows to be true: `column`, `row`, `depth`, `object`."""
        return Maps(self._file("truth.npz"))

    def frames(self) -> NDArray[Any]:
        """The raw frames, of shape (frames, height, width), mapped into memory."""
        frames: NDArray[Any] = np.load(self._file("frames.npy"), mmap_mode="c")
        return frames

    def report(self) -> Report:
        """The report."""
        return Report.parse(self._json("report.json"))

    def check(self) -> None:
        """Compares every file with length and hash in the manifest; `BundleError` names all that differ."""
        wrong = []
        for name, said in dict(self.manifest.get("files") or {}).items():
            path = self.path / name
            if not path.is_file():
                wrong.append(f"{name} is missing")
            elif path.stat().st_size != said["bytes"]:
                wrong.append(f"{name} has {path.stat().st_size} bytes instead of {said['bytes']}")
            else:
                with path.open("rb") as file:
                    if hashlib.file_digest(file, "sha256").hexdigest() != said["sha256"]:
                        wrong.append(f"{name} has other bytes than those that were written")
        if wrong:
            raise BundleError(f"{self.path} is damaged: {'; '.join(wrong)}")


def open_bundle(path: str | Path) -> Bundle:
    """Opens the folder of a scan: one that was copied, fetched or made by `polscan scan` or `polscan decode`."""
    return Bundle(path)
