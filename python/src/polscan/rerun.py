"""Scans in a Rerun viewer as they come, or in a recording of it. Needs the extra `polscan[rerun]`.

    polscan-rerun http://127.0.0.1:8631                                         opens a viewer
    polscan-rerun http://127.0.0.1:8631 --connect rerun+http://HOST:9876/proxy  one that is open elsewhere
    polscan-rerun http://127.0.0.1:8631 --save scans.rrd --last 20 --count 20   what there is, as a file

On the timeline `acquired`: the points with their uncertainties (`cloud`), the verdict with its reasons (`verdict`), the
number of points and the flatness of each plane of the report as curves (`figures`).
"""

from __future__ import annotations

import argparse
import sys
import tomllib
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from itertools import islice, takewhile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ._client import Scan, Scanner
from .errors import NotFound, PolscanError
from .models import ScanInfo

try:
    import rerun as rr
except ImportError as error:
    raise ImportError("scans are shown by the SDK of Rerun: pip install 'polscan[rerun]'") from error

COLOURINGS: dict[str, Callable[[NDArray[np.void]], NDArray[np.float64]]] = {
    "depth": lambda cloud: cloud["z"].astype(float),
    "sigma": lambda cloud: cloud["sigma_z"].astype(float),
    "intensity": lambda cloud: cloud["intensity"].astype(float),
}
"""What points may be coloured by, and its value for each."""

_STOPS = np.array(
    [[62, 38, 168], [46, 135, 247], [18, 190, 185], [200, 193, 41], [249, 251, 21]], float
)  # fmt: skip
_LEVELS = {"ok": "INFO", "degraded": "WARN"}


def colours(values: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Colours from blue to yellow, of shape (n, 3), for values from their percentile 1 to their percentile 99."""
    known = values[np.isfinite(values)]
    low, high = np.percentile(known, [1, 99]) if known.size else (0.0, 1.0)
    share = np.clip((np.nan_to_num(values, nan=low) - low) / ((high - low) or 1.0), 0, 1)
    places = np.linspace(0, 1, len(_STOPS))
    return np.stack([np.interp(share, places, _STOPS[:, one]) for one in range(3)], axis=-1).astype(np.uint8)


def log_cloud(cloud: NDArray[np.void], to: rr.RecordingStream, *, colour: str = "depth") -> None:
    """Shows points, with `sigma_z_mm` and `flags` of each, at the time that `to` is set to."""
    positions = np.stack([cloud["x"], cloud["y"], cloud["z"]], axis=-1)
    shown = rr.Points3D(positions, colors=colours(COLOURINGS[colour](cloud)), radii=rr.Radius.ui_points(1.5))
    # Copies: the fields of a cloud lie 30 bytes apart, and what is shown is held in columns.
    beside = rr.AnyValues(sigma_z_mm=cloud["sigma_z"].copy(), flags=cloud["flags"].copy())
    to.log("cloud", shown, beside)


def log_scan(scan: Scan, to: rr.RecordingStream, *, points: int = 50_000, colour: str = "depth") -> None:
    """Shows a scan that has come to its end: at most `points` of its points, its verdict and the figures of its report.

    A scan without a cloud empties the view: what is seen is never of another scan than the verdict beside it.
    """
    info = scan.info
    # Scans of a series were all asked for at once; what they show is of when they were taken.
    to.set_time("acquired", timestamp=info.acquired or info.created)
    _log_verdict(info, to)
    if info.state != "done" or not info.points:
        to.log("cloud", rr.Clear(recursive=False))
        return
    _log_axes(scan, to)
    log_cloud(scan.sample(points), to, colour=colour)
    to.log("figures/points", rr.Scalars(float(info.points)))
    for plane in scan.report().planes:
        if plane.rmse_mm is not None:
            to.log(f"figures/flatness_mm/{plane.name}", rr.Scalars(plane.rmse_mm))


def _log_verdict(info: ScanInfo, to: rr.RecordingStream) -> None:
    verdict = info.verdict or info.state
    reasons = "".join(f"\n{reason.type}: {reason.message}" for reason in info.reasons)
    text = f"{info.label or info.id}: {verdict}{reasons}"
    to.log("verdict", rr.TextLog(text, level=_LEVELS.get(verdict, "ERROR")))


def _log_axes(scan: Scan, to: rr.RecordingStream) -> None:
    """A cloud in the frame of the camera has y down and z forward; of a world nobody says which way is up."""
    if scan.info.artifact("calibration.toml") is None:
        return
    if "world" not in tomllib.loads(scan.read("calibration.toml").decode()):
        to.log("cloud", rr.ViewCoordinates.RDF, static=True)


def _ended(scanner: Scanner, last: int) -> Iterator[Scan]:
    """The `last` scans that have ended, the oldest first, and then each that ends, once. Who is deleted first is left out."""
    after = scanner.status().revision
    # Identities grow: scans that end from now on are not older than these.
    begun = [scan.id for scan in scanner.scans(state=("queued", "projecting", "acquired", "decoding"))]
    before = [scan.id for scan in islice((scan for scan in scanner.scans() if scan.info.ended), max(last, 1))]
    since = min(begun + before[:1], default="")
    # What is told of a scan after its end is a new label, or that it is kept.
    known = set(before)
    yield from _whole(scanner, reversed(before[:last]))
    for event in scanner.events(after=after):
        if event.kind == "gap":
            # What happened meanwhile is forgotten, the scans are not.
            newer = takewhile(lambda scan: scan.id >= since, scanner.scans())
            ended = [scan.id for scan in newer if scan.info.ended and scan.id not in known]
        elif event.scan and event.scan.ended and event.scan.id not in known:
            ended = [event.scan.id]
        else:
            continue
        known.update(ended)
        yield from _whole(scanner, reversed(ended))


def _whole(scanner: Scanner, ids: Iterable[str]) -> Iterator[Scan]:
    """The scans with what is known of their files, of which lists and events say nothing."""
    for id_ in ids:
        with suppress(NotFound):
            yield scanner.get(id_)


def _arguments(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="polscan-rerun", description="Shows scans in a Rerun viewer as they come."
    )
    parser.add_argument("url", help="address of the service, such as http://127.0.0.1:8631")
    to = parser.add_mutually_exclusive_group()
    to.add_argument(
        "--connect",
        metavar="ADDRESS",
        help="a viewer that is open, such as rerun+http://127.0.0.1:9876/proxy",
    )
    to.add_argument("--save", metavar="FILE", type=Path, help="a recording (.rrd) instead of a viewer")
    parser.add_argument(
        "--last", metavar="N", type=int, default=1, help="begin with the last N scans (default: 1)"
    )
    parser.add_argument("--count", metavar="N", type=int, help="end after N scans (default: go on)")
    parser.add_argument(
        "--points", metavar="N", type=int, default=50_000, help="most points of a scan (default: 50000)"
    )
    parser.add_argument("--colour", choices=COLOURINGS, default="depth", help="what points are coloured by")
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> int:
    """The program `polscan-rerun`."""
    asked = _arguments(arguments)
    if asked.save and asked.save.exists():
        print(f"polscan-rerun: {asked.save} exists already; choose another name", file=sys.stderr)
        return 1
    recording = rr.RecordingStream("polscan")
    shown = 0
    try:
        with Scanner(asked.url) as scanner:
            # A service that does not answer is told before a viewer opens.
            scanner.status()
            if asked.save:
                recording.save(asked.save)
            elif asked.connect:
                recording.connect_grpc(asked.connect)
            else:
                recording.spawn()
            for scan in islice(_ended(scanner, asked.last), asked.count):
                log_scan(scan, recording, points=asked.points, colour=asked.colour)
                recording.flush()
                shown += 1
                print(f"{scan.id} {scan.info.verdict or scan.info.state}", flush=True)
    except (PolscanError, ValueError, OSError, RuntimeError) as error:
        print(f"polscan-rerun: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"polscan-rerun: ended after {shown} scans", file=sys.stderr)
    finally:
        recording.flush()
        recording.disconnect()
    return 0


if __name__ == "__main__":
    sys.exit(main())
