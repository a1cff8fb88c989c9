"""The multisine that determines a vehicle's parameters in the shortest time within its limits.

Each line is first predicted alone, in the closed loop of the model and the vehicle's controller: what it says about
the parameters (diagnosis.information), and how far it moves each channel that has a limit. From these follow
spectrum, phases and amplitude (diagnosis.prediction.line_spectrum). The result is simulated with the parameters
wherever they may be, and made smaller until no limit is reached.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import degrees
from typing import Any

import numpy as np
from numpy.typing import NDArray

from upright.diagnosis.information import information, predicted_information
from upright.diagnosis.prediction.closed_loop import Controller, Experiment, causal, simulate
from upright.diagnosis.prediction.line_spectrum import Lines, phases, power
from upright.estimators.contract import EstimationError
from upright.models.model import Model
from upright.models.segment import Segment
from upright.service.offline.next_experiment import require_predictable
from upright.telemetry.errors import UprightError
from upright.vehicles import registry
from upright.vehicles.experiment.excitation import ExcitationError, Multisine, make_excitation
from upright.vehicles.file import VehicleFile
from upright.vehicles.sections import REST, ExperimentSection, is_reference

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

NAME = "designed"
SETTLED = 1.0 / 3.0
"""Share of a prediction after which a line is in steady state."""
NORMAL = 1.96
"""Standard deviations to either side that hold 95 %."""
DRAWS, SEED = 40, 51
"""Number and seed of the values that are drawn."""
HALVED = 7
"""How often an amplitude is halved at most."""
ROUNDS = 3
"""Of scaling: a loop that is not quite linear does not use twice as much at twice the amplitude."""
LEAST = 0.05
"""Least share of a value that is drawn: no parameter is zero."""
SMALLER, MOST_SMALLER = 0.95, 40
"""Factor on the amplitude as long as one of them comes too close to a limit, and how often it is tried."""


class MultisineError(UprightError):
    """No multisine can be designed."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """An experiment with the `deviations` that its record leaves, at least, of the parameters by name."""

    name: str
    seconds: float
    deviations: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class DesignedMultisine:
    """`section` of a vehicle file; `largest` share of each limit that it uses, by channel, with the nominal parameters;
    `candidates`: it and the vehicle's own experiments; `about`: the parameters in question."""

    section: ExperimentSection
    largest: Mapping[str, float]
    about: tuple[str, ...]
    candidates: tuple[Candidate, ...]

    @property
    def toml(self) -> str:
        """The section as text for a vehicle file."""
        section = self.section
        lines = ",\n".join(f"    [{f:.6g}, {share:.4f}, {phase:.1f}]" for f, share, phase in section.spectrum or [])
        amplitude = (
            f"amplitude_deg = {section.amplitude_deg:.4g}  # peak"
            if section.amplitude_deg is not None
            else f"amplitude = {section.amplitude:.4g}"
        )
        return (
            f'[experiments.{NAME}]\ntitle = "{section.title}"\nexcitation = "multisine"\nat = "{section.at}"\n'
            f"{amplitude}\nduration = {section.duration:g}\n"
            f"spectrum = [  # Hz, share of the amplitude, deg\n{lines},\n]\n"
        )

    def seconds_like(self, name: str) -> float:
        """s of the designed multisine after which the parameters in question are as well known as after the whole
        experiment `name`."""
        other = next(each for each in self.candidates if each.name == name)
        own = self.candidates[0]
        return own.seconds * max((own.deviations[each] / other.deviations[each]) ** 2 for each in self.about)

    def to_json(self) -> dict[str, Any]:
        return {
            "experiment": self.section.model_dump(exclude_none=True),
            "share_of_limits": dict(self.largest),
            "parameters": list(self.about),
            "candidates": [
                {"name": each.name, "seconds": each.seconds, "std": dict(each.deviations)} for each in self.candidates
            ],
        }


def designed_multisine(
    vehicle: VehicleFile,
    model: Model,
    *,
    about: Sequence[str] = (),
    duration: float = 30.0,
    start: float = 0.1,
    stop: float = 3.0,
    lines: int = 24,
    share: float = 0.5,
    progress: Progress | None = None,
) -> DesignedMultisine:
    """The multisine of at most `lines` lines from `start` to `stop` Hz for the parameters `about`, by default those of
    the vehicle file that `model` estimates, using `share` of each limit.

    Raises MultisineError and ModelError for what cannot be designed, ExcitationError for an impossible signal.
    """
    report = progress or (lambda text, done: None)
    require_predictable(vehicle, model)
    model = causal(registry.of(vehicle.vehicle.kind).prediction().assumed(model))
    names = tuple(each.name for each in model.parameters if each.estimated)
    chosen = tuple(about) or tuple(name for name in names if name in vehicle.parameters.values)
    strange = [name for name in chosen if name not in names]
    if strange or not chosen:
        what = f"the model does not estimate {', '.join(strange)}" if strange else "the model estimates no parameter"
        raise MultisineError(f"{what}.", remedy=f"Use some of: {', '.join(names)}.")
    stand = _Stand(vehicle, model, duration)
    if not stand.at:
        what = f"no experiment of {vehicle.vehicle.id} excites it while it is upright."
        raise MultisineError(what, remedy="Add one to its vehicle file: its injection point is used.")
    known = stand.lines(np.unique(np.round(np.geomspace(start, stop, lines) * duration)) / duration, report)
    best = power(known, [names.index(name) for name in chosen])
    kept, amplitudes = known.of(best > 0.0), np.sqrt(best[best > 0.0])
    report("choosing the phases", 0.6)
    turned, peak = phases(kept, amplitudes)
    section = stand.scaled(stand.multisine(kept.frequency, amplitudes, turned, 0.5 * share / peak), share)
    section = stand.within_limits(section, lambda done: report("checking it with other parameters", 0.7 + 0.2 * done))
    report("comparing it with the vehicle's experiments", 0.9)
    seen = stand.watched(section)
    own = Candidate(NAME, duration, information(model, seen.rows).deviations())
    largest = {name: float(np.max(np.abs(values))) for name, values in seen.shares.items()}
    return DesignedMultisine(section, largest, chosen, (own, *_others(vehicle, model)))


@dataclass(frozen=True, slots=True)
class _Seen:
    """A predicted experiment: its `rows`, and each channel with a limit over that limit, (n,), by name."""

    rows: Segment
    shares: Mapping[str, Array]


@dataclass(frozen=True, slots=True)
class _Stand:
    """The vehicle with `model` in it, for experiments of `duration` s at the first injection point that its own use."""

    vehicle: VehicleFile
    model: Model
    duration: float

    @property
    def at(self) -> str:
        used = {each.at for each in self.vehicle.experiments.values() if each.excitation != "none" and each.gets_up}
        return next((each for each in self.vehicle.INJECTION_POINTS if each in used and each != REST), "")

    def section(self, peak: float, **keys: Any) -> ExperimentSection:
        """An experiment with an excitation of this `peak`, SI."""
        key, factor = ("amplitude_deg", degrees(1.0)) if is_reference(self.at) else ("amplitude", 1.0)
        size = {} if keys["excitation"] == "none" else {key: factor * peak}
        title = f"Multisine for {self.duration:g} s, designed for this vehicle"
        return ExperimentSection.model_validate(
            {"title": title, "at": self.at, "duration": self.duration, **size, **keys}
        )

    def experiment(self, section: ExperimentSection) -> Experiment:
        """Its prediction. Raises ExcitationError."""
        file = self.vehicle.model_copy(update={"experiments": {NAME: section}})
        return registry.of(file.vehicle.kind).prediction().of(file)(NAME)

    def watched(self, section: ExperimentSection) -> _Seen:
        """Raises MultisineError if it comes too close to a limit."""
        experiment, samples = self.experiment(section), list[Mapping[str, float]]()

        def controller(model: Model) -> Controller:
            step = experiment.controller(model)

            def watching(time: float, seen: Mapping[str, float]) -> Mapping[str, float]:
                given = step(time, seen)
                if time >= 0.0:
                    samples.append({**seen, **given})
                return given

            return watching

        course = simulate(self.model, replace(experiment, controller=controller))
        if course.broken:
            remedy = "Use less of the limits; or identify the vehicle first, and give the result."
            raise MultisineError(f"{course.broken}.", remedy=remedy)
        limits = {each.channel: each.largest for each in experiment.limits}
        shares = {name: np.array([sample[name] for sample in samples]) / limit for name, limit in limits.items()}
        return _Seen(course.rows, shares)

    def lines(self, frequencies: Array, report: Progress) -> Lines:
        """Each line predicted alone."""
        still = information(self.model, self.watched(self.section(0.0, excitation="none")).rows)
        period = self.vehicle.period
        matrices, transfers = [], []
        for number, frequency in enumerate(frequencies.tolist()):
            report(f"predicting the line at {frequency:.3g} Hz", 0.6 * number / len(frequencies))
            section, seen = self._alone(frequency)
            peak, ramp = section.amplitude_si, make_excitation(section, 1.0 / period).ramp
            settled = slice(round(SETTLED * self.duration / period), round((self.duration - ramp) / period))
            moved = [_component(each, frequency, period, settled) for each in seen.shares.values()]
            transfers.append(np.array(moved) / (-1j * peak))
            matrices.append((information(self.model, seen.rows).matrix - still.matrix) / peak**2)
        return Lines(frequencies, still.matrix, np.array(matrices), np.array(transfers).T, self.duration)

    def multisine(self, frequencies: Array, amplitudes: Array, turned: Array, factor: float) -> ExperimentSection:
        """With `factor` on the amplitudes."""
        spectrum = zip(
            frequencies.tolist(), (amplitudes / np.max(amplitudes)).tolist(), np.degrees(turned).tolist(), strict=True
        )
        section = self.section(1.0, excitation="multisine", spectrum=list(spectrum))
        waveform = make_excitation(section, float(self.vehicle.control.rate)).waveform
        assert isinstance(waveform, Multisine)
        # The waveform is scaled to a peak of 1; the amplitude of its strongest line is then `scale`.
        return self.section(factor * float(np.max(amplitudes)) / waveform.scale, **_own(section))

    def scaled(self, section: ExperimentSection, share: float) -> ExperimentSection:
        """`section` with the amplitude at which it uses `share` of a limit, its beginning and its end included."""
        for _ in range(ROUNDS):
            smaller, seen = self._watched_smaller(section)
            used = max(float(np.max(np.abs(each))) for each in seen.shares.values())
            section = self.section(share / used * smaller.amplitude_si, **_own(section))
        return section

    def within_limits(self, section: ExperimentSection, report: Callable[[float], None]) -> ExperimentSection:
        """`section`, smaller if need be, so that no limit is reached wherever the estimated parameters may be.

        Raises MultisineError if it would have to become too small to be of use.
        """
        points = self._elsewhere()
        for _ in range(MOST_SMALLER):
            experiment = self.experiment(section)
            for number, values in enumerate(points):
                report(number / len(points))
                if simulate(self.model.change(values), experiment).broken:
                    points = [values, *(each for each in points if each is not values)]
                    break
            else:
                return section
            section = self.section(SMALLER * section.amplitude_si, **_own(section))
        raise MultisineError(
            "with other parameters, within their standard deviations, a limit is reached.",
            remedy="Identify the vehicle first, and give the result: upright multisine RESULT.",
        )

    def _elsewhere(self) -> list[dict[str, float]]:
        """Values that the vehicle's parameters may have: as they are, each alone at the ends of its 95 % interval, and
        all of them drawn."""
        uncertain = [p for p in self.model.parameters if p.name in self.vehicle.parameters.values and p.std > 0.0]
        ends = [{p.name: p.value + side * NORMAL * p.std} for p in uncertain for side in (-1.0, 1.0)]
        random = np.random.default_rng(SEED).standard_normal((DRAWS, len(uncertain)))
        drawn = [{p.name: p.value + p.std * float(x) for p, x in zip(uncertain, each, strict=True)} for each in random]
        least = {p.name: LEAST * p.value for p in uncertain}
        return [{name: max(least[name], value) for name, value in each.items()} for each in ({}, *ends, *drawn)]

    def _alone(self, frequency: float) -> tuple[ExperimentSection, _Seen]:
        """A line alone, at first with half the largest peak that the vehicle's own experiments have here."""
        largest = max(each.amplitude_si for each in self.vehicle.experiments.values() if each.at == self.at)
        return self._watched_smaller(self.section(0.5 * largest, excitation="sine", frequency=frequency))

    def _watched_smaller(self, section: ExperimentSection) -> tuple[ExperimentSection, _Seen]:
        """`section`, with its amplitude halved until it comes too close to no limit, and its prediction.

        Raises MultisineError if it does so nevertheless.
        """
        for _ in range(HALVED):
            try:
                return section, self.watched(section)
            except MultisineError:
                smaller = section.model_dump(exclude_none=True)
                key = "amplitude" if section.amplitude_deg is None else "amplitude_deg"
                section = ExperimentSection.model_validate({**smaller, key: 0.5 * smaller[key]})
        return section, self.watched(section)


def _own(section: ExperimentSection) -> dict[str, Any]:
    return {"excitation": section.excitation, "spectrum": section.spectrum}


def _component(values: Array, frequency: float, period: float, rows: slice) -> complex:
    """The component of `values` at `frequency` Hz over as many whole periods as the `rows` hold: values are the real
    part of it times exp(i omega t).

    Raises MultisineError if they hold none.
    """
    chosen = values[rows]
    count = round(int(len(chosen) * period * frequency + 1e-6) / (frequency * period))
    if not count:
        remedy = f"Make it longer, or begin above {1.0 / (len(chosen) * period):.2g} Hz."
        raise MultisineError(f"no whole period of {frequency:.3g} Hz fits in.", remedy=remedy)
    time = period * (rows.start + np.arange(count))
    turned = np.exp(-2j * np.pi * frequency * time)
    return complex(2.0 * np.mean((chosen[:count] - np.mean(chosen[:count])) * turned))


def _others(vehicle: VehicleFile, model: Model) -> list[Candidate]:
    """The vehicle's own experiments that can be predicted."""
    predict = registry.of(vehicle.vehicle.kind).prediction().of(vehicle)
    found = []
    for name, section in vehicle.experiments.items():
        if section.at == REST or section.excitation == "none" or not section.gets_up:
            continue
        try:
            seen = predicted_information(model, predict(name))
        except (EstimationError, ExcitationError):
            continue
        found.append(Candidate(name, section.duration, seen.deviations()))
    return found
