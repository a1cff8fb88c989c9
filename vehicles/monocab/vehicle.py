"""The MONOCAB's entry in the registry."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from upright.vehicles.contract import Models, Prediction, Twin, VehicleKind
from upright.vehicles.monocab.channels import CHANNELS
from upright.vehicles.monocab.control.controller import design
from upright.vehicles.monocab.control.full import design_full
from upright.vehicles.monocab.file import FULL, REDUCED, MonocabFile
from upright.vehicles.monocab.kind import Monocab
from upright.vehicles.monocab.views import VIEWS

if TYPE_CHECKING:
    from upright.diagnosis.prediction.closed_loop_error import Loop
    from upright.estimators.identify.subject import OwnMethods
    from upright.models.control_design.robustness import CheckedDesign, Known
    from upright.telemetry.recording import Recording
    from upright.vehicles.contract import Measure


def _models() -> Models:
    from upright.vehicles.monocab.gimbals import SPEED_LOOPS
    from upright.vehicles.monocab.model import MONOCAB_ROLL

    return Models(MONOCAB_ROLL.add("static_torque"), SPEED_LOOPS)


def _identification() -> OwnMethods:
    from upright.vehicles.monocab.identification.own import OWN

    return OWN


def _recorded_loop(vehicle: MonocabFile, recording: Recording) -> Loop | str:
    from upright.vehicles.monocab.recorded_loop import recorded_loop

    return recorded_loop(vehicle, recording)


def _designs(vehicle: MonocabFile, known: Known) -> dict[str, CheckedDesign]:
    found: dict[str, CheckedDesign] = {REDUCED: design(vehicle, known=known)}
    if any(drive.role == "trim" for drive in vehicle.drive):
        found[FULL] = design_full(vehicle, known=known)
    return found


def _prediction() -> Prediction:
    from upright.vehicles.monocab import predicted

    return Prediction(predicted.NEEDS, predicted.GIVES, predicted.predictor)


def _twin() -> Twin:
    from upright.simulation.monocab.truth import PlantTruth

    return Twin(PlantTruth(), "upright_servo.eds")


def _evaluations() -> dict[str, Measure]:
    from upright.vehicles.monocab.identification.flywheels import run_down, spin_up
    from upright.vehicles.monocab.identification.static_torque import static_torque
    from upright.vehicles.monocab.identification.trim_effect import trim_effect

    return {"spin_up": spin_up, "run_down": run_down, "static_torque": static_torque, "trim_effect": trim_effect}


def _measured(vehicle: MonocabFile, recordings: Sequence[Recording]) -> Mapping[str, tuple[float, float]]:
    from upright.vehicles.monocab.identification.flywheels import measured

    return measured(vehicle, recordings)


KIND = VehicleKind(
    file=MonocabFile,
    channels=CHANNELS,
    kind=Monocab,
    views=VIEWS,
    models=_models,
    identification=_identification,
    recorded_loop=_recorded_loop,
    designs=_designs,
    prediction=_prediction,
    twin=_twin,
    shaken=(2.0, 20.0),
    evaluations=_evaluations,
    measured=_measured,
)
