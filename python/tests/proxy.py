"""A network that breaks where it is told to."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable
from types import TracebackType
from typing import Self

Change = Callable[[bytes], bytes]


class Proxy:
    """Hands everything on to a service, but breaks a connection off after so many bytes of its answers.

    `cuts` are for the connections that carry a request of which `match` is a part, one after the other; later ones are left whole.
    """

    def __init__(
        self, address: str, match: bytes, cuts: list[int], change: Change = lambda data: data
    ) -> None:
        host, port = address.rsplit(":", 1)
        self._target = (host, int(port))
        self._match, self._cuts, self._change = match, list(cuts), change
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.requests: list[bytes] = []
        self._open: list[socket.socket] = []
        self._thread = threading.Thread(target=self._accept, daemon=True)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self._listener.getsockname()[1]}"

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._thread.join(5)
        self.cut_all()

    def cut_all(self) -> None:
        """Breaks every connection off."""
        for one in self._open:
            with_quiet_close(one)

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            server = socket.create_connection(self._target)
            self._open += [client, server]
            limit: list[int | None] = [None]
            threading.Thread(target=self._up, args=(client, server, limit), daemon=True).start()
            threading.Thread(target=self._down, args=(server, client, limit), daemon=True).start()

    def _up(self, client: socket.socket, server: socket.socket, limit: list[int | None]) -> None:
        try:
            while data := client.recv(65536):
                if self._match in data:
                    self.requests.append(data)
                    limit[0] = self._cuts.pop(0) if self._cuts else None
                server.sendall(data)
        except OSError:
            pass
        with_quiet_close(server)

    def _down(self, server: socket.socket, client: socket.socket, limit: list[int | None]) -> None:
        try:
            while data := server.recv(4096):
                if limit[0] is not None:
                    data = data[: limit[0]]
                    limit[0] -= len(data)
                client.sendall(self._change(data))
                if limit[0] == 0:
                    break
        except OSError:
            pass
        with_quiet_close(client)
        with_quiet_close(server)


def with_quiet_close(one: socket.socket) -> None:
    try:
        one.shutdown(socket.SHUT_RDWR)
    except OSError:
        pass
    finally:
        one.close()
