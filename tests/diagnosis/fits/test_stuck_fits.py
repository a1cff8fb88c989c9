"""Fits that had stopped short of the optimum, on the records on which they did."""

from __future__ import annotations

from upright.diagnosis.diagnose import diagnose
from upright.diagnosis.parts import diagnose_actuators
from upright.estimators.identify.run import with_values
from upright.models.effects.catalogue import find
from upright.service.virtual.run import record
from upright.vehicles import registry
from upright.vehicles.file import load
from upright.vehicles.registry import nominal_model

VEHICLE = load("monocab")
VALUES, DEVIATIONS = VEHICLE.parameters.values, VEHICLE.parameters.deviations
MODEL = with_values(nominal_model("monocab").remove("static_torque"), VALUES, DEVIATIONS)


def test_fit_of_the_model_alone_continues_from_its_apparent_optimum() -> None:
    """It was 1,200 nats short, and so was the fit with each effect: none appeared to be missing."""
    hide = ("input_deadband=0.0110519", "load_dependent_friction=0.00994092")
    recording = record("monocab", "multisine", hide=hide, seed=239602470, duration=30.0)
    actuators = [with_values(each, VALUES, DEVIATIONS) for each in registry.of("monocab").models().actuators]
    candidates = [find(name) for name in ("input_deadband", "input_gain", "input_asymmetry")]
    found = diagnose_actuators(actuators, [recording], support=VEHICLE.support, candidates=candidates)
    assert [each.effect for each in found.findings] == ["input_deadband"]


def test_quick_fit_that_overshoots_restarts_from_zero_amplitude() -> None:
    """Beside a creeping torque, the score test's amplitude of the scale increased the error, and so did half of it."""
    hide = ("sensor_scale=-1.16901", "torque_drift=-0.129222")
    recording = record("monocab", "multisine", hide=hide, seed=675140893, duration=30.0)
    candidates = ("sensor_scale", "sensor_offset", "torque_drift", "static_torque")
    found = diagnose(MODEL, [recording], support=VEHICLE.support, candidates=candidates)
    assert [each.effect for each in found.findings] == ["torque_drift", "sensor_scale"]
