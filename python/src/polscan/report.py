"""The report of a scan."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Self

from .errors import ProtocolError
from .models import Cause, Document


@dataclass(frozen=True, kw_only=True)
class Size(Document):
    """Size of the camera's image in pixels."""

    width: int
    height: int


@dataclass(frozen=True, kw_only=True)
class Plane(Document):
    """A plane that was fitted to a named region, without leaving anything out."""

    name: str
    points: int
    coverage: float | None = None
    """Valid pixels of the lit ones, 0 to 1."""
    rmse_mm: float | None = None
    bow_mm: float | None = None
    p95_mm: float | None = None


@dataclass(frozen=True, kw_only=True)
class Report(Document):
    """`report.json`. Look at `verdict` and `reasons` first; every figure is in `raw`."""

    schema: str
    mode: str
    frames: int
    size: Size
    verdict: str
    """`ok`, `degraded` or `failed`."""
    reasons: tuple[Cause, ...]
    """Empty if and only if the verdict is `ok`."""
    pixels: dict[str, Any] | None = None
    """Counts of pixels by class; `None` where nothing was decoded."""
    notes: tuple[str, ...] = ()
    points: int | None = None
    capture: dict[str, Any] | None = None
    contrast: dict[str, Any] | None = None
    planes: tuple[Plane, ...] = field(default=())
    truth: dict[str, Any] | None = None
    timings_ms: dict[str, Any] | None = None
    calibration: dict[str, Any] | None = None

    @classmethod
    def parse(cls, document: Any) -> Self:  # noqa: ANN401 - anything may be in a file
        """Reads a report; `ProtocolError` where it is none of this version."""
        schema = document.get("schema") if isinstance(document, dict) else None
        if schema != "polscan.report/1":
            raise ProtocolError(f"a report of the schema {schema}, where polscan.report/1 is understood")
        return super().parse(document)
