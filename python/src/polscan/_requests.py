"""What both clients share: requests that are only values, and waiting that is only arithmetic."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import re
import time
import tomllib
import uuid
from collections.abc import Iterable, Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from typing import IO, Any, Final
from urllib.parse import quote

import httpx

from .errors import HashMismatch, Problem, ProtocolError, WaitTimeout

HEARTBEAT_S = 5.0
"""The service says something at least so often on a stream of events."""

POLL_S = 30.0
"""How long one request waits for a scan; then it is seen whether the service is still there."""


class Keep:
    """What is left as it is."""


KEEP: Final = Keep()


class Patience:
    """How long to go on trying, and how long to rest in between."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._end = math.inf
        self._rest = 0.1
        self.renew()

    def renew(self) -> None:
        """Something came: begin again."""
        self._end = time.monotonic() + self._seconds
        self._rest = 0.1

    def rest(self) -> float | None:
        """Seconds to rest before the next try; nothing where patience has run out."""
        left = self._end - time.monotonic()
        if left <= 0:
            return None
        rest, self._rest = min(self._rest, left), min(self._rest * 2, 2.0)
        return rest


class Deadline:
    """The time until which something is waited for."""

    def __init__(self, seconds: float | None, what: str) -> None:
        self._end = math.inf if seconds is None else time.monotonic() + seconds
        self._told = f"{what} did not come within {seconds} s"

    def left(self, most: float = math.inf) -> float:
        """Seconds that are left, at most `most`; `WaitTimeout` where there are none."""
        left = self._end - time.monotonic()
        if left <= 0:
            raise WaitTimeout(self._told)
        return min(left, most)


def new_key() -> str:
    """A key by which a request that is sent twice happens once."""
    return str(uuid.uuid4())


def token_of_environment() -> str | None:
    """The token in `POLSCAN_TOKEN`, where there is one."""
    return os.environ.get("POLSCAN_TOKEN") or None


def scan_body(
    mode: str | None,
    exposure_us: float | None,
    label: str | None,
    tags: Iterable[str],
    queue: bool,
    repeat: int | None,
) -> dict[str, Any]:
    """What a scan is asked for with; what is not given is the configuration's."""
    given = {"mode": mode, "exposure_us": exposure_us, "label": label, "repeat": repeat}
    body: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    return {**body, "tags": tag_list(tags), "queue": queue}


def board(description: Mapping[str, Any] | str | Path) -> dict[str, Any]:
    """The description of a board, from its file where it is a path."""
    if not isinstance(description, str | Path):
        return dict(description)
    text = Path(description).read_text(encoding="utf-8")
    return dict(json.loads(text) if Path(description).suffix == ".json" else tomllib.loads(text))


def segment(name: str) -> str:
    """A name as a part of an address."""
    return quote(name, safe="")


def tag_list(tags: Iterable[str]) -> list[str]:
    """Tags; a single string is one tag and not its letters."""
    return [tags] if isinstance(tags, str) else list(tags)


def listing(
    state: str | Iterable[str] | None,
    verdict: str | None,
    mode: str | None,
    label: str | None,
    tags: Iterable[str],
    pinned: bool | None,
    since: datetime | None,
    until: datetime | None,
    limit: int,
) -> dict[str, str]:
    """Parameters of a list of scans."""
    states = None if state is None else ",".join(tag_list(state))
    given = {
        "state": states, "verdict": verdict, "mode": mode, "label": label,
        "tag": ",".join(tag_list(tags)) or None,
        "pinned": None if pinned is None else str(pinned).lower(),
        "since": rfc3339(since), "until": rfc3339(until), "limit": str(limit),
    }  # fmt: skip
    return {name: value for name, value in given.items() if value is not None}


def rfc3339(moment: datetime | None) -> str | None:
    """A time as the service takes it; one without a zone is this machine's."""
    return None if moment is None else moment.astimezone(UTC).isoformat().replace("+00:00", "Z")


def document(answer: httpx.Response) -> Any:  # noqa: ANN401 - it is read by who asked
    """The JSON of an answer."""
    try:
        return answer.json()
    except ValueError as error:
        asked = answer.request.url
        raise ProtocolError(f"{asked} did not answer with JSON; is this the address of polscan?") from error


def overloaded(refusal: Problem) -> bool:
    """Whether the same request may be taken in a moment."""
    return refusal.status == 503 and refusal.type == "overloaded"


def inside(folder: Path, name: str) -> Path:
    """The place of a file below a folder; nothing that the service says leads out of it."""
    parts = PurePosixPath(name)
    if parts.is_absolute() or not parts.parts or ".." in parts.parts or "\\" in name or ":" in name:
        raise ProtocolError(
            f"the service names a file {name!r}, which does not lie in the folder of its scan"
        )
    return folder.joinpath(*parts.parts)


def has_hash(path: Path, sha256: str) -> bool:
    """Whether a file is there, with that hash."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest() == sha256


class Download:
    """A file that comes in pieces, perhaps over several connections."""

    def __init__(self, file: IO[bytes], sha256: str | None) -> None:
        self._file = file
        self._digest = hashlib.sha256()
        self.expected = sha256
        self.have = 0

    def headers(self) -> dict[str, str]:
        """Asks for what is missing of the same file, and for bytes as they are."""
        headers = {"Accept-Encoding": "identity"}
        if self.have and self.expected:
            headers |= {"Range": f"bytes={self.have}-", "If-Range": f'"{self.expected}"'}
        return headers

    def begin(self, answer: httpx.Response) -> None:
        """An answer without the wanted range begins the file again."""
        tag = answer.headers.get("etag", "").strip('"')
        if answer.status_code != 206 or not self.expected:
            self.restart()
        if self.expected is None and re.fullmatch("[0-9a-f]{64}", tag):
            self.expected = tag

    def restart(self) -> None:
        """Forgets what came."""
        self._file.seek(0)
        self._file.truncate()
        self._digest = hashlib.sha256()
        self.have = 0

    def write(self, chunk: bytes) -> None:
        """Takes the next bytes."""
        self._file.write(chunk)
        self._digest.update(chunk)
        self.have += len(chunk)

    def right(self) -> bool:
        """Whether what came is what was described."""
        return self.expected is None or self._digest.hexdigest() == self.expected

    def wrong(self, name: str) -> HashMismatch:
        """Says that it is not."""
        told = f"{self.have} bytes with the SHA-256 {self._digest.hexdigest()} instead of {self.expected}"
        return HashMismatch(f"{name} came damaged twice: {told}; check network and the disk of the service")


@contextlib.contextmanager
def written_whole(path: Path) -> Iterator[IO[bytes]]:
    """A file that is there in full or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{uuid.uuid4().hex}.part")
    try:
        with part.open("w+b") as file:
            yield file
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
