"""The scanner as a device of ophyd-async, for plans of bluesky. Needs the extra `polscan[ophyd]`.

from ophyd_async.core import init_devices
from polscan.ophyd import PolscanDevice

with init_devices():
    scanner = PolscanDevice("http://127.0.0.1:8631", folder="/data/visit-7")
RE(bluesky.plans.grid_scan([scanner], stage.x, 0, 10, 5))
"""

from __future__ import annotations

import asyncio
import contextlib
from pathlib import Path
from typing import Any

from bluesky.protocols import Reading, Triggerable
from ophyd_async.core import (
    DEFAULT_TIMEOUT,
    AsyncStatus,
    Device,
    DeviceMock,
    StandardReadable,
    StandardReadableFormat,
    soft_signal_r_and_setter,
    soft_signal_rw,
)

from ._async_client import AsyncScan, AsyncScanner
from .errors import Problem, ScanFailed


class PolscanDevice(StandardReadable, Triggerable):
    """Scans when it is triggered; the status is done as soon as the object may move.

    Reading waits for the result, so a plan may move a stage between trigger and read, and still gets the verdict.
    It has `scan_id`, `state`, `verdict`, `reasons` (why the verdict is not `ok`, in words), `points`, and where the
    results are: `bundle`, the folder, and `cloud`, the PLY file. They are fetched below `folder`; without one, they
    are addresses of the service.

    A scan that ends before its frames are taken fails the status of the trigger. One whose verdict is `failed` is
    read like any other: what to do about it is the plan's to say.

    `mode` and `exposure_us` may be set; empty and 0 stand for the service's configuration. `timeout_s` is how long a scan may take
    until it is acquired, and after that until it is done.
    """

    def __init__(
        self,
        url: str = "http://127.0.0.1:8631",
        *,
        name: str = "",
        folder: str | Path | None = None,
        label: str | None = None,
        tags: tuple[str, ...] = (),
        queue: bool = True,
        timeout_s: float = 300.0,
        **client: Any,  # noqa: ANN401 - those of AsyncScanner
    ) -> None:
        self._url = url.rstrip("/")
        self._client = client
        self._scanner: AsyncScanner | None = None
        self._folder = None if folder is None else Path(folder)
        self._request: dict[str, Any] = {"label": label, "tags": tags, "queue": queue}
        self._timeout_s = timeout_s
        self._scan: AsyncScan | None = None
        self._mocked = False
        self._triggered = False
        self._given_up = False
        self.mode = soft_signal_rw(str, "")
        self.exposure_us = soft_signal_rw(float, 0.0, units="us")
        self.version, self._set_version = soft_signal_r_and_setter(str, "")
        configuration: list[Device] = [self.mode, self.exposure_us, self.version]
        self.add_readables(configuration, StandardReadableFormat.CONFIG_SIGNAL)
        self.scan_id, self._set_scan_id = soft_signal_r_and_setter(str, "")
        self.state, self._set_state = soft_signal_r_and_setter(str, "")
        self.verdict, self._set_verdict = soft_signal_r_and_setter(str, "")
        self.reasons, self._set_reasons = soft_signal_r_and_setter(str, "")
        self.bundle, self._set_bundle = soft_signal_r_and_setter(str, "")
        self.cloud, self._set_cloud = soft_signal_r_and_setter(str, "")
        self.points, self._set_points = soft_signal_r_and_setter(int, 0)
        told = [self.scan_id, self.state, self.verdict, self.reasons, self.bundle, self.cloud]
        self.add_readables(told, StandardReadableFormat.UNCACHED_SIGNAL)
        self.add_readables([self.points], StandardReadableFormat.HINTED_UNCACHED_SIGNAL)
        super().__init__(name=name)

    async def connect(
        self,
        mock: bool | DeviceMock[Any] = False,
        timeout: float = DEFAULT_TIMEOUT,
        force_reconnect: bool = False,
    ) -> None:
        """Sees whether the service is there. A mocked device asks nobody, and its scans are nothing."""
        self._mocked = bool(mock)
        if not self._mocked:
            async with AsyncScanner(self._url, **self._client) as scanner:
                status = await asyncio.wait_for(scanner.status(), timeout)
            self._set_version(status.version)
        await super().connect(mock, timeout, force_reconnect)

    @AsyncStatus.wrap
    async def trigger(self) -> None:
        """Scans; done as soon as the object may move."""
        self._scan, self._given_up = None, False
        if self._mocked:
            return
        self._triggered = True
        try:
            await self._acquire()
        except ScanFailed:
            # A scan that the plan gave up is nobody's fault.
            if not self._given_up:
                raise
        finally:
            self._triggered = False
            if self._given_up:
                await self._close()

    async def _acquire(self) -> None:
        mode, exposure_us = await asyncio.gather(self.mode.get_value(), self.exposure_us.get_value())
        # Kept for the plan: `unstage` closes its connections.
        self._scanner = self._scanner or AsyncScanner(self._url, **self._client)
        self._scan = await self._scanner.scan(
            mode=mode or None, exposure_us=exposure_us or None, **self._request
        )
        if self._given_up:
            await self._scan.cancel()
        await self._scan.acquired(self._timeout_s)

    async def _close(self) -> None:
        scanner, self._scanner, self._scan = self._scanner, None, None
        if scanner is not None:
            await scanner.aclose()

    async def read(self) -> dict[str, Reading[Any]]:
        """Waits for the result of the latest trigger and says where it is."""
        if self._scan is not None:
            await self._take(self._scan)
        return await super().read()

    async def _take(self, scan: AsyncScan) -> None:
        info = await scan.done(self._timeout_s, check=False)
        bundle, cloud = f"{self._url}{scan.href}", f"{self._url}{scan.href}/cloud.ply"
        if self._folder is not None:
            path = self._folder / info.id
            # Without a manifest there is nothing to fetch; state and reasons say why.
            with contextlib.suppress(ScanFailed):
                await scan.download(path)
            bundle, cloud = str(path), str(path / "cloud.ply")
        has_bundle = info.artifact("manifest.json") is not None
        self._set_scan_id(info.id)
        self._set_state(info.state)
        self._set_verdict(info.verdict or "")
        self._set_reasons("; ".join(reason.message for reason in info.reasons))
        self._set_points(info.points or 0)
        self._set_bundle(bundle if has_bundle else "")
        self._set_cloud(cloud if info.artifact("cloud.ply") is not None else "")

    @AsyncStatus.wrap
    async def unstage(self) -> None:
        """Stops a scan that nobody waits for any more, and closes the connections."""
        if self._triggered:
            self._given_up = True
            if self._scan is not None:
                # It may have come to its end just now.
                with contextlib.suppress(Problem):
                    await self._scan.cancel()
        else:
            await self._close()
        await super().unstage()
