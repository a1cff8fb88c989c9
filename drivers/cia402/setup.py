"""Set-up of a drive over SDO before it is run: its identity, the PDOs both ways, and when it stops by itself.

Blocking: `configure` must run in a thread, while another passes the bus's frames to the canopen network. It leaves the
drive in NMT pre-operational, disabled; the control loop starts and enables it. CiA 301 and CiA 402.
"""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass
from pathlib import Path

import canopen

from upright.drivers.cia301 import emergency, nmt
from upright.drivers.cia301.nmt import NmtCommand
from upright.drivers.cia301.sdo_client import WALL, Clock
from upright.drivers.cia402 import eds, modes, states
from upright.drivers.cia402 import objects as od
from upright.drivers.cia402.config import DriveConfig
from upright.drivers.cia402.pdo_setup import configure_pdos
from upright.drivers.cia402.sdo import DriveSetupError, MissingNode, Refused, SdoDialogue, milliseconds
from upright.drivers.cia402.states import State

POLL_PERIOD = 0.02
"""s between two looks at a drive that adopts a mode or switches off."""

STOP_REACTIONS = {"fault": 1, "disable_voltage": 2, "quick_stop": 3}
"""Values of the abort connection option code (6007h); 0 is no reaction, and negative ones are the makers'."""

SYNC_BITS = 0x7FFFFFFF
"""Of 1005h: bit 31 means nothing (CiA 301), bit 30 that the drive produces the SYNC."""

EMERGENCY_BITS = 0xBFFFFFFF
"""Of 1014h: bit 30 is reserved, bit 31 means that the drive sends none."""

CIA402_PROFILE = 402


@dataclass(frozen=True, slots=True)
class Supervision:
    """How master and drives monitor each other. Times in s, rounded up to whole ms for the drive."""

    master_node: int
    heartbeat_period: float
    """Of the drive's own heartbeat."""
    heartbeat_timeout: float
    """Time without the master's heartbeat after which the drive stops by itself."""
    rpdo_timeout: float
    """Time without a setpoint after which the drive stops by itself, if it can monitor that."""
    cycle_period: float
    """Between two SYNCs."""


@dataclass(frozen=True, slots=True)
class DriveReport:
    """What was found in a drive and what was changed. None if the drive does not have the object."""

    name: str
    node: int
    eds: str
    device_type: int
    vendor_id: int
    product_code: int
    revision: int | None
    serial_number: int | None
    state: State
    """On arrival, before it was switched off."""
    error_code: int | None
    supported_modes: tuple[int, ...] | None
    mode: int
    quick_stop_option: int | None
    stop_reaction: int | None
    watches_heartbeat: bool
    watches_rpdos: bool
    changes: tuple[str, ...]
    """Objects that were written, with the value before and after."""
    warnings: tuple[str, ...]
    """What the drive lacks, with the consequences."""


def configure(
    network: canopen.Network,
    config: DriveConfig,
    supervision: Supervision,
    before: DriveReport | None = None,
    clock: Clock = WALL,
) -> DriveReport:
    """Make the drive of `config` ready to be started (NMT) and enabled, and read back all that was written.

    One that was set up `before` has to be the same device with the same firmware. What is right already is not written.
    A refusal ends the set-up if the vehicle cannot run without it; else it is a warning of the report.

    Raises:
        DriveConfigError: the EDS file does not exist.
        DriveSetupError: with the node, the object and the remedy; `MissingNode` if nothing answers.
    """
    file, dictionary = eds.load(config)
    sdo = SdoDialogue(network, config, clock)
    try:
        network.send_message(*nmt.command_frame(NmtCommand.PRE_OPERATIONAL, config.node))
        return _configure(sdo, file, dictionary, supervision, before)
    finally:
        sdo.close()


def _configure(
    sdo: SdoDialogue,
    file: Path,
    dictionary: canopen.ObjectDictionary,
    supervision: Supervision,
    before: DriveReport | None,
) -> DriveReport:
    config = sdo.config
    device_type = _check_profile(sdo)
    vendor_id, product_code = _check_identity(sdo)
    eds.check_identity(config, file, dictionary, vendor_id, product_code)
    revision, serial_number = _check_unchanged(sdo, before)
    state, error_code = _switch_off(sdo)
    eds.check_device(sdo, file)
    supported = _select_mode(sdo)
    _set_sync(sdo, supervision)
    watches_rpdos = configure_pdos(sdo, dictionary, supervision.rpdo_timeout)
    watches_heartbeat = _set_heartbeats(sdo, supervision)
    if not (watches_heartbeat or watches_rpdos):
        raise sdo.refuse(
            "it can monitor neither the master's heartbeat (1016h) nor its setpoints (1400h:5), and would keep the "
            "last speed when the master is gone",
            remedy="Use a drive, or a firmware, that has one of them.",
        )
    return DriveReport(
        name=config.name,
        node=config.node,
        eds=str(file),
        device_type=device_type,
        vendor_id=vendor_id,
        product_code=product_code,
        revision=revision,
        serial_number=serial_number,
        state=state,
        error_code=error_code,
        supported_modes=supported,
        mode=config.mode,
        quick_stop_option=_check_quick_stop(sdo),
        stop_reaction=_set_stop_reaction(sdo),
        watches_heartbeat=watches_heartbeat,
        watches_rpdos=watches_rpdos,
        changes=tuple(sdo.changes),
        warnings=tuple(sdo.warnings),
    )


def _check_profile(sdo: SdoDialogue) -> int:
    device_type = sdo.read(od.DEVICE_TYPE)
    if device_type & 0xFFFF != CIA402_PROFILE:
        raise sdo.refuse(
            f"is {device_type:#010x}: device profile {device_type & 0xFFFF}, not {CIA402_PROFILE}; this is not a drive",
            entry=od.DEVICE_TYPE,
            remedy="Check the node ids: another device answers under this one.",
        )
    return device_type


def _check_identity(sdo: SdoDialogue) -> tuple[int, int]:
    vendor_id, product_code = sdo.read(od.VENDOR_ID), sdo.find(od.PRODUCT_CODE) or 0
    for entry, key, found, expected in (
        (od.VENDOR_ID, "vendor_id", vendor_id, sdo.config.vendor_id),
        (od.PRODUCT_CODE, "product_code", product_code, sdo.config.product_code),
    ):
        if expected and found != expected:
            raise sdo.refuse(
                f"the drive reports {found:#x}, but {key} in the vehicle file is {expected:#x}",
                entry=entry,
                remedy=f"Check that the drives are not mixed up; else write {key} = {found:#x}, or 0 for any.",
            )
    return vendor_id, product_code


def _check_unchanged(sdo: SdoDialogue, before: DriveReport | None) -> tuple[int | None, int | None]:
    """Revision and serial number of the drive."""
    revision, serial_number = sdo.find(od.REVISION), sdo.find(od.SERIAL_NUMBER)
    if before is not None:
        for entry, found, known in (
            (od.REVISION, revision, before.revision),
            (od.SERIAL_NUMBER, serial_number, before.serial_number),
        ):
            if found != known:
                raise sdo.refuse(
                    f"the drive reports {found or 0:#x}, and {known or 0:#x} when it was set up before: what was "
                    "commissioned is not what would run",
                    entry=entry,
                    remedy="If it was exchanged on purpose, restart the service and commission the vehicle again.",
                )
    return revision, serial_number


def _switch_off(sdo: SdoDialogue) -> tuple[State, int | None]:
    """Disable a drive that is still on, as from an earlier run. Its state on arrival, and its error code in Fault."""
    arrival = state = states.classify(sdo.read(od.STATUSWORD))
    off = (State.SWITCH_ON_DISABLED, State.NOT_READY_TO_SWITCH_ON, State.FAULT)
    if state not in off:
        sdo.write(od.CONTROLWORD, states.DISABLE_VOLTAGE)
        deadline = sdo.clock.now() + sdo.config.mode_timeout
        while state not in off:
            if sdo.clock.now() > deadline:
                raise sdo.refuse(
                    f"stays in {state.value} after disable voltage",
                    entry=od.STATUSWORD,
                    remedy="Switch the drive off by hand, and check that nothing else on the bus controls it; if it "
                    "brakes for longer, write mode_timeout in its section.",
                )
            sdo.clock.sleep(POLL_PERIOD)
            state = states.classify(sdo.read(od.STATUSWORD))
    if state is not State.FAULT:
        return arrival, None
    error_code = sdo.find(od.ERROR_CODE)
    what = emergency.describe(error_code) if error_code is not None else "no error code"
    sdo.warnings.append(f"it is in Fault ({what}): reset it before it can be enabled")
    return arrival, error_code


def _select_mode(sdo: SdoDialogue) -> tuple[int, ...] | None:
    mode = sdo.config.mode
    bits = sdo.find(od.SUPPORTED_MODES)
    supported = None if bits is None else modes.supported(bits)
    if supported is None:
        sdo.warnings.append(f"no {od.SUPPORTED_MODES}: only 6061h shows whether it has mode {mode}")
    elif mode not in supported:
        raise sdo.refuse(
            f"the drive has modes {', '.join(map(str, supported)) or 'none'}, but not mode {mode}",
            entry=od.SUPPORTED_MODES,
            remedy="Choose another one under mode in the vehicle file, or set the drive up for this one.",
        )
    if _requested_mode(sdo) != mode:
        sdo.write(od.MODE, mode)
    deadline = sdo.clock.now() + sdo.config.mode_timeout
    while (shown := sdo.read(od.MODE_DISPLAY)) != mode:
        if sdo.clock.now() > deadline:
            raise sdo.refuse(
                f"is {shown} {sdo.config.mode_timeout:g} s after mode {mode} was requested",
                entry=od.MODE_DISPLAY,
                remedy="Check in the drive's manual what this mode needs (mode 9 often a synchronous cycle); if the "
                "drive needs longer for it, write mode_timeout in its section.",
            )
        sdo.clock.sleep(POLL_PERIOD)
    return supported


def _requested_mode(sdo: SdoDialogue) -> int | None:
    """The mode that the drive was asked for last; None if it does not show that."""
    try:
        return sdo.read(od.MODE)
    except Refused:
        return None


def _set_sync(sdo: SdoDialogue, supervision: Supervision) -> None:
    """The drive must receive SYNC on 080h and not produce it; in a cyclic mode it must also know the cycle."""
    sdo.set_where_present(od.SYNC_COB_ID, 0x80, without="assumed to be 080h", bits=SYNC_BITS)
    if sdo.config.operation.cyclic and not _knows_cycle(sdo, supervision.cycle_period):
        exponent = -3 if math.isclose(supervision.cycle_period % 1e-3, 0.0, abs_tol=1e-9) else -4
        value = round(supervision.cycle_period * 10.0**-exponent)
        without = "the drive must find out the cycle of the setpoints by itself"
        if sdo.set_where_present(od.INTERPOLATION_TIME, value, without=without):
            sdo.set_where_present(od.INTERPOLATION_EXPONENT, exponent, without=without)


def _knows_cycle(sdo: SdoDialogue, period: float) -> bool:
    """Whether 60C2h gives the period (s) already, in whatever units."""
    value, exponent = sdo.find(od.INTERPOLATION_TIME), sdo.find(od.INTERPOLATION_EXPONENT)
    return value is not None and exponent is not None and math.isclose(value * 10.0**exponent, period, rel_tol=1e-6)


def _set_heartbeats(sdo: SdoDialogue, supervision: Supervision) -> bool:
    """The drive's own heartbeat, and the one that it monitors. False if it cannot monitor one."""
    timeout = milliseconds(supervision.heartbeat_timeout)
    watches = sdo.set_time(
        od.CONSUMER_HEARTBEAT,
        supervision.master_node << 16 | timeout,
        without="the drive does not notice a dead master by its heartbeat, only by missing setpoints",
    )
    _set_own_heartbeat(sdo, supervision)
    sdo.set_if_accepted(
        od.EMERGENCY_COB_ID,
        nmt.EMERGENCY_COB_ID + sdo.config.node,
        without="the drive does not say why it has a fault",
        bits=EMERGENCY_BITS,
    )
    return watches


def _set_own_heartbeat(sdo: SdoDialogue, supervision: Supervision) -> None:
    """Another period than asked for will do if two fit into the time that is waited for one (a frame may get lost), and
    if it is not so short that it takes much of the bus."""
    entry, wanted = od.PRODUCER_HEARTBEAT, milliseconds(supervision.heartbeat_period)
    try:
        sdo.set(entry, wanted)
    except Refused:
        if not wanted <= 2 * sdo.read(entry) <= milliseconds(supervision.heartbeat_timeout):
            raise


def _set_stop_reaction(sdo: SdoDialogue) -> int | None:
    """What the drive does when the master is gone; None if it does not have the object.

    If the drive does not know the reaction of the vehicle file, any other that stops it will do.
    """
    entry, wanted = od.ABORT_CONNECTION_OPTION, STOP_REACTIONS[sdo.config.stop_reaction]
    test = "test it by pulling the plug"
    try:
        own = f"what the drive does when the master is gone is set in its own parameters; {test}"
        return wanted if sdo.set_where_present(entry, wanted, without=own) else None
    except Refused as error:
        reason = error.reason
    found = sdo.read(entry)
    others = iter(value for value in STOP_REACTIONS.values() if value != wanted)
    while found == 0 and (value := next(others, None)) is not None:
        with contextlib.suppress(Refused):
            sdo.set(entry, value)
            found = value
    if found == 0:
        raise sdo.refuse(
            f"is 0, so that the drive goes on when the master is gone, and takes no other value ({reason})",
            entry=entry,
            remedy="Set in the drive's own parameters that it stops, or use a firmware that can.",
        )
    name = next((name for name, value in STOP_REACTIONS.items() if value == found), "")
    use = f'write stop_reaction = "{name}" if that is right' if name else "its manual says what that is"
    sdo.warnings.append(f"{reason}: the drive reacts with {found} instead; {use}, and {test}")
    return found


def _check_quick_stop(sdo: SdoDialogue) -> int | None:
    option = sdo.find(od.QUICK_STOP_OPTION)
    if option is None:
        sdo.warnings.append(f"no {od.QUICK_STOP_OPTION}: how it stops is set in its own parameters")
    elif option == 0:
        sdo.warnings.append(f"{od.QUICK_STOP_OPTION} is 0: a quick stop just switches the torque off, without a ramp")
    return option


__all__ = ["DriveReport", "DriveSetupError", "MissingNode", "Supervision", "configure"]
