"""The roll filter on motions whose truth is known in closed form: turns about a body-fixed axis with a lever arm."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest

from estimators.roll_filter import GRAVITY, RollFilter, RollFilterConfig, RollState
from telemetry.samples import ImuSample, Vector3

MONOCAB = RollFilterConfig(
    rate=250.0,
    acceleration_std=0.2,
    angular_rate_density=0.003,
    bias_random_walk=1e-4,
    position=(0.0, 0.0, 0.9),
)
ACCELERATION_NOISE = 0.02
"""m/s^2 a sample."""
ANGULAR_RATE_NOISE = 3.5e-5 * math.sqrt(125.0)
"""rad/s a sample: gyro I of the LPMS-IG1, 3.5e-5 rad/s/sqrt(Hz) over half of 250 Hz."""

Angle = Callable[[float], tuple[float, float, float]]
"""Angle, its rate and its acceleration at a time."""


@dataclass(frozen=True)
class Motion:
    """A turn by `angle` about the body-fixed `axis`, beginning with the body at `start` (roll, pitch)."""

    angle: Angle
    axis: Vector3 = (1.0, 0.0, 0.0)
    start: tuple[float, float] = (0.0, 0.0)
    position: Vector3 = MONOCAB.position
    bias: Vector3 = (0.0, 0.0, 0.0)
    rate: float = MONOCAB.rate

    def up(self, time: float) -> np.ndarray:
        roll, pitch = self.start
        up = np.array([-math.sin(pitch), math.cos(pitch) * math.sin(roll), math.cos(pitch) * math.cos(roll)])
        axis = np.array(self.axis)
        turned = -self.angle(time)[0]
        return (
            up * math.cos(turned)
            + np.cross(axis, up) * math.sin(turned)
            + axis * (axis @ up) * (1.0 - math.cos(turned))
        )

    def sample(self, time: float, received: float, noise: np.random.Generator | None) -> ImuSample:
        """The readings at `time`, stamped `received`."""
        _, rate, acceleration = self.angle(time)
        axis, arm = np.array(self.axis), np.array(self.position)
        omega = axis * rate
        force = GRAVITY * self.up(time) + np.cross(axis * acceleration, arm) + np.cross(omega, np.cross(omega, arm))
        gyro = omega + self.bias
        if noise is not None:
            force = force + noise.normal(0.0, ACCELERATION_NOISE, 3)
            gyro = gyro + noise.normal(0.0, ANGULAR_RATE_NOISE, 3)
        return ImuSample(round(received * 1e9), tuple(force.tolist()), tuple(gyro.tolist()))

    def samples(self, duration: float, *, seed: int | None = 1, jitter: float = 0.0) -> Iterator[ImuSample]:
        noise = None if seed is None else np.random.default_rng(seed)
        late = np.random.default_rng(7).uniform(0.0, jitter, round(duration * self.rate))
        for number, delay in enumerate(late):
            time = number / self.rate
            yield self.sample(time, time + delay, noise)


def still(_: float) -> tuple[float, float, float]:
    return 0.0, 0.0, 0.0


def sine(amplitude: float, frequency: float, start: float = 2.0) -> Angle:
    """A sine ramped in over one second from `start` on, at rest before, as the excitations are."""
    omega = 2.0 * math.pi * frequency

    def angle(time: float) -> tuple[float, float, float]:
        t = time - start
        if t < 0.0:
            return 0.0, 0.0, 0.0
        ramp = (0.5 - 0.5 * math.cos(math.pi * t), 0.5 * math.pi * math.sin(math.pi * t))
        share = (*ramp, 0.5 * math.pi**2 * math.cos(math.pi * t)) if t < 1.0 else (1.0, 0.0, 0.0)
        wave = (math.sin(omega * t), omega * math.cos(omega * t), -(omega**2) * math.sin(omega * t))
        return (
            amplitude * share[0] * wave[0],
            amplitude * (share[1] * wave[0] + share[0] * wave[1]),
            amplitude * (share[2] * wave[0] + 2.0 * share[1] * wave[1] + share[0] * wave[2]),
        )

    return angle


def run(samples: Iterator[ImuSample], config: RollFilterConfig = MONOCAB) -> list[RollState]:
    roll_filter = RollFilter(config)
    return [roll_filter.update(sample) for sample in samples]


def up_of(state: RollState) -> np.ndarray:
    cosine = math.cos(state.pitch)
    return np.array([-math.sin(state.pitch), cosine * math.sin(state.roll), cosine * math.cos(state.roll)])


def inclination_error(motion: Motion, states: list[RollState], after: float) -> float:
    """Largest angle (rad) between estimated and true up vector from `after` seconds on."""
    worst = 0.0
    for number, state in enumerate(states):
        time = number / motion.rate
        if time >= after:
            true = motion.up(time)
            worst = max(worst, math.atan2(float(np.linalg.norm(np.cross(up_of(state), true))), float(up_of(state) @ true)))
    return worst

if __name__=="__main__":
    for f in (.05,.2,.5,1,3):
        for rate in (100.,250.,500.):
          for jit in (0,.2):
            m=Motion(sine(math.radians(1),f),rate=rate); d=max(15,2/f)
            st=run(m.samples(d,jitter=jit/rate),replace(MONOCAB,rate=rate))
            e=np.array([s.roll for s in st])-np.array([m.angle(k/rate)[0] for k in range(len(st))])
            print(f,rate,jit,'rms deg',np.degrees(np.sqrt(np.mean(e[int(5*rate):]**2))),'max',np.degrees(np.abs(e[int(5*rate):]).max()), 'std',np.degrees(st[-1].roll_std))
    for b in ((math.radians(.5),0,0),(math.radians(.5),math.radians(-.5),math.radians(.5))):
        m=Motion(still,bias=b,start=(math.radians(4),0)); st=run(m.samples(30))
        for t in (.1,.5,1,2,3,5,10,20,29): print(t,math.degrees(st[int(t*250)].roll-m.start[0]),np.degrees(st[int(t*250)].bias))
