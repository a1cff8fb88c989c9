"""Faults of the drives: power states, communication, axes that do not follow, encoders that lie, supply."""

from __future__ import annotations

import dataclasses
import random
import struct
from collections.abc import Callable

from faults import clues
from faults.bench import Bench
from faults.fault import (
    CONTROL_LOST,
    DETECTED,
    KINDS,
    MONOCAB,
    NOT_FOLLOWED,
    SIDE_LOAD,
    UP,
    Fault,
    Wanted,
    When,
    harmless,
    in_order,
    stopped,
)
from upright.simulation.bus.drive_node import VirtualDrive
from upright.simulation.bus.objects import CONTROLWORD, MODE
from upright.simulation.bus.power_state import PowerState
from upright.simulation.faults import CURRENT_ERROR, OVERCURRENT
from upright.simulation.faults import FAULTS as VIRTUAL
from upright.telemetry.samples import CanFrame
from upright.vehicles.bounds import Code

Choice = Callable[[Bench], list[VirtualDrive]]
PAIRS = ("monocab", "twsbr")
"""Kinds with two drives that hold the vehicle up."""
QUICK_STOP, SHUTDOWN = 0x02, 0x06
WARNING, VENDOR_WARNING, UNDER_VOLTAGE = 0x80, 0xFF01, 0x3220
SIZES = {"statusword": 2, "velocity_actual": 4, "torque_actual": 2, "position_actual": 4}
"""Bytes of the objects in TPDOs."""
OTHER_PRODUCT, OTHER_REVISION = 0x0BAD, 0x0002_0000


def one(bench: Bench) -> list[VirtualDrive]:
    return bench.main[:1]


def both(bench: Bench) -> list[VirtualDrive]:
    return bench.main


def trim(bench: Bench) -> list[VirtualDrive]:
    return bench.of_role("trim")


def every(bench: Bench) -> list[VirtualDrive]:
    return list(bench.drives.values())


def on(choice: Choice, act: Callable[[Bench, VirtualDrive], object]) -> Callable[[Bench], None]:
    """Do something to each of the chosen drives."""

    def inject(bench: Bench) -> None:
        for drive in choice(bench):
            act(bench, drive)

    return inject


def overcurrent(bench: Bench, drive: VirtualDrive) -> None:
    drive.fail(OVERCURRENT, CURRENT_ERROR)


def silent_fault(bench: Bench, drive: VirtualDrive) -> None:
    """Fault in the statusword alone."""
    drive.servo.fail(OVERCURRENT, CURRENT_ERROR, bench.truth.time, under_power=True)


def emergency(bench: Bench, drive: VirtualDrive, code: int = VENDOR_WARNING, register: int = WARNING) -> None:
    bench.to_daemon(0x80 + drive.config.node, struct.pack("<HB5x", code, register))


def emergency_storm(bench: Bench, drive: VirtualDrive) -> None:
    """Ten EMCYs in each cycle: the warning, and that it is over."""

    def storm() -> None:
        for _ in range(5):
            emergency(bench, drive)
            emergency(bench, drive, 0, 0)

    bench.each_cycle.append(storm)


def commands_itself(controlword: int) -> Callable[[Bench, VirtualDrive], object]:
    """The drive acts as if its master had sent this controlword."""

    def act(bench: Bench, drive: VirtualDrive) -> None:
        drive.servo.write(CONTROLWORD, controlword, bench.truth.time)
        drive.servo.update(bench.truth.time)

    return act


def other_mode(bench: Bench, drive: VirtualDrive) -> None:
    """The drive changes by itself to a mode whose target is 0."""
    drive.servo.image[MODE] = 9


def unplug(bench: Bench, drive: VirtualDrive) -> None:
    drive.connected = False


def lose_power(bench: Bench, drive: VirtualDrive) -> None:
    """Electronics and power stage lose their supply for good."""
    drive.connected = False
    drive.servo.restart(bench.truth.time)


def restart(bench: Bench, drive: VirtualDrive) -> None:
    VIRTUAL["drive_restart"].inject(bench.plant_side, drive.config.name)


def come_back_as_another(bench: Bench, drive: VirtualDrive) -> None:
    """The drive is switched off and on again, and reports another product code."""
    drive.config = dataclasses.replace(drive.config, product_code=OTHER_PRODUCT)
    restart(bench, drive)


def come_back_with_other_firmware(bench: Bench, drive: VirtualDrive) -> None:
    """The drive is switched off and on again, and reports another revision."""
    drive.config = dataclasses.replace(drive.config, revision=OTHER_REVISION)
    restart(bench, drive)


def boot_up_message(bench: Bench, drive: VirtualDrive) -> None:
    bench.to_daemon(0x700 + drive.config.node, b"\x00")


def lose_heartbeat(bench: Bench, drive: VirtualDrive) -> None:
    drive.heartbeat_enabled = False


def lose_pdos(bench: Bench, drive: VirtualDrive) -> None:
    """Heartbeats go on, process data stop."""
    ids = tpdos(drive)
    bench.received.append(lambda frame: [] if frame.can_id in ids else [frame])


def tpdos(drive: VirtualDrive) -> tuple[int, ...]:
    return tuple(0x180 + 0x100 * place + drive.config.node for place in range(len(drive.config.tpdo)))


def acting(drive: VirtualDrive, effect: Callable[[float], float]) -> None:
    """Put `effect` between setpoint and axis for as long as the drive says Operation enabled."""
    axis = drive.servo.axis  # type: ignore[attr-defined]
    axis.effects = (
        *axis.effects,
        lambda value: effect(value) if drive.state is PowerState.OPERATION_ENABLED else value,
    )


def follows_as(effect: Callable[[float], float]) -> Callable[[Bench, VirtualDrive], object]:
    return lambda bench, drive: acting(drive, effect)


def runs_away(share: float) -> Callable[[Bench, VirtualDrive], object]:
    """The axis moves with this share of its largest setpoint, whatever the setpoint is."""

    def act(bench: Bench, drive: VirtualDrive) -> None:
        limits, role = bench.vehicle.limits, drive.config.role
        largest = {"gimbal": "precession_rate", "trim": "trim_rate"}.get(role)
        largest = largest or ("torque" if hasattr(limits, "torque") else "voltage")
        value = share * getattr(limits, largest)
        acting(drive, lambda setpoint: value)

    return act


def frozen(*, position: bool, rate: bool) -> Callable[[Bench, VirtualDrive], object]:
    """The drive goes on reporting its present position or rate."""

    def act(bench: Bench, drive: VirtualDrive) -> None:
        places: dict[int, list[slice]] = {}
        for can_id, names in zip(tpdos(drive), drive.config.tpdo, strict=True):
            begin = 0
            for name in names:
                if (name == "position_actual" and position) or (name == "velocity_actual" and rate):
                    places.setdefault(can_id, []).append(slice(begin, begin + SIZES[name]))
                begin += SIZES[name]
        kept: dict[int, bytes] = {}

        def through(frame: CanFrame) -> list[CanFrame]:
            if frame.can_id not in places:
                return [frame]
            first, data = kept.setdefault(frame.can_id, frame.data), bytearray(frame.data)
            for place in places[frame.can_id]:
                data[place] = first[place]
            return [CanFrame(frame.timestamp_ns, frame.can_id, bytes(data))]

        bench.received.append(through)

    return act


def short_pdos(bench: Bench, drive: VirtualDrive) -> None:
    ids = tpdos(drive)
    bench.received.append(
        lambda frame: [
            CanFrame(frame.timestamp_ns, frame.can_id, frame.data[:-1] if frame.can_id in ids else frame.data)
        ]
    )


def same_id(bench: Bench, drive: VirtualDrive) -> None:
    """Another node sends random bytes under the id of the drive's first TPDO."""
    draw = random.Random(3)
    size = sum(SIZES[name] for name in drive.config.tpdo[0])
    bench.each_cycle.append(lambda: bench.to_daemon(tpdos(drive)[0], draw.randbytes(size)))


def cut_supply(bench: Bench, drive: VirtualDrive) -> None:
    """The power stage loses its supply: no torque, statusword bit 4 is off, and the drive says Operation enabled."""
    drive.servo.supplied = False
    axis = drive.servo.axis  # type: ignore[attr-defined]
    if hasattr(axis, "torque_limit"):
        axis.torque_limit = 0.0
    else:
        axis.effects = (*axis.effects, lambda value: 0.0)


def derate(bench: Bench, drive: VirtualDrive) -> None:
    """A tenth of the torque, as at a temperature limit; statusword bit 11 shows it."""
    axis = drive.servo.axis  # type: ignore[attr-defined]
    axis.torque_limit *= 0.1


def warn(bench: Bench, drive: VirtualDrive) -> None:
    drive.servo.warning = True


def run_down_battery(bench: Bench) -> None:
    """The supply of all drives falls to 60 % within 4 s: a warning below 85 %, torque in proportion, a trip below 65 %.

    Lowering takes 1.5 s, and half of the torque is enough for it.
    """
    begin, axes = bench.truth.time, [drive.servo.axis for drive in bench.drives.values()]  # type: ignore[attr-defined]
    limits = [getattr(axis, "torque_limit", None) for axis in axes]
    share = 1.0
    for axis, limit in zip(axes, limits, strict=True):
        if limit is None:
            axis.effects = (*axis.effects, lambda value: share * value)

    def fall() -> None:
        nonlocal share
        share = max(0.6, 1.0 - 0.1 * (bench.truth.time - begin))
        for axis, limit in zip(axes, limits, strict=True):
            if limit is not None:
                axis.torque_limit = share * limit
        for drive in bench.drives.values():
            drive.servo.warning = share < 0.85
            if share < 0.65 and drive.state is PowerState.OPERATION_ENABLED:
                drive.fail(UNDER_VOLTAGE, 0x04)

    bench.each_cycle.append(fall)


def ramp_object(bench: Bench, drive: VirtualDrive) -> None:
    """The drive's own ramp becomes 10 rpm/s, as by a wrong write in its commissioning tool over a second interface."""
    drive.servo.parameters.acceleration = drive.servo.parameters.deceleration = 10.0


def _not_followed(
    name: str,
    what: str,
    choice: Choice,
    act: Callable[[Bench, VirtualDrive], object],
    *,
    kinds: tuple[str, ...] = KINDS,
    weaker: bool = False,
) -> Fault:
    """`weaker`: the controller still moves the axes."""
    return stopped(
        name,
        what,
        on(choice, act),
        *NOT_FOLLOWED,
        within=DETECTED if weaker else CONTROL_LOST,
        since=clues.not_followed,
        why="known once the axis is off by 0.05 rad/s (5 % of the largest setpoint without a speed loop) from what a "
        "healthy one would do: at a constant setpoint both do the same",
        kinds=kinds,
        or_in_order=choice is one or weaker,
    )


def half(value: float) -> float:
    return 0.5 * value


def double(value: float) -> float:
    return 2.0 * value


def reversed_(value: float) -> float:
    return -value


def nothing(value: float) -> float:
    return 0.0


FAULTS: tuple[Fault, ...] = (
    in_order(
        "drive_heartbeat_lost",
        "a drive stops its heartbeat, its process data go on",
        on(one, lose_heartbeat),
        Wanted.DRIVE_HEARTBEAT,
        says=("heartbeat",),
        since=clues.heartbeat_overdue,
        why="known when it is overdue for as long as the drives grant the master; it still follows and answers",
        or_harmless=True,
    ),
    stopped(
        "drive_pdos_lost",
        "a drive sends its heartbeat, but no process data any more",
        on(one, lose_pdos),
        Code.DRIVE_SILENT,
        within=CONTROL_LOST,
    ),
    stopped(
        "drive_overcurrent",
        "a drive has an overcurrent: EMCY, Fault, brake",
        on(one, overcurrent),
        Code.DRIVE_EMERGENCY,
        Code.DRIVE_NOT_ENABLED,
        within=CONTROL_LOST,
    ),
    stopped(
        "drive_fault_without_emergency",
        "a drive is in Fault and sends no EMCY",
        on(one, silent_fault),
        Code.DRIVE_NOT_ENABLED,
        within=CONTROL_LOST,
    ),
    in_order(
        "drive_warns_by_emergency",
        "a drive sends a warning (EMCY FF01h of its vendor) and goes on",
        on(one, emergency),
        Wanted.DRIVE_WARNING,
        says=("ff01", "warn"),
        why="the drive does what it is told: a warning is a reason to lower the vehicle, not to drop it",
        or_harmless=True,
    ),
    in_order(
        "drive_emergency_storm",
        "a drive sends ten EMCYs in each cycle, warnings and their end",
        on(one, emergency_storm),
        Wanted.DRIVE_WARNING,
        says=("ff01", "warn", "emcy", "emergency"),
        why="the drive does what it is told; the loop must bear the frames",
        or_harmless=True,
    ),
    stopped(
        "trim_overcurrent",
        "the trim drive has an overcurrent: EMCY, Fault, brake",
        on(trim, overcurrent),
        Code.DRIVE_EMERGENCY,
        Code.DRIVE_NOT_ENABLED,
        kinds=MONOCAB,
        or_in_order=True,
        why="the gimbals hold the vehicle alone",
    ),
    stopped(
        "drive_quick_stop",
        "a drive stops by itself (Quick stop active)",
        on(one, commands_itself(QUICK_STOP)),
        Code.DRIVE_NOT_ENABLED,
        within=CONTROL_LOST,
        when=UP,
    ),
    stopped(
        "drive_falls_back",
        "a drive falls back to Ready to switch on by itself",
        on(one, commands_itself(SHUTDOWN)),
        Code.DRIVE_NOT_ENABLED,
        within=CONTROL_LOST,
        when=UP,
    ),
    in_order(
        "drive_warning_bit",
        "a drive sets the warning bit of its statusword (bit 7) and goes on",
        on(one, warn),
        Wanted.DRIVE_WARNING,
        says=("warn",),
        or_harmless=True,
        why="the drive does what it is told; the operator needs to know",
    ),
    _not_followed("drive_mode_one", "a drive changes its mode of operation by itself", one, other_mode, kinds=PAIRS),
    _not_followed("drive_mode_both", "the main drives change their mode of operation by themselves", both, other_mode),
    stopped(
        "drive_unplugged", "the bus cable of a drive is out", on(one, unplug), Code.DRIVE_SILENT, within=CONTROL_LOST
    ),
    stopped(
        "trim_unplugged",
        "the bus cable of the trim drive is out",
        on(trim, unplug),
        Code.DRIVE_SILENT,
        kinds=MONOCAB,
        or_in_order=True,
    ),
    stopped(
        "drives_unplugged",
        "the bus cable of all drives is out",
        on(every, unplug),
        Code.DRIVE_SILENT,
        within=CONTROL_LOST,
    ),
    stopped(
        "drive_without_power",
        "a drive loses its supply for good",
        on(one, lose_power),
        Code.DRIVE_SILENT,
        within=CONTROL_LOST,
    ),
    stopped(
        "drives_without_power",
        "all drives lose their supply for good",
        on(every, lose_power),
        Code.DRIVE_SILENT,
        within=CONTROL_LOST,
    ),
    stopped(
        "drive_restarts",
        "the supply of a drive fails, it boots again",
        on(one, restart),
        Code.DRIVE_SILENT,
        Code.DRIVE_RESTARTED,
        within=CONTROL_LOST,
    ),
    stopped(
        "drive_exchanged",
        "a drive is switched off and on, and is another product then (1018h:2)",
        on(one, come_back_as_another),
        Code.DRIVE_SILENT,
        Code.DRIVE_RESTARTED,
        within=CONTROL_LOST,
        locks="1018",
        why="its parameters, units and limits may be others: it must not run before somebody has looked",
    ),
    stopped(
        "drive_other_firmware",
        "a drive is switched off and on, and has another firmware then (1018h:3)",
        on(one, come_back_with_other_firmware),
        Code.DRIVE_SILENT,
        Code.DRIVE_RESTARTED,
        within=CONTROL_LOST,
        locks="revision",
        why="what was commissioned is not what would run: somebody has to look before the next run",
    ),
    stopped(
        "drive_boot_up_message",
        "the boot-up message of a drive comes, and it goes on",
        on(one, boot_up_message),
        Code.DRIVE_RESTARTED,
        within=CONTROL_LOST,
        or_in_order=True,
    ),
    _not_followed(
        "axis_stuck_one", "an axis stands still, its drive says enabled", one, follows_as(nothing), kinds=PAIRS
    ),
    _not_followed("axis_stuck_both", "the main axes stand still, their drives say enabled", both, follows_as(nothing)),
    _not_followed(
        "axis_half_one", "an axis follows with half its setpoint", one, follows_as(half), kinds=PAIRS, weaker=True
    ),
    _not_followed(
        "axis_half_both", "the main axes follow with half their setpoint", both, follows_as(half), weaker=True
    ),
    _not_followed(
        "axis_double_both", "the main axes follow with twice their setpoint", both, follows_as(double), weaker=True
    ),
    _not_followed("axis_reversed_one", "an axis turns the wrong way", one, follows_as(reversed_), kinds=PAIRS),
    _not_followed("axis_reversed_both", "the main axes turn the wrong way", both, follows_as(reversed_)),
    _not_followed("axis_runs_away_one", "an axis runs away", one, runs_away(1.0), kinds=PAIRS),
    _not_followed("axis_runs_away_both", "the main axes run away with half their speed", both, runs_away(0.5)),
    _not_followed("axis_creeps_both", "the main axes creep away, whatever their setpoint is", both, runs_away(0.06)),
    stopped(
        "trim_runs_away",
        "the trim mass runs away",
        on(trim, runs_away(1.0)),
        *NOT_FOLLOWED,
        since=clues.trim_not_followed,
        kinds=MONOCAB,
        or_in_order=True,
        why="known once it is off by 2 mm; 500 kg that move by 10 mm in 100 ms are 50 N m, which the gimbals hold "
        "while the vehicle is lowered",
    ),
    stopped(
        "trim_creeps",
        "the trim mass creeps away with a tenth of its speed",
        on(trim, runs_away(0.1)),
        *NOT_FOLLOWED,
        since=clues.trim_not_followed,
        kinds=MONOCAB,
        or_in_order=True,
        why="known once it is off by 2 mm, 10 N m",
    ),
    in_order(
        "trim_sticks",
        "the trim mass sticks, its drive says enabled",
        on(trim, follows_as(nothing)),
        Wanted.TRIM_FOLLOWING,
        says=("trim",),
        since=clues.trim_not_followed,
        kinds=MONOCAB,
        when=(When.SETTLE, When.EXCITE, When.LOWER),
        experiments=(SIDE_LOAD,),
        why="known once it is off by 2 mm; the gimbals hold vehicle and person for long enough to lower them",
    ),
    stopped(
        "encoder_frozen_one",
        "a drive reports the same position and rate for ever",
        on(one, frozen(position=True, rate=True)),
        Wanted.AXIS_CONTRADICTION,
        Wanted.TORQUE_BALANCE,
        *NOT_FOLLOWED,
        since=clues.axis_lies,
        or_in_order=True,
        why="known once the axis has moved",
    ),
    stopped(
        "encoder_frozen_both",
        "the main drives report the same position and rate for ever",
        on(both, frozen(position=True, rate=True)),
        Wanted.AXIS_CONTRADICTION,
        Wanted.TORQUE_BALANCE,
        *NOT_FOLLOWED,
        since=clues.axis_lies,
        or_in_order=True,
        why="known once the axes have moved",
        kinds=PAIRS,
    ),
    stopped(
        "encoder_position_frozen_both",
        "the main drives report the same position for ever, and a rate that is right",
        on(both, frozen(position=True, rate=False)),
        Wanted.AXIS_CONTRADICTION,
        Wanted.TORQUE_BALANCE,
        *NOT_FOLLOWED,
        since=clues.axis_lies,
        or_in_order=True,
        why="known once the axes have moved: position and rate contradict each other",
    ),
    stopped(
        "drive_short_pdos",
        "the process data of a drive lack their last byte",
        on(one, short_pdos),
        Code.DRIVE_SILENT,
        within=CONTROL_LOST,
    ),
    stopped(
        "drive_id_twice",
        "another node sends random bytes under the id of a drive",
        on(one, same_id),
        Code.DRIVE_NOT_ENABLED,
        Code.DRIVE_SILENT,
        Wanted.FOREIGN_MASTER,
        within=CONTROL_LOST,
    ),
    stopped(
        "drives_no_voltage",
        "the power stages lose their supply, the drives say Operation enabled (statusword bit 4 is off)",
        on(both, cut_supply),
        Wanted.DRIVE_NO_VOLTAGE,
        Code.DRIVE_NOT_ENABLED,
        within=CONTROL_LOST,
        why="statusword bit 4 says it in the next frame",
    ),
    harmless(
        "drives_derated",
        "the gimbals have a tenth of their torque, as when they are too hot",
        on(both, derate),
        kinds=MONOCAB,
        or_in_order=True,
        why="a tenth accelerates the gimbals faster than the vehicle needs: what they follow is no fault",
    ),
    in_order(
        "battery_low",
        "the supply of the drives falls slowly; they warn below 85 % and trip below 65 %",
        run_down_battery,
        Wanted.DRIVE_WARNING,
        says=("warn", "voltage"),
        since=clues.warned,
        why="known when the drives warn; two seconds later they trip, and lowering takes less",
    ),
    stopped(
        "drive_ramp_changed",
        "the drives accelerate by 10 rpm/s only, from now on",
        on(both, ramp_object),
        *NOT_FOLLOWED,
        within=CONTROL_LOST,
        since=clues.not_followed,
        kinds=MONOCAB,
        why="known once the axis is off by 0.05 rad/s from what a healthy one would do",
    ),
)
