"""The methods that identify a vehicle, in groups as in the paper's figure 3, and which recordings each of them takes.

Time domain: a step from rest, as in the paper, since nothing moves the vehicle more in so short a time. Where no
recording is of a step, they take all: every experiment begins with getting up from the support. Prediction error and
the recursive methods take all recordings at once anyway.

Frequency domain: an excitation of the roll reference that covers a band, while the vehicle is balanced. One at the
controller's output the controller works against, which leaves the low frequencies, and so the gravity stiffness, unsure
(Griese et al., section III-C); a step from rest is no periodic motion at all.

A recording that does not say which experiment it is of (a CSV file) is given to every method; the method itself refuses
what it cannot use.

Each method also states its flaws: what makes its values deviate by more than their standard deviations say, and under
which condition. estimators.identify.choice reads them. Sources: Ljung, "System identification", 2nd ed., section 7.6
(noisy regressors) and chapter 13 (closed loop); docs/explanation/methods.md for
the simulation of an unstable model.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from telemetry.recording import Recording


class Domain(StrEnum):
    """Groups of methods."""

    TIME = "time domain"
    FREQUENCY = "frequency domain"
    RECURSIVE = "recursive"
    DRIVES = "drives"
    """What is told of the actuators, apart from the vehicle."""


class Takes(StrEnum):
    """Which recordings a method takes."""

    ALL = "all recordings"
    STEPS = "steps from rest"
    BANDS = "a sweep or multisine on the reference"


class Condition(StrEnum):
    """When a flaw counts."""

    ALWAYS = "always"
    CLOSED_LOOP = "closed loop"
    """A controller acts on what is measured."""
    UNSTABLE = "unstable"
    """The model is unstable at the method's values, and the simulations are not short against its pole."""


@dataclass(frozen=True, slots=True)
class Flaw:
    """Why a method is not sound where `condition` holds; `reason` completes "not sound here: ..."."""

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
    """One method by the name it is asked for and reported by.

    `rank`: of methods that are sound and predict equally well, the one with the lowest rank is chosen; None for one
    that does not estimate the model. `flaws` say when it is not sound.
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
"""In the order in which they are shown. Ranks: methods without a bias first, and of these the most precise one; what
the frequency domain estimates lacks the static torque."""

BANDS = ("sweep", "multisine")


@dataclass(frozen=True, slots=True)
class Experiment:
    """What a recording says it is of: `excitation` and where it acts, `at`; "" where it does not say."""

    excitation: str = ""
    at: str = ""

    def __str__(self) -> str:
        if self.excitation in ("", "none"):
            return "no excitation" if self.excitation else "an unknown experiment"
        return f"a {self.excitation} {'from' if self.at == 'rest' else 'at'} {self.at.replace('_', ' ')}"


def experiment_of(recording: Recording) -> Experiment:
    """The experiment of a recording's metadata."""
    try:
        definition = json.loads(recording.metadata.get("experiment_definition", "{}"))
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
