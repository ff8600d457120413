"""The asynchronous client. `_client.py` is made from this file by `tools/unasync.py`: change this one only."""

from __future__ import annotations

import json
import ssl
import tempfile
from collections.abc import AsyncGenerator, Iterable, Mapping
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import httpx
import numpy as np
from numpy.typing import NDArray

from . import _pause, _requests
from ._requests import KEEP, Deadline, Keep, Patience
from ._sse import EventParser, PartParser
from .bundle import Bundle, Maps, open_bundle, read_cloud
from .errors import CalibrationFailed, ConnectionLost, NotFound, Problem, ProtocolError, ScanFailed, problem
from .models import (
    CalibrationInfo,
    Calibrations,
    Devices,
    Event,
    Page,
    Preview,
    Readiness,
    ScanInfo,
    SessionView,
    Status,
)
from .report import Report

_JSON = {"Content-Type": "application/json"}


class AsyncScanner:
    """A polscan service.

    `token` is that of `polscan token add`; left out, it is taken from the variable `POLSCAN_TOKEN`. `verify` says which
    certificate is trusted: `True` those of the system, a path those of a PEM file, `False` any at all. A request that gets no
    answer is sent again for `patience_s`, so that a service may be restarted meanwhile; nothing happens twice by that.
    `timeout_s` is how long one answer may take. Proxies of the environment are not used.
    """

    def __init__(
        self,
        url: str = "http://127.0.0.1:8631",
        *,
        token: str | None = None,
        verify: bool | str | Path | ssl.SSLContext = True,
        timeout_s: float = 10.0,
        patience_s: float = 10.0,
        transport: httpx.AsyncBaseTransport | None = None,
    ) -> None:
        token = token or _requests.token_of_environment()
        trusted: bool | ssl.SSLContext
        trusted = ssl.create_default_context(cafile=verify) if isinstance(verify, str | Path) else verify
        self.url = url.rstrip("/")
        self._patience_s = patience_s
        self._timeout_s = timeout_s
        self._client = httpx.AsyncClient(
            base_url=self.url,
            headers={"Authorization": f"Bearer {token}"} if token else {},
            verify=trusted,
            timeout=timeout_s,
            transport=transport,
            trust_env=False,
        )

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.aclose()

    async def aclose(self) -> None:
        """Closes the connections."""
        await self._client.aclose()

    def __repr__(self) -> str:
        return f"AsyncScanner({self.url!r})"

    # Requests

    async def _send(
        self,
        method: str,
        path: str,
        *,
        body: Any = None,  # noqa: ANN401 - JSON
        params: dict[str, str] | None = None,
        headers: dict[str, str] | None = None,
        again: bool = True,
    ) -> httpx.Response:
        """Sends a request until it is answered. `again`: whether it may arrive twice without happening twice."""
        patience = Patience(self._patience_s)
        tried = False
        while True:
            sent = {"json": {} if body is None else body, "headers": {**_JSON, **(headers or {})}}
            arguments: dict[str, Any] = {"headers": headers} if method in ("GET", "DELETE") else sent
            try:
                answer = await self._client.request(method, path, params=params, **arguments)
            except httpx.TransportError as error:
                rest = patience.rest() if again or isinstance(error, httpx.ConnectError) else None
                if rest is None:
                    raise self._lost(error) from error
            else:
                if answer.status_code < 400:
                    return answer
                refusal = problem(answer.status_code, answer.content)
                if method == "DELETE" and tried and isinstance(refusal, NotFound):
                    # The answer to the request before was lost.
                    return answer
                rest = patience.rest() if _requests.overloaded(refusal) else None
                if rest is None:
                    raise refusal
            tried = True
            await _pause.wait(rest)

    def _lost(self, error: Exception) -> ConnectionLost:
        told = f"no answer from {self.url} ({str(error) or type(error).__name__})"
        return ConnectionLost(f"{told}; check that the service runs there (`polscan serve`) and the network")

    async def _get(self, path: str, params: dict[str, str] | None = None) -> Any:  # noqa: ANN401 - JSON
        return _requests.document(await self._send("GET", path, params=params))

    # Scans

    async def scan(
        self,
        *,
        mode: str | None = None,
        exposure_us: float | None = None,
        label: str | None = None,
        tags: Iterable[str] = (),
        queue: bool = False,
        idempotency_key: str | None = None,
    ) -> AsyncScan:
        """Asks for a scan and returns at once; the scan's `acquired()` and `done()` wait.

        `queue`: wait for other scans instead of raising `Busy`. The key makes the request happen once, however often it is sent; one
        is made up where none is given.
        """
        body = _requests.scan_body(mode, exposure_us, label, tags, queue, None)
        return AsyncScan(self, await self._accepted("/v1/scans", body, idempotency_key))

    async def scan_series(
        self,
        repeat: int,
        *,
        mode: str | None = None,
        exposure_us: float | None = None,
        label: str | None = None,
        tags: Iterable[str] = (),
        queue: bool = False,
        idempotency_key: str | None = None,
    ) -> list[AsyncScan]:
        """Asks for several scans, one after the other, and returns them all at once."""
        body = _requests.scan_body(mode, exposure_us, label, tags, queue, repeat)
        first = await self._accepted("/v1/scans", body, idempotency_key)
        others = [await self.get(id) for id in first.scans if id != first.id]
        return [AsyncScan(self, first), *others]

    async def _accepted(self, path: str, body: dict[str, Any], key: str | None) -> ScanInfo:
        headers = {"Idempotency-Key": key or _requests.new_key()}
        return ScanInfo.parse(_requests.document(await self._send("POST", path, body=body, headers=headers)))

    async def get(self, id: str) -> AsyncScan:
        """The scan of that identity."""
        return AsyncScan(self, ScanInfo.parse(await self._get(f"/v1/scans/{id}")))

    async def scans(
        self,
        *,
        state: str | Iterable[str] | None = None,
        verdict: str | None = None,
        mode: str | None = None,
        label: str | None = None,
        tags: Iterable[str] = (),
        pinned: bool | None = None,
        since: datetime | None = None,
        until: datetime | None = None,
        page_size: int = 50,
    ) -> AsyncGenerator[AsyncScan, None]:
        """All scans that fit, the newest first, fetched page by page as they are used up.

        `state`: one or several of them; `tags`: all of which a scan must have; `since` and `until`: when it was accepted.
        """
        params = _requests.listing(state, verdict, mode, label, tags, pinned, since, until, page_size)
        while True:
            page = Page.parse(await self._get("/v1/scans", params))
            for info in page.scans:
                yield AsyncScan(self, info)
            if page.next is None:
                return
            params["cursor"] = page.next

    # The service

    async def status(self) -> Status:
        """Everything about the service at one moment."""
        return Status.parse(await self._get("/v1/status"))

    async def readiness(self) -> Readiness:
        """Whether a scan would be accepted on an idle rig, and why not."""
        try:
            return Readiness.parse(await self._get("/readyz"))
        except Problem as refusal:
            if refusal.status != 503 or "ready" not in refusal.document:
                raise
            return Readiness.parse(refusal.document)

    async def wait_ready(self, timeout_s: float | None = None) -> None:
        """Waits until the rig can scan."""
        deadline = Deadline(timeout_s, "a rig that can scan")
        while not (await self.readiness()).ready:
            await _pause.wait(deadline.left(0.2))

    async def devices(self) -> Devices:
        """Cameras and projectors that are found."""
        return Devices.parse(await self._get("/v1/devices"))

    async def config(self) -> dict[str, Any]:
        """The configuration in force."""
        return dict(await self._get("/v1/config"))

    async def pause_queue(self) -> int:
        """Holds queued scans back; how many."""
        return int(_requests.document(await self._send("POST", "/v1/queue/pause"))["scans"])

    async def resume_queue(self) -> int:
        """Releases queued scans; how many."""
        return int(_requests.document(await self._send("POST", "/v1/queue/resume"))["scans"])

    async def show(self, picture: str) -> None:
        """Holds one picture on the projector for set-up.

        `white`, `h`, `v`, `black`, `focus`, `crosshair`, `checker`, or a pattern such as `column-0` or `row-3-inverse`.
        """
        await self._send("PUT", "/v1/projector", body={"show": picture})

    async def preview(self) -> Preview:
        """The latest frame of the camera, with a hint whether the light is right."""
        answer = await self._send("GET", "/v1/preview.jpg")
        return Preview.of(answer.content, answer.headers)

    async def previews(self) -> AsyncGenerator[Preview, None]:
        """The latest frames one after the other; who is slow misses some. Ends where the connection does."""
        begun = False
        try:
            async with self._client.stream("GET", "/v1/preview.mjpeg") as answer:
                if answer.status_code != 200:
                    raise problem(answer.status_code, await answer.aread())
                begun, parser = True, PartParser()
                async for chunk in answer.aiter_bytes():
                    for headers, jpeg in parser.feed(chunk):
                        yield Preview.of(jpeg, headers)
        except httpx.TransportError as error:
            if not begun:
                raise self._lost(error) from error

    async def events(
        self, *, after: int | None = None, timeout_s: float | None = None
    ) -> AsyncGenerator[Event, None]:
        """Follows everything that changes, over lost connections and restarts of the service, without loss.

        `after`: the number of the last event that is known already, such as `status().revision`; left out, that of the moment in
        which the first event is asked for. An event `gap` says that those before it are no longer known. The next event
        may take `timeout_s`; then `WaitTimeout` is raised.
        """
        last = after if after is not None else (await self.status()).revision
        patience = Patience(self._patience_s)
        deadline = Deadline(timeout_s, "the next event")
        while True:
            parser = EventParser()
            timeout = httpx.Timeout(self._timeout_s, read=deadline.left(3 * _requests.HEARTBEAT_S))
            lost: Exception | None = None
            try:
                headers = {"Last-Event-ID": str(last)}
                async with self._client.stream(
                    "GET", "/v1/events", headers=headers, timeout=timeout
                ) as answer:
                    if answer.status_code != 200:
                        raise problem(answer.status_code, await answer.aread())
                    async for chunk in answer.aiter_bytes():
                        patience.renew()
                        for event in parser.feed(chunk):
                            last = last if event.id is None else event.id
                            yield event
                            deadline = Deadline(timeout_s, "the next event")
                        deadline.left()
            except httpx.TransportError as error:
                lost = error
            except Problem as refusal:
                if not _requests.overloaded(refusal):
                    raise
                lost = refusal
            deadline.left()
            rest = patience.rest()
            if rest is None:
                raise self._lost(lost or ConnectionError("the stream of events ended")) from lost
            await _pause.wait(rest)

    # Calibrations

    async def calibrations(self) -> Calibrations:
        """The calibration that scans use, and all that the service made, the newest first."""
        return Calibrations.parse(await self._get("/v1/calibrations"))

    async def calibration(self, id: str) -> AsyncCalibration:
        """The calibration of that identity."""
        return AsyncCalibration(self, CalibrationInfo.parse(await self._get(f"/v1/calibrations/{id}")))

    async def calibrate_noise(self) -> AsyncCalibration:
        """Begins to measure the noise of the camera, of a plate or card before the rig."""
        return await self._calibrate("noise", {})

    async def calibrate_sync(self) -> AsyncCalibration:
        """Begins to measure the timing of the projector, on a plate or card before the rig."""
        return await self._calibrate("sync", {})

    async def calibrate_polarization(
        self,
        *,
        angle_deg: float | None = None,
        card: str | None = None,
        coupon: str | None = None,
        with_: Iterable[str] = (),
        watch_s: float | None = None,
    ) -> AsyncCalibration:
        """Begins to measure polarization on bare metal, at the angle at which the polarizer stands.

        `card` and `coupon` are regions of the camera's image, `NAME=X,Y,W,H`; `with_` the calibrations at other angles, three in all
        make a calibration; `watch_s` only tells H and V for so long.
        """
        given = {"angle_deg": angle_deg, "card": card, "coupon": coupon, "watch_s": watch_s}
        body: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
        return await self._calibrate("polarization", {**body, "with": _requests.tag_list(with_)})

    async def calibrate_rig(
        self,
        board: Mapping[str, Any] | str | Path,
        *,
        measured_mm: float | None = None,
        baseline_mm: float | None = None,
        gates: Mapping[str, Any] | None = None,
    ) -> AsyncCalibration:
        """Opens a session that calibrates camera and projector with a board: `take_view()` for each place of it, then `solve()`.

        `board` is the description that `polscan calibrate board` writes beside the page, or the path of it; `measured_mm` the
        length of the page's bar by a ruler, `baseline_mm` the distance of camera and projector by a ruler; `gates` are limits
        other than the usual ones. One session is open at a time.
        """
        described = _requests.board(board)
        given = {
            "measured_mm": measured_mm,
            "baseline_mm": baseline_mm,
            "gates": dict(gates) if gates else None,
        }
        body = {name: value for name, value in given.items() if value is not None}
        return await self._calibrate("rig", {"board": described, **body})

    async def _calibrate(self, kind: str, body: dict[str, Any]) -> AsyncCalibration:
        # There are no keys for calibrations: one whose answer is lost is not asked for twice.
        answer = await self._send("POST", f"/v1/calibrations/{kind}", body=body, again=False)
        return AsyncCalibration(self, CalibrationInfo.parse(_requests.document(answer)))

    # Files

    async def _fetch(self, href: str, to: Path, sha256: str | None, length: int | None) -> Path:
        """Streams a file to `to`, goes on where a connection broke, and compares its hash."""
        with _requests.written_whole(to) as file:
            for _ in range(2):
                download = _requests.Download(file, sha256)
                download.restart()
                await self._fill(href, download, length)
                if download.right():
                    return to
            raise download.wrong(href)

    async def _fill(self, href: str, download: _requests.Download, length: int | None) -> None:
        patience = Patience(self._patience_s)
        while True:
            lost: Exception = ConnectionError("the answer ended early")
            try:
                async with self._client.stream("GET", href, headers=download.headers()) as answer:
                    if answer.status_code not in (200, 206):
                        raise problem(answer.status_code, await answer.aread())
                    download.begin(answer)
                    async for chunk in answer.aiter_raw():
                        download.write(chunk)
                        patience.renew()
                if length is None or download.have >= length:
                    return
            except httpx.TransportError as error:
                lost = error
            except Problem as refusal:
                if not _requests.overloaded(refusal):
                    raise
                lost = refusal
            rest = patience.rest()
            if rest is None:
                raise self._lost(lost) from lost
            await _pause.wait(rest)


class AsyncScan:
    """One scan of a service. `info` is what was last heard of it."""

    def __init__(self, scanner: AsyncScanner, info: ScanInfo) -> None:
        self.scanner = scanner
        self.info = info

    def __repr__(self) -> str:
        return f"<AsyncScan {self.id} {self.info.state}>"

    @property
    def id(self) -> str:
        """Identity."""
        return self.info.id

    @property
    def href(self) -> str:
        """Address below that of the service."""
        return f"/v1/scans/{self.info.id}"

    async def refresh(self) -> ScanInfo:
        """Asks how it is now."""
        self.info = ScanInfo.parse(await self.scanner._get(self.href))
        return self.info

    async def acquired(self, timeout_s: float | None = None, *, check: bool = True) -> ScanInfo:
        """Waits until the last frame is taken: the object may move.

        `ScanFailed` where the scan ended before, unless `check` is false; `WaitTimeout` where it takes longer than `timeout_s`.
        """
        info = await self._wait("acquired", timeout_s)
        if check and info.acquired is None and info.ended and info.source is None:
            raise ScanFailed(info)
        return info

    async def done(self, timeout_s: float | None = None, *, check: bool = True) -> ScanInfo:
        """Waits until the scan is at its end.

        `ScanFailed` where it has no result, unless `check` is false; `WaitTimeout` where it takes longer than `timeout_s`.
        """
        info = await self._wait("done", timeout_s)
        if check and info.state != "done":
            raise ScanFailed(info)
        return info

    def _reached(self, until: str) -> bool:
        return self.info.ended or (until == "acquired" and self.info.state in ("acquired", "decoding"))

    async def _wait(self, until: str, timeout_s: float | None) -> ScanInfo:
        deadline = Deadline(timeout_s, f"the state {until} of scan {self.id}")
        while not self._reached(until):
            timeout = httpx.Timeout(self.scanner._timeout_s, read=deadline.left(_requests.POLL_S))
            try:
                client = self.scanner._client
                answer = await client.get(self.href, params={"wait": until}, timeout=timeout)
            except httpx.TransportError:
                deadline.left()
                # Whether it takes its time or is gone: this one says which, and is patient.
                await self.refresh()
                await _pause.wait(deadline.left(0.05))
                continue
            if answer.status_code >= 400:
                refusal = problem(answer.status_code, answer.content)
                if not _requests.overloaded(refusal):
                    raise refusal
                await self.refresh()
                await _pause.wait(deadline.left(0.5))
                continue
            self.info = ScanInfo.parse(_requests.document(answer))
        if self.info.ended and not self.info.artifacts:
            # Lists and events leave the files out.
            await self.refresh()
        return self.info

    async def follow(self, timeout_s: float | None = None) -> AsyncGenerator[ScanInfo, None]:
        """The scan as it changes from now on, frame by frame, until its end.

        The next change may take `timeout_s`.
        """
        await self.refresh()
        yield self.info
        if self.info.ended:
            return
        async for event in self.scanner.events(after=self.info.revision, timeout_s=timeout_s):
            if event.kind == "gap" or event.data.get("id") == self.id:
                if event.kind == "deleted":
                    return
                if event.kind == "progress":
                    self.info = ScanInfo.parse({**self.info.raw, **event.data})
                else:
                    # An event may be heard before the service answers requests with what it says.
                    await self._refresh_past(event.id or 0)
                yield self.info
                if self.info.ended:
                    return

    async def _refresh_past(self, revision: int) -> None:
        deadline = Deadline(self.scanner._timeout_s, f"what event {revision} says of scan {self.id}")
        while (await self.refresh()).revision < revision:
            await _pause.wait(deadline.left(0.02))

    async def cancel(self) -> ScanInfo:
        """Stops it; frames that were taken are kept."""
        self.info = ScanInfo.parse(
            _requests.document(await self.scanner._send("POST", f"{self.href}/cancel"))
        )
        return self.info

    async def delete(self) -> None:
        """Deletes it and its files."""
        await self.scanner._send("DELETE", self.href)

    async def update(
        self,
        *,
        label: str | Keep | None = KEEP,
        tags: Iterable[str] | Keep = KEEP,
        pinned: bool | Keep = KEEP,
    ) -> ScanInfo:
        """Changes label, tags or pin; what is left out stays. A pinned scan is never deleted by itself."""
        body: dict[str, Any] = {}
        if not isinstance(label, Keep):
            body["label"] = label
        if not isinstance(tags, Keep):
            body["tags"] = _requests.tag_list(tags)
        if not isinstance(pinned, Keep):
            body["pinned"] = pinned
        answer = await self.scanner._send("PATCH", self.href, body=body)
        self.info = ScanInfo.parse(_requests.document(answer))
        return self.info

    async def reprocess(
        self,
        *,
        mode: str | None = None,
        label: str | None = None,
        tags: Iterable[str] = (),
        idempotency_key: str | None = None,
    ) -> AsyncScan:
        """Decodes the recorded frames again, as a scan of its own and without the rig."""
        given = {"mode": mode, "label": label}
        body: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
        body["tags"] = _requests.tag_list(tags)
        info = await self.scanner._accepted(f"{self.href}/reprocess", body, idempotency_key)
        return AsyncScan(self.scanner, info)

    # Results

    async def fetch(self, name: str, to: str | Path) -> Path:
        """Streams a file of the scan to `to`, compares its hash, and returns the path.

        The file is there in full or not at all. A folder gets the file under its own name.
        """
        path = Path(to)
        path = _requests.inside(path, name) if path.is_dir() else path
        if self.info.artifact(name) is None:
            await self.refresh()
        artifact = self.info.artifact(name)
        href = artifact.href if artifact else f"{self.href}/{name}"
        sha256, length = (artifact.sha256, artifact.bytes) if artifact else (None, None)
        return await self.scanner._fetch(href, path, sha256, length)

    async def read(self, name: str) -> bytes:
        """A file of the scan as bytes, its hash compared: `overview.png`, `maps/depth.png` and so on."""
        with tempfile.TemporaryDirectory(prefix="polscan-") as folder:
            return (await self.fetch(name, Path(folder) / "file")).read_bytes()

    async def evidence(self) -> bytes | None:
        """Waits for the scan and returns the picture of what does not add up at each pixel, in units of the camera's noise, as a PNG.

        Yellow is where to look. Of a scan that nothing was decoded of there is none.
        """
        await self.done(check=False)
        pictures = [name for name in ("maps/worst-pair.png", "maps/residual.png") if self.info.artifact(name)]
        return await self.read(pictures[0]) if pictures else None

    async def download(self, folder: str | Path) -> Bundle:
        """Fetches all files into a folder, and opens it. What lies there already with the right hash is not fetched again."""
        await self.done(check=False)
        if self.info.artifact("manifest.json") is None:
            raise ScanFailed(self.info)
        for artifact in sorted(self.info.artifacts, key=lambda one: one.name == "manifest.json"):
            path = _requests.inside(Path(folder), artifact.name)
            if not _requests.has_hash(path, artifact.sha256):
                await self.scanner._fetch(artifact.href, path, artifact.sha256, artifact.bytes)
        return open_bundle(folder)

    async def cloud(self, to: str | Path | None = None) -> NDArray[np.void]:
        """Waits for the scan and returns its points, with the fields of `polscan.CLOUD`.

        They are mapped into memory from the file `to`, or from one that lives as long as the array.
        """
        await self.done()
        with tempfile.TemporaryDirectory(prefix="polscan-") as folder:
            return read_cloud(await self.fetch("cloud.ply", to or Path(folder) / "cloud.ply"))

    async def sample(self, points: int = 50_000) -> NDArray[np.void]:
        """Waits for the scan and returns at most `points` of its points (200 000 at the most), spread evenly over the image.

        For a look at many clouds, one after the other; the fields are those of `cloud`.
        """
        await self.done()
        path, params = f"{self.href}/sample.ply", {"points": str(points)}
        answer = await self.scanner._send("GET", path, params=params)
        with tempfile.TemporaryDirectory(prefix="polscan-") as folder:
            file = Path(folder) / "sample.ply"
            file.write_bytes(answer.content)
            return read_cloud(file)

    async def maps(self, to: str | Path | None = None) -> dict[str, NDArray[Any]]:
        """Waits for the scan and returns its maps by name, of shape (height, width); see `polscan.Maps`.

        They are mapped into memory from the file `to`, or from one that lives as long as the arrays.
        """
        await self.done()
        with tempfile.TemporaryDirectory(prefix="polscan-") as folder:
            return dict(Maps(await self.fetch("maps.npz", to or Path(folder) / "maps.npz")))

    async def frames(self, to: str | Path | None = None) -> NDArray[Any]:
        """Waits for the scan and returns its raw frames, of shape (frames, height, width), mapped like `maps`."""
        await self.done(check=False)
        with tempfile.TemporaryDirectory(prefix="polscan-") as folder:
            path = await self.fetch("frames.npy", to or Path(folder) / "frames.npy")
            frames: NDArray[Any] = np.load(path, mmap_mode="c")
            return frames

    async def report(self) -> Report:
        """Waits for the scan and returns its report, that of a failed scan too."""
        await self.done(check=False)
        try:
            return Report.parse(json.loads(await self.read("report.json")))
        except ValueError as error:
            raise ProtocolError(f"the report of scan {self.id} is no JSON: {error}") from error

    async def summary(self) -> str:
        """Waits for the scan and returns what a person wants to know of it."""
        await self.done(check=False)
        return (await self.scanner._send("GET", f"{self.href}/summary.txt")).text


class AsyncCalibration:
    """One calibration of a service. `info` is what was last heard of it."""

    def __init__(self, scanner: AsyncScanner, info: CalibrationInfo) -> None:
        self.scanner = scanner
        self.info = info

    def __repr__(self) -> str:
        return f"<AsyncCalibration {self.id} {self.info.kind} {self.info.state}>"

    @property
    def id(self) -> str:
        """Identity."""
        return self.info.id

    @property
    def href(self) -> str:
        """Address below that of the service."""
        return f"/v1/calibrations/{self.info.id}"

    async def refresh(self) -> CalibrationInfo:
        """Asks how it is now."""
        self.info = CalibrationInfo.parse(await self.scanner._get(self.href))
        return self.info

    async def follow(self, timeout_s: float | None = None) -> AsyncGenerator[CalibrationInfo, None]:
        """The calibration as it changes from now on, until its end. The next change may take `timeout_s`."""
        info = await self.refresh()
        yield info
        if info.ended:
            return
        async for event in self.scanner.events(after=info.revision, timeout_s=timeout_s):
            if event.kind == "gap" or event.data.get("id") == self.id:
                # An event may be heard before the service answers requests with what it says.
                deadline = Deadline(
                    self.scanner._timeout_s, f"what event {event.id} says of calibration {self.id}"
                )
                said = CalibrationInfo.parse(event.data).revision if event.kind == "calibration" else 0
                while (info := await self.refresh()).revision < said:
                    await _pause.wait(deadline.left(0.02))
                yield info
                if info.ended:
                    return

    async def done(self, timeout_s: float | None = None, *, check: bool = True) -> CalibrationInfo:
        """Waits for the end. `CalibrationFailed` where there is no result, unless `check` is false.

        A result may still not be trusted: `accepted` and `refused` say so.
        """
        deadline = Deadline(timeout_s, f"the end of calibration {self.id}")
        while not (await self.refresh()).ended:
            await _pause.wait(deadline.left(0.2))
        if check and self.info.state != "done":
            raise CalibrationFailed(self.info)
        return self.info

    async def settled(self, timeout_s: float | None = None) -> CalibrationInfo:
        """Waits until a step that is under way is over: until it is `open` again, or at its end."""
        deadline = Deadline(timeout_s, f"the step of calibration {self.id}")
        while (await self.refresh()).state == "running":
            await _pause.wait(deadline.left(0.1))
        return self.info

    async def _step(self, method: str, path: str, timeout_s: float | None) -> CalibrationInfo:
        # A view that is asked for twice were two views.
        await self.scanner._send(method, f"{self.href}/{path}", again=False)
        return await self.settled(timeout_s)

    async def take_view(self, timeout_s: float | None = None) -> SessionView:
        """Takes a view of the board as it stands. `CalibrationFailed` says why there is none; the session stays open.

        `info.session.missing` says what the next one should do. A view may still be of no use: `unusable` says why.
        """
        info = await self._step("POST", "views", timeout_s)
        if info.error is not None or info.session is None or not info.session.views:
            raise CalibrationFailed(info)
        return info.session.views[-1]

    async def drop_view(self, name: str, timeout_s: float | None = None) -> CalibrationInfo:
        """Drops a view with its frames. `CalibrationFailed` says why the others cannot be looked at; the session stays open."""
        info = await self._step("DELETE", f"views/{_requests.segment(name)}", timeout_s)
        if info.error is not None:
            raise CalibrationFailed(info)
        return info

    async def solve(self, timeout_s: float | None = None, *, check: bool = True) -> CalibrationInfo:
        """Calibrates from the views. `CalibrationFailed` where it is refused, unless `check` is false; the session stays open.

        `refused` has the failing checks and the view to drop.
        """
        info = await self._step("POST", "solve", timeout_s)
        if check and not info.accepted:
            raise CalibrationFailed(info)
        return info

    async def cancel(self) -> CalibrationInfo:
        """Stops it; a watch ends as `done`."""
        answer = await self.scanner._send("POST", f"{self.href}/cancel")
        self.info = CalibrationInfo.parse(_requests.document(answer))
        return self.info

    async def delete(self) -> None:
        """Deletes it with its files; one that runs has to be cancelled first."""
        await self.scanner._send("DELETE", self.href)

    async def fetch(self, name: str, to: str | Path) -> Path:
        """Streams a file of the calibration to `to`, and returns the path."""
        path = Path(to)
        path = _requests.inside(path, name) if path.is_dir() else path
        return await self.scanner._fetch(f"{self.href}/{name}", path, None, None)

    async def read(self, name: str) -> bytes:
        """A file of the calibration as bytes, such as `report.json`."""
        with tempfile.TemporaryDirectory(prefix="polscan-") as folder:
            return (await self.fetch(name, Path(folder) / "file")).read_bytes()
