"""`upright demo` from the command line, and what can be done with its recordings."""

from __future__ import annotations

import json
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path
from typing import Any

import pytest

from upright.service.control.clients import api

UPRIGHT = [sys.executable, "-c", "from upright.service.cli import main; main()"]
TRUTH = {"inertia": 1650.0, "gravity_stiffness": 14500.0}

pytestmark = pytest.mark.timeout(180)


STILL = ("--hide", "disturbance=0")
"""The assertions are about a vehicle without a random disturbance."""


def upright(*words: str, code: int = 0) -> str:
    done = subprocess.run([*UPRIGHT, *words], capture_output=True, text=True, timeout=170, check=False)
    assert done.returncode == code, done.stderr
    return done.stdout if code == 0 else done.stderr


def document(*words: str) -> Any:
    return json.loads(upright(*words, "--json"))


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The folder of a demo's recordings, and what it printed."""
    folder = tmp_path_factory.mktemp("demo")
    return folder, upright("demo", *STILL, "--data", str(folder))


@pytest.fixture(scope="module")
def recordings(told: tuple[Path, str]) -> dict[str, Path]:
    return {name: next(told[0].glob(f"*_{name}.arrow")) for name in ("step", "sweep")}


def compared(text: str, experiment: str) -> dict[str, tuple[float, str]]:
    """By model (what its name begins with): its fit of roll in %, and its verdict, from the table of `experiment`."""
    table = re.search(rf"_{experiment} *\n(.*?)\n +recording ", text, re.DOTALL)
    assert table is not None, text
    rows = re.findall(r"^(\S+) +roll +(\S+) % .* (\w+) *$", table[1], re.MULTILINE)
    return {name: (float(fit), verdict) for name, fit, verdict in rows}


@pytest.mark.parametrize(("name", "bound"), [("step", 0.03), ("sweep", 0.01)])
def test_inertia_and_gravity_stiffness_are_identified(recordings: dict[str, Path], name: str, bound: float) -> None:
    method = "recursive_least_squares"
    found = document("identify", str(recordings[name]), "--method", method)["methods"][method]
    assert found["status"] == "ok"
    for parameter, true in TRUTH.items():
        entry = found["parameters"][parameter]
        assert entry["value"] == pytest.approx(true, rel=bound)
        assert abs(entry["value"] - true) < 1.96 * entry["std"]


def test_cad_model_is_not_adequate_and_the_identified_one_is(told: tuple[Path, str]) -> None:
    by_name = compared(told[1], "sweep")
    assert by_name["CAD"][1] == "fails"
    assert by_name["recursive_least_squares"][1] == "adequate"
    assert by_name["recursive_least_squares"][0] > 95.0 > by_name["CAD"][0]


def test_replay_of_either_file_gives_the_live_estimates(recordings: dict[str, Path]) -> None:
    arrow, log = recordings["step"], recordings["step"].with_suffix(".log")
    results = document("replay", str(arrow), str(log))["recordings"]
    live = json.loads(arrow.with_suffix(".estimates.json").read_text())["methods"]
    assert results[str(arrow)] == results[str(log)] == live


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".mat"])
def test_raw_log_is_converted(recordings: dict[str, Path], tmp_path: Path, suffix: str) -> None:
    target = tmp_path / f"step{suffix}"
    upright("convert", str(recordings["step"].with_suffix(".log")), str(target))
    assert target.stat().st_size > 100_000


def test_truncated_recording_is_identified_with_a_warning(recordings: dict[str, Path], tmp_path: Path) -> None:
    whole = recordings["sweep"].read_bytes()
    cut = tmp_path / "cut.arrow"
    cut.write_bytes(whole[: len(whole) // 2])
    words = ("identify", str(cut), "--method", "recursive_least_squares")
    done = subprocess.run([*UPRIGHT, *words], capture_output=True, text=True, check=True)
    assert "cut.arrow" in done.stderr.replace("\n", "")
    assert "inertia" in done.stdout


def test_hidden_effect_leaves_no_model_adequate_and_is_named_in_the_last_sentence(tmp_path: Path) -> None:
    said = upright("demo", *STILL, "--experiment", "multisine", "--hide", "coulomb_friction", "--data", str(tmp_path))
    said, _, report = said.rpartition("Report: ")
    assert Path(report.strip()) == tmp_path / "diagnosis.html"  # no browser opens it here
    assert (tmp_path / "diagnosis.html").is_file()
    last = " ".join(said.rpartition("\n\n")[2].split())
    # Of the dry frictions, a busy machine may have time for another one.
    assert re.match(r"The model lacks \w+_friction.* \(torque = [56]\d\.\d+ ± \d\.\d+ N m\): with it, the", last)
    assert re.search(r"falls from (\S+) to (\S+) \(1 for a right model\)", last)
    models = compared(said, "multisine")
    assert {"CAD", "recursive_least_squares"} <= models.keys()
    assert {verdict for _, verdict in models.values()} == {"fails"}


def test_unknown_effect_error_lists_the_available_effects(tmp_path: Path) -> None:
    output = upright("demo", "--hide", "gremlins", "--data", str(tmp_path), code=1)
    assert "gremlins" in output
    assert "coulomb_friction" in output


class DashboardDemo:
    """A demo with its dashboard. `port` is the port of the page, `output` the text printed so far."""

    # Under a shell that runs the tests in the background, Ctrl-C would be ignored.
    WORDS = (
        sys.executable,
        "-c",
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
        "from upright.service.cli import main; main()",
    )

    def __init__(self, folder: Path) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        words = ["demo", "--dashboard", "--port", str(self.port), "--experiment", "hold", "--data", str(folder)]
        self.output = ""
        self._until = time.monotonic() + 120.0
        self._running = subprocess.Popen(
            [*self.WORDS, *words], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )

    def __enter__(self) -> DashboardDemo:
        self._running.__enter__()
        return self

    def __exit__(self, *raised: object) -> None:
        self._running.kill()
        self._running.communicate()

    def wait_for(self, words: str) -> None:
        """Wait until it has printed `words`."""
        assert self._running.stdout is not None
        while words not in self.output:
            line = self._running.stdout.readline()
            assert line, f"it ended without {words!r}: {self.output}"
            assert time.monotonic() < self._until, self.output
            self.output += line

    def page(self) -> str:
        with urllib.request.urlopen(f"http://127.0.0.1:{self.port}/", timeout=10.0) as answer:
            return str(answer.read().decode())

    def interrupt(self) -> None:
        """Send Ctrl-C, and collect the output until the demo has ended."""
        self._running.send_signal(signal.SIGINT)
        self.output += self._running.communicate(timeout=30.0)[0]


def test_dashboard_runs_during_the_demo_and_ends_with_it(tmp_path: Path) -> None:
    with DashboardDemo(tmp_path) as demo:
        demo.wait_for("Experiment hold")
        page = demo.page()
        demo.interrupt()
    assert "<title>" in page
    assert f"http://localhost:{demo.port}" in demo.output
    assert "Traceback" not in demo.output
    with pytest.raises(OSError):
        demo.page()


def test_dashboard_keeps_running_after_an_experiment_is_stopped_early(tmp_path: Path) -> None:
    with DashboardDemo(tmp_path) as demo:
        demo.wait_for("Experiment hold")
        time.sleep(1.0)  # the vehicle still rests on its support
        (place,) = tmp_path.glob("*.sock")
        list(api.call([place], {"verb": "stop"}, timeout=30.0))
        demo.wait_for("until Ctrl-C")
        assert "<title>" in demo.page()
        demo.interrupt()
    assert "No report" in demo.output
    assert "Traceback" not in demo.output


def test_occupied_port_error_names_the_port_and_the_remedy(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        output = upright("demo", "--dashboard", "--port", port, "--data", str(tmp_path), code=1)
    assert port in output
    assert "--port" in output


def test_balancing_robot_demo_identifies_compares_and_diagnoses(tmp_path: Path) -> None:
    """It is identified afterwards as well, excluding the seconds in which it gets up."""
    output = upright("demo", *STILL, "--vehicle", "twsbr", "--experiment", "square", "--data", str(tmp_path))
    (recording,) = tmp_path.glob("*_square.arrow")
    fitted = json.loads(recording.with_suffix(".estimates.json").read_text())["methods"]["prediction_error"]
    assert fitted["status"] == "ok"
    assert fitted["parameters"]["motor_constant"]["value"] > 0.0
    assert "fails" in output, "the vehicle file's numbers are off the plant's by up to 40 %"
    assert "adequate: the model explains these recordings to within their noise" in output
    assert recording.with_suffix(".png").stat().st_size > 10_000
    assert "<svg" in (tmp_path / "diagnosis.html").read_text()
