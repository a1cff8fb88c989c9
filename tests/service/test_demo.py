"""The story as a person runs it: `upright demo` from the command line, and what can be done with its recordings."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path
from typing import Any

import pytest

from service.control import api

UPRIGHT = [sys.executable, "-c", "from service.cli import main; main()"]
TRUTH = {"inertia": 1650.0, "gravity_stiffness": 14500.0}

pytestmark = pytest.mark.timeout(180)


STILL = ("--hide", "disturbance=0")
"""What is asserted of a demo is asserted of a vehicle that nothing shakes."""


def upright(*words: str, code: int = 0) -> str:
    done = subprocess.run([*UPRIGHT, *words], capture_output=True, text=True, timeout=170, check=False)
    assert done.returncode == code, done.stderr
    return done.stdout if code == 0 else done.stderr


def document(*words: str) -> Any:
    return json.loads(upright(*words, "--json"))


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("demo")
    upright("demo", *STILL, "--data", str(folder))
    return {name: next(folder.glob(f"*_{name}.arrow")) for name in ("step", "sweep")}


@pytest.mark.parametrize(("name", "bound"), [("step", 0.03), ("sweep", 0.01)])
def test_inertia_and_gravity_stiffness_come_out(recordings: dict[str, Path], name: str, bound: float) -> None:
    method = "recursive_least_squares"
    found = document("identify", str(recordings[name]), "--method", method)["methods"][method]
    assert found["status"] == "ok"
    for parameter, true in TRUTH.items():
        entry = found["parameters"][parameter]
        assert entry["value"] == pytest.approx(true, rel=bound)
        assert abs(entry["value"] - true) < 1.96 * entry["std"]


def test_the_cad_model_fails_and_the_identified_one_is_adequate(recordings: dict[str, Path]) -> None:
    sweep = recordings["sweep"]
    models = document("compare", str(sweep), "--model", str(sweep.with_suffix(".estimates.json")))["models"]
    by_name = {model["name"]: model for model in models}
    assert not by_name["CAD"]["adequate"]
    assert by_name["recursive_least_squares"]["adequate"]
    assert by_name["recursive_least_squares"]["fit_percent"]["roll"] > 95 > by_name["CAD"]["fit_percent"]["roll"]


def test_replay_gives_the_live_numbers_from_either_file(recordings: dict[str, Path]) -> None:
    arrow, log = recordings["step"], recordings["step"].with_suffix(".log")
    results = document("replay", str(arrow), str(log))["recordings"]
    live = json.loads(arrow.with_suffix(".estimates.json").read_text())["methods"]
    assert results[str(arrow)] == results[str(log)] == live


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".mat"])
def test_a_raw_log_converts(recordings: dict[str, Path], tmp_path: Path, suffix: str) -> None:
    target = tmp_path / f"step{suffix}"
    upright("convert", str(recordings["step"].with_suffix(".log")), str(target))
    assert target.stat().st_size > 100_000


def test_a_truncated_recording_gives_what_it_holds_and_says_so(recordings: dict[str, Path], tmp_path: Path) -> None:
    whole = recordings["sweep"].read_bytes()
    cut = tmp_path / "cut.arrow"
    cut.write_bytes(whole[: len(whole) // 2])
    words = ("identify", str(cut), "--method", "recursive_least_squares")
    done = subprocess.run([*UPRIGHT, *words], capture_output=True, text=True, check=True)
    assert "cut.arrow" in done.stderr.replace("\n", "")
    assert "inertia" in done.stdout


def test_a_hidden_effect_makes_the_model_fail(tmp_path: Path) -> None:
    upright("demo", *STILL, "--experiment", "multisine", "--hide", "coulomb_friction", "--data", str(tmp_path))
    recording = next(tmp_path.glob("*_multisine.arrow"))
    models = document("compare", str(recording), "--model", str(recording.with_suffix(".estimates.json")))["models"]
    assert not any(model["adequate"] for model in models)


def test_an_effect_that_does_not_exist_lists_those_that_do(tmp_path: Path) -> None:
    said = upright("demo", "--hide", "gremlins", "--data", str(tmp_path), code=1)
    assert "gremlins" in said
    assert "coulomb_friction" in said


class Shown:
    """A demo that shows its dashboard. `port` is the page's, `said` what it has printed so far."""

    # Under a shell that runs the tests in the background, Ctrl-C would be ignored.
    WORDS = (
        sys.executable,
        "-c",
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); from service.cli import main; main()",
    )

    def __init__(self, folder: Path) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        words = ["demo", "--dashboard", "--port", str(self.port), "--experiment", "hold", "--data", str(folder)]
        self.said = ""
        self._until = time.monotonic() + 120.0
        self._running = subprocess.Popen(
            [*self.WORDS, *words], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )

    def __enter__(self) -> Shown:
        self._running.__enter__()
        return self

    def __exit__(self, *raised: object) -> None:
        self._running.kill()
        self._running.communicate()

    def wait_for(self, words: str) -> None:
        """Until it has said `words`."""
        assert self._running.stdout is not None
        while words not in self.said:
            line = self._running.stdout.readline()
            assert line, f"it ended without {words!r}: {self.said}"
            assert time.monotonic() < self._until, self.said
            self.said += line

    def page(self) -> str:
        with urllib.request.urlopen(f"http://127.0.0.1:{self.port}/", timeout=10.0) as answer:
            return str(answer.read().decode())

    def interrupt(self) -> None:
        """Ctrl-C, and what it says until it has ended."""
        self._running.send_signal(signal.SIGINT)
        self.said += self._running.communicate(timeout=30.0)[0]


def test_the_dashboard_is_there_while_it_runs_and_ends_with_it(tmp_path: Path) -> None:
    with Shown(tmp_path) as demo:
        demo.wait_for("Experiment hold")
        page = demo.page()
        demo.interrupt()
    assert "<title>" in page
    assert f"http://localhost:{demo.port}" in demo.said
    assert "Traceback" not in demo.said
    with pytest.raises(OSError):
        demo.page()


def test_an_experiment_that_is_stopped_early_leaves_the_dashboard_running(tmp_path: Path) -> None:
    with Shown(tmp_path) as demo:
        demo.wait_for("Experiment hold")
        time.sleep(1.0)  # it rests on its support still
        (place,) = tmp_path.glob("*.sock")
        list(api.call([place], {"verb": "stop"}, timeout=30.0))
        demo.wait_for("until Ctrl-C")
        assert "<title>" in demo.page()
        demo.interrupt()
    assert "No report" in demo.said
    assert "Traceback" not in demo.said


def test_a_port_that_is_taken_is_said_with_the_remedy(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        said = upright("demo", "--dashboard", "--port", port, "--data", str(tmp_path), code=1)
    assert port in said
    assert "--port" in said


def test_the_balancing_robot_has_a_story_of_its_own(tmp_path: Path) -> None:
    """It is identified afterwards as well, without the seconds in which it gets up."""
    told = upright("demo", *STILL, "--vehicle", "twsbr", "--experiment", "square", "--data", str(tmp_path))
    (recording,) = tmp_path.glob("*_square.arrow")
    fitted = json.loads(recording.with_suffix(".estimates.json").read_text())["methods"]["prediction_error"]
    assert fitted["status"] == "ok"
    assert fitted["parameters"]["motor_constant"]["value"] > 0.0
    assert "fails" in told, "the vehicle file's numbers are off the plant's by up to 40 %"
    assert "adequate: the model explains these recordings to within their noise" in told
    assert recording.with_suffix(".png").stat().st_size > 10_000
    assert "<svg" in (tmp_path / "diagnosis.html").read_text()
