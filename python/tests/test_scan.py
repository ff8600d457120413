"""Scans that succeed, and everything that is done with them."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import json
import threading
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from service import Service

import polscan
from polscan import AsyncScanner, Scanner


def test_a_cloud_is_what_the_service_wrote(service: Service, scanner: Scanner) -> None:
    scan = scanner.scan(mode="pse", exposure_us=1500, label="first")
    cloud = scan.cloud()
    assert scan.info.exposure_us == 1500
    assert scan.info.verdict == "ok"
    assert cloud.dtype == polscan.CLOUD
    assert len(cloud) == scan.info.points
    assert len(cloud) > 20_000
    # Read by other means: the header says how long a point is, and the rest is points.
    data = (service.store / scan.id / "cloud.ply").read_bytes()
    assert data.endswith(np.ascontiguousarray(cloud).tobytes())
    assert 700 < np.median(cloud["z"]) < 1300
    assert (cloud["sigma_z"] > 0).all()


def test_a_sample_is_a_part_of_the_cloud(scanner: Scanner) -> None:
    scan = scanner.scan(mode="pse")
    cloud = np.ascontiguousarray(scan.cloud())
    few = scan.sample(500)
    assert (len(few), few.dtype) == (500, polscan.CLOUD)
    # In the order of the cloud, and none of them twice.
    places = {point.tobytes(): place for place, point in enumerate(cloud)}
    found = [places[point.tobytes()] for point in few]
    assert found == sorted(set(found))
    # From each stretch of it: the gap between two is never that of three.
    assert np.diff(found).max() < 3 * len(cloud) / 500
    assert len(scan.sample(200_000)) == min(len(cloud), 200_000)
    with pytest.raises(polscan.Invalid, match="points"):
        scan.sample(0)
    with pytest.raises(polscan.ScanFailed):
        scanner.scan(exposure_us=1).sample()


def test_a_cloud_may_be_changed_and_its_file_stays_as_it_is(scanner: Scanner, tmp_path: Path) -> None:
    scan = scanner.scan(mode="fast")
    cloud = scan.cloud(tmp_path / "part.ply")
    before = (tmp_path / "part.ply").read_bytes()
    assert isinstance(cloud, np.memmap)
    cloud["z"] += 1000
    assert (tmp_path / "part.ply").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["part.ply"]


def test_maps_and_frames_agree_with_numpy(service: Service, scanner: Scanner) -> None:
    scan = scanner.scan(mode="pse")
    maps = scan.maps()
    folder = service.store / scan.id
    with np.load(folder / "maps.npz") as expected:
        assert set(maps) == set(expected.files)
        for name in expected.files:
            assert isinstance(maps[name], np.memmap)
            np.testing.assert_array_equal(maps[name], expected[name])
    np.testing.assert_array_equal(np.isnan(maps["depth"]), ~maps["mask"])
    np.testing.assert_array_equal(scan.frames(), np.load(folder / "frames.npy"))


def test_a_report_is_typed_and_whole(service: Service, scanner: Scanner) -> None:
    scan = scanner.scan()
    report = scan.report()
    written = json.loads((service.store / scan.id / "report.json").read_bytes())
    assert report.raw == written
    assert (report.verdict, report.reasons) == ("ok", ())
    assert (report.size.width, report.size.height) == (200, 150)
    assert [plane.name for plane in report.planes] == ["white", "black"]
    assert report.planes[0].rmse_mm == written["planes"][0]["rmse_mm"]
    assert "ok" in scan.summary()


def test_a_bundle_is_fetched_checked_and_opened_without_a_service(scanner: Scanner, tmp_path: Path) -> None:
    scan = scanner.scan(mode="fast")
    bundle = scan.download(tmp_path / "copy")
    bundle.check()
    assert bundle.id == scan.id
    offline = polscan.open_bundle(tmp_path / "copy")
    np.testing.assert_array_equal(offline.cloud(), scan.cloud())
    assert offline.report().verdict == scan.info.verdict
    assert set(offline.truth()) == {"column", "row", "depth", "object"}
    assert (offline.path / "maps" / "depth.png").read_bytes() == scan.read("maps/depth.png")
    # What is there is not fetched again, and what was damaged is.
    report = tmp_path / "copy" / "report.json"
    kept = (tmp_path / "copy" / "cloud.ply").stat().st_ino
    report.write_bytes(b"{}")
    with pytest.raises(polscan.BundleError, match=r"report\.json has 2 bytes"):
        bundle.check()
    scan.download(tmp_path / "copy").check()
    assert (tmp_path / "copy" / "cloud.ply").stat().st_ino == kept


def test_the_object_may_move_before_the_scan_is_done(bench: Scanner) -> None:
    scan = bench.scan(mode="fast")
    info = scan.acquired(30)
    assert info.acquired is not None
    assert info.state in ("acquired", "decoding", "done")
    assert scan.done(30).state == "done"


def test_a_wait_gives_up_in_time_and_the_scan_goes_on(bench: Scanner) -> None:
    scan = bench.scan(mode="pse")
    with pytest.raises(polscan.WaitTimeout, match=r"acquired .* did not come within 0\.2 s"):
        scan.acquired(0.2)
    assert scan.done(30).state == "done"


def test_lists_are_filtered_and_paged(scanner: Scanner) -> None:
    mark = f"list-{datetime.now(UTC).timestamp()}"
    before = datetime.now(UTC) - timedelta(seconds=1)
    series = scanner.scan_series(5, mode="fast", tags=[mark], label="a\u2028b", queue=True)
    assert [one.info.series.index for one in series if one.info.series] == [0, 1, 2, 3, 4]
    for one in series:
        one.done(60)
    newest_first = [one.id for one in reversed(series)]
    assert [one.id for one in scanner.scans(tags=mark, page_size=2)] == newest_first
    series[1].update(pinned=True, label=None, tags=[mark, "kept"])
    assert [one.id for one in scanner.scans(tags=[mark, "kept"])] == [series[1].id]
    assert [one.id for one in scanner.scans(tags=mark, pinned=True)] == [series[1].id]
    assert [one.id for one in scanner.scans(tags=mark, label="a\u2028b", since=before)] == [
        one for one in newest_first if one != series[1].id
    ]
    assert list(scanner.scans(tags=mark, until=before)) == []
    assert list(scanner.scans(tags=mark, state=["failed", "cancelled"])) == []
    assert series[1].refresh().label is None
    # Found in a list, a scan does as well as one that was asked for.
    assert len(next(scanner.scans(tags=mark, verdict="ok")).cloud()) > 0


def test_pinned_scans_are_not_deleted_and_deleted_ones_are_gone(scanner: Scanner) -> None:
    scan = scanner.scan(mode="fast")
    scan.done(30)
    scan.update(pinned=True)
    with pytest.raises(polscan.Conflict) as refused:
        scan.delete()
    assert refused.value.type == "pinned"
    scan.update(pinned=False)
    scan.delete()
    with pytest.raises(polscan.NotFound):
        scan.refresh()


def test_a_scan_is_decoded_again(scanner: Scanner) -> None:
    source = scanner.scan(mode="pse", label="both")
    source.done(30)
    again = source.reprocess(mode="fast", tags="again")
    assert again.done(30).source == source.id
    assert again.info.tags == ("again",)
    assert again.report().mode == "fast"


def test_the_same_key_is_the_same_scan(scanner: Scanner) -> None:
    first = scanner.scan(mode="fast", idempotency_key="part-7")
    assert scanner.scan(mode="fast", idempotency_key="part-7").id == first.id
    with pytest.raises(polscan.Invalid):
        scanner.scan(mode="pse", idempotency_key="part-7")
    first.done(30)
    other = scanner.scan(mode="fast")
    other.done(30)
    assert other.id != first.id


def test_a_scan_is_followed_to_its_end(scanner: Scanner) -> None:
    scan = scanner.scan(mode="fast", label="a\u2028b")
    seen = list(scan.follow(timeout_s=30))
    assert seen[-1].state == "done"
    assert seen[-1].label == "a\u2028b"
    progress = [one.progress for one in seen if one.progress]
    frames = [one.frames for one in progress]
    assert frames == sorted(frames)
    assert frames[-1] == progress[-1].of


def test_events_come_without_loss(scanner: Scanner) -> None:
    after = scanner.status().revision
    scan = scanner.scan(mode="fast")
    last = scan.done(30).revision
    numbers, states = [], []
    for event in scanner.events(after=after, timeout_s=30):
        assert event.id is not None
        numbers.append(event.id)
        if event.scan and event.scan.id == scan.id:
            states.append(event.scan.state)
        if event.id >= last:
            break
    assert numbers == list(range(after + 1, last + 1))
    assert states == ["queued", "projecting", "acquired", "decoding", "done"]


def test_events_give_up_in_time(service: Service) -> None:
    with Scanner(service.url) as scanner, pytest.raises(polscan.WaitTimeout):
        list(scanner.events(timeout_s=0.3))


def test_the_rig_is_looked_at_and_set_up(scanner: Scanner) -> None:
    assert scanner.readiness().ready
    scanner.wait_ready(5)
    status = scanner.status()
    assert (status.ready, status.rig) == (True, "ready")
    assert scanner.devices().cameras[0].driver == "sim"
    assert scanner.config()["scan"]["mode"] == "pse"
    scanner.show("column-0")
    assert scanner.status().showing == "column-0"
    with pytest.raises(polscan.Invalid) as refused:
        scanner.show("rainbow")
    assert refused.value.status == 422
    scanner.show("h")
    preview = scanner.preview()
    assert preview.exposure in ("good", "over", "under")
    picture = preview.array()
    assert (picture.dtype, picture.ndim, picture.shape[2]) == (np.uint8, 3, 3)
    with contextlib.closing(scanner.previews()) as pictures:
        first, second = next(pictures), next(pictures)
    assert second.frame > first.frame
    assert second.array().shape == picture.shape


def test_the_queue_is_held_and_released(bench: Scanner) -> None:
    first, second = bench.scan(mode="fast"), bench.scan(mode="fast", queue=True)
    assert bench.pause_queue() >= 1
    first.done(30)
    assert second.refresh().held
    assert bench.resume_queue() == 1
    second.done(30)


def test_a_calibration_runs_and_leaves_files(scanner: Scanner, tmp_path: Path) -> None:
    calibration = scanner.calibrate_noise()
    seen = list(calibration.follow(timeout_s=30))
    info = calibration.done(30)
    assert (info.kind, info.state, info.accepted) == ("noise", "done", True)
    assert seen[-1].revision == info.revision
    path = calibration.fetch("noise.toml", tmp_path)
    assert path == tmp_path / "noise.toml"
    assert b"gain" in path.read_bytes()
    assert json.loads(calibration.read("report.json"))
    listed = scanner.calibrations()
    assert listed.calibrations[0].kind == "rig"
    assert calibration.id in [run.id for run in listed.runs]
    assert scanner.calibration(calibration.id).info == info
    calibration.delete()
    assert calibration.id not in [run.id for run in scanner.calibrations().runs]


def test_a_watch_of_the_polarizer_ends_when_it_is_told_to(scanner: Scanner) -> None:
    watch = scanner.calibrate_polarization(watch_s=60)
    for info in watch.follow(timeout_s=30):
        if info.live is not None:
            assert info.live.advice
            watch.cancel()
            break
    assert watch.done(30).state == "done"


def test_two_clients_at_once_get_their_own_scans(service: Service) -> None:
    wrong: list[BaseException] = []
    got: dict[str, str] = {}

    def work(name: str) -> None:
        try:
            with Scanner(service.url) as scanner:
                for index in range(2):
                    scan = scanner.scan(mode="fast", label=f"{name}-{index}", queue=True)
                    cloud = scan.cloud()
                    assert scan.info.label == f"{name}-{index}"
                    got[scan.id] = hashlib.sha256(cloud.tobytes()).hexdigest()
        except BaseException as error:
            wrong.append(error)

    workers = [threading.Thread(target=work, args=(name,)) for name in ("one", "two")]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert wrong == []
    assert len(got) == 4


def test_one_client_serves_several_threads(scanner: Scanner) -> None:
    ids: list[str] = []

    def follow_one() -> None:
        ids.extend(one.id for one in scanner.scan(mode="fast", queue=True).follow(30))

    follow = threading.Thread(target=follow_one)
    follow.start()
    other = scanner.scan(mode="fast", queue=True)
    other.done(30)
    follow.join()
    assert ids
    assert other.id not in ids


def test_the_asynchronous_client_does_the_same(service: Service, tmp_path: Path) -> None:
    async def work() -> None:
        async with AsyncScanner(service.url) as scanner:
            after = (await scanner.status()).revision
            first, second = await asyncio.gather(
                scanner.scan(mode="fast", queue=True), scanner.scan(mode="pse", queue=True, tags="async")
            )
            clouds = await asyncio.gather(first.cloud(), second.cloud(tmp_path / "cloud.ply"))
            assert [len(cloud) for cloud in clouds] == [first.info.points, second.info.points]
            assert (await second.report()).mode == "pse"
            assert [one.id async for one in scanner.scans(tags="async")] == [second.id]
            ends = set()
            async with contextlib.aclosing(scanner.events(after=after, timeout_s=30)) as events:
                async for event in events:
                    if event.scan and event.scan.ended:
                        ends.add(event.scan.id)
                    if len(ends) == 2:
                        break
            assert ends == {first.id, second.id}
            bundle = await second.download(tmp_path / "bundle")
            bundle.check()
            with pytest.raises(polscan.NotFound):
                await scanner.get("nobody")

    asyncio.run(work())
