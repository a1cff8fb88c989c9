"""What does a diagnosis find in free decays? `python benchmarks/free_decays.py [NAME ...]`

Bodies that swing or coast freely are simulated independently of the models: with true sticking, and with other sensors.
Each record is diagnosed, as by `upright diagnose`, with a model without friction whose inertia is 10 % off. The program
prints the verdict, the effects with their amplitudes, the sensor errors, the energy of the one-step errors over the
noise floor, and seconds.

inertia angle'' = torque - stiffness sin(angle) - viscous angle' - dry friction, semi-implicit steps, with Karnopp's
friction: a body whose rate would change its sign within a step sticks if the force on it is below the dry friction.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from upright.diagnosis.diagnose import Diagnosis, diagnose
from upright.estimators.stopwatch import stopwatch
from upright.models.model import Model
from upright.models.parts import Disturbance, Hold, Input, Joint, Output, Parameter, Sensor, State
from upright.telemetry.recording import Recording, describe

Array = NDArray[np.float64]


def nothing(time: float) -> float:
    return 0.0


@dataclass(frozen=True)
class Body:
    """SI units. It is released at the angle `begin`, rad, and recorded for `span` s at `rate` Hz."""

    inertia: float = 0.02
    stiffness: float = 0.8
    dry: float = 0.0
    viscous: float = 0.0
    begin: float = 1.2
    span: float = 30.0
    rate: float = 200.0
    torque: Callable[[float], float] = nothing

    def course(self) -> tuple[Array, Array]:
        """Time and angle of each sample."""
        finer = max(4, round(4000.0 / self.rate))
        step, angle, speed, rows = 1.0 / self.rate / finer, self.begin, 0.0, []
        for row in range(round(self.span * self.rate)):
            rows.append(angle)
            given = self.torque(row / self.rate)
            for _ in range(finer):
                force = given - self.stiffness * math.sin(angle) - self.viscous * speed
                sticks = abs(force) <= self.dry
                if speed == 0.0 and sticks:
                    break
                against = math.copysign(self.dry, speed or force)
                moved = speed + step * (force - against) / self.inertia
                speed = 0.0 if moved * speed < 0.0 and sticks else moved
                angle += step * speed
        return np.arange(len(rows)) / self.rate, np.array(rows)

    def by_encoder(self, counts: int, *, torque_noise: float = 0.0, seed: int = 0) -> Recording:
        """Angle by an encoder of `counts` per turn, and the torque, with white noise (N m) in its measurement."""
        time, angle = self.course()
        count = 2.0 * np.pi / counts
        torque = np.array([self.torque(each) for each in time.tolist()])
        torque = torque + torque_noise * np.random.default_rng(seed).standard_normal(len(time))
        return _table(time, {"position": np.round(angle / count) * count, "torque": torque})

    def by_camera(self, *, noise: float, jitter: float, late: float, rate: float, seed: int) -> Recording:
        """White noise, rad; each picture is taken `late` s before its time stamp, with a jitter of `jitter` s. The time
        stamps have the same jitter."""
        random = np.random.default_rng(seed)
        time, angle = self.course()
        stamps = np.arange(0.1, time[-1] - 0.1, 1.0 / rate)
        stamps = stamps + jitter * random.standard_normal(len(stamps))
        exposed = stamps - late + jitter * random.standard_normal(len(stamps))
        seen = np.interp(exposed, time, angle) + noise * random.standard_normal(len(stamps))
        return _table(stamps, {"position": seen, "torque": np.zeros(len(stamps))})

    def model(self, noise: float, force: float) -> Model:
        """A model without friction whose inertia is 10 % off; `force` is a typical one at the joint, N m."""
        return Model(
            name="swing",
            title="A body that swings",
            base_states=(
                State("angle", "rad", "rate", initial="position", initial_std=0.1),
                State("rate", "rad/s", "pivot_force / inertia", initial_std=1.0, process_noise=0.01),
            ),
            inputs=(Input("torque", "N m", Hold.ZERO_ORDER),),
            outputs=(Output("position", "rad", "angle", noise=noise),),
            base_parameters=(
                Parameter("inertia", "kg m^2", 1.1 * self.inertia, std=0.2 * self.inertia, lower=0.0),
                Parameter("stiffness", "N m/rad", self.stiffness, estimated=False),
            ),
            joints=(
                Joint(
                    name="pivot",
                    coordinate="angle",
                    rate="rate",
                    inertia="inertia",
                    load="torque - stiffness * sin(angle)",
                    force_unit="N m",
                    coordinate_unit="rad",
                    force_scale=force,
                    coordinate_scale=1.0,
                    rate_scale=5.0,
                    smooth_rate=0.02,
                    disturbance=Disturbance(),
                ),
            ),
            sensors=(Sensor("encoder", angle="position"),),
        )


def pushed(time: float) -> float:
    """N m: a push every six seconds, in alternating directions."""
    return 0.05 * (-1.0) ** int(time // 6.0) if time % 6.0 < 0.6 else 0.0


def _table(time: Array, values: dict[str, Array]) -> Recording:
    units = {"position": "rad", "torque": "N m"}
    return Recording(describe(units), np.round(time * 1e9).astype(np.int64), values)


@dataclass(frozen=True, slots=True)
class Swing:
    """A body, how it is recorded, and what the model is given: the sensor's noise, rad, and a typical force, N m."""

    body: Body
    seen: Callable[[Body], Recording]
    noise: float
    force: float = 0.3


def _by_camera(body: Body) -> Recording:
    return body.by_camera(noise=2e-3, jitter=2e-3, late=0.015, rate=50.0, seed=3)


SWINGS: Mapping[str, Swing] = {
    "encoder": Swing(Body(dry=0.012, viscous=0.001), lambda body: body.by_encoder(4096), 1e-3),
    "passive_motor": Swing(
        Body(dry=0.012, viscous=0.001), lambda body: body.by_encoder(4096, torque_noise=0.003, seed=7), 1e-3
    ),
    "noisier_motor": Swing(
        Body(dry=0.012, viscous=0.001), lambda body: body.by_encoder(4096, torque_noise=0.02, seed=5), 1e-3
    ),
    "camera_dry": Swing(Body(dry=0.01, viscous=0.0005, begin=1.0, rate=500.0), _by_camera, 2e-3),
    "camera_viscous": Swing(Body(dry=0.0003, viscous=0.004, begin=1.0, rate=500.0), _by_camera, 2e-3),
    "arm": Swing(
        Body(inertia=0.005, stiffness=0.0, dry=1e-4, viscous=0.0015, begin=0.0, rate=500.0, torque=pushed),
        lambda body: body.by_encoder(2048),
        2e-3,
        0.05,
    ),
}


def _summary(found: Diagnosis) -> str:
    effects = []
    for each in found.findings:
        sizes = [
            f"{name.partition('.')[2]} {size.value:.4g} ± {size.std:.2g}"
            for name, size in each.parameters.items()
            if size.value is not None and size.std is not None
        ]
        effects.append(f"{' or '.join((each.effect, *each.tied_with))} ({', '.join(sizes)})")
    errors = [f"{each.channel} errs by {each}" for each in found.sensor_errors]
    over = f"{found.innovation_ratio_before:.3g} to {found.innovation_ratio_after:.3g} over the floor"
    return "; ".join((found.verdict.value, *effects, *errors, over))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"one of {', '.join(SWINGS)}; default: all")
    for name in parser.parse_args().names or SWINGS:
        swing = SWINGS[name]
        began = stopwatch()
        found = diagnose(swing.body.model(swing.noise, swing.force), [swing.seen(swing.body)])
        hidden = f"dry {swing.body.dry:g} N m, viscous {swing.body.viscous:g} N m s"
        print(f"{name} ({hidden}): {_summary(found)}; {stopwatch() - began:.0f} s", flush=True)


if __name__ == "__main__":
    main()
