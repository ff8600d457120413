"""What goes wrong says so, by name and with what to do."""

from __future__ import annotations

import json
import pickle
import ssl
import subprocess
import threading
import time
from pathlib import Path

import httpx
import pytest
import trustme
from conftest import MakeService
from proxy import Proxy
from service import Service, token

import polscan
from polscan import Scanner


def test_a_failed_scan_says_why_and_keeps_its_files(scanner: Scanner, tmp_path: Path) -> None:
    scan = scanner.scan(exposure_us=1)
    with pytest.raises(polscan.ScanFailed) as failed:
        scan.cloud()
    assert failed.value.info.state == "failed"
    assert failed.value.reasons[0].type == "nothing-lit"
    assert "lens cap" in str(failed.value)
    # The same story as the report's, and what was captured is there.
    report = scan.report()
    assert report.verdict == "failed"
    assert [reason.type for reason in report.reasons] == [reason.type for reason in failed.value.reasons]
    assert report.reasons[0].evidence is not None
    assert scan.frames().shape[0] == report.frames
    assert len(polscan.read_cloud(scan.fetch("cloud.ply", tmp_path))) == 0
    assert str(pickle.loads(pickle.dumps(failed.value))) == str(failed.value)  # noqa: S301 - just made


BUMPED = """
[[sim.faults]]
kind = "bumped-object"
at_ms = 1500.0
object = "black"
by_mm = [4.0, 0.0, 0.0]
"""


@pytest.mark.parametrize(
    ("fault", "exposure_us", "diagnosis", "shown"),
    [(BUMPED, None, "motion", "maps/worst-pair.png"), ("", 1.0, "nothing-lit", "maps/residual.png")],
    ids=["while-it-is-captured", "when-it-is-decoded"],
)
def test_a_script_and_curl_are_told_the_same_of_a_failed_scan(
    make_service: MakeService, fault: str, exposure_us: float | None, diagnosis: str, shown: str
) -> None:
    service = make_service()
    service.config.write_text(service.config.read_text() + fault)
    service.start()
    with Scanner(service.url) as scanner:
        scanner.wait_ready(30)
        scan = scanner.scan(exposure_us=exposure_us)
        with pytest.raises(polscan.ScanFailed) as failed:
            scan.cloud()
        picture = scan.evidence()

    def curl(path: str) -> bytes:
        command = ["curl", "-sS", "--fail", f"{service.url}/v1/scans/{scan.id}{path}"]
        return subprocess.run(command, check=True, capture_output=True).stdout

    told = json.loads(curl(""))
    assert told["reasons"][0]["type"] == diagnosis
    assert [reason.raw for reason in failed.value.reasons] == told["reasons"]
    report = json.loads(curl("/report.json"))
    assert [reason["message"] for reason in report["reasons"]] == [one["message"] for one in told["reasons"]]
    assert report["reasons"][0]["evidence"]
    # What a person reads has the same words, in lines.
    words = " ".join(curl("/summary.txt").decode().split())
    assert " ".join(told["reasons"][0]["message"].split()) in words
    assert picture == curl(f"/{shown}")


def test_a_busy_rig_names_who_has_it(bench: Scanner) -> None:
    first = bench.scan(mode="fast", label="mine")
    with pytest.raises(polscan.Busy) as busy:
        bench.scan(mode="fast")
    assert busy.value.status == 409
    assert busy.value.holder is not None
    assert (busy.value.holder["id"], busy.value.holder["label"]) == (first.id, "mine")
    assert busy.value.next_step is not None
    assert "queue" in busy.value.next_step
    assert pickle.loads(pickle.dumps(busy.value)).document == busy.value.document  # noqa: S301 - just made


def test_a_full_queue_is_refused(bench: Scanner) -> None:
    for _ in range(3):
        bench.scan(mode="fast", queue=True)
    with pytest.raises(polscan.QueueFull):
        bench.scan(mode="fast", queue=True)


def test_a_cancelled_scan_is_cancelled_for_who_waits(bench: Scanner) -> None:
    scan = bench.scan(mode="pse")
    scan.cancel()
    with pytest.raises(polscan.ScanFailed, match="is cancelled"):
        scan.done(30)
    with pytest.raises(polscan.ScanFailed, match="is cancelled"):
        scan.acquired(30)
    assert scan.acquired(check=False).state == "cancelled"
    with pytest.raises(polscan.ScanFailed, match="is cancelled"):
        scan.cloud()


def test_the_report_of_a_scan_that_was_given_up_is_typed(bench: Scanner) -> None:
    scan = bench.scan(mode="pse")
    while not (progress := scan.refresh().progress) or progress.frames < 2:
        time.sleep(0.02)
    scan.cancel()
    scan.done(30, check=False)
    report = scan.report()
    assert (report.verdict, report.reasons[0].type) == ("failed", "cancelled")
    assert (report.pixels, report.points) == (None, None)
    assert scan.frames().shape[0] == report.frames >= 2


def test_previews_end_with_their_connection(service: Service, scanner: Scanner) -> None:
    with Scanner("http://127.0.0.1:1") as nobody, pytest.raises(polscan.ConnectionLost):
        next(nobody.previews())
    scanner.wait_ready(30)
    with Proxy(service.address, b"preview.mjpeg", []) as proxy, Scanner(proxy.url) as torn:
        pictures = torn.previews()
        assert next(pictures).jpeg[:2] == b"\xff\xd8"
        proxy.cut_all()
        assert len(list(pictures)) < 100


def test_a_file_that_does_not_exist_yet_is_refused(bench: Scanner, tmp_path: Path) -> None:
    scan = bench.scan(mode="fast")
    with pytest.raises(polscan.Conflict):
        scan.fetch("cloud.ply", tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_what_is_not_there_is_not_found(scanner: Scanner, tmp_path: Path) -> None:
    with pytest.raises(polscan.NotFound) as refused:
        scanner.get("nobody")
    assert refused.value.type == "unknown-scan"
    assert refused.value.next_step == "GET /v1/scans lists them"
    scan = scanner.scan(mode="fast")
    scan.done(30)
    with pytest.raises(polscan.NotFound):
        scan.fetch("nothing.bin", tmp_path)
    with pytest.raises(polscan.NotFound):
        scanner.calibration("nobody")


def test_a_request_against_the_rules_is_refused(scanner: Scanner) -> None:
    with pytest.raises(polscan.Invalid) as refused:
        scanner.scan(mode="colour")
    assert refused.value.document["errors"]
    with pytest.raises(polscan.Invalid):
        scanner.scan(exposure_us=-1)


def test_a_rig_that_cannot_scan_says_why(make_service: MakeService, tmp_path: Path) -> None:
    service = make_service(("store.min_free_gib", "1e6"), folder=tmp_path).start(ready=False)
    with Scanner(service.url) as scanner:
        with pytest.raises(polscan.WaitTimeout, match="a rig that can scan"):
            scanner.wait_ready(1)
        said = scanner.readiness()
        assert not said.ready
        assert "storage" in [reason.type for reason in said.reasons]
        with pytest.raises(polscan.NotReady) as refused:
            scanner.scan()
        assert "storage" in [reason["type"] for reason in refused.value.reasons]


def test_a_service_that_is_not_there_is_said_to_be(tmp_path: Path) -> None:
    start = time.monotonic()
    with Scanner("http://127.0.0.1:9", patience_s=0.3) as scanner:
        with pytest.raises(polscan.ConnectionLost, match="polscan serve"):
            scanner.scan()
        with pytest.raises(polscan.ConnectionLost):
            next(scanner.events(after=0))
    assert time.monotonic() - start < 5


def test_an_answer_that_is_not_polscans_is_said_to_be() -> None:
    page = httpx.MockTransport(lambda _: httpx.Response(200, html="<h1>router</h1>"))
    with (
        Scanner(transport=page) as scanner,
        pytest.raises(polscan.ProtocolError, match="is this the address"),
    ):
        scanner.status()
    other = httpx.MockTransport(lambda _: httpx.Response(200, json={"id": 7}))
    with Scanner(transport=other) as scanner, pytest.raises(polscan.ProtocolError, match="ScanInfo"):
        scanner.get("x")
    broken = httpx.MockTransport(lambda _: httpx.Response(502, html="<h1>bad gateway</h1>"))
    with Scanner(transport=broken) as scanner, pytest.raises(polscan.Problem, match="bad gateway") as refused:
        scanner.status()
    assert refused.value.status == 502


@pytest.mark.parametrize("name", ["../x", "/etc/x", "a/../../x", "C:x", "a\\b", ""])
def test_no_file_is_written_outside_of_its_folder(name: str, tmp_path: Path) -> None:
    artifacts = [
        {"name": one, "href": "/f", "bytes": 0, "sha256": "0" * 64} for one in (name, "manifest.json")
    ]
    info = {
        "id": "x", "state": "done", "revision": 1, "mode": "pse", "created": "2026-01-01T00:00:00Z",
        "artifacts": artifacts,
    }  # fmt: skip
    with Scanner(transport=httpx.MockTransport(lambda _: httpx.Response(200, json=info))) as scanner:
        scan = scanner.get("x")
        with pytest.raises(polscan.ProtocolError, match="does not lie in the folder"):
            scan.download(tmp_path / "inner")
    assert list(tmp_path.iterdir()) == []


def test_tokens_reach_as_far_as_their_scope(
    make_service: MakeService, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tokens = {scope: token(tmp_path, scope) for scope in ("read", "scan", "admin")}
    service = make_service(("api.tokens", '"tokens"'), folder=tmp_path)
    service.start()
    for wrong in (None, "polscan_" + "0" * 64):
        with Scanner(service.url, token=wrong) as scanner, pytest.raises(polscan.Unauthorized) as refused:
            next(scanner.events(after=0))
        assert refused.value.status == 401
    with Scanner(service.url, token=tokens["read"]) as scanner:
        assert scanner.status().ready
        with pytest.raises(polscan.Unauthorized) as refused:
            scanner.scan()
        assert (refused.value.status, refused.value.type) == (403, "insufficient-scope")
    monkeypatch.setenv("POLSCAN_TOKEN", tokens["scan"])
    with Scanner(service.url) as scanner:
        assert len(scanner.scan(mode="fast").cloud()) > 0


def test_certificates_are_verified_as_it_is_said(make_service: MakeService, tmp_path: Path) -> None:
    authority = trustme.CA()
    server = authority.issue_cert("127.0.0.1")
    server.private_key_and_cert_chain_pem.write_to_path(str(tmp_path / "server.pem"))
    authority.cert_pem.write_to_path(str(tmp_path / "authority.pem"))
    service = make_service(
        ("api.tls_certificate", '"server.pem"'), ("api.tls_key", '"server.pem"'), folder=tmp_path
    )
    service.scheme = "https"
    service.start()
    with (
        Scanner(service.url, patience_s=0.2) as scanner,
        pytest.raises(polscan.ConnectionLost, match=r"(?i)certificate"),
    ):
        scanner.status()
    context = ssl.create_default_context(cafile=str(tmp_path / "authority.pem"))
    for verify in (str(tmp_path / "authority.pem"), tmp_path / "authority.pem", context, False):
        with Scanner(service.url, verify=verify) as scanner:
            assert scanner.status().ready
    with Scanner(service.url, verify=tmp_path / "authority.pem") as scanner:
        assert len(scanner.scan(mode="fast").cloud()) > 0


def test_a_damaged_bundle_is_told_by_name(scanner: Scanner, tmp_path: Path) -> None:
    bundle = scanner.scan(mode="fast").download(tmp_path / "scan")
    with pytest.raises(polscan.BundleError, match=r"manifest\.json"):
        polscan.open_bundle(tmp_path)
    (bundle.path / "maps" / "depth.png").unlink()
    cloud = (bundle.path / "cloud.ply").read_bytes()
    (bundle.path / "cloud.ply").write_bytes(cloud[:-1])
    (bundle.path / "maps.npz").write_bytes(b"no archive")
    with pytest.raises(polscan.BundleError) as damaged:
        bundle.check()
    for name in ("maps/depth.png is missing", "cloud.ply has", "maps.npz has"):
        assert name in str(damaged.value)
    with pytest.raises(polscan.BundleError, match="bytes follow"):
        bundle.cloud()
    with pytest.raises(polscan.BundleError, match=r"cannot read .*maps\.npz"):
        bundle.maps()
    manifest = json.loads((bundle.path / "manifest.json").read_bytes())
    (bundle.path / "manifest.json").write_text(json.dumps({**manifest, "schema": "polscan.bundle/2"}))
    with pytest.raises(polscan.BundleError, match="another version"):
        polscan.open_bundle(bundle.path)


@pytest.mark.parametrize(
    ("ply", "told"),
    [
        (b"", "no PLY"),
        (b"ply\nformat binary_little_endian 1.0\n", "within its header"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n", "format ascii"),
        (b"ply\nformat binary_little_endian 1.0\nelement face 1\nend_header\n", "more than points"),
        (b"ply\nelement vertex 1\nproperty list uchar int i\nend_header\n", "not understood"),
        (b"ply\nelement vertex 2\nproperty float x\nend_header\n1234", "2 points of 4 bytes, but 4"),
    ],
)
def test_what_is_no_cloud_is_told_by_what_is_wrong(ply: bytes, told: str, tmp_path: Path) -> None:
    (tmp_path / "cloud.ply").write_bytes(ply)
    with pytest.raises(polscan.BundleError, match=told):
        polscan.read_cloud(tmp_path / "cloud.ply")


def test_compressed_maps_are_read_as_well(tmp_path: Path) -> None:
    import numpy as np

    depth = np.arange(12, dtype="<f4").reshape(3, 4)
    np.savez_compressed(tmp_path / "maps.npz", depth=depth)
    np.testing.assert_array_equal(polscan.Maps(tmp_path / "maps.npz")["depth"], depth)


# The network


def test_a_torn_download_goes_on_where_it_was(service: Service, tmp_path: Path) -> None:
    with Scanner(service.url) as scanner:
        scan = scanner.scan(mode="pse")
        expected = scan.cloud().tobytes()
    with (
        Proxy(service.address, b"cloud.ply HTTP", [100, 50_000, 400_000]) as proxy,
        Scanner(proxy.url) as scanner,
    ):
        path = scanner.get(scan.id).fetch("cloud.ply", tmp_path)
        assert path.read_bytes().endswith(expected)
        assert len(proxy.requests) == 4
        ranges = [b"range: bytes=" in request.lower() for request in proxy.requests]
        assert ranges == [False, False, True, True]
    assert [one.name for one in tmp_path.iterdir()] == ["cloud.ply"]


def test_a_damaged_download_is_never_handed_over(service: Service, tmp_path: Path) -> None:
    with Scanner(service.url) as scanner:
        scan = scanner.scan(mode="fast")
        scan.done(30)
    damaged = lambda data: data.replace(b"standard deviation", b"standard deviatioN")  # noqa: E731
    with Proxy(service.address, b"cloud.ply HTTP", [], damaged) as proxy, Scanner(proxy.url) as scanner:
        with pytest.raises(polscan.HashMismatch, match="damaged twice"):
            scanner.get(scan.id).fetch("cloud.ply", tmp_path)
        assert len(proxy.requests) == 2
    assert list(tmp_path.iterdir()) == []


def test_a_download_that_cannot_go_on_leaves_nothing(service: Service, tmp_path: Path) -> None:
    with Scanner(service.url) as scanner:
        scan = scanner.scan(mode="fast")
        scan.done(30)
    with (
        Proxy(service.address, b"cloud.ply HTTP", [0] * 100) as proxy,
        Scanner(proxy.url, patience_s=0.5) as scanner,
        pytest.raises(polscan.ConnectionLost),
    ):
        scanner.get(scan.id).fetch("cloud.ply", tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_request_whose_answer_is_lost_happens_once(service: Service) -> None:
    mark = "answer-lost"
    with Proxy(service.address, b"POST /v1/scans", [0, 0]) as proxy, Scanner(proxy.url) as scanner:
        scan = scanner.scan(mode="fast", tags=mark, queue=True)
        scan.done(30)
        assert len(proxy.requests) == 3
        assert [one.id for one in scanner.scans(tags=mark)] == [scan.id]
    with Proxy(service.address, b"DELETE /v1/scans", [0]) as proxy, Scanner(proxy.url) as scanner:
        scanner.get(scan.id).delete()
        assert len(proxy.requests) == 2
        assert list(scanner.scans(tags=mark)) == []


def test_a_calibration_whose_answer_is_lost_is_not_begun_twice(service: Service) -> None:
    with (
        Proxy(service.address, b"POST /v1/calibrations", [0, 0]) as proxy,
        Scanner(proxy.url, patience_s=5) as scanner,
    ):
        before = len(scanner.calibrations().runs)
        with pytest.raises(polscan.ConnectionLost):
            scanner.calibrate_noise()
        assert len(proxy.requests) == 1
        # The service may answer a request before its lists tell of it.
        end = time.monotonic() + 10
        while len(runs := scanner.calibrations().runs) == before and time.monotonic() < end:
            time.sleep(0.05)
        assert len(runs) == before + 1
        scanner.calibration(runs[0].id).done(30)


def test_events_survive_broken_connections(service: Service) -> None:
    with (
        Proxy(service.address, b"GET /v1/events", [300, 1000, 2000, 300]) as proxy,
        Scanner(proxy.url) as scanner,
    ):
        after = scanner.status().revision
        scan = scanner.scan(mode="fast", queue=True)
        last = scan.done(30).revision
        numbers = []
        for event in scanner.events(after=after, timeout_s=30):
            numbers.append(event.id)
            if event.id == last:
                break
        assert numbers == list(range(after + 1, last + 1))
        assert len(proxy.requests) == 5


def test_a_service_that_dies_and_comes_back_is_waited_for(make_service: MakeService) -> None:
    service = make_service(("sim.pacing", '"real-time"'), ("store.quota_gib", "1.0")).start()
    with Scanner(service.url, patience_s=60) as scanner:
        after = scanner.status().revision
        scan = scanner.scan(mode="pse")
        events = scanner.events(after=after, timeout_s=60)
        numbers = [next(events).id for _ in range(8)]
        service.kill()
        service.start()
        # Whoever waited is told what became of it, and nothing is rerun by itself.
        with pytest.raises(polscan.ScanFailed, match="is interrupted"):
            scan.done(60)
        last = scan.info.revision
        for event in events:
            numbers.append(event.id)
            if event.id is not None and event.id >= last:
                break
        events.close()
        assert None not in numbers
        assert numbers == sorted(set(numbers), key=lambda number: number or 0)
        assert numbers[0] == after + 1
        assert len(scanner.scan(mode="fast").cloud()) > 0


def test_a_service_that_is_restarted_in_good_order_is_waited_for(make_service: MakeService) -> None:
    service = make_service(("sim.pacing", '"real-time"')).start()
    ended: list[str] = []
    with Scanner(service.url, patience_s=60) as scanner:
        scan = scanner.scan(mode="fast")
        waiting = threading.Thread(target=lambda: ended.append(scan.done(60, check=False).state))
        waiting.start()
        service.stop()
        service.start()
        waiting.join()
        # A service that is asked to end lets the running scan come to its own end first.
        assert ended == ["done"]


def test_a_wait_that_breaks_off_goes_on(slow: Service) -> None:
    with Proxy(slow.address, b"wait=done", []) as proxy, Scanner(proxy.url) as scanner:
        scan = scanner.scan(mode="pse", queue=True)
        breaks = [threading.Timer(delay, proxy.cut_all) for delay in (0.5, 1.0)]
        for one in breaks:
            one.start()
        assert scan.done(30).state == "done"
        for one in breaks:
            one.join()
        assert len(proxy.requests) == 3


def test_a_client_without_patience_says_that_the_service_went_away(make_service: MakeService) -> None:
    service = make_service(("sim.pacing", '"real-time"')).start()
    with Scanner(service.url, patience_s=0.3) as scanner:
        scan = scanner.scan(mode="pse")
        service.kill()
        with pytest.raises(polscan.ConnectionLost):
            scan.done(30)
