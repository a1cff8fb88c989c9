"""Modules that the control process must not import, checked on a running daemon."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

SERVE = "from upright.service.cli import main; main()"
FORBIDDEN = {"sympy", "numba", "llvmlite", "pyarrow", "pandas", "matplotlib"}
"""docs/explanation/architecture.md: nothing that compiles, plots or keeps tables."""


def test_running_daemon_imports_no_forbidden_module(tmp_path: Path) -> None:
    socket, log = tmp_path / "s.sock", tmp_path / "imports"
    command = [sys.executable, "-X", "importtime", "-c", SERVE, "serve", "monocab", "--bus", "virtual:nobody"]
    with log.open("wb") as stream:
        daemon = subprocess.Popen([*command, "--data", str(tmp_path), "--socket", str(socket)], stderr=stream)
        try:
            for _ in range(300):
                if socket.exists():
                    break
                time.sleep(0.1)
            assert socket.exists(), log.read_text()[-500:]
            time.sleep(1.0)  # the observer starts, and the daemon searches for the drives, which are not on this bus
            assert daemon.poll() is None
        finally:
            daemon.send_signal(signal.SIGTERM)
            daemon.wait(30)
    lines = [line for line in log.read_text().splitlines() if line.startswith("import time:")]
    modules = {line.rpartition("|")[2].strip() for line in lines}
    assert {"upright.drivers", "upright.service", "numpy"} <= modules
    assert not FORBIDDEN & {each.partition(".")[0] for each in modules}
