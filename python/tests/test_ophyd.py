"""The device, in plans of a RunEngine."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import bluesky.plan_stubs as bps
import bluesky.plans as bp
import pytest
from bluesky.preprocessors import run_decorator, stage_decorator
from bluesky.run_engine import RunEngine
from bluesky.utils import FailedStatus
from ophyd_async.core import init_devices
from service import Service

import polscan
from polscan import Scanner
from polscan.ophyd import PolscanDevice

Documents = list[tuple[str, dict[str, Any]]]


@pytest.fixture(scope="module")
def engine() -> Iterator[RunEngine]:
    engine = RunEngine({})
    yield engine
    engine.loop.call_soon_threadsafe(engine.loop.stop)


def device(engine: RunEngine, url: str, **arguments: Any) -> PolscanDevice:  # noqa: ANN401
    assert engine is not None
    with init_devices():
        # Named after the variable.
        scanner = PolscanDevice(url, **arguments)
    return scanner  # noqa: RET504


def run(engine: RunEngine, plan: Any) -> Documents:  # noqa: ANN401
    documents: Documents = []
    engine(plan, lambda name, document: documents.append((name, dict(document))))
    return documents


def only(documents: Documents, kind: str) -> dict[str, Any]:
    (found,) = [document for name, document in documents if name == kind]
    return found


def test_a_count_makes_event_documents(engine: RunEngine, service: Service, tmp_path: Path) -> None:
    scanner = device(engine, service.url, folder=tmp_path, tags=("beamline",))
    documents = run(engine, bp.count([scanner], num=2))
    events = [document["data"] for name, document in documents if name == "event"]
    assert len({event["scanner-scan_id"] for event in events}) == 2
    for event in events:
        assert event["scanner-verdict"] == "ok"
        cloud = polscan.read_cloud(event["scanner-cloud"])
        assert len(cloud) == event["scanner-points"]
        assert polscan.open_bundle(event["scanner-bundle"]).id == event["scanner-scan_id"]
    descriptor = only(documents, "descriptor")
    assert descriptor["hints"]["scanner"]["fields"] == ["scanner-points"]
    assert descriptor["configuration"]["scanner"]["data"]["scanner-version"]
    assert only(documents, "stop")["exit_status"] == "success"
    with Scanner(service.url) as client:
        ids = [one.id for one in client.scans(tags="beamline")]
    assert ids == [event["scanner-scan_id"] for event in reversed(events)]


def test_the_trigger_is_done_when_the_object_may_move(engine: RunEngine, slow: Service) -> None:
    scanner = device(engine, slow.url)
    seen: dict[str, Any] = {}

    @stage_decorator([scanner])
    @run_decorator()
    def plan() -> Any:  # noqa: ANN401
        start = time.monotonic()
        yield from bps.trigger(scanner, wait=True)
        seen["trigger_s"] = time.monotonic() - start
        with Scanner(slow.url) as client:
            seen["scan"] = next(iter(client.scans())).info
        yield from bps.create()
        yield from bps.read(scanner)
        yield from bps.save()

    documents = run(engine, plan())
    # The capture takes its time, and what is read has waited for the rest.
    assert seen["trigger_s"] > 1
    assert seen["scan"].acquired is not None
    data = only(documents, "event")["data"]
    assert (data["scanner-scan_id"], data["scanner-state"]) == (seen["scan"].id, "done")
    # Without a folder the results are where the service has them.
    assert data["scanner-cloud"] == f"{slow.url}/v1/scans/{seen['scan'].id}/cloud.ply"


def test_exposure_and_mode_are_set_by_plans(engine: RunEngine, service: Service) -> None:
    scanner = device(engine, service.url)

    def plan() -> Any:  # noqa: ANN401
        yield from bps.mv(scanner.exposure_us, 1200.0, scanner.mode, "fast")
        yield from bp.count([scanner])

    documents = run(engine, plan())
    configuration = only(documents, "descriptor")["configuration"]["scanner"]["data"]
    assert configuration["scanner-exposure_us"] == 1200
    with Scanner(service.url) as client:
        info = client.get(only(documents, "event")["data"]["scanner-scan_id"]).info
    assert (info.exposure_us, info.mode) == (1200, "fast")


def test_a_failed_verdict_is_read_with_its_reasons(engine: RunEngine, service: Service) -> None:
    scanner = device(engine, service.url)

    def plan() -> Any:  # noqa: ANN401
        yield from bps.mv(scanner.exposure_us, 1.0)
        yield from bp.count([scanner])

    data = only(run(engine, plan()), "event")["data"]
    assert (data["scanner-state"], data["scanner-verdict"], data["scanner-points"]) == ("failed", "failed", 0)
    assert "lens cap" in data["scanner-reasons"]


def test_a_scan_that_is_refused_fails_the_plan(engine: RunEngine, service: Service) -> None:
    scanner = device(engine, service.url)

    def plan() -> Any:  # noqa: ANN401
        yield from bps.mv(scanner.mode, "colour")
        yield from bp.count([scanner])

    with pytest.raises(FailedStatus) as failed:
        run(engine, plan())
    assert isinstance(failed.value.__cause__, polscan.Invalid)


def test_a_plan_that_gives_up_stops_its_scan(engine: RunEngine, slow: Service) -> None:
    scanner = device(engine, slow.url, tags=("given up",))

    @stage_decorator([scanner])
    def plan() -> Any:  # noqa: ANN401
        yield from bps.trigger(scanner, wait=False)
        yield from bps.sleep(0.5)
        raise RuntimeError("the beam is lost")

    with pytest.raises(RuntimeError, match="the beam is lost"):
        run(engine, plan())
    with Scanner(slow.url) as client:
        (scan,) = client.scans(tags="given up")
        assert scan.done(30, check=False).state == "cancelled"


def test_a_service_that_is_not_there_does_not_connect(engine: RunEngine) -> None:
    with pytest.raises(Exception, match="polscan serve"):
        device(engine, "http://127.0.0.1:9", patience_s=0.2)


def test_a_mocked_device_asks_nobody(engine: RunEngine) -> None:
    with init_devices(mock=True):
        scanner = PolscanDevice("http://127.0.0.1:9", patience_s=0.2)
    data = only(run(engine, bp.count([scanner])), "event")["data"]
    assert data["scanner-scan_id"] == ""
