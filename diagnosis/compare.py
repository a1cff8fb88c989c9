"""Model against measurement: how far it predicts, what torque it misses, and whether that is more than noise.

Two views of the same recording, of free motion only:

* Prediction. Roll and roll rate 0.05, 0.2 and 0.5 s ahead of the measured state, beside the noise floor: what the
  sensors alone would make of a perfect model.
* Missing torque. What the filtered torque balance leaves over, N m: the model's terms less the measured gyroscopic and
  trim torque. A fraction of a sample of misalignment between drives and IMU is fitted along, since it says nothing
  about the vehicle; its size is told.

`adequate` is the outcome of four tests on the missing torque, each at a hundredth: its energy against that of the
sensor noise sent through the same filter (by time, over the whole record and in windows; by frequency, in octaves), its
mean by bins of roll, roll rate, precession and precession rate (against a parametric bootstrap of the noise), and its
mean overall. What the roll filter still has to learn of the gyro bias when a recording begins is no failure of the
model: it is allowed for with the part of the filter's own standard deviation that has yet to go.
SI units, signs as in telemetry.channels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import welch
from scipy.stats import chi2, norm

from estimators.balance_rows import BALANCE_CHANNELS, BalanceRow, BalanceRows, FilterConfig
from estimators.contract import EstimationError
from estimators.prediction import SETTLED, FreeMotion, Noise, Prediction, free_motion, predict, sensor_noise
from telemetry.recording import Recording

Array = NDArray[np.float64]

HORIZONS = (0.05, 0.2, 0.5)
"""s ahead that predictions reach; figures that name no horizon are those of the last."""
LEVEL = 0.01
"""Probability with which a test rejects a model that is right."""
FLOOR_TOLERANCE = 1.5
"""Energy over the floor that is put down to the floor being an estimate itself."""
BINS = 8
DRAWS = 200
LONGEST_LIST = 5


@dataclass(frozen=True, slots=True)
class MissingTorque:
    """The torque the model misses, N m, by time: shape (n,), `stride` s apart. `runs` numbers gapless stretches."""

    time: Array
    torque: Array
    runs: NDArray[np.int64]
    coordinates: Mapping[str, Array]
    stride: float
    smallest_movement: Mapping[str, float]
    """Standard deviation by coordinate below which it is mostly noise itself."""
    settling: Array
    """Standard deviation, N m, of what the roll filter's settling makes of it: one error that fades, (n,)."""
    floor: float
    """RMS that sensor noise alone makes of it."""
    floor_density: tuple[Array, Array]
    """Frequencies (Hz) and the power density of that noise, N^2 m^2/Hz."""
    time_offset: float
    """s by which the drives' values turned out older than their time stamps say."""


@dataclass(frozen=True, slots=True)
class ModelComparison:
    """One model against one recording. Figures by channel are `HORIZONS[-1]` ahead; `fails` is empty where adequate."""

    name: str
    fit_percent: Mapping[str, float]
    rmse: Mapping[str, float]
    noise_floor: Mapping[str, float]
    innovation_ratio: float
    adequate: bool
    fails: Mapping[str, Sequence[Mapping[str, Any]]]
    predictions: Sequence[Prediction] = field(repr=False, default=())
    missing_torque: MissingTorque | None = field(repr=False, default=None)

    def to_json(self) -> dict[str, Any]:
        """One entry of `compare --json`."""
        return {
            "name": self.name,
            "fit_percent": dict(self.fit_percent),
            "rmse": dict(self.rmse),
            "noise_floor": dict(self.noise_floor),
            "innovation_ratio": self.innovation_ratio,
            "adequate": self.adequate,
            "fails": {view: [dict(entry) for entry in entries] for view, entries in self.fails.items()},
            "by_horizon": [
                {"horizon": p.horizon, "rmse": {c: p.rmse(c) for c in p.measured}, "noise_floor": dict(p.floor)}
                for p in self.predictions
            ],
        }


def compare(models: Mapping[str, Mapping[str, float]], recording: Recording, support: float) -> list[ModelComparison]:
    """Every model, by name its parameters, against `recording`; `support` is the supports' roll angle, rad.

    Raises EstimationError where the vehicle was free too shortly or a parameter is missing, RecordingError where a
    channel is.
    """
    stretches = free_motion(recording, support)
    noise = sensor_noise(stretches)
    known_torques: dict[tuple[float, ...], list[BalanceRow]] = {}
    comparisons = []
    for name, parameters in models.items():
        key = tuple(parameters.get(known, 0.0) for known in ("angular_momentum", "trim_mass", "trim_height"))
        if key not in known_torques:
            known_torques[key] = balance_rows(parameters, recording, support)
        comparisons.append(_compare(name, parameters, recording, known_torques[key], stretches, noise))
    return comparisons


def _compare(
    name: str,
    parameters: Mapping[str, float],
    recording: Recording,
    rows: Sequence[BalanceRow],
    stretches: Sequence[FreeMotion],
    noise: Noise,
) -> ModelComparison:
    predictions = [p for p in (predict(stretches, parameters, horizon, noise) for horizon in HORIZONS) if p]
    missing = missing_torque(parameters, recording, rows, noise)
    fails = {
        "time": fails_in_time(missing),
        "frequency": fails_in_frequency(missing),
        "state": fails_by_state(missing),
        "equation": fails_in_equation(missing),
    }
    last = predictions[-1] if predictions else None
    channels = ("roll", "roll_rate") if last else ()
    return ModelComparison(
        name=name,
        fit_percent={c: last.fit_percent(c) for c in channels} if last else {},
        rmse={c: last.rmse(c) for c in channels} if last else {},
        noise_floor=dict(last.floor) if last else {},
        innovation_ratio=float(np.mean(missing.torque**2) / missing.floor**2),
        adequate=not any(fails.values()),
        fails=fails,
        predictions=predictions,
        missing_torque=missing,
    )


def balance_rows(parameters: Mapping[str, float], recording: Recording, support: float) -> list[BalanceRow]:
    """The filtered torque balance of all free motion in `recording`."""
    source = BalanceRows(parameters, support, BALANCE_CHANNELS)
    rows = [row for row in map(source.update, recording.frames(BALANCE_CHANNELS)) if row]
    if len(rows) < 4 * BINS:
        what = f"only {source.free_time:.1f} s of free motion"
        raise EstimationError("recording", what, remedy="record the vehicle upright for longer.")
    return rows


def missing_torque(
    parameters: Mapping[str, float], recording: Recording, rows: Sequence[BalanceRow], noise: Noise
) -> MissingTorque:
    """What the torque balance with these parameters leaves over, and what of it sensor noise explains."""
    config = FilterConfig()
    for needed in ("inertia", "gravity_stiffness"):
        if needed not in parameters:
            raise EstimationError(f"parameter {needed}", "missing", remedy="add it to the model.")
    output = np.array([row.output for row in rows])
    regressors = np.array([row.regressors for row in rows])
    names = ("inertia", "gravity_stiffness", "static_torque.torque")
    values = np.array([parameters.get(name, 0.0) for name in names])
    torque = regressors[:, :3] @ values - output
    nuisance, spacing = regressors[:, 3], 1.0 / recording.rate
    # More than a sample is no misalignment of rows, but a lag of the vehicle, and is to show.
    offset = -float(np.clip(nuisance @ torque / max(nuisance @ nuisance, 1e-300), -spacing, spacing))
    torque = torque + offset * nuisance
    stamps = np.array([row.timestamp_ns for row in rows])
    places = np.searchsorted(recording.timestamp_ns, stamps)
    frequency = np.linspace(0.0, min(0.5 / spacing, 10.0 * config.bandwidth / (2.0 * np.pi)), 2001)
    gain = 1.0 / np.sqrt(1.0 + (2.0 * np.pi * frequency / config.bandwidth) ** (2 * config.order))
    gyro = 2.0 * spacing * (parameters["inertia"] * noise.roll_rate_std * 2.0 * np.pi * frequency) ** 2
    # The roll filter's error: a first-order process that takes two time constants to settle.
    corner = 2.0 / SETTLED / (2.0 * np.pi)
    slow = 2.0 * (parameters["gravity_stiffness"] * noise.roll_std) ** 2 / (np.pi * corner)
    density = gain**2 * (gyro + slow / (1.0 + (frequency / corner) ** 2))
    floor = float(np.sqrt(np.trapezoid(density, frequency)))
    return MissingTorque(
        time=(stamps - recording.timestamp_ns[0]) * 1e-9,
        torque=torque,
        runs=np.cumsum([row.begins for row in rows]),
        coordinates={
            name: np.asarray(recording[name])[places] for name in ("roll", "roll_rate", "precession", "precession_rate")
        },
        stride=config.stride,
        smallest_movement={
            "roll": 10.0 * noise.roll_std,
            "roll_rate": 10.0 * noise.roll_rate_std,
            "precession_rate": 10.0 * floor / parameters["angular_momentum"],
        },
        settling=parameters["gravity_stiffness"] * settling_std(recording)[places],
        floor=floor,
        floor_density=(frequency, density),
        time_offset=offset,
    )


def settling_std(recording: Recording) -> Array:
    """rad, (n,): the part of the roll filter's standard deviation that goes away during the recording."""
    std = np.nan_to_num(recording["roll_std"])
    return np.sqrt(std**2 - np.min(std) ** 2)


def independent_samples(signal: Array) -> float:
    """How many independent samples carry the same information about the power of `signal`, (n,)."""
    centred = signal - np.mean(signal)
    spectrum = np.abs(np.fft.rfft(centred, 2 * len(signal))) ** 2
    covariance = np.fft.irfft(spectrum)[: len(signal) // 4]
    return float(len(signal) / (1.0 + 2.0 * np.sum((covariance[1:] / max(covariance[0], 1e-300)) ** 2)))


def _energy_limit(samples: float, tests: int) -> float:
    """Energy over the floor that a right model stays under in `tests` windows of so many independent samples."""
    return float(FLOOR_TOLERANCE * chi2.ppf(1.0 - LEVEL / tests, max(samples, 1.0)) / max(samples, 1.0))


def fails_in_time(missing: MissingTorque) -> list[dict[str, Any]]:
    """The worst windows of 2 s in which the missing torque is more than noise, worst first."""
    length = round(2.0 / missing.stride)
    starts = range(0, max(len(missing.torque) - length // 2, 1), length)
    share = independent_samples(missing.torque) / len(missing.torque)
    limit = _energy_limit(share * min(length, len(missing.torque)), len(starts))
    once = float(chi2.isf(LEVEL / len(starts), 1))
    found = []
    for start in starts:
        part = slice(start, start + length)
        rms = float(np.sqrt(np.mean(missing.torque[part] ** 2)))
        if rms**2 > limit * missing.floor**2 + once * np.mean(missing.settling[part] ** 2):
            times = missing.time[part]
            found.append({"from": float(times[0]), "to": float(times[-1]), "rms": rms, "floor": missing.floor})
    return sorted(found, key=lambda entry: -entry["rms"])[:LONGEST_LIST]


def fails_in_frequency(missing: MissingTorque) -> list[dict[str, Any]]:
    """The octaves in which the missing torque has more power than sensor noise, worst first."""
    segment = min(len(missing.torque), round(8.0 / missing.stride))
    frequency, power = welch(missing.torque, 1.0 / missing.stride, nperseg=segment, detrend="constant")
    settling = welch(missing.settling, 1.0 / missing.stride, nperseg=segment, detrend="constant")[1]
    floor = np.interp(frequency, *missing.floor_density) + float(chi2.isf(LEVEL, 1)) * settling
    averages = max(1.0, 1.6 * len(missing.torque) / segment - 0.6)
    edges = [edge for edge in 0.125 * 2.0 ** np.arange(7) if edge >= frequency[1]]
    found = []
    for low, high in pairwise(edges):
        inside = (frequency >= low) & (frequency < high)
        if not inside.any():
            continue
        ratio = float(np.sum(power[inside]) / np.sum(floor[inside]))
        if ratio > _energy_limit(2.0 * averages * max(1.0, 0.5 * np.sum(inside)), len(edges) - 1):
            found.append({"from_hz": float(low), "to_hz": float(high), "power_over_floor": ratio})
    return sorted(found, key=lambda entry: -entry["power_over_floor"])[:LONGEST_LIST]


def fails_by_state(missing: MissingTorque) -> list[dict[str, Any]]:
    """The bins of a coordinate in which the missing torque has a mean that noise would not give, surest first.

    The reference is a parametric bootstrap: noise of the floor's colour in the same bins. A coordinate that hardly
    moves beyond its noise is left out, since that noise is in the missing torque too.
    """
    torque = missing.torque - np.mean(missing.torque)
    noise = floor_noise(missing, DRAWS)
    fade = missing.settling - np.mean(missing.settling)
    noise += np.random.default_rng(2).standard_normal((DRAWS, 1)) * fade
    bound = float(norm.isf(LEVEL / (2.0 * BINS * len(missing.coordinates)))) * np.sqrt(FLOOR_TOLERANCE)
    found: list[tuple[float, str, Array, int, float]] = []
    for name, coordinate in missing.coordinates.items():
        if np.std(coordinate) <= missing.smallest_movement.get(name, 0.0):
            continue
        edges = np.linspace(np.min(coordinate), np.max(coordinate), BINS + 1)
        bins = np.clip(np.searchsorted(edges, coordinate, side="right") - 1, 0, BINS - 1)
        members = np.eye(BINS)[bins]
        members /= np.maximum(np.sum(members, axis=0), 1.0)
        means, spread = torque @ members, np.std(noise @ members, axis=0)
        found += [
            (abs(float(means[place] / spread[place])), name, edges, int(place), float(means[place]))
            for place in np.flatnonzero(np.abs(means) > bound * spread)
        ]
    found.sort(key=lambda entry: -entry[0])
    return [
        {
            "coordinate": name,
            "from": float(edges[place]),
            "to": float(edges[place + 1]),
            "missing_torque": mean,
            "std": abs(mean) / surety,
        }
        for surety, name, edges, place, mean in found[: 2 * LONGEST_LIST]
    ]


def floor_noise(missing: MissingTorque, draws: int) -> Array:
    """`draws` records of noise of the floor's power density, less their mean, (draws, n). The same every time."""
    count = len(missing.torque)
    frequency = np.fft.rfftfreq(count, missing.stride)
    amplitude = np.sqrt(np.interp(frequency, *missing.floor_density) * count / (2.0 * missing.stride))
    amplitude[0] = 0.0
    white = np.random.default_rng(1).standard_normal((2, draws, len(frequency))) / np.sqrt(2.0)
    noise: Array = np.fft.irfft(amplitude * (white[0] + 1j * white[1]), count, axis=1)
    return noise


def fails_in_equation(missing: MissingTorque) -> list[dict[str, Any]]:
    """The roll equation, where its missing torque has a mean or an energy that noise does not explain."""
    mean, rms = float(np.mean(missing.torque)), float(np.sqrt(np.mean(missing.torque**2)))
    span = len(missing.torque) * missing.stride
    white = np.interp(0.0, *missing.floor_density) / (2.0 * span)
    mean_std = float(np.sqrt(white + np.mean(missing.settling) ** 2))
    limit = _energy_limit(independent_samples(missing.torque), 1)
    expected = limit * missing.floor**2 + float(chi2.isf(LEVEL, 1)) * float(np.mean(missing.settling**2))
    if rms**2 <= expected and abs(mean) <= norm.isf(LEVEL / 2.0) * np.sqrt(FLOOR_TOLERANCE) * mean_std:
        return []
    return [{"equation": "roll", "mean": mean, "mean_std": mean_std, "rms": rms, "floor": missing.floor}]
