"""The Debian package on a running system: installed, replaced while the vehicle rests but not while it is balanced,
removed; and `make install`, which does the same without dpkg.

The wheelhouse of these packages holds upright and pip alone, so that they are installed in seconds, and a stand-in runs
instead of the daemon. The whole one, as `make deb` makes it, is left to `make thorough-test`.
"""

from __future__ import annotations

import ensurepip
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from guest_service import REPOSITORY, journal, open_to_the_service, run, show, wait_for_mode, write_vehicle

from upright.service.control.cycle.operation import Mode

pytestmark = [pytest.mark.systemd, pytest.mark.timeout(240)]

DEPLOY = REPOSITORY / "deploy"
INSTALLED = Path("/opt/upright/.venv/bin/upright")
UNIT = Path("/usr/lib/systemd/system/upright.service")
ENVIRONMENT = {
    **os.environ,
    "PATH": f"{os.environ['PATH']}:/usr/sbin:/sbin",
    "PYTHON": str(Path(sys.base_prefix) / "bin" / "python3"),
}
"""For the scripts of the package: the Python of the checkout."""

STATUS = Path("/run/upright-status")
STANDS_IN = f"""
[Service]
ExecStart=
ExecStart=/bin/sh -c 'systemd-notify --ready --status="$(cat {STATUS})"; exec sleep infinity'
NotifyAccess=all
WatchdogSec=0
"""
"""In place of the daemon, which tells systemd its mode in the same way (test_systemd.py)."""


@pytest.fixture(scope="module")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheelhouse of upright and pip."""
    folder = tmp_path_factory.mktemp("wheels")
    build = ["-m", "hatchling", "build", "--target", "wheel", "--directory", folder]
    run("env", "--chdir", REPOSITORY, sys.executable, *build)
    for pip in (Path(ensurepip.__file__).parent / "_bundled").glob("pip-*.whl"):
        shutil.copy(pip, folder)
    return folder


@pytest.fixture
def no_other_unit() -> None:
    """Hides what the tests of the unit install."""
    subprocess.run(["systemctl", "stop", "upright"], check=False, capture_output=True)
    shutil.rmtree("/etc/systemd/system/upright.service.d", ignore_errors=True)
    Path("/etc/systemd/system/upright.service").unlink(missing_ok=True)
    open_to_the_service()


def _deploy(script: str, *arguments: str | Path) -> str:
    done = subprocess.run([DEPLOY / script, *arguments], env=ENVIRONMENT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout.strip()


class Dpkg:
    """dpkg with a database of what upright depends on alone: to read the computer's takes ten seconds in the guest."""

    def __init__(self, folder: Path) -> None:
        self._options = ("dpkg", "--admindir", folder, "--force-unsafe-io")
        for name in ("info", "updates", "triggers"):
            (folder / name).mkdir(parents=True)
        (folder / "status").write_text(run("dpkg-query", "--status", "python3", "systemd") + "\n")

    def fails(self, *arguments: str | Path) -> str:
        """What dpkg says to arguments that it has to refuse."""
        done = self._call(*arguments)
        assert done.returncode != 0
        return done.stderr

    def __call__(self, *arguments: str | Path) -> str:
        """What dpkg says to arguments that it has to accept."""
        done = self._call(*arguments)
        assert done.returncode == 0, done.stdout + done.stderr + journal()
        return done.stdout

    def _call(self, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
        command = [*self._options, *arguments]
        return subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, timeout=120)


@pytest.mark.usefixtures("no_other_unit")
def test_package_is_installed_replaced_at_rest_and_removed(wheels: Path, tmp_path: Path) -> None:
    dpkg = Dpkg(tmp_path / "dpkg")
    old, new = (_deploy("deb", wheels, tmp_path, version) for version in ("1.0", "2.0"))
    assert "systemctl enable --now upright" in dpkg("--install", old), "what a person does next"
    assert run("id", "--name", "--user", "upright") == "upright"
    assert (show("UnitFileState"), show("ActiveState")) == ("disabled", "inactive"), "a person starts the service"

    where = run("/opt/upright/.venv/bin/python", "-I", "-c", "import upright; print(upright.__file__)")
    assert where.startswith("/opt/upright/.venv/")

    own = Path("/etc/systemd/system/upright.service.d/guest.conf")
    own.parent.mkdir()
    own.write_text(STANDS_IN)
    run("systemctl", "daemon-reload")
    STATUS.write_text("running: experiment hold")
    run("systemctl", "start", "upright")
    first = show("MainPID")
    assert "an experiment is running, and nothing was changed. End it first: upright stop" in dpkg.fails("-i", new)
    assert "Version: 1.0\n" in dpkg("--status", "upright")
    assert (show("ActiveState"), show("MainPID")) == ("active", first)
    assert "an experiment is running" in dpkg.fails("--remove", "upright")
    assert (show("ActiveState"), show("MainPID")) == ("active", first)

    STATUS.write_text("disarmed: ready")
    run("systemctl", "restart", "upright")
    second = show("MainPID")
    dpkg("--install", new)
    assert "Version: 2.0\n" in dpkg("--status", "upright")
    assert (show("ActiveState"), show("MainPID") != second) == ("active", True), "the service runs again, and anew"

    recording, configuration = Path("/var/lib/upright/recording.arrow"), Path("/etc/upright/upright.env")
    recording.touch()
    dpkg("--remove", "upright")
    assert show("ActiveState") == "inactive"
    assert left_behind() == []
    assert configuration.exists()
    dpkg("--purge", "upright")
    assert not configuration.exists()
    assert recording.exists()


def left_behind() -> list[Path]:
    """What is there of an installation."""
    return [path for path in (INSTALLED, UNIT, Path("/opt/upright"), Path("/usr/bin/upright")) if os.path.lexists(path)]


@pytest.mark.usefixtures("no_other_unit")
def test_make_install_and_uninstall_do_the_same_without_dpkg(wheels: Path) -> None:
    _deploy("install", wheels)
    assert INSTALLED.exists()
    assert show("FragmentPath") in (str(UNIT), "/lib/systemd/system/upright.service")
    _deploy("install", "--remove")
    assert left_behind() == []


@pytest.mark.thorough
@pytest.mark.timeout(900)
@pytest.mark.usefixtures("no_other_unit")
def test_whole_package_runs_with_the_computers_own_python() -> None:
    """`make deb` has to be done before."""
    (package,) = (REPOSITORY / "dist").glob("upright_*.deb")
    clean = ["env", "-i", f"PATH={ENVIRONMENT['PATH']}"]
    run(*clean, "dpkg", "--install", package, seconds=600)
    assert Path("/opt/upright/.venv/bin/python").resolve().is_relative_to("/usr/bin")
    write_vehicle()
    own = Path("/etc/systemd/system/upright.service.d/guest.conf")
    own.parent.mkdir()
    own.write_text(
        "[Service]\nExecStart=\nExecStart=/opt/upright/.venv/bin/upright serve ${VEHICLE} --bus socketcan:vcan0\n"
    )
    run("systemctl", "daemon-reload")
    run("systemctl", "start", "upright")
    assert "set_up" in wait_for_mode(Mode.STARTING)["code"]
    run(*clean, "dpkg", "--purge", "upright")
    assert show("ActiveState") == "inactive"
    assert left_behind() == []
