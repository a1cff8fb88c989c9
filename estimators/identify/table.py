"""The methods that identify a vehicle, in groups as in the paper's figure 3, and the recordings that each takes.

Time domain: a step from rest, as in the paper, since nothing moves the vehicle more in so short a time. If no recording
is of a step, they take all: every experiment begins with getting up from the support. Prediction error and the
recursive methods always take all recordings.

Frequency domain: an excitation of the roll reference that covers a band, while the vehicle is balanced. The controller
counteracts an excitation at its own output, so that the low frequencies, and with them the gravity stiffness, are
uncertain (Griese et al., section III-C). A step from rest is not a periodic motion.

A recording that does not state its experiment (a CSV file) is given to every method; the method itself refuses data
that it cannot use.

Each method also states its flaws: reasons why its values deviate by more than their standard deviations imply, and the
conditions. estimators.identify.choice uses them. Sources: Ljung, "System identification", 2nd ed., section 7.6 (noisy
regressors) and chapter 13 (closed loop); docs/explanation/methods.md for the simulation of an unstable model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from upright.telemetry.documents import from_json
from upright.telemetry.recording import Recording


class Domain(StrEnum):
    """Groups of methods."""

    TIME = "time domain"
    FREQUENCY = "frequency domain"
    RECURSIVE = "recursive"
    DRIVES = "drives"
    """Parameters of the actuators, apart from the vehicle."""


class Takes(StrEnum):
    """Which recordings a method takes."""

    ALL = "all recordings"
    STEPS = "steps from rest"
    BANDS = "a sweep or multisine on the reference"


class Condition(StrEnum):
    """When a flaw applies."""

    ALWAYS = "always"
    CLOSED_LOOP = "closed loop"
    """A controller feeds the measurements back."""
    UNSTABLE = "unstable"
    """The model is unstable at the method's values, and the simulations are not short compared with its pole."""


@dataclass(frozen=True, slots=True)
class Flaw:
    """Why a method is not sound if `condition` holds; `reason` completes "not sound here: ..."."""

    condition: Condition
    reason: str


NOISY_REGRESSORS = Flaw(
    Condition.ALWAYS, "its estimate is biased by sensor noise, since its regressors are made of noisy signals"
)
DIRECT_SPECTRUM = Flaw(
    Condition.CLOSED_LOOP,
    "a direct spectral estimate is biased in closed loop, since the controller feeds disturbances back to the input",
)
FREE_RUN = Flaw(
    Condition.UNSTABLE,
    "it simulates without correction, and in the simulation of an unstable model every disturbance grows",
)


@dataclass(frozen=True, slots=True)
class Method:
    """One method, by the name under which it is requested and reported.

    `rank`: of methods that are sound and predict equally well, the one with the lowest rank is chosen; None for a
    method that does not estimate the model. `flaws` state when it is not sound.
    """

    name: str
    domain: Domain
    takes: Takes
    rank: int | None = None
    flaws: tuple[Flaw, ...] = ()


METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        Method("output_error", Domain.TIME, Takes.STEPS, 1, (FREE_RUN,)),
        Method("output_error_simplex", Domain.TIME, Takes.STEPS, 2, (FREE_RUN,)),
        Method("least_squares", Domain.TIME, Takes.STEPS, 7, (NOISY_REGRESSORS,)),
        Method("instrumental_variables", Domain.TIME, Takes.STEPS, 3),
        Method("prediction_error", Domain.TIME, Takes.ALL, 0),
        Method("frequency_output_error", Domain.FREQUENCY, Takes.BANDS, 9, (DIRECT_SPECTRUM,)),
        Method("frequency_equation_error", Domain.FREQUENCY, Takes.BANDS, 10, (NOISY_REGRESSORS, DIRECT_SPECTRUM)),
        Method("recursive_least_squares", Domain.RECURSIVE, Takes.ALL, 8, (NOISY_REGRESSORS,)),
        Method("recursive_instrumental_variables", Domain.RECURSIVE, Takes.ALL, 5),
        Method("recursive_output_error", Domain.RECURSIVE, Takes.ALL, 6, (FREE_RUN,)),
        Method("recursive_prediction_error", Domain.RECURSIVE, Takes.ALL, 4),
        Method("drive_lag", Domain.DRIVES, Takes.ALL),
    )
}
"""In the order in which they are shown. Ranks: methods without a bias first, of these the most precise one first; the
estimates of the frequency domain lack the static torque."""

BANDS = ("sweep", "multisine")


@dataclass(frozen=True, slots=True)
class Experiment:
    """The experiment that a recording states: `excitation` and where it acts, `at`; "" if it does not state it."""

    excitation: str = ""
    at: str = ""

    def __str__(self) -> str:
        if self.excitation in ("", "none"):
            return "no excitation" if self.excitation else "an unknown experiment"
        return f"a {self.excitation} {'from' if self.at == 'rest' else 'at'} {self.at.replace('_', ' ')}"


def experiment_of(recording: Recording) -> Experiment:
    """The experiment of a recording's metadata."""
    try:
        definition = from_json(recording.metadata.get("experiment_definition", "{}"))
        return Experiment(str(definition.get("excitation") or ""), str(definition.get("at") or ""))
    except (ValueError, AttributeError):
        return Experiment()


def unsuited(method: Method, experiments: Sequence[Experiment]) -> list[str]:
    """Why `method` leaves out each of the recordings of these `experiments`; "" for those that it takes."""
    stepped = any(each.excitation == "step" for each in experiments)

    def reason(experiment: Experiment) -> str:
        if not experiment.excitation:
            return ""
        if method.takes is Takes.BANDS and (experiment.excitation not in BANDS or experiment.at == "controller_output"):
            return f"it is of {experiment}; this method takes {method.takes}"
        if method.takes is Takes.STEPS and stepped and experiment.excitation != "step":
            return f"it is of {experiment}; this method takes {method.takes}, and there are some"
        return ""

    return [reason(experiment) for experiment in experiments]
