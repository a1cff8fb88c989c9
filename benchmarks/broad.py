"""Compare the roll filter and VQF with optical ground truth, in one run: `python benchmarks/broad.py [TRIAL]...`

Each BROAD trial (Laidig et al., Data 6(7), 2021) is encoded as the CAN frames of an LPMS-IG1, replayed through
`drivers.imu.imu` and the roll filter with the settings of vehicles/monocab/vehicle.toml, and scored as in BROAD: RMS of
the inclination error, the angle between the estimated and the true up vector, over the samples of the movement phase
that have ground truth. VQF (6-D: gyro and accelerometer) gets the readings directly.

VQF takes a gyro reading as the mean over the interval that ends at it. The roll filter takes it as the instantaneous
rate, which here lies half an interval back. So the filter's estimate is extrapolated over that half interval with the
last rate, and both are compared with the truth of the same sample.

This IMU lags the optical system by 4.1 ms, measured from the two angular rates without any filter. On fast motion this
lag is most of every filter's error. The columns `corrected` compare each estimate with the truth at the time that it
belongs to, and show the remaining error.
"""

from __future__ import annotations

import argparse
import math
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import h5py
import numpy as np
import numpy.typing as npt
import vqf
from rich.console import Console
from rich.table import Table

from upright.drivers.imu.imu import Imu
from upright.drivers.imu.layout import ACCELERATION, ANGULAR_RATE, ImuConfig, encode_frames
from upright.estimators.roll_filter import RollFilter, RollFilterConfig
from upright.telemetry.samples import ImuSample

ROOT = Path(__file__).resolve().parent.parent
TRIALS = ROOT.parent / "shared" / "data" / "broad"

MEASURED_LATENCY = 4.1e-3
"""s by which the gyro of BROAD lags the optical angular rate (4.0 to 4.2 ms on trials 02, 09 and 24)."""

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Trial:
    """One recording: (N, 3) readings in SI units, (N, 3) true up vector in the body frame (NaN where unknown)."""

    name: str
    rate: float
    acceleration: Array
    angular_rate: Array
    up: Array
    movement: npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Score:
    """Inclination RMSE of one trial, deg."""

    trial: str
    upright: float
    upright_int16: float | None
    upright_corrected: float
    vqf: float
    vqf_corrected: float

    @property
    def ratio(self) -> float:
        return self.upright / self.vqf


def read_trial(path: Path) -> Trial:
    """Read a BROAD trial. If it does not mark the movement phase, all samples count."""
    with h5py.File(path) as file:
        quaternion = np.asarray(file["opt_quat"], dtype=float)
        movement = np.asarray(file["movement"], dtype=bool) if "movement" in file else np.ones(len(quaternion), bool)
        return Trial(
            name=path.stem,
            rate=float(file.attrs["sampling_rate"]),
            acceleration=np.ascontiguousarray(file["imu_acc"], dtype=float),
            angular_rate=np.ascontiguousarray(file["imu_gyr"], dtype=float),
            up=up_vector(quaternion),
            movement=movement,
        )


def up_vector(quaternion: Array) -> Array:
    """The earth's z axis in the body frame, (N, 3), of body-to-earth quaternions (N, 4) with w first."""
    w, x, y, z = quaternion.T
    return np.stack((2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)), axis=1)


def inclination_rmse(trial: Trial, up: Array, latency: float) -> float:
    """RMS angle (deg) between `up` (N, 3) and the truth `latency` seconds earlier."""
    place = np.maximum(np.arange(len(up)) - latency * trial.rate, 0.0)
    before = np.minimum(place.astype(int), len(up) - 2)
    share = (place - before)[:, None]
    truth = trial.up[before] * (1.0 - share) + trial.up[before + 1] * share
    error = np.arctan2(np.linalg.norm(np.cross(up, truth), axis=1), np.sum(up * truth, axis=1))
    scored = error[trial.movement & np.isfinite(error)]
    return math.degrees(math.sqrt(np.mean(scored**2)))


def shipped_filter(rate: float) -> RollFilterConfig:
    """The settings of vehicles/monocab/vehicle.toml for a hand-held IMU, without a lever arm."""
    table = tomllib.loads((ROOT / "vehicles" / "monocab" / "vehicle.toml").read_text())["imu"]["filter"]
    return RollFilterConfig(rate=rate, **table)


def replay(trial: Trial, config: ImuConfig) -> Array:
    """Up vector (N, 3) from the trial's readings as CAN frames, through the driver and the filter."""
    imu, roll_filter = Imu(config), RollFilter(shipped_filter(trial.rate))
    up = np.full((len(trial.up), 3), np.nan)
    for number, reading in enumerate(_samples(trial)):
        for frame in encode_frames(config, reading):
            sample = imu.handle(frame)
        if sample is None:
            continue
        state = roll_filter.update(sample)
        sine, cosine = math.sin(state.pitch), math.cos(state.pitch)
        up[number] = (-sine, cosine * math.sin(state.roll), cosine * math.cos(state.roll))
    if imu.statistics.sets != len(up):
        raise RuntimeError(f"{trial.name}: the IMU driver dropped sets: {imu.statistics} {imu.fault_text}")
    return up


def score(path: Path, *, int16: bool) -> Score:
    """Run one trial through VQF and upright, with float32 frames and, if `int16`, with 16-bit frames too."""
    trial = read_trial(path)
    peer = up_vector(vqf.VQF(1.0 / trial.rate).updateBatch(trial.angular_rate, trial.acceleration)["quat6D"])
    ours = replay(trial, _imu(trial.rate, "float32"))
    coarse = _to_sample(trial, replay(trial, _imu(trial.rate, "int16"))) if int16 else None
    return Score(
        trial=trial.name,
        upright=inclination_rmse(trial, _to_sample(trial, ours), 0.0),
        upright_int16=None if coarse is None else inclination_rmse(trial, coarse, 0.0),
        upright_corrected=inclination_rmse(trial, ours, MEASURED_LATENCY),
        vqf=inclination_rmse(trial, peer, 0.0),
        vqf_corrected=inclination_rmse(trial, peer, MEASURED_LATENCY - 0.5 / trial.rate),
    )


def _to_sample(trial: Trial, up: Array) -> Array:
    """Extrapolate `up` (N, 3) by half an interval with the last rate: u' = u x w."""
    return up + 0.5 / trial.rate * np.cross(up, trial.angular_rate)


def _imu(rate: float, precision: Literal["float32", "int16"]) -> ImuConfig:
    """An LPMS-IG1 with the ranges of BROAD's IMU (16 g, 2000 deg/s)."""
    return ImuConfig(
        protocol="sequential",
        base_id=0x514,
        precision=precision,
        slots=(*ACCELERATION, *ANGULAR_RATE),
        rate=rate,
        acceleration_range=16 * 9.81,
        angular_rate_range=math.radians(2000.0),
    )


def _samples(trial: Trial) -> Iterator[ImuSample]:
    readings = zip(trial.acceleration.tolist(), trial.angular_rate.tolist(), strict=True)
    for number, (acceleration, angular_rate) in enumerate(readings):
        yield ImuSample(round(number * 1e9 / trial.rate), tuple(acceleration), tuple(angular_rate))


def table(scores: Sequence[Score]) -> Table:
    """Inclination RMSE in degrees, one row per trial."""
    result = Table(title="BROAD: inclination RMSE, deg")
    result.add_column("trial")
    for name in ("upright", "VQF", "ratio", "upright int16", "upright corrected", "VQF corrected", "ratio"):
        result.add_column(name, justify="right")
    for row in scores:
        corrected = row.upright_corrected / row.vqf_corrected
        values = (row.upright, row.vqf, row.ratio, row.upright_int16, row.upright_corrected, row.vqf_corrected)
        result.add_row(row.trial, *("-" if value is None else f"{value:.3f}" for value in (*values, corrected)))
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description="Roll filter and VQF on BROAD trials.")
    parser.add_argument("trial", nargs="*", type=Path, help=f"HDF5 files; default: all in {TRIALS}")
    paths = parser.parse_args().trial or sorted(TRIALS.glob("*.hdf5"))
    if not paths:
        parser.error(f"no trials in {TRIALS}; give the HDF5 files of BROAD")
    Console(width=140).print(table([score(path, int16=True) for path in paths]))


if __name__ == "__main__":
    main()
