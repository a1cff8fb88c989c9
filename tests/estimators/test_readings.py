"""Physics shows how a table is to be read, and an effect that the model lacks is no reason to ask."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from pendulum_plant import Missing, nothing, write

from upright.estimators.readings.question import question
from upright.models.file.model_file import load_model
from upright.models.model import Model
from upright.service.offline.inputs.wanted import wanted
from upright.telemetry.recording import Recording
from upright.telemetry.storage import load
from upright.telemetry.tables.mapping import said_of

MANUAL = Path(__file__).resolve().parents[2] / "docs" / "how-to" / "write-your-own-model.md"
Change = Callable[[Recording], Recording]


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Model:
    """The manual's pendulum."""
    blocks = re.findall(r"```toml\n(.*?)```", MANUAL.read_text(), re.S)
    path = tmp_path_factory.mktemp("manual") / "pendulum.toml"
    path.write_text(blocks[0])
    return load_model(path)


def run(folder: Path, model: Model, missing: Missing = nothing, **plant: float) -> Recording:
    path = write(folder / "run.csv", missing, seed=3, duration=12.0, **plant)  # type: ignore[arg-type]
    return load(path, wanted([model]))


@pytest.fixture(scope="module")
def plain(model: Model, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return run(tmp_path_factory.mktemp("plain"), model)


def times(factor: float, recording: Recording) -> Recording:
    since = (recording.timestamp_ns - recording.timestamp_ns[0]) * factor
    return replace(recording, timestamp_ns=np.round(since).astype(np.int64))


def changed(recording: Recording, **channels: Callable[[np.ndarray], np.ndarray]) -> Recording:
    values = {name: channels.get(name, np.copy)(column) for name, column in recording.values.items()}
    return replace(recording, values=values)


def exchanged(recording: Recording) -> Recording:
    return replace(recording, values={"voltage": recording["angle"], "angle": recording["voltage"]})


def pwm(volts: np.ndarray) -> np.ndarray:
    return np.round(volts * 255.0 / 24.0)


@dataclass(frozen=True)
class Wrong:
    name: str
    change: Change
    says: str
    options: tuple[str, ...]


WRONG = (
    Wrong("ms", partial(times, 1e3), "time in milliseconds", ("--assume time=ms",)),
    Wrong("us", partial(times, 1e6), "time in microseconds", ("--assume time=us",)),
    Wrong("minutes", partial(times, 1.0 / 60.0), "time in minutes", ("--assume time=min",)),
    Wrong("degrees", partial(changed, angle=np.degrees), "angle in degrees", ("--assume angle=deg",)),
    Wrong("turns", partial(changed, angle=lambda a: a / 2.0 / np.pi), "in revolutions", ("--assume angle=rev",)),
    Wrong("millivolts", partial(changed, voltage=lambda u: 1e3 * u), "in millivolts", ("--assume voltage=mV",)),
    Wrong(
        "turned",
        partial(changed, angle=np.negative),
        "with the opposite sign",
        ("--assume voltage=-1", "--assume angle=-1"),
    ),
    Wrong("exchanged", exchanged, "exchanged with", ("--assume voltage=swapped:angle",)),
    Wrong("PWM", partial(changed, voltage=pwm), "PWM count", ("--assume voltage=0.0",)),
    Wrong("PWM, turned", partial(changed, voltage=lambda u: -pwm(u)), "PWM count", ("--assume voltage=-0.0",)),
    Wrong(
        "ms and degrees",
        lambda recording: times(1e3, changed(recording, angle=np.degrees)),
        "time in milliseconds and angle in degrees",
        ("--assume time=ms --assume angle=deg",),
    ),
)


@pytest.mark.parametrize("case", WRONG, ids=lambda case: case.name)
def test_what_a_table_does_not_state_is_found_and_asked(case: Wrong, model: Model, plain: Recording) -> None:
    asked = question(model, [case.change(plain)])
    assert asked is not None
    assert case.says in asked.what
    for option in case.options:
        assert option in asked.remedy


def test_factor_of_a_pwm_count_is_estimated(model: Model, plain: Recording) -> None:
    asked = question(model, [changed(plain, voltage=pwm)])
    assert asked is not None
    # The model's CAD values decide: 0.3 N m/V and 9.8 +- 2 N m/rad, where it is 11.5.
    assert float(asked.together[0].changes[0][1].unit) == pytest.approx(24.0 / 255.0, rel=0.2)


def test_wrapped_angle_is_found_if_it_jumps(model: Model, plain: Recording) -> None:
    # Its range is that of an encoder whose zero is amid the motion.
    wrapped = changed(plain, angle=lambda angle: np.mod(angle, 2.0 * np.pi))
    asked = question(model, [wrapped])
    assert asked is not None
    assert asked.remedy.startswith("read it with --assume angle=wrapped;")
    again = asked.together[0].of(wrapped)
    assert again is not None
    whole = np.round((again["angle"] - plain["angle"])[0] / (2.0 * np.pi)) * 2.0 * np.pi
    np.testing.assert_allclose(again["angle"] - whole, plain["angle"], atol=1e-9)


EFFECTS: dict[str, Missing] = {
    "nothing": nothing,
    "dry friction": lambda time, angle, rate: -0.6 * np.sign(rate),
    "much drag": lambda time, angle, rate: -0.8 * rate,
    "static torque": lambda time, angle, rate: 1.5,
    "hardening": lambda time, angle, rate: -40.0 * angle**3,
}


@pytest.mark.parametrize("name", EFFECTS)
def test_missing_effect_is_no_question(name: str, model: Model, tmp_path: Path) -> None:
    assert question(model, [run(tmp_path, model, EFFECTS[name])]) is None


@pytest.mark.parametrize("plant", [{"dead_band": 2.0}, {"late": 0.02}, {"early": 0.005}], ids=str)
def test_effect_of_an_actuator_or_a_sensor_is_no_question(
    plant: dict[str, float], model: Model, tmp_path: Path
) -> None:
    assert question(model, [run(tmp_path, model, **plant)]) is None


def test_gain_within_what_physics_may_be_is_no_question(model: Model, plain: Recording) -> None:
    assert question(model, [changed(plain, voltage=lambda volts: 1.4 * volts)]) is None


def test_channel_that_its_user_settled_is_not_questioned(model: Model, plain: Recording) -> None:
    wrong = changed(plain, angle=np.degrees)
    assert question(model, [wrong], said_of((), ("angle=1", "voltage=1", "time=s")).settled) is None


def test_question_is_an_error_with_both_ways_out(model: Model, plain: Recording) -> None:
    asked = question(model, [changed(plain, angle=np.degrees)])
    assert asked is not None
    text = str(asked.error())
    assert "run.csv" in text
    assert "Remedy: read it with --assume angle=deg; if it is right as it is, with --assume angle=1." in text
