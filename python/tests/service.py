"""The program as a service, in a process of its own, on a small simulated rig."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import httpx

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests" / "python"))


def program() -> Path:
    """The program under test: `POLSCAN_BINARY`, or the one that the Rust suite was built with."""
    target = ROOT / os.environ.get("CARGO_TARGET_DIR", "target")
    path = Path(os.environ.get("POLSCAN_BINARY", target / "debug" / "polscan"))
    if not path.is_file():
        raise FileNotFoundError(f"there is no {path}; build it (`cargo build`) or name it in POLSCAN_BINARY")
    return path


class Service:
    """A configuration, a store, and the process that serves them, which may be started again."""

    def __init__(self, folder: Path, changes: Sequence[tuple[str, str]] = (), scale: float = 8.0) -> None:
        import small_twin

        self.folder = folder
        self.store = folder / "store"
        settings = [
            ("store.dir", json.dumps(str(self.store))),
            ("store.min_free_gib", "0.0"),
            ("api.listen", '"127.0.0.1:0"'),
            *changes,
        ]
        self.config = small_twin.write(folder, scale, settings)
        self.scheme = "http"
        self.process: subprocess.Popen[bytes] | None = None
        self.address = ""

    @property
    def url(self) -> str:
        return f"{self.scheme}://{self.address}"

    def log(self) -> str:
        return (self.folder / "log").read_text(errors="replace")

    def set(self, name: str, value: str) -> None:
        """Changes a key of the configuration for the next start."""
        import small_twin

        self.config.write_text(small_twin.set_key(self.config.read_text(), name, value))

    def start(self, ready: bool = True) -> Service:
        """Starts it; again at the address that it had."""
        if self.address:
            self.set("api.listen", json.dumps(self.address))
        where = self.folder / "address"
        where.unlink(missing_ok=True)
        with (self.folder / "log").open("ab") as log:
            command = [
                str(program()),
                "serve",
                "--json",
                "--config",
                str(self.config),
                "--address-file",
                str(where),
            ]
            self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=log)
        self.until(lambda: where.exists() and where.read_text().strip(), "the service does not listen")
        self.address = where.read_text().strip()
        if ready:
            with httpx.Client(verify=False, trust_env=False) as client:  # noqa: S501 - only whether it is there
                asked = lambda: client.get(f"{self.url}/readyz").status_code == 200  # noqa: E731
                self.until(asked, "the rig does not open")
        return self

    def until(self, reached: Any, otherwise: str) -> None:  # noqa: ANN401
        end = time.monotonic() + 60
        while not reached():
            assert self.process is not None
            if self.process.poll() is not None or time.monotonic() > end:
                raise AssertionError(f"{otherwise}:\n{self.log()}")
            time.sleep(0.02)

    def stop(self) -> None:
        """Asks it to end, and waits until it has."""
        assert self.process is not None
        self.process.terminate()
        assert self.process.wait(60) == 0
        self.process = None

    def kill(self) -> None:
        """Ends it in the middle of whatever it does."""
        if self.process is not None:
            self.process.send_signal(signal.SIGKILL)
            self.process.wait(30)
            self.process = None


def token(folder: Path, scope: str) -> str:
    """A new token of the file `tokens`."""
    command = [
        str(program()),
        "token",
        "add",
        f"for-{scope}",
        "--scope",
        scope,
        "--file",
        str(folder / "tokens"),
    ]
    return str(subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip())
