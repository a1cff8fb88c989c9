"""A trial in a process of its own: `python -m fuzz.worker NAME FOLDER --seconds S --seed N [--coverage]`.

The account is written to FOLDER/account every second and at the end, the input that is being tried to FOLDER/input
before it is tried: whoever watches finds there what crashed the interpreter, or hangs it. With --coverage Atheris makes
the inputs, and prefers those that reach new code.
"""

from __future__ import annotations

import argparse
import importlib
import os
import pickle
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fuzz.target import Target
    from fuzz.trial import Session

PACKAGES = ["upright", "canopen", "h11"]
"""That Atheris observes."""


class Diary:
    """What the watching process reads."""

    def __init__(self, folder: Path) -> None:
        self._input = os.open(folder / "input", os.O_RDWR | os.O_CREAT, 0o600)
        self._account = folder / "account"
        self._written = 0.0

    def before(self, data: bytes) -> None:
        os.pwrite(self._input, len(data).to_bytes(8, "little") + data, 0)

    def write(self, account: Any, period: float = 0.0) -> None:
        """Replace the account, if the last is older than `period` s."""
        if time.monotonic() - self._written >= period:
            beside = self._account.with_suffix(".part")
            beside.write_bytes(pickle.dumps(account))
            beside.replace(self._account)
            self._written = time.monotonic()


def written(folder: Path) -> tuple[Any, bytes]:
    """The last account, None if there is none, and the last input."""
    account = folder / "account"
    content = (folder / "input").read_bytes() if (folder / "input").exists() else bytes(8)
    length = int.from_bytes(content[:8], "little")
    return pickle.loads(account.read_bytes()) if account.exists() else None, content[8 : 8 + length]


def with_atheris(target: Target, session: Session, folder: Path, number: int, over: Callable[[], bool]) -> None:
    """Inputs by libFuzzer, from the examples on. Does not return."""
    import atheris

    corpus = folder / "corpus"
    corpus.mkdir(exist_ok=True)
    for place, data in enumerate(target.examples()):
        (corpus / str(place)).write_bytes(data)
        session.take(data)

    def one(data: bytes) -> None:
        if over():
            session.close()
            diary.write(session.account)
            os._exit(0)  # libFuzzer's own end runs no handlers
        session.take(data)
        diary.write(session.account, 1.0)

    diary = Diary(folder)
    options = [
        "-timeout=100000",
        "-rss_limit_mb=0",
        "-detect_leaks=0",
        "-max_len=65536",
        f"-seed={number + 1}",
        "-verbosity=0",
    ]
    atheris.Setup([sys.argv[0], *options, str(corpus)], one)
    atheris.Fuzz()


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("name")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seconds", type=float, required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--coverage", action="store_true")
    chosen = parser.parse_args()
    if chosen.coverage:
        import atheris

        with atheris.instrument_imports(include=PACKAGES):
            targets = importlib.import_module("fuzz.targets")
    else:
        targets = importlib.import_module("fuzz.targets")
    from fuzz.trial import Session, tried

    target = targets.TARGETS[chosen.name]
    diary = Diary(chosen.folder)
    session = Session(target, chosen.folder, diary.before)
    end = time.monotonic() + chosen.seconds

    def over() -> bool:
        diary.write(session.account, 1.0)
        return time.monotonic() > end

    if chosen.coverage:
        with_atheris(target, session, chosen.folder, chosen.seed, over)
    tried(target, session, chosen.seed, over)
    session.close()
    diary.write(session.account)


if __name__ == "__main__":
    main()
