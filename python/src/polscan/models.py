"""What the service answers, as frozen dataclasses. What a later service adds is in `raw`."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from functools import cache
from typing import Any, Self

from .errors import ProtocolError

ENDS = frozenset({"done", "failed", "cancelled", "interrupted"})
"""States of a scan that never change again."""


def instant(text: str) -> datetime:
    """A time of RFC 3339, aware of its zone."""
    return datetime.fromisoformat(text)


@cache
def _hints(kind: Hashable) -> dict[str, Any]:
    return typing.get_type_hints(typing.cast("type", kind))


def _value(hint: Any, value: Any) -> Any:  # noqa: ANN401 - the hint says what
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is types.UnionType:
        if value is None and type(None) in arguments:
            return None
        return _value(next(one for one in arguments if one is not type(None)), value)
    if origin is tuple:
        return tuple(_value(arguments[0], one) for one in value or ())
    if origin is dict or hint is Any:
        return value
    if isinstance(hint, type) and issubclass(hint, Document):
        return hint.parse(value)
    if hint is datetime:
        return instant(value)
    if hint is float and isinstance(value, int):
        return float(value)
    if not isinstance(value, hint):
        raise TypeError(f"{value!r} is no {hint.__name__}")
    return value


@dataclass(frozen=True, kw_only=True)
class Document:
    """A JSON object of the service."""

    raw: dict[str, Any] = field(repr=False, compare=False)
    """All of it."""

    @classmethod
    def parse(cls, document: Any) -> Self:  # noqa: ANN401 - anything may have been answered
        """Reads what was answered; `ProtocolError` where it is something else."""
        try:
            hints, given = _hints(typing.cast("Hashable", cls)), {}
            for one in dataclasses.fields(cls):
                if one.name != "raw" and one.name in document:
                    given[one.name] = _value(hints[one.name], document[one.name])
            return cls(raw=dict(document), **given)
        except (TypeError, ValueError, AttributeError, KeyError) as error:
            raise ProtocolError(f"cannot read the service's {cls.__name__}: {error}") from error


@dataclass(frozen=True, kw_only=True)
class Cause(Document):
    """Why a scan has no result that can be used, or a doubtful one."""

    type: str
    """Stable slug of the diagnosis."""
    message: str
    """What was seen and what to do."""
    evidence: Any = None
    """Figures, in a report."""


@dataclass(frozen=True, kw_only=True)
class Artifact(Document):
    """A file of a scan."""

    name: str
    href: str
    bytes: int
    sha256: str


@dataclass(frozen=True, kw_only=True)
class Progress(Document):
    """How far a capture is."""

    frames: int
    """Frames in hand."""
    of: int
    """Frames of the sequence; 0 before the capture has begun."""
    retaken: int
    """Pairs and references that were taken again."""


@dataclass(frozen=True, kw_only=True)
class Series(Document):
    """Place of a scan among those of one request."""

    index: int
    of: int
    first: str


@dataclass(frozen=True, kw_only=True)
class ScanInfo(Document):
    """All that is known of a scan at one moment."""

    id: str
    state: str
    """`queued`, `projecting`, `acquired`, `decoding`, `done`, `failed`, `cancelled` or `interrupted`."""
    revision: int
    """Number of the event that last changed it."""
    mode: str
    created: datetime
    started: datetime | None = None
    acquired: datetime | None = None
    """When the last frame was in memory: from then on the object may move."""
    finished: datetime | None = None
    label: str | None = None
    tags: tuple[str, ...] = ()
    pinned: bool = False
    exposure_us: float | None = None
    progress: Progress | None = None
    queue_position: int | None = None
    held: bool = False
    verdict: str | None = None
    """`ok`, `degraded` or `failed`, once there is a report."""
    reasons: tuple[Cause, ...] = ()
    error: Cause | None = None
    source: str | None = None
    """The scan whose frames this one was decoded from."""
    series: Series | None = None
    points: int | None = None
    bytes: int | None = None
    href: str | None = None
    artifacts: tuple[Artifact, ...] = ()
    scans: tuple[str, ...] = ()
    """All scans of the request, where it asked for several."""

    @property
    def ended(self) -> bool:
        """Whether it will never change again, but for label, tags and pin."""
        return self.state in ENDS

    def artifact(self, name: str) -> Artifact | None:
        """The file of that name, where the scan has one."""
        return next((one for one in self.artifacts if one.name == name), None)


@dataclass(frozen=True, kw_only=True)
class Page(Document):
    """A page of scans, the newest first."""

    scans: tuple[ScanInfo, ...]
    next: str | None = None
    """`cursor` of the next page."""


@dataclass(frozen=True, kw_only=True)
class Device(Document):
    """A camera or projector."""

    driver: str
    model: str
    serial: str
    in_use: bool
    unusable: str | None = None
    """Why it cannot be used."""


@dataclass(frozen=True, kw_only=True)
class Devices(Document):
    """Cameras and projectors that are found."""

    cameras: tuple[Device, ...]
    projectors: tuple[Device, ...]


@dataclass(frozen=True, kw_only=True)
class Readiness(Document):
    """Whether a scan would be accepted on an idle rig, and why not."""

    ready: bool
    reasons: tuple[Cause, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Status(Document):
    """Everything about the service at one moment. `raw` has more."""

    revision: int
    """Number of the latest event."""
    ready: bool
    reasons: tuple[Cause, ...]
    state: str
    """`idle`, `scanning`, `calibrating`, `stopping` or `fault`."""
    rig: str
    version: str
    uptime_s: float
    queue: tuple[str, ...]
    finishing: tuple[str, ...]
    held: int
    queue_capacity: int
    capturing: str | None = None
    calibrating: str | None = None
    rig_message: str | None = None
    showing: str | None = None
    camera: dict[str, Any] | None = None
    projector: dict[str, Any] | None = None
    storage: dict[str, Any] | None = None


@dataclass(frozen=True, kw_only=True)
class CalibrationFile(Document):
    """A file of a calibration."""

    name: str
    href: str


@dataclass(frozen=True, kw_only=True)
class LiveValue(Document):
    """H and V while somebody turns the polarizer."""

    h_dn: float
    v_dn: float
    advice: str
    values: int
    off_deg: float | None = None


@dataclass(frozen=True, kw_only=True)
class SessionView(Document):
    """A view of the board in a session."""

    name: str
    corners: int
    """Corners of the board that were found."""
    plane_points: int
    """Decoded points on the board."""
    corner_sigma_px: float | None = None
    """Their standard deviation by the picture's noise, rms."""
    tilt_deg: tuple[float, ...] | None = None
    """Tilt of the board about the image's x and y axis, by a lens that is guessed from the views."""
    unusable: str | None = None
    """Why it is of no use; nothing where it is."""


@dataclass(frozen=True, kw_only=True)
class SessionState(Document):
    """A session with a board as it stands."""

    board: str
    """The board, in words."""
    views: tuple[SessionView, ...]
    """In the order in which they were taken."""
    missing: tuple[str, ...]
    """What the next views should do: parts of the image, tilts. Empty when nothing is missing."""
    views_missing: int
    """Views still missing at least."""
    camera_coverage: tuple[tuple[int, ...], ...]
    """Corners of the board in each ninth of the camera's image, rows from the top."""
    projector_coverage: tuple[tuple[int, ...], ...]
    """Decoded points of the board in each ninth of the projector's picture, rows from the top."""


@dataclass(frozen=True, kw_only=True)
class CalibrationInfo(Document):
    """All that is known of a calibration at one moment."""

    id: str
    kind: str
    state: str
    """`open` (a session with a board, between its steps), `running`, `done`, `failed`, `cancelled`, `interrupted`."""
    revision: int
    created: datetime
    steps: int
    watch: bool
    finished: datetime | None = None
    doing: str | None = None
    angle_deg: float | None = None
    live: LiveValue | None = None
    session: SessionState | None = None
    """What is still missing and which views there are, of a session with a board."""
    accepted: bool | None = None
    """Whether it can be trusted; nothing before its end."""
    refused: tuple[str, ...] = ()
    """Why it is not accepted."""
    error: Cause | None = None
    summary: tuple[str, ...] = ()
    """What was found, in words."""
    files: tuple[str, ...] = ()
    href: str | None = None
    artifacts: tuple[CalibrationFile, ...] = ()

    @property
    def ended(self) -> bool:
        """Whether it will never change again."""
        return self.state not in ("open", "running")


@dataclass(frozen=True, kw_only=True)
class CalibrationInUse(Document):
    """The calibration file that scans use."""

    id: str
    file: str
    kind: str
    quality: dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Calibrations(Document):
    """The file that scans use, and what the service calibrated, the newest first."""

    calibrations: tuple[CalibrationInUse, ...]
    runs: tuple[CalibrationInfo, ...]
    fault: str | None = None
    """Why the file that scans use cannot be read."""


@dataclass(frozen=True)
class Event:
    """Something changed."""

    kind: str
    """`scan`, `progress`, `rig`, `projector`, `deleted`, `calibration`, ...; `gap`: events before are forgotten."""
    id: int | None
    """Its number; only a `gap` has none."""
    data: dict[str, Any]

    @property
    def scan(self) -> ScanInfo | None:
        """The scan as it is now, of an event `scan`."""
        return ScanInfo.parse(self.data) if self.kind == "scan" else None


@dataclass(frozen=True)
class Preview:
    """The latest frame of the camera, saturated pixels in red."""

    jpeg: bytes
    frame: int
    """Its number since the service started."""
    exposure: str
    """`good`, `over` or `under`."""
    saturated_share: float
    """Share of the pixels that are saturated, 0 to 1."""

    @classmethod
    def of(cls, jpeg: bytes, headers: Mapping[str, str]) -> Preview:
        """Reads the hints beside the picture."""
        try:
            frame, share = int(headers["x-polscan-frame"]), float(headers["x-polscan-saturated-share"])
            return cls(jpeg, frame, headers["x-polscan-exposure"], share)
        except (KeyError, ValueError) as error:
            raise ProtocolError(f"cannot read the headers of a preview: {error}") from error

    def array(self) -> Any:  # noqa: ANN401 - numpy's type names are long, and pillow is an extra
        """The picture as uint8 of shape (height, width, 3). Needs the extra `polscan[images]`."""
        import io

        import numpy as np

        try:
            from PIL import Image
        except ImportError as error:
            raise ImportError("pictures become arrays by pillow: pip install 'polscan[images]'") from error
        with Image.open(io.BytesIO(self.jpeg)) as picture:
            return np.asarray(picture.convert("RGB"))
