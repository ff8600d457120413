"""Which scans a viewer is shown, without a viewer."""

from __future__ import annotations

import importlib
import sys
import types
from typing import Any

import pytest

from polscan import NotFound
from polscan.models import Event, ScanInfo


class Scanner:
    """A service whose scans end, are deleted, and whose events are forgotten, as a test wants it."""

    def __init__(self, ended: list[str], running: list[str], events: list[Event]) -> None:
        self.ended, self.running, self._events = ended, running, events

    def status(self) -> Any:  # noqa: ANN401
        return types.SimpleNamespace(revision=7)

    def scans(self, state: Any = None) -> Any:  # noqa: ANN401
        ids = self.running if state else sorted(self.ended + self.running, reverse=True)
        for id_ in ids:
            yield types.SimpleNamespace(id=id_, info=types.SimpleNamespace(ended=id_ in self.ended))

    def get(self, id_: str) -> Any:  # noqa: ANN401
        if id_ not in self.ended:
            raise NotFound({"status": 404, "detail": "unknown"})
        return types.SimpleNamespace(id=id_)

    def events(self, after: int) -> Any:  # noqa: ANN401
        assert after == 7
        yield from self._events


def gap() -> Event:
    return Event("gap", None, {})


def end(id_: str, monkeypatch: pytest.MonkeyPatch) -> Event:
    """An event of a scan that has ended."""
    event = Event("scan", 8, {"id": id_})
    info = types.SimpleNamespace(id=id_, ended=True)
    known = ScanInfo.parse

    def parse(document: Any) -> Any:  # noqa: ANN401
        return info if document is event.data else known(document)

    monkeypatch.setattr(ScanInfo, "parse", parse)
    return event


@pytest.fixture
def ended(monkeypatch: pytest.MonkeyPatch) -> Any:  # noqa: ANN401
    """The function under test, where the viewer's library may be missing."""
    if importlib.util.find_spec("rerun") is None:
        monkeypatch.setitem(sys.modules, "rerun", types.ModuleType("rerun"))
    module = importlib.import_module("polscan.rerun")

    def shown(scanner: Scanner, last: int = 1) -> list[str]:
        return [scan.id for scan in module._ended(scanner, last)]

    return shown


def test_a_scan_that_was_deleted_is_left_out(ended: Any, monkeypatch: pytest.MonkeyPatch) -> None:  # noqa: ANN401
    scanner = Scanner(["a", "b"], [], [end("c", monkeypatch)])
    assert ended(scanner, 2) == ["a", "b"]


def test_what_ended_while_events_were_forgotten_is_shown(ended: Any, monkeypatch: pytest.MonkeyPatch) -> None:  # noqa: ANN401
    scanner = Scanner(["a", "b", "d"], ["c"], [])

    def events(after: int) -> Any:  # noqa: ANN401
        assert after == 7
        scanner.ended += ["c", "e"]
        scanner.running = []
        yield gap()
        yield gap()
        yield end("e", monkeypatch)

    monkeypatch.setattr(scanner, "events", events)
    assert ended(scanner) == ["d", "c", "e"]
