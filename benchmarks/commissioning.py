"""Does a guided commissioning find what is wrong, and where? And what does it end with?

    python benchmarks/commissioning.py [--defects] [--whole] [--only NAME ...]

`--defects`: each defect of the table is built into a virtual MONOCAB (or its vehicle file is wrong by it), and the
commissioning goes on until a step is not accepted: which step, in which words, and how far the vehicle rolled up to
then in truth, beyond the support that it lay on. `--whole`: the whole way with the virtual vehicle's disturbance,
without one, and with hidden effects; every number of the steps that end it. Without either, both.
"""

from __future__ import annotations

import argparse
import atexit
import os
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from math import degrees
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does, before numpy is loaded

from upright.service.commission.guide import Guide
from upright.service.control.daemon import Places
from upright.service.virtual.daemon import daemon_beside
from upright.service.virtual.vehicle import requested_disturbance
from upright.simulation.config import SimulationConfig
from upright.simulation.faults import parse_faults
from upright.simulation.vehicle import VirtualVehicle
from upright.vehicles.commissioning import Entry, State, is_within
from upright.vehicles.file import load
from upright.vehicles.sections import VehicleFile

SEED = 700
"""Of the sensors' noise and of the disturbance. No limit of a step was chosen with it."""
Change = Callable[[VehicleFile], VehicleFile]
SHOWN = {
    "trim": ("trim_effect",),
    "effects": ("effects_found", "innovation_ratio"),
    "identify": ("inertia", "gravity_stiffness"),
    "full": ("full_phase_margin", "full_gain_margin"),
    "disturbance": ("largest_roll", "largest_precession", "final_precession"),
    "prediction": ("loop_error", "innovation_ratio"),
    "response": ("loop_error", "gain_off", "phase_off"),
}


def of_drive(name: str, **changes: Any) -> Change:
    """The vehicle file with other keys of a drive."""

    def change(file: VehicleFile) -> VehicleFile:
        drives = [each.model_copy(update=changes) if each.name == name else each for each in file.drive]
        return file.model_copy(update={"drive": drives})

    return change


def of_imu(**changes: Any) -> Change:
    """The vehicle file with other keys of the IMU."""
    return lambda file: file.model_copy(update={"imu": file.imu.model_copy(update=changes)})


def both(*changes: Change) -> Change:
    def change(file: VehicleFile) -> VehicleFile:
        for each in changes:
            file = each(file)
        return file

    return change


def plant(**values: float) -> Callable[[SimulationConfig], SimulationConfig]:
    """Another truth."""
    return lambda config: replace(config, plant=replace(config.plant, **values))


def as_it_is(thing: Any) -> Any:
    return thing


@dataclass(frozen=True, slots=True)
class Defect:
    """`file` is what the daemon reads, `truth` what the vehicle is built like."""

    name: str
    file: Change = as_it_is
    truth: Change = as_it_is
    configure: Callable[[SimulationConfig], SimulationConfig] = as_it_is
    faults: Sequence[str] = ()


def every(seconds: int, fault: str) -> tuple[str, ...]:
    """A fault that comes now and then."""
    return tuple(f"{fault}@{at}" for at in range(seconds, 600, seconds))


def slower(file: VehicleFile) -> VehicleFile:
    """With less bandwidth of the full controller, as the step `full` advises with so late setpoints. It is a file on
    disk, since the steps that design and identify read it there."""
    folder = tempfile.TemporaryDirectory()
    atexit.register(folder.cleanup)
    path = Path(folder.name) / "slower.toml"
    path.write_text(f"{Path(file.path).read_text()}\n[full_controller]\neffort_weight = 7.0\n")
    return load(str(path))


WHOLE = (
    (Defect("disturbance 8 N m"), ["disturbance=8,0.3"]),
    (Defect("no disturbance"), ["disturbance=0"]),
    (Defect("Coulomb friction"), ["disturbance=8,0.3", "coulomb_friction"]),
    (Defect("viscous friction"), ["disturbance=8,0.3", "viscous_friction"]),
    (Defect("delay of the setpoints, weights as shipped"), ["disturbance=8,0.3", "input_delay"]),
    (Defect("delay of the setpoints, effort_weight = 7", file=slower), ["disturbance=8,0.3", "input_delay"]),
)
DEFECTS = (
    Defect("gyro in rad/s, file says deg/s", truth=of_imu(angular_rate_unit="rad/s")),
    Defect("gyro in deg/s, file says rad/s", file=of_imu(angular_rate_unit="rad/s")),
    Defect("IMU turned by 180 deg about z", truth=of_imu(axes=("-x", "-y", "+z"))),
    Defect("IMU turned by 90 deg about z", truth=of_imu(axes=("+y", "-x", "+z"))),
    Defect("IMU upside down", truth=of_imu(axes=("+x", "-y", "-z"))),
    Defect("one gimbal reversed", truth=of_drive("gimbal_right", direction=1)),
    Defect(
        "both gimbals reversed",
        truth=both(of_drive("gimbal_left", direction=-1), of_drive("gimbal_right", direction=1)),
    ),
    Defect(
        "node ids of left gimbal and trim mass swapped",
        truth=both(of_drive("gimbal_left", node=3), of_drive("trim", node=1)),
    ),
    Defect(
        "gear ratio of the gimbals 80, file says 100",
        truth=both(of_drive("gimbal_left", gear_ratio=80.0), of_drive("gimbal_right", gear_ratio=80.0)),
    ),
    Defect("angular momentum 20 % smaller", configure=plant(angular_momentum=2640.0)),
    Defect("one flywheel 20 % slow", configure=plant(angular_momentum=2970.0)),
    Defect("trim mass sticks, its motor turns", configure=plant(trim_mass=1.0)),
    Defect("trim mass runs the wrong way", truth=of_drive("trim", direction=-1)),
    Defect("loose connector: the left gimbal restarts every 25 s", faults=every(25, "drive_restart:gimbal_left")),
    Defect("the IMU pauses for 40 ms every 25 s", faults=every(25, "imu_gap")),
)


@dataclass(slots=True)
class Roll:
    """The largest magnitude of the true roll beyond the supports' angle, and whether it ever left them, rad."""

    largest: float = 0.0
    least: float = field(default=1e9)

    def watch(self, virtual: VirtualVehicle) -> None:
        roll = abs(getattr(virtual.plant, "roll", 0.0))
        self.largest, self.least = max(self.largest, roll), min(self.least, roll)


def steps_of(defect: Defect, hide: list[str], roll: Roll) -> Iterator[Entry]:
    """The entries of one commissioning, until a step is not accepted."""
    file = load("monocab")
    told, truth = defect.file(file), defect.truth(file)
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder)
        places = Places(bus := f"virtual:commissioning-{os.getpid()}", bus, data, data / "s.sock")
        with daemon_beside(
            told,
            places,
            hide,
            SEED,
            disturbance=requested_disturbance(file, hide),
            truth=truth,
            configure=defect.configure,
            faults=parse_faults(defect.faults, [each.name for each in file.drive]),
            watch=roll.watch,
        ):
            guide = Guide(told, [places.socket], lambda messages: list(messages)[-1])
            guide.begin()
            while (step := guide.steps.next(guide.record())) is not None:
                entry = guide.carry_out(step.id)
                yield entry
                if entry.state is not State.ACCEPTED:
                    return


def print_defect(defect: Defect) -> None:
    roll = Roll()
    last = list(steps_of(defect, ["disturbance=8,0.3"], roll))[-1]
    step = load_steps().find(last.step)
    if last.state is State.FAILED:
        words = last.reason
    else:
        words = "; ".join(
            f"{each.title} {number.value if number.value is None else round(number.value, 3)} ({each.limits})"
            for each in step.acceptance
            if not is_within(each, last.numbers) and (number := last.numbers.get(each.quantity))
        )
    found = last.step if last.state is not State.ACCEPTED else "NOT FOUND"
    print(
        f"| {defect.name} | {found} | {words} | {degrees(roll.largest):.2f} | {degrees(roll.least):.2f} |", flush=True
    )


def load_steps() -> Any:
    from upright.vehicles.commissioning import steps_of as of

    return of("monocab")


def print_whole(vehicle: Defect, hide: list[str]) -> None:
    began = time.perf_counter()
    entries = list(steps_of(vehicle, hide, Roll()))
    accepted = sum(each.state is State.ACCEPTED for each in entries)
    print(f"{vehicle.name}: {accepted} of {len(load_steps().step)} steps accepted, {time.perf_counter() - began:.0f} s")
    for each in entries:
        shown = [
            f"{quantity} {number.value:.4g}" + (f" ± {number.std:.2g}" if number.std is not None else "")
            for quantity in SHOWN.get(each.step, ())
            if (number := each.numbers.get(quantity)) and number.value is not None
        ]
        if shown or each.state is not State.ACCEPTED:
            print(f"  {each.step} ({each.state.value}): {', '.join(shown)} {each.reason}")
        if each.step in ("effects", "prediction", "response"):
            for line in each.text:
                print(f"    {line}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--defects", action="store_true")
    parser.add_argument("--whole", action="store_true")
    parser.add_argument("--only", nargs="+", default=[])
    given = parser.parse_args()
    everything = not (given.defects or given.whole)
    if given.defects or everything:
        print("| defect | step | words | largest roll, deg | least roll, deg |\n| - | - | - | - | - |")
        for defect in DEFECTS:
            if not given.only or any(word in defect.name for word in given.only):
                print_defect(defect)
    if given.whole or everything:
        for vehicle, hide in WHOLE:
            if not given.only or any(word in vehicle.name for word in given.only):
                print_whole(vehicle, hide)


if __name__ == "__main__":
    main()
