"""A plant at another pace gets the same diagnosis: verdict, names and amplitudes in their own units do not change."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from thorough import of_many

from upright.diagnosis.diagnose import Diagnosis, Finding, Verdict, diagnose
from upright.diagnosis.prepare.usable import check, needed
from upright.estimators.data.segments import DataError, segments
from upright.estimators.data.time_scale import motion_time, time_scale
from upright.models.attach import starts
from upright.models.effects.catalogue import CATALOGUE
from upright.models.file.model_file import load_model
from upright.models.model import Model
from upright.models.natural_time import natural_time
from upright.models.parts import ModelError
from upright.telemetry.channels import Channel, ChannelTable
from upright.telemetry.recording import Recording
from upright.vehicles.monocab.model import MODELS as MONOCABS
from upright.vehicles.twsbr.model import MODELS as ROBOTS

PACES = (0.01, 1.0, 100.0)
"""Seconds that the plant takes for what takes one second at pace 1."""
MASS, STIFFNESS, DAMPING = 2.0, 50.0, 4.0
NOISE = 2e-5
LATE = 0.045
"""s by which the force acts late if that is the hidden effect."""
SPACING, FINER, DURATION = 0.01, 20, 24.0
CHANNELS = ChannelTable((Channel("position", "m", "of the mass"), Channel("force", "N", "on it")))
Missing = Callable[[float, float, float], float]
HIDDEN: dict[str, tuple[Missing, dict[str, tuple[float, int]]]] = {
    "viscous_friction": (lambda t, x, v: -0.5 * v, {"coefficient": (0.5, 1)}),
    "coulomb_friction": (lambda t, x, v: -0.1 * v / math.hypot(v, 2e-3), {"torque": (0.1, 0)}),
    "cubic_stiffness": (lambda t, x, v: -900.0 * x**3, {"coefficient": (900.0, 0)}),
    "periodic_disturbance": (lambda t, x, v: 0.1 * math.sin(2.0 * math.pi * 2.7 * t + 0.3), {"frequency": (2.7, -1)}),
    "torque_step": (lambda t, x, v: 0.3 if t > 11.0 else 0.0, {"torque": (0.3, 0), "start": (11.0, 1)}),
    "input_delay": (lambda t, x, v: 0.0, {"delay": (LATE, 1)}),
}
"""Force (N) of time, position and rate at pace 1; the true parameters, and the power of time in their units."""
AMBIGUOUS = {"torque_step"}
"""A slow random force may imitate it: only identical results at all paces are required."""
FILE = """
title = "Mass on a spring"

[parameters]
mass = {{ unit = "kg", value = {mass!r}, std = {mass_std!r}, lower = 0.0 }}
stiffness = {{ unit = "N/m", value = 48.0, std = 10.0 }}
damping = {{ unit = "N s/m", value = {damping!r}, estimated = false }}

[states.position]
unit = "m"
derivative = "rate"
initial = "position"
initial_std = 1e-3

[states.rate]
unit = "m/s"
derivative = "axis_force / mass"
initial_std = {rate!r}
process_noise = {process_noise!r}

[inputs.force]
unit = "N"
hold = "zero_order"

[outputs.position]
unit = "m"
expression = "position"
noise = 1e-4

[joints.axis]
coordinate = "position"
rate = "rate"
inertia = "mass"
load = "force - stiffness * position - damping * rate"
force_unit = "N"
coordinate_unit = "m"
force_scale = 1.0
coordinate_scale = 0.1
rate_scale = {rate_scale!r}
smooth_rate = {smooth_rate!r}

[actuators.drive]
command = "force"
joint = "axis"
rate_unit = "N"
command_scale = 2.0

[sensors.encoder]
angle = "position"
angle_unit = "m"
angle_scale = 0.1
"""


def model(folder: Path, pace: float) -> Model:
    """The model file of a user whose plant takes `pace` times as long for everything."""
    path = folder / f"mass_{pace:g}.toml"
    text = FILE.format(
        mass=1.9 * pace**2,
        mass_std=0.4 * pace**2,
        damping=DAMPING * pace,
        rate=0.3 / pace,
        process_noise=1e-3 / pace**1.5,
        rate_scale=0.25 / pace,
        smooth_rate=1e-3 / pace,
    )
    path.write_text(text)
    return load_model(path)


@cache
def columns(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Position and force of the plant at pace 1, by the leapfrog rule, twenty steps per sample."""
    missing = HIDDEN[name][0] if name else lambda t, x, v: 0.0
    random = np.random.default_rng(31)
    count = round(DURATION / SPACING)
    waves = np.array([0.11, 0.23, 0.41, 0.67, 1.1, 1.7, 2.3])
    phases = random.uniform(0.0, 2.0 * math.pi, len(waves))
    forces = np.sum(np.sin(2.0 * math.pi * np.outer(np.arange(count) * SPACING, waves) + phases), axis=1)
    position, rate, step = 0.0, 0.0, SPACING / FINER
    positions = np.empty(count)
    late = round(LATE / step) if name == "input_delay" else 0
    acting = np.repeat(forces, FINER).tolist()
    for row in range(count):
        positions[row] = position
        for part in range(FINER):
            time = row * SPACING + part * step
            force = acting[max(row * FINER + part - late, 0)]
            for half in (0, 1):
                push = force - STIFFNESS * position - DAMPING * rate + missing(time + half * step, position, rate)
                rate += 0.5 * step * push / MASS
                position += step * rate * (1 - half)
    return positions + NOISE * random.standard_normal(count), forces


def recording(name: str, pace: float, every: int = 1) -> Recording:
    position, force = (each[::every] for each in columns(name))
    stamps = (np.arange(len(position)) * every * SPACING * pace * 1e9).round().astype(np.int64)
    return Recording(CHANNELS, stamps, {"position": position, "force": force}, source="mass")


def diagnosed(folder: Path, name: str, pace: float) -> Diagnosis:
    return diagnose(model(folder, pace), [recording(name, pace)])


@pytest.mark.parametrize("name", of_many([*HIDDEN, ""], "torque_step", ""))
def test_diagnosis_does_not_depend_on_the_pace_of_the_plant(name: str, tmp_path: Path) -> None:
    usual, *others = (diagnosed(tmp_path, name, pace) for pace in (1.0, *PACES))
    if name not in AMBIGUOUS:
        assert usual.verdict is (Verdict.MISSING_EFFECT if name else Verdict.ADEQUATE), usual.reason
        assert [name in names(each) for each in usual.findings] == [True][: bool(name)]
    for pace, found in zip(PACES, others, strict=True):
        assert found.verdict is usual.verdict, found.reason
        # Rounding decides which of indistinguishable effects comes first.
        assert [names(each) for each in found.findings] == [names(each) for each in usual.findings]
        for here, there in zip(found.findings, usual.findings, strict=True):
            for local, (true, power) in HIDDEN[name][1].items():
                one, other = (each.parameters[f"{each.effect}.{local}"] for each in (here, there))
                assert one.value is not None
                assert one.std is not None
                assert other.value is not None
                unit = pace**power
                assert abs(one.value / unit - other.value) < 0.1 * one.std / unit
                assert one.value / unit == pytest.approx(true, rel=0.03)


def names(finding: Finding) -> set[str]:
    return {finding.effect, *finding.tied_with}


def test_time_scales_and_required_durations_follow_the_plant(tmp_path: Path) -> None:
    for pace in PACES:
        plant = model(tmp_path, pace)
        rows = segments(plant, [recording("", pace)])
        assert natural_time(plant) == pytest.approx(0.4 * pace)
        assert time_scale(plant, rows) == pytest.approx(0.4 * pace)
        moves = motion_time(plant, rows)
        assert moves is not None
        assert moves == pytest.approx(pace * (motion_time(plant, segments(plant, [recording("", 1.0)])) or 0.0))
        check(plant, [recording("", pace)])
        with pytest.raises(DataError, match="cannot distinguish effects"):
            check(plant, [recording("", pace).between(0.0, 6.0 * pace)])


def test_record_of_few_samples_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="400 samples of free motion"):
        check(model(tmp_path, 1.0), [recording("", 1.0, every=6)])


def test_record_bounds_a_time_scale_that_is_far_off(tmp_path: Path) -> None:
    """A model file with the rate of a plant that is a hundred times slower: it implies 40 s, but the record has 24."""
    slow = model(tmp_path, 100.0)
    (there,) = segments(slow, [recording("", 1.0)])
    swing = [replace(there, measured=0.01 * np.sin(4.0 * math.pi * there.time)[:, None])]
    assert natural_time(slow) == pytest.approx(40.0)
    assert motion_time(slow, swing) == pytest.approx(1.0 / (4.0 * math.pi), rel=0.01)
    assert time_scale(slow, swing) < 0.5
    assert needed(slow, swing) < 10.0
    few = [replace(there, time=100.0 * there.time)]
    assert time_scale(model(tmp_path, 0.01), few) == pytest.approx(10.0)  # ten of its samples, 1 s apart


@pytest.mark.parametrize("model", [*MONOCABS, *ROBOTS], ids=lambda model: str(model.name))
def test_natural_time_of_the_monocab_and_robot_models_is_400_ms(model: Model) -> None:
    assert natural_time(model) == 0.4


@pytest.mark.parametrize("name", CATALOGUE)
def test_durations_and_frequencies_of_an_effect_follow_the_plant(name: str, tmp_path: Path) -> None:
    usual, fast = (model(tmp_path, pace) for pace in (1.0, 0.01))
    try:
        parts = [(each, each.add(name).effects[-1]) for each in (usual, fast)]
    except ModelError:
        return  # no such place
    power = {"s": 1, "Hz": -1}
    for one, other in zip(*(attached.parameters for _, attached in parts), strict=True):
        if one.unit not in power:
            continue
        local, factor = one.name.split(".")[1], 0.01 ** power[one.unit]
        numbers = [
            (p.value, p.scale, p.lower, p.upper, *starts(plant, attached, local))
            for p, (plant, attached) in zip((one, other), parts, strict=True)
        ]
        assert numbers[1] == pytest.approx([factor * each for each in numbers[0]])
