"""A TCP proxy with limited rate and added delay, to be put between a browser and a broker."""

from __future__ import annotations

import queue
import socket
import threading
import time
from contextlib import suppress

PIECE = 512


class SlowLink:
    """Listens at `port` of this machine and forwards to port `target`, in both directions, until `close`.

    It forwards `rate` bytes per second, each `delay` s late. Further data wait in the buffers of the sender.
    """

    def __init__(self, target: int, rate: float, delay: float) -> None:
        self._target, self._rate, self._delay = target, rate, delay
        self._server = socket.create_server(("127.0.0.1", 0))
        self._open: list[socket.socket] = [self._server]
        self.port: int = self._server.getsockname()[1]
        self._begin(self._accept)

    def close(self) -> None:
        for each in self._open:
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            each.close()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                near, _ = self._server.accept()
                far = socket.create_connection(("127.0.0.1", self._target))
                self._open += [near, far]
                for source, sink in ((near, far), (far, near)):
                    self._pass_on(source, sink)

    def _pass_on(self, source: socket.socket, sink: socket.socket) -> None:
        in_transit: queue.SimpleQueue[tuple[float, bytes]] = queue.SimpleQueue()

        def take() -> None:
            data = b"-"
            while data:
                try:
                    data = source.recv(PIECE)
                except OSError:
                    data = b""
                time.sleep(len(data) / self._rate)
                in_transit.put((time.monotonic() + self._delay, data))

        def give() -> None:
            with suppress(OSError):
                while True:
                    due, data = in_transit.get()
                    time.sleep(max(0.0, due - time.monotonic()))
                    if not data:
                        sink.shutdown(socket.SHUT_WR)
                        return
                    sink.sendall(data)

        self._begin(take)
        self._begin(give)

    @staticmethod
    def _begin(work: object) -> None:
        threading.Thread(target=work, daemon=True).start()  # type: ignore[arg-type]
