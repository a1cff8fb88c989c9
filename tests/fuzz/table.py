"""`make fuzz`: every target for some minutes, as one table.

PYTHONPATH=tests python -m fuzz.table [--minutes 10] [--only sdo] [--coverage] [--markdown] [--replay FILE]
"""

from __future__ import annotations

import argparse
import base64
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from fuzz.target import Target
from fuzz.targets import TARGETS
from fuzz.trial import REPOSITORY, Account, Failure
from fuzz.worker import written
from upright.telemetry.errors import UprightError

COLUMNS = ("target", "inputs", "accepted", "refused", "crashes", "hangs", "too large", "slowest s", "growth MB")
WIDTHS = (12, 9, 9, 9, 8, 6, 10, 10, 9)
STARTING = 60.0
"""s until a worker on a busy machine has tried its first input."""
PATIENCE = 20.0
"""Times a target's processor time after which an input that waits is a hang, too."""
LOOK = 0.2
"""s between two looks at a worker."""


def row(account: Account) -> tuple[str, ...]:
    counts = (account.inputs, account.accepted, account.refused)
    failed = (account.count(kind) for kind in ("crash", "hang", "memory"))
    return (account.target, *map(str, (*counts, *failed)), f"{account.slowest:.2f}", f"{account.growth:.0f}")


def text(cells: Sequence[str]) -> str:
    return " ".join(
        cell.rjust(width) if place else cell.ljust(width)
        for place, (cell, width) in enumerate(zip(cells, WIDTHS, strict=True))
    )


def markdown(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def fuzzed(target: Target, seconds: float, number: int, *, coverage: bool) -> Account:
    """The account of a target after `seconds`; its worker is started again where an input ends it."""
    account, end = Account(target.name), time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0.0:
        with tempfile.TemporaryDirectory(dir=_memory()) as folder:
            part, last, why = _work(target, Path(folder), left, number, coverage)
        if part is not None:
            account.merge(part)
        if why:
            account.inputs += 0 if part is None else 1
            account.note("hang" if why == "hang" else "crash", "the interpreter", why, [last])
            if part is None:
                break
        number += 1_000_000
    return account


def _work(
    target: Target, folder: Path, seconds: float, number: int, coverage: bool
) -> tuple[Account | None, bytes, str]:
    """What one worker did: its account, its last input, and why it did not come to its end."""
    command = [
        sys.executable,
        "-m",
        "fuzz.worker",
        target.name,
        str(folder),
        f"--seconds={seconds}",
        f"--seed={number}",
    ]
    if coverage:
        command.append("--coverage")
    path = os.pathsep.join(
        [str(REPOSITORY), str(REPOSITORY / "tests"), str(REPOSITORY / "tests" / "support"), *filter(None, sys.path)]
    )
    environment = {**os.environ, "PYTHONPATH": path, "OPENBLAS_NUM_THREADS": "1"}
    with (folder / "said").open("wb") as said:
        worker = subprocess.Popen(command, env=environment, cwd=folder, stdout=said, stderr=said)
        why = ""
        try:
            while worker.poll() is None:
                time.sleep(LOOK)
                if _waits(folder) > STARTING + PATIENCE * target.seconds:
                    why = "hang"
                    worker.kill()
        finally:
            if worker.poll() is None:
                worker.kill()
            worker.wait()
    account, last = written(folder)
    if not why and worker.returncode:
        words = (folder / "said").read_text(errors="replace").strip().splitlines()
        why = f"exit {worker.returncode}: {words[-1] if words else ''}"
    return account, last, why


def _waits(folder: Path) -> float:
    """s since the worker began with its last input."""
    current = folder / "input"
    return time.time() - current.stat().st_mtime if current.exists() else 0.0


def _memory() -> str | None:
    return "/dev/shm" if Path("/dev/shm").is_dir() else None


def keep(account: Account, folder: Path) -> Iterator[str]:
    """Write each failure into a file of its own, and say which."""
    for each in account.failures.values():
        folder.mkdir(parents=True, exist_ok=True)
        name = hashlib.sha256(f"{account.target} {each.where}".encode()).hexdigest()[:8]
        path = folder / f"{account.target}-{name}.json"
        inputs = [base64.b64encode(data).decode() for data in each.inputs]
        path.write_text(
            json.dumps(
                {
                    "target": account.target,
                    "kind": each.kind,
                    "where": each.where,
                    "words": each.words,
                    "inputs": inputs,
                }
            )
        )
        yield f"{account.target}: {each.kind} ({each.count}) {each.where}: {each.words}: {path}"


def replay(path: Path) -> int:
    """Try the inputs of a kept failure again, with the traceback of what they raise."""
    document = json.loads(path.read_text())
    target = TARGETS[document["target"]]
    print(f"{target.name}: {document['kind']}: {document['where']}")
    with tempfile.TemporaryDirectory(dir=_memory()) as folder, target.opened(Path(folder)) as trial:
        for data in map(base64.b64decode, document["inputs"]):
            began = time.process_time()
            print(f"{len(data)} bytes: {data[:200]!r}")
            try:
                trial(data)
            except UprightError as error:
                print(f"refused: {error}")
            except Exception:
                traceback.print_exc()
                return 1
            print(f"{time.process_time() - began:.3f} s")
    return 0


def parsed(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Feed rubbish to everything that reads what others wrote.")
    parser.add_argument("--minutes", type=float, default=1.0, help="for each target (default: 1)")
    parser.add_argument("--only", action="append", choices=tuple(TARGETS), metavar="NAME", help="may be repeated")
    parser.add_argument("--processes", type=int, default=2, help="targets at a time (default: 2)")
    parser.add_argument(
        "--seed", type=int, default=int(time.time()), help="decides what is generated (default: the time)"
    )
    parser.add_argument("--coverage", action="store_true", help="inputs by Atheris, which looks for new code to reach")
    parser.add_argument("--keep", type=Path, default=REPOSITORY / ".fuzz", help="folder of the inputs that failed")
    parser.add_argument("--markdown", action="store_true", help="print a table for a page")
    parser.add_argument("--replay", type=Path, metavar="FILE", help="only try the inputs of a kept failure again")
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table; 1 if there was any crash, hang or too much memory."""
    chosen = parsed(arguments)
    if chosen.replay:
        return replay(chosen.replay)
    line = markdown if chosen.markdown else text
    print(line(COLUMNS))
    if chosen.markdown:
        print(line(["---", *["---:"] * (len(COLUMNS) - 1)]))
    failures: list[str] = []
    total = 0
    with ThreadPoolExecutor(chosen.processes) as pool:
        targets = [TARGETS[name] for name in chosen.only or TARGETS]
        for account in pool.map(
            lambda target: fuzzed(target, 60.0 * chosen.minutes, chosen.seed, coverage=chosen.coverage), targets
        ):
            print(line(row(account)), flush=True)
            failures += keep(account, chosen.keep)
            total += account.inputs
    print(f"\n{total} inputs, seed {chosen.seed}")
    for each in failures:
        print(each)
    return 1 if failures else 0


__all__ = ["Failure", "fuzzed", "keep", "main", "replay"]

if __name__ == "__main__":
    sys.exit(main())
