"""Reading streams: pure, so that the synchronous and the asynchronous client share it."""

from __future__ import annotations

import json

from .errors import ProtocolError
from .models import Event


class EventParser:
    """Bytes of a stream of server-sent events become events.

    Lines end where the service ends them. What Python takes for an end of a line besides, such as U+2028, may be part
    of a label.
    """

    def __init__(self) -> None:
        self._rest = b""
        self._id: int | None = None
        self._kind = "message"
        self._data: list[str] = []

    def feed(self, chunk: bytes) -> list[Event]:
        """Takes bytes; the events that they complete."""
        *lines, self._rest = (self._rest + chunk).split(b"\n")
        events = (self._line(line.removesuffix(b"\r").decode(errors="replace")) for line in lines)
        return [event for event in events if event]

    def _line(self, line: str) -> Event | None:
        if line:
            name, _, value = line.partition(":")
            value = value.removeprefix(" ")
            if name == "data":
                self._data.append(value)
            elif name == "event":
                self._kind = value
            elif name == "id":
                if not value.isdecimal():
                    raise ProtocolError(f"an event has the number {value!r}")
                self._id = int(value)
            return None
        event = None
        if self._data:
            try:
                data = json.loads("\n".join(self._data))
            except ValueError as error:
                raise ProtocolError(f"cannot read the data of an event: {error}") from error
            event = Event(self._kind, self._id, data)
        self._id, self._kind, self._data = None, "message", []
        return event


class PartParser:
    """Bytes of a `multipart/x-mixed-replace` with lengths become parts."""

    def __init__(self) -> None:
        self._have = b""

    def feed(self, chunk: bytes) -> list[tuple[dict[str, str], bytes]]:
        """Takes bytes; the parts that they complete, each as headers in lower case and body."""
        self._have += chunk
        parts = []
        while (end := self._have.find(b"\r\n\r\n")) >= 0:
            lines = self._have[:end].decode("latin-1").split("\r\n")
            pairs = (line.partition(":") for line in lines if ":" in line)
            headers = {name.strip().lower(): value.strip() for name, _, value in pairs}
            try:
                length = int(headers["content-length"])
            except (KeyError, ValueError) as error:
                raise ProtocolError("a picture of the stream does not say how long it is") from error
            if len(self._have) < end + 4 + length:
                break
            parts.append((headers, self._have[end + 4 : end + 4 + length]))
            self._have = self._have[end + 4 + length :]
        return parts
