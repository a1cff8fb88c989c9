"""Asks the computer for the facts: /proc, /sys, `ip`, systemd, the daemon and the broker. Nothing is changed.

Each question is answered alone; one that cannot be answered is a `NotKnown` with the reason.
"""

from __future__ import annotations

import asyncio
import ctypes
import json
import os
import platform
import pwd
import resource
import socket
import struct
import subprocess
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar

from upright.service.control import assembly
from upright.service.control.clients import api
from upright.service.doctor.facts import (
    UNLIMITED,
    Access,
    Broker,
    CanLink,
    Clock,
    Disk,
    Facts,
    Kernel,
    Limits,
    NotKnown,
    Process,
    Software,
    Unit,
    Vehicle,
)
from upright.service.mqtt.client import MqttConfig, MqttConfigError
from upright.service.observer.recording.storage_check import obstacle
from upright.telemetry.errors import UprightError
from upright.vehicles.file import load, shipped, shipped_file
from upright.vehicles.sections import VehicleFile

INSTALLED = Path("/etc/upright/vehicle.toml")
"""The vehicle file of the service."""

PATIENCE = 5.0
"""s for a command or the broker to answer."""

LOG_LINE = 48
"""Bytes of a frame in a raw log (candump)."""

POLICIES = {os.SCHED_OTHER: "other", os.SCHED_FIFO: "fifo", os.SCHED_RR: "rr", os.SCHED_BATCH: "batch"}
SO_PEERCRED = struct.Struct("3i")
STA_UNSYNC, TIME_ERROR = 0x0040, 5

T = TypeVar("T")


class _Unanswered(UprightError):
    """A question that this computer cannot answer."""


@dataclass(frozen=True, slots=True)
class Subject:
    """What is asked about: the vehicle file, where the daemon listens and records (None: where it usually does)."""

    vehicle: str | None
    socket: Path | None = None
    data: Path | None = None


def collect(subject: Subject, progress: Callable[[str], None] = lambda text: None) -> tuple[Facts, dict[str, Any]]:
    """The facts, and the daemon's status ({} if none answers). `progress` gets what is asked next."""
    file, notes, why = _file(subject.vehicle)
    vehicle = NotKnown(why) if file is None else _answer(_vehicle, file)
    progress("asking the daemon")
    daemon, status = _daemon(_sockets(subject, file))
    progress("asking the kernel")
    known = Facts(
        kernel=_answer(_kernel),
        vehicle=vehicle,
        links=_answer(_links, vehicle),
        access=_answer(_access, _sockets(subject, file), file),
        clock=_answer(_clock),
        governors=_answer(_governors),
        limits=_answer(_limits),
        daemon=daemon,
        unit=_answer(_unit),
        softirq=_answer(_softirq),
        receive_buffer=_answer(lambda: int(Path("/proc/sys/net/core/rmem_max").read_text())),
        broker=_asked_broker(file, progress),
        software=_answer(_software),
        disk=_answer(_disk, subject.data, status),
        notes=notes,
    )
    return known, status


def path_of(subject: Subject) -> Path:
    """The vehicle file, whether it can be used or not."""
    name = subject.vehicle or str(INSTALLED)
    return shipped_file(name) if name in shipped() else Path(name)


def loaded(subject: Subject) -> VehicleFile | None:
    """The vehicle file, if there is one and it can be used."""
    return _file(subject.vehicle)[0]


def _answer(ask: Callable[..., T], *arguments: Any) -> T | NotKnown:
    try:
        return ask(*arguments)
    except OSError as error:
        return NotKnown(f"{error.filename or 'this computer'}: {error.strerror or error}")
    except (_Unanswered, ValueError, KeyError, metadata.PackageNotFoundError, subprocess.SubprocessError) as error:
        return NotKnown(str(error).rstrip(".") or type(error).__name__)


def run(*command: str) -> str:
    """What a command prints. Raises _Unanswered with what it complains about."""
    environment = {**os.environ, "LC_ALL": "C", "PATH": f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin"}
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, errors="replace", timeout=PATIENCE, env=environment, check=False
        )
    except FileNotFoundError as error:
        raise _Unanswered(f"the command {command[0]} is not installed") from error
    if done.returncode:
        raise _Unanswered(f"{command[0]}: {(done.stderr.strip() or 'failed').splitlines()[0]}")
    return done.stdout


# The vehicle file and the daemon


def _file(name: str | None) -> tuple[VehicleFile | None, tuple[str, ...], str]:
    """The vehicle file, what is wrong with it, and why there is none."""
    if name is None and not INSTALLED.exists():
        return None, (), "no vehicle was given"
    try:
        return load(name or str(INSTALLED)), (), ""
    except UprightError as error:
        return None, (str(error),), "the vehicle file cannot be used"


def _vehicle(file: VehicleFile) -> Vehicle:
    buses = list(dict.fromkeys((file.bus.drives, file.bus.imu)))
    kernel = [address.partition(":")[2] for address in buses if address.startswith("socketcan:")]
    setpoints = sum(len(drive.rpdo) for drive in file.drive)
    answers = sum(len(drive.tpdo) for drive in file.drive)
    frames = len(assembly.imu_config(file).can_ids) + setpoints + answers + 2
    return Vehicle(
        id=file.vehicle.id,
        interfaces=tuple(kernel),
        other_buses=tuple(address for address in buses if not address.startswith("socketcan:")),
        bitrate=file.bus.bitrate,
        frames_a_cycle=setpoints + 2,  # with SYNC and heartbeat
        missed_cycles=file.limits.missed_cycles,
        bytes_a_second=file.control.rate * (frames * LOG_LINE + 8.0 * (len(assembly.channels(file)) + 1)),
    )


def _sockets(subject: Subject, file: VehicleFile | None) -> list[Path]:
    if subject.socket is not None:
        return [subject.socket]
    return api.socket_candidates(file.vehicle.id) if file is not None else []


def _daemon(sockets: list[Path]) -> tuple[Process | NotKnown, dict[str, Any]]:
    """The process that answers at one of the sockets, and its status."""
    for path in sockets:
        try:
            with socket.socket(socket.AF_UNIX) as connection:
                connection.settimeout(PATIENCE)
                connection.connect(str(path))
                peer = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, SO_PEERCRED.size)
            status = list(api.call([path], {"verb": "status"}, timeout=PATIENCE))[-1]["status"]
        except (OSError, UprightError, KeyError, ValueError):
            continue
        found = _answer(_process, SO_PEERCRED.unpack(peer)[0], str(status.get("version", "")))
        return found, status
    return NotKnown("no daemon answers" if sockets else "no vehicle was given"), {}


def _process(pid: int, version: str) -> Process:
    policy = os.sched_getscheduler(pid) & ~os.SCHED_RESET_ON_FORK
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    locked = [int(line.split()[1]) for line in lines if line.startswith("VmLck:")]
    return Process(
        pid=pid,
        policy=POLICIES.get(policy, str(policy)),
        priority=os.sched_getparam(pid).sched_priority,
        locked_kb=locked[0] if locked else None,
        version=version,
    )


def _unit() -> Unit:
    names = "LoadState ActiveState NRestarts NeedDaemonReload CPUSchedulingPolicy CPUSchedulingPriority LimitMEMLOCK"
    answer = run("systemctl", "show", "upright", *(f"--property={name}" for name in names.split()))
    found = dict(line.partition("=")[::2] for line in answer.splitlines())
    if found["LoadState"] == "not-found":
        return Unit(installed=False)
    memlock = found["LimitMEMLOCK"]
    return Unit(
        installed=True,
        active=found["ActiveState"],
        restarts=int(found["NRestarts"]),
        reload_needed=found["NeedDaemonReload"] == "yes",
        policy=POLICIES.get(int(found["CPUSchedulingPolicy"]), found["CPUSchedulingPolicy"]),
        priority=int(found["CPUSchedulingPriority"]),
        memlock=UNLIMITED if memlock == "infinity" else int(memlock),
    )


# The kernel


def _kernel() -> Kernel:
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as error:
        return Kernel(platform.release(), platform.version(), error.strerror or str(error))
    return Kernel(platform.release(), platform.version())


def _links(vehicle: Vehicle | NotKnown) -> tuple[CanLink, ...]:
    found = [
        _link(each) for each in json.loads(run("ip", "-details", "-json", "link")) if each.get("link_type") == "can"
    ]
    if isinstance(vehicle, NotKnown):
        return tuple(found)
    return tuple(each for each in found if each.name in vehicle.interfaces)


def _link(shown: dict[str, Any]) -> CanLink:
    """An interface from an entry of `ip -details -json link`."""
    info = shown.get("linkinfo", {})
    data = info.get("info_data", {})
    virtual = info.get("info_kind") != "can"
    return CanLink(
        name=shown["ifname"],
        up="UP" in shown.get("flags", ()),
        queue=int(shown.get("txqlen", 0)),
        virtual=virtual,
        state="" if virtual else str(data.get("state", "")),
        bitrate=data.get("bittiming", {}).get("bitrate"),
        restart_ms=None if virtual else int(data.get("restart_ms", 0)),
    )


class _Timex(ctypes.Structure):
    """The beginning of struct timex, adjtimex(2); the rest is room."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("frequency", ctypes.c_long),
        ("largest_error", ctypes.c_long),
        ("estimated_error", ctypes.c_long),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_char * 256),
    )


def _clock() -> Clock:
    timex = _Timex()
    state = ctypes.CDLL(None, use_errno=True).adjtimex(ctypes.byref(timex))
    if state < 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    source = Path("/sys/devices/system/clocksource/clocksource0/current_clocksource").read_text().strip()
    synchronised = state != TIME_ERROR and not timex.status & STA_UNSYNC
    return Clock(synchronised, timex.largest_error * 1e-6, source)


def _governors() -> dict[str, int]:
    places = Path("/sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq/scaling_governor")
    found = Counter(place.read_text().strip() for place in places)
    if not found:
        raise _Unanswered("the kernel does not choose the frequency of these processors (no cpufreq)")
    return dict(found)


def _limits() -> Limits:
    soft = [resource.getrlimit(which)[0] for which in (resource.RLIMIT_RTPRIO, resource.RLIMIT_MEMLOCK)]
    rtprio, memlock = (UNLIMITED if each == resource.RLIM_INFINITY else each for each in soft)
    return Limits(rtprio, memlock)


def _softirq() -> str:
    for place in Path("/proc").glob("[0-9]*/comm"):
        try:
            if place.read_text().startswith("ksoftirqd/"):
                policy = os.sched_getscheduler(int(place.parent.name)) & ~os.SCHED_RESET_ON_FORK
                return POLICIES.get(policy, str(policy))
        except OSError:
            continue
    raise _Unanswered("no thread ksoftirqd is to be seen here")


# Permissions, disk, software, broker


def _access(sockets: list[Path], file: VehicleFile | None) -> Access:
    refused = []
    for path in sockets:
        try:
            with socket.socket(socket.AF_UNIX) as connection:
                connection.connect(str(path))
        except PermissionError as error:
            refused.append((str(path), str(error.strerror), _group(path)))
        except OSError:
            continue
    for address in (file.bus.drives, file.bus.imu) if file is not None else ():
        device = Path(address.partition(":")[2].partition("@")[0])
        if address.startswith("slcan:/") and device.exists() and not os.access(device, os.R_OK | os.W_OK):
            refused.append((str(device), "Permission denied", _group(device)))
    return Access(pwd.getpwuid(os.getuid()).pw_name, tuple(dict.fromkeys(refused)))


def _group(path: Path) -> str:
    """The group that may use a path, or the folder that hides it."""
    while True:
        try:
            return path.group()
        except (OSError, KeyError):
            path = path.parent


def _disk(data: Path | None, status: dict[str, Any]) -> Disk:
    given = data or (Path(status["data"]) if "data" in status else None)
    folder = (given or Path(os.environ.get("STATE_DIRECTORY", "recordings"))).absolute()
    there = folder
    while not there.exists():
        there = there.parent
    space = os.statvfs(there)
    if "data" in status and given == Path(status["data"]):
        trouble = str(status.get("observer", {}).get("obstacle", ""))  # the daemon tries it, and may do so
    elif not os.access(there, os.W_OK):
        trouble = f"{there} cannot be written by this user."
    else:
        trouble = obstacle(folder) if there == folder else ""
    return Disk(str(folder), space.f_bavail * space.f_frsize, trouble)


def _software() -> Software:
    from packaging.requirements import Requirement

    wrong = []
    for text in metadata.requires("upright") or ():
        requirement = Requirement(text)
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
            continue
        try:
            found = metadata.version(requirement.name)
        except metadata.PackageNotFoundError:
            wrong.append(f"{requirement.name} is missing")
        else:
            if not requirement.specifier.contains(found, prereleases=True):
                wrong.append(f"{requirement.name} is {found}, not {requirement.specifier}")
    return Software(assembly.version(), platform.python_version(), tuple(wrong))


def _asked_broker(file: VehicleFile | None, progress: Callable[[str], None]) -> Broker | NotKnown:
    if file is None:
        return NotKnown("no vehicle file")
    section = file.mqtt
    if not section.broker:
        return NotKnown("the vehicle file names no broker")
    progress(f"asking the broker {section.broker}")
    try:
        config = MqttConfig.of(section.model_dump(), file.vehicle.id)
        assert config is not None
        return Broker(section.broker, asyncio.run(_trouble(config)))
    except MqttConfigError as error:
        return Broker(section.broker, str(error).rstrip("."))


async def _trouble(config: MqttConfig) -> str:
    """Why the broker does not accept a connection as the vehicle's; "" if it does."""
    import aiomqtt

    try:
        async with (
            asyncio.timeout(PATIENCE),
            aiomqtt.Client(
                config.host,
                config.port,
                username=config.username,
                password=config.password,
                identifier=f"{config.client_id}-doctor",  # another session than the daemon's, which goes on
                tls_context=config.tls,
                timeout=PATIENCE,
            ),
        ):
            return ""
    except (aiomqtt.MqttError, OSError, UnicodeError) as error:  # a TimeoutError is an OSError
        return str(error) or "it does not answer"
