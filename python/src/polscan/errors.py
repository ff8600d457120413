"""Everything that can go wrong, as exceptions."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .models import CalibrationInfo, Cause, ScanInfo


class PolscanError(Exception):
    """What everything raised here descends from."""


class ConnectionLost(PolscanError):  # noqa: N818 - it says what happened
    """The service did not answer, for as long as the client had patience."""


class WaitTimeout(PolscanError, TimeoutError):  # noqa: N818
    """What was waited for did not come in time. It goes on all the same."""


class ProtocolError(PolscanError):
    """The answer is none of polscan's, or of a version that this client does not understand."""


class HashMismatch(PolscanError):  # noqa: N818
    """A file that was fetched is not the one that the service described, twice in a row."""


class BundleError(PolscanError):
    """A folder is no bundle, or a file in it is damaged."""


class Problem(PolscanError):  # noqa: N818 - the name of RFC 9457
    """The service refused. Carries the problem document of RFC 9457.

    `document` is the whole of it; the service's own members, `errors`, `holder` and `reasons`, are in there.
    """

    def __init__(self, document: Mapping[str, Any]) -> None:
        self.document: dict[str, Any] = dict(document)
        self.type: str = str(document.get("type", "about:blank"))
        """Stable slug, such as `busy`."""
        self.title: str = str(document.get("title", "the request was refused"))
        """The same for all problems of the type."""
        self.status: int = int(document.get("status", 0))
        """HTTP status."""
        self.detail: str = str(document.get("detail", ""))
        """What is wrong here and what to do."""
        super().__init__(f"{self.title}: {self.detail}" if self.detail else self.title)

    @property
    def next_step(self) -> str | None:
        """What to do about it: the part of `detail` after the semicolon, where there is one."""
        _, found, step = self.detail.partition("; ")
        return step if found else None

    def __reduce__(self) -> tuple[type[Problem], tuple[dict[str, Any]]]:
        return (type(self), (self.document,))


class Unauthorized(Problem):
    """A token is needed (401), or the one given does not allow this (403)."""


class NotFound(Problem):
    """There is no such scan, calibration or file (404)."""


class Conflict(Problem):
    """The state of the rig or of the scan does not allow it now (409)."""


class Busy(Conflict):
    """Somebody else has the rig: `holder` says who."""

    @property
    def holder(self) -> dict[str, Any] | None:
        """Who has the rig: `id`, `state`, `created`, `label`, `calibration`."""
        holder = self.document.get("holder")
        return dict(holder) if isinstance(holder, dict) else None


class Invalid(Problem):
    """The request contradicts itself or the rules (400, 413, 415, 422)."""


class QueueFull(Problem):
    """Too many scans wait already (429)."""


class NotReady(Problem):
    """The rig cannot scan (503): `reasons` says why."""

    @property
    def reasons(self) -> list[dict[str, Any]]:
        """Why not: each with `type` and `message`."""
        return list(self.document.get("reasons") or [])


_BY_TYPE: dict[str, type[Problem]] = {"busy": Busy}
_BY_STATUS: dict[int, type[Problem]] = {
    400: Invalid, 401: Unauthorized, 403: Unauthorized, 404: NotFound, 409: Conflict,
    413: Invalid, 415: Invalid, 422: Invalid, 429: QueueFull, 503: NotReady,
}  # fmt: skip


def problem(status: int, body: bytes) -> Problem:
    """The exception for an answer that is an error."""
    try:
        document = json.loads(body)
    except ValueError:
        document = None
    if not isinstance(document, dict):
        text = body[:200].decode(errors="replace").strip()
        document = {"title": f"HTTP status {status}", "detail": text or "an answer without a reason"}
    document["status"] = status
    kind = _BY_TYPE.get(str(document.get("type"))) or _BY_STATUS.get(status, Problem)
    return kind(document)


class ScanFailed(PolscanError):  # noqa: N818
    """A scan came to an end without a result that can be used.

    It is kept, with whatever was captured: `info` says how it ended, `reasons` why and what to do.
    """

    def __init__(self, info: ScanInfo) -> None:
        self.info = info
        self.reasons: tuple[Cause, ...] = info.reasons or ((info.error,) if info.error else ())
        told = "; ".join(reason.message for reason in self.reasons)
        super().__init__(f"scan {info.id} is {info.state}" + (f": {told}" if told else ""))

    def __reduce__(self) -> tuple[type[ScanFailed], tuple[ScanInfo]]:
        return (type(self), (self.info,))


class CalibrationFailed(PolscanError):  # noqa: N818
    """A calibration came to an end without a result."""

    def __init__(self, info: CalibrationInfo) -> None:
        self.info = info
        told = info.error.message if info.error else "; ".join(info.refused)
        super().__init__(
            f"calibration {info.id} ({info.kind}) is {info.state}" + (f": {told}" if told else "")
        )

    def __reduce__(self) -> tuple[type[CalibrationFailed], tuple[CalibrationInfo]]:
        return (type(self), (self.info,))
