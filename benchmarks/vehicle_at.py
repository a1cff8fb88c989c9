"""Run `upright serve` or `upright simulate` for the MONOCAB at another IMU rate: RATE serve|simulate.

For benchmarks/turnaround.py. The limit of missed cycles is raised, so that delays of the computer appear as missed
cycles in the table and do not stop the run.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from upright.service.cli import main
from upright.vehicles.file import load


def at_rate(rate: float) -> str:
    """The shipped vehicle file with another rate."""
    text = Path(load("monocab").path).read_text()
    for old, new in (
        ("rate = 250 ", f"rate = {rate:.0f} "),
        ("missed_cycles = 7 ", "missed_cycles = 50 "),
        ("heartbeat_timeout = 0.12", "heartbeat_timeout = 1.0"),
    ):
        assert old in text
        text = text.replace(old, new)
    return text


if __name__ == "__main__":
    folder = Path(tempfile.mkdtemp())
    vehicle = folder / "monocab.toml"
    vehicle.write_text(at_rate(float(sys.argv[1])))
    places = ["--data", str(folder), "--socket", str(folder / "s.sock")] if sys.argv[2] == "serve" else []
    sys.argv = ["upright", sys.argv[2], str(vehicle), "--bus", "socketcan:vcan0", *places]
    main()
