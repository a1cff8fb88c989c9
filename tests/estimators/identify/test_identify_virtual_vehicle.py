"""From the virtual vehicle's own sensors, roll filter and controller to its parameters: the required accuracy."""

from __future__ import annotations

import numpy as np
import pytest
from closed_loop import ClosedLoop
from monocab_channels import MONOCAB

from upright.diagnosis.prediction.compare import compare
from upright.estimators.identify.run import identify, with_values
from upright.simulation.monocab.truth import PlantTruth
from upright.telemetry.recording import Recording
from upright.telemetry.samples import Frame
from upright.vehicles.monocab.identification.own import OWN
from upright.vehicles.monocab.identification.torque_balance import Method, TorqueBalance
from upright.vehicles.registry import nominal_model

TRUTH = PlantTruth()
METHOD = Method.PLAIN.value


def recorded(loop: ClosedLoop, name: str) -> list[Frame]:
    """The control cycles of one whole experiment."""
    loop.run(name)
    (_, start), (_, end) = loop.witness.recordings[-1], loop.witness.ended[-1]
    return [frame for frame in loop.witness.frames if start <= frame.timestamp_ns <= end]


def recording_of(frames: list[Frame]) -> Recording:
    table = np.array([frame.values for frame in frames])
    stamps = np.array([frame.timestamp_ns for frame in frames])
    return Recording(MONOCAB, stamps, {name: table[:, i] for i, name in enumerate(MONOCAB.names)})


@pytest.mark.parametrize(("experiment", "within"), [("step", 0.03), ("sweep", 0.01)])
def test_inertia_and_gravity_stiffness_of_the_virtual_vehicle_are_estimated(experiment: str, within: float) -> None:
    loop = ClosedLoop()
    vehicle = loop.vehicle
    recording = recording_of(recorded(loop, experiment))
    known, deviations = vehicle.parameters.values, vehicle.parameters.deviations
    model = with_values(nominal_model("monocab"), known, deviations)
    methods = identify([recording], known, vehicle.support, [METHOD], deviations=deviations, model=model, own=OWN)[
        "methods"
    ]
    document = methods[METHOD]
    assert document["status"] == "ok"
    for name, truth in (("inertia", TRUTH.inertia), ("gravity_stiffness", TRUTH.gravity_stiffness)):
        parameter = document["parameters"][name]
        assert parameter["value"] == pytest.approx(truth, rel=within), name
        assert abs(parameter["value"] - truth) < 1.96 * parameter["std"], name

    estimator = TorqueBalance(known, vehicle.support, deviations=deviations, channels=MONOCAB)
    for frame in recording.frames():
        estimator.update(frame)
    model = with_values(nominal_model("monocab"), known, deviations)
    models = {"CAD": model, "identified": with_values(model, estimator.result().values, {})}
    cad, found = compare(models, [recording], support=vehicle.support)
    assert not cad.adequate
    assert found.adequate, found.fails
    assert found.rmse["roll"] < 0.5 * cad.rmse["roll"]
