"""Shared by all tests: the measured data, and the conditions under which tests that need SocketCAN or systemd run.

With UPRIGHT_REQUIRE_ALL=1 a test that would be skipped fails instead, with the reason for the skip. A test on a bus
that fails while the machine stood still is run again, and reports that (`standstill.py`).
"""

from __future__ import annotations

import os
import time
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import pytest
from standstill import MachineStoodStill, Witness

Report = TypeVar("Report", pytest.TestReport, pytest.CollectReport)

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does, before numpy is loaded

REQUIRE_ALL = os.environ.get("UPRIGHT_REQUIRE_ALL") == "1"


def _in_throwaway_systemd() -> bool:
    """Whether this is the guest with a systemd of its own: elsewhere a test must not install units."""
    return "User Mode Linux" in Path("/proc/cpuinfo").read_text() and Path("/run/systemd/system").is_dir()


def pytest_configure(config: pytest.Config) -> None:
    """Compiled models are kept between test runs, separate from the user's."""
    cache = config.rootpath / ".pytest_cache" / "upright"
    if config.rootpath.stat().st_uid not in (os.geteuid(), 0):  # in the guest, where nobody's files are read as code
        cache = Path("/dev/shm/upright-cache")
    os.environ.setdefault("UPRIGHT_CACHE", str(cache))


WITNESS = pytest.StashKey[Witness]()


def _in_real_time(item: pytest.Item) -> bool:
    return item.get_closest_marker("vcan") is not None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if _in_real_time(item):
            item.add_marker(pytest.mark.flaky(reruns=2, only_rerun=[MachineStoodStill.__name__]))


@contextmanager
def _witnessed(item: pytest.Item) -> Iterator[None]:
    """Replaces a failure by MachineStoodStill if the machine stood still in the meantime."""
    if not _in_real_time(item):
        yield
        return
    stash, start = item.session.stash, time.monotonic()
    if WITNESS not in stash:
        stash[WITNESS] = Witness(Path("/dev/shm/upright-standstill"))
    try:
        yield
    except (Exception, pytest.fail.Exception) as error:  # a timeout is the latter
        lasted = stash[WITNESS].longest_since(start)
        if lasted == 0:
            raise
        raise MachineStoodStill(f"for {lasted * 1e3:.0f} ms") from error


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup(item: pytest.Item) -> Generator[None]:
    if item.get_closest_marker("vcan") and not Path("/sys/class/net/vcan0").exists():
        pytest.skip("no vcan0 here; `make vcan-test` runs this in a guest that has one")
    if item.get_closest_marker("own_time") and "time-travel" not in Path("/proc/cmdline").read_text():
        pytest.skip("not in a guest with a time of its own; `make vcan-test` runs this there")
    if item.get_closest_marker("systemd") and not _in_throwaway_systemd():
        pytest.skip("not in the throw-away guest with systemd; `make vcan-test` runs this there")
    with _witnessed(item):
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None]:
    with _witnessed(item):
        return (yield)


def pytest_sessionfinish(session: pytest.Session) -> None:
    if witness := session.stash.get(WITNESS, None):
        witness.close()


@pytest.fixture(scope="session")
def measured_data() -> Path:
    """The folder of measured records (BROAD, EMPS, CAN logs, EDS files) that lies beside the checkout."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"the measured records are not in {folder}")
    return folder


def _required(report: Report) -> Report:
    if REQUIRE_ALL and report.skipped and not hasattr(report, "wasxfail"):
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else report.longrepr
        report.outcome = "failed"
        report.longrepr = f"Everything is required here (UPRIGHT_REQUIRE_ALL=1), but: {reason}"
    return report


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    return _required((yield))


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report() -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    return _required((yield))
