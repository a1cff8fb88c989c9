"""The client of the raw log in the control process: starts `raw_log` beside it, sends orders, reads reports."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path


class RawLogProcess:
    """One raw log process for the SocketCAN `channels`; its errors go to `event(severity, code, text)`. `base_ns` is
    that of the clock of this process, by default the wall clock's.

    Create it in a running event loop.
    """

    def __init__(
        self, channels: Sequence[str], event: Callable[[str, str, str], None], base_ns: int | None = None
    ) -> None:
        base = [] if base_ns is None else ["--base", str(base_ns)]
        self.failure = ""
        """Why the log of the running or last recording is not complete, "" if it is."""
        self._event = event
        self._stopping = False
        self._heard = b""
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "upright.service.observer.recording.raw_log", *channels, *base],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
            bufsize=0,
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._orders, self._answers = self._process.stdin, self._process.stdout
        os.set_blocking(self._answers.fileno(), False)
        asyncio.get_running_loop().add_reader(self._answers, self._read)

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self._process.poll() is None

    def open(self, path: Path, start_ns: int) -> None:
        """Log the frames from `start_ns` on to the new file `path`."""
        self.failure = ""
        self._order(f"open {start_ns} {path}")

    def close(self, end_ns: int) -> None:
        """Log no frame after `end_ns`."""
        self._order(f"close {end_ns}")

    async def stop(self) -> None:
        """Close the file, if one is open, and end the process."""
        self._stopping = True
        if self._answers.closed:
            return
        with contextlib.suppress(BrokenPipeError):
            self._orders.write(b"quit\n")
        self._orders.close()
        try:
            await asyncio.to_thread(self._process.wait, 5.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            await asyncio.to_thread(self._process.wait)
        self._read()
        asyncio.get_running_loop().remove_reader(self._answers)
        self._answers.close()

    def _order(self, order: str) -> None:
        try:
            self._orders.write(order.encode() + b"\n")
        except BrokenPipeError:
            self._fail("the raw log process ended: raw frames are not logged any more")

    def _fail(self, text: str) -> None:
        if text != self.failure:
            self.failure = text
            self._event("error", "raw_log", text)

    def _read(self) -> None:
        """Read lines of JSON: an error, or the report of a closed file."""
        while True:
            heard = self._answers.read(65536)
            if heard is None:
                break
            if not heard:
                if not self._stopping:
                    self._fail("the raw log process ended: raw frames are not logged any more")
                asyncio.get_running_loop().remove_reader(self._answers)
                break
            self._heard += heard
        *lines, self._heard = self._heard.split(b"\n")
        for line in lines:
            account = json.loads(line)
            if account.get("error"):
                self._fail(account["error"])
            elif account["lost"]:
                self._event("warning", "raw_log", f"{account['lost']} frames did not reach {account['path']}")
