"""Measure how long `import upright` takes, beside `import numpy`, and what each further step to a verdict adds.

    .venv/bin/python benchmarks/importing.py

Each line is a process of its own, the fastest of several; a bare Python is subtracted.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time

STEPS = {
    "import numpy": "import numpy",
    "import upright": "import upright",
    "... and define an effect": "import upright; upright.Effect",
    "... and read a recording": "import upright; upright.load",
    "... and diagnose": "import upright; upright.diagnose",
}
"""What is measured to what is run. The last two import what they need, and do no work."""


def seconds_of(code: str, runs: int) -> float:
    """s of wall-clock time until a process has run `code`, the minimum of several runs."""
    least = float("inf")
    for _ in range(runs):
        begin = time.perf_counter()
        subprocess.run([sys.executable, "-c", code], check=True)
        least = min(least, time.perf_counter() - begin)
    return least


def main() -> None:
    """Print a line for each step."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--runs", type=int, default=7, help="of which the fastest counts")
    runs = parser.parse_args().runs
    bare = seconds_of("pass", runs)
    taken = {step: seconds_of(code, runs) - bare for step, code in STEPS.items()}
    for step, seconds in taken.items():
        print(f"{step:26}{seconds:7.3f} s{seconds / taken['import numpy']:8.2f} x import numpy")


if __name__ == "__main__":
    main()
