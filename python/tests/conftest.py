from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from service import Service

from polscan import Scanner

MakeService = Callable[..., Service]


@pytest.fixture(scope="session")
def make_service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[MakeService]:
    """Makes services that are not started yet, and ends them all."""
    made: list[Service] = []

    def make(*changes: tuple[str, str], folder: Path | None = None) -> Service:
        service = Service(folder or tmp_path_factory.mktemp("service"), changes)
        made.append(service)
        return service

    yield make
    for service in made:
        service.kill()


@pytest.fixture(scope="session")
def service(make_service: MakeService) -> Service:
    """A service that computes as fast as it can, for tests that leave it as it is."""
    return make_service().start()


@pytest.fixture(scope="session")
def slow(make_service: MakeService) -> Service:
    """A service at the pace of a real rig: a capture takes about two seconds."""
    return make_service(("sim.pacing", '"real-time"'), ("scan.queue_capacity", "2")).start()


@pytest.fixture
def scanner(service: Service) -> Iterator[Scanner]:
    with Scanner(service.url) as scanner:
        yield scanner


@pytest.fixture
def bench(slow: Service) -> Iterator[Scanner]:
    """A client of the slow service, which leaves it idle."""
    with Scanner(slow.url) as scanner:
        yield scanner
        for scan in scanner.scans(state=["queued", "projecting"]):
            scan.cancel()
            scan.done(30, check=False)
