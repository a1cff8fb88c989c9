"""The checks of `upright doctor`: facts in, one finding out, with a remedy that can be typed. Pure.

`CHECKS` is the whole list, in the order in which a frame meets them: kernel, bus, process, disk, broker.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import StrEnum

from upright.service.doctor.facts import UNLIMITED, CanLink, Facts, NotKnown

CAN_INTERRUPT = 50
"""Real-time priority of interrupt threads on PREEMPT_RT kernels."""

RECEIVE_BUFFER = 1 << 20
"""Bytes that the daemon asks for (drivers.bus.socketcan)."""

GOOD_SOURCES = ("tsc", "kvm-clock", "arch_sys_counter", "hyperv_clocksource_tsc_page", "xen", "um_timer", "timer")
"""Clock sources that are read without leaving the processor, or that a virtual machine has instead."""

DROP_INS = "systemd/upright.service.d"
REALTIME = (
    f"sudo install -D -m 644 {DROP_INS}/realtime.conf /etc/systemd/system/upright.service.d/realtime.conf && "
    "sudo systemctl daemon-reload && sudo systemctl restart upright"
)


class Status(StrEnum):
    """The result of a check."""

    OK = "ok"
    NOT_KNOWN = "not_known"
    WARNING = "warning"
    PROBLEM = "problem"


_GRAVITY = list(Status)


@dataclass(frozen=True, slots=True)
class Finding:
    """What a check found, as a sentence, and what to do about it ("" if nothing)."""

    status: Status
    text: str
    remedy: str = ""


Judge = Callable[[Facts], Finding]


@dataclass(frozen=True, slots=True)
class Check:
    """One check: its name for programs, and for people."""

    name: str
    title: str
    judge: Judge


def examine(facts: Facts) -> list[tuple[Check, Finding]]:
    """All checks with their findings."""
    return [(check, check.judge(facts)) for check in CHECKS]


def worst(findings: Iterable[Finding]) -> Status:
    """The gravest status; OK if there is nothing."""
    return max((each.status for each in findings), key=_GRAVITY.index, default=Status.OK)


def _ok(text: str) -> Finding:
    return Finding(Status.OK, text)


def _warning(text: str, remedy: str) -> Finding:
    return Finding(Status.WARNING, text, remedy)


def _problem(text: str, remedy: str) -> Finding:
    return Finding(Status.PROBLEM, text, remedy)


def _not_known(fact: NotKnown, remedy: str = "") -> Finding:
    return Finding(Status.NOT_KNOWN, f"Not known: {fact.why}.", remedy)


# The computer


def kernel(facts: Facts) -> Finding:
    """A kernel that can be preempted anywhere keeps a cycle from waiting for a driver."""
    found = facts.kernel
    if isinstance(found, NotKnown):
        return _not_known(found)
    if "PREEMPT_RT" in found.version:
        return _ok(f"Linux {found.release} with PREEMPT_RT.")
    return _warning(
        f"Linux {found.release} without PREEMPT_RT: under load a driver may hold up a cycle for milliseconds.",
        "sudo apt-get install linux-image-rt-amd64 (Debian; Ubuntu: sudo pro enable realtime-kernel), then reboot",
    )


def socketcan(facts: Facts) -> Finding:
    """Without SocketCAN there is no bus, except one over UDP or a serial adapter."""
    found = facts.kernel
    if isinstance(found, NotKnown):
        return _not_known(found)
    if not found.no_can:
        return _ok("The kernel opens CAN sockets.")
    text = f"The kernel opens no CAN sockets: {found.no_can}."
    remedy = "sudo modprobe can-raw"
    if not isinstance(facts.vehicle, NotKnown) and not facts.vehicle.interfaces:
        return _warning(f"{text} The vehicle {facts.vehicle.id} has none.", remedy)
    return _problem(text, remedy)


def governor(facts: Facts) -> Finding:
    """A processor that sleeps between cycles wakes up late."""
    found = facts.governors
    if isinstance(found, NotKnown):
        return _not_known(found)
    slow = sorted(name for name in found if name != "performance")
    if not slow:
        return _ok("All processors run at full frequency (governor performance).")
    which = ", ".join(f"{found[name]} with {name}" for name in slow)
    return _warning(
        f"Processors change their frequency ({which}): a cycle after a pause takes longer.",
        "sudo cpupower frequency-set -g performance (package linux-cpupower)",
    )


def clock(facts: Facts) -> Finding:
    """The control loop follows a clock that nobody sets; recordings and MQTT show the computer's time."""
    found = facts.clock
    if isinstance(found, NotKnown):
        return _not_known(found)
    if found.source not in GOOD_SOURCES:
        return _warning(
            f"The kernel reads the time from {found.source}, which is slow and may jump.",
            "see `dmesg | grep -i clocksource` for why; with a sound processor boot with `tsc=reliable`",
        )
    if not found.synchronised:
        return _warning(
            "Nothing synchronises the computer's clock: the times of recordings and those of other devices part.",
            "sudo timedatectl set-ntp true, or without a network sudo apt-get install chrony and a local source",
        )
    return _ok(f"The clock is synchronised within {1e3 * found.error:.0f} ms (source {found.source}).")


# The bus


def vehicle(facts: Facts) -> Finding:
    """The vehicle file says which interfaces, bit rate and broker there have to be."""
    if facts.notes:
        return _problem(f"The vehicle file cannot be used: {' '.join(facts.notes)}", "upright config check FILE")
    if isinstance(facts.vehicle, NotKnown):
        return _not_known(facts.vehicle, "upright doctor VEHICLE")
    buses = ", ".join((*facts.vehicle.interfaces, *facts.vehicle.other_buses))
    return _ok(f"The vehicle {facts.vehicle.id} is on {buses}.")


def _of_links(judge: Callable[[CanLink, Facts], Finding | None]) -> Judge:
    """A check of every CAN interface: the gravest finding, with the texts of all that are as grave."""

    def check(facts: Facts) -> Finding:
        links = facts.links
        if not isinstance(facts.vehicle, NotKnown) and not facts.vehicle.interfaces:
            return _ok(f"No CAN interface is used, but {', '.join(facts.vehicle.other_buses)}.")
        if isinstance(links, NotKnown):
            return _not_known(links)
        found = [finding for link in links if (finding := judge(link, facts)) is not None]
        if not found:
            return _not_known(NotKnown("no such interface is up" if links else "there is no CAN interface"))
        gravest = worst(found)
        chosen = [each for each in found if each.status == gravest]
        remedies = dict.fromkeys(each.remedy for each in chosen if each.remedy)
        return Finding(gravest, " ".join(each.text for each in chosen), "; ".join(remedies))

    return check


def _link_up(link: str, facts: Facts) -> str:
    if link.startswith("vcan"):
        return f"sudo ip link set {link} up"
    bitrate = facts.vehicle.bitrate if not isinstance(facts.vehicle, NotKnown) else 1_000_000
    return f"sudo ip link set {link} up txqueuelen 100 type can bitrate {bitrate} restart-ms 100"


def interfaces(facts: Facts) -> Finding:
    """The vehicle's interfaces exist and are up."""
    if not isinstance(facts.vehicle, NotKnown) and not isinstance(facts.links, NotKnown):
        there = {link.name for link in facts.links}
        missing = [name for name in facts.vehicle.interfaces if name not in there]
        if missing:
            made = [
                f"sudo ip link add dev {name} type vcan && sudo ip link set {name} up"
                if name.startswith("vcan")
                else f"connect the CAN adapter (`ip -br link` lists all), then {_link_up(name, facts)}"
                for name in missing
            ]
            return _problem(f"There is no interface {', '.join(missing)}.", "; ".join(made))
    return _of_links(_is_up)(facts)


def _is_up(link: CanLink, facts: Facts) -> Finding:
    if link.up:
        return _ok(f"{link.name} is up.")
    return _problem(f"{link.name} is down.", f"{_link_up(link.name, facts)} (see docs/how-to/run-as-a-service.md)")


def _bitrate(link: CanLink, facts: Facts) -> Finding | None:
    if link.virtual:
        return _ok(f"{link.name} is virtual and has no bit rate.")
    if not link.up or link.bitrate is None:
        return None
    if isinstance(facts.vehicle, NotKnown):
        return _ok(f"{link.name} has {link.bitrate / 1e3:g} kbit/s; no vehicle file says what it should have.")
    if link.bitrate == facts.vehicle.bitrate:
        return _ok(f"{link.name} has {link.bitrate / 1e3:g} kbit/s, as the vehicle file.")
    return _problem(
        f"{link.name} has {link.bitrate / 1e3:g} kbit/s, but the vehicle file says {facts.vehicle.bitrate / 1e3:g}.",
        f"sudo ip link set {link.name} down && {_link_up(link.name, facts)}, and BitRate= in "
        "/etc/systemd/network/20-can0.network; or correct [bus] bitrate",
    )


def _state(link: CanLink, facts: Facts) -> Finding | None:
    if link.virtual:
        return _ok(f"{link.name} is virtual and sees no errors.")
    if not link.up or not link.state:
        return None
    if link.state == "ERROR-ACTIVE":
        return _ok(f"{link.name} sees no errors on the bus.")
    remedy = (
        "measure 60 ohm between CAN_H and CAN_L with the power off (120 ohm at each end), check that another node is "
        f"on and has the same bit rate, and watch `ip -details -statistics link show {link.name}`"
    )
    text = f"{link.name} is in state {link.state}: frames are damaged or not acknowledged."
    return _problem(text, remedy) if link.state in ("BUS-OFF", "STOPPED") else _warning(text, remedy)


def _restart(link: CanLink, facts: Facts) -> Finding | None:
    if link.virtual:
        return _ok(f"{link.name} is virtual and never bus-off.")
    if link.restart_ms:
        return _ok(f"{link.name} joins the bus again {link.restart_ms} ms after a bus-off.")
    return _warning(
        f"{link.name} stays off after a bus-off until a person acts (restart-ms 0).",
        f"sudo ip link set {link.name} down && {_link_up(link.name, facts)}, and RestartSec=100ms in "
        "/etc/systemd/network/20-can0.network",
    )


def _queue(link: CanLink, facts: Facts) -> Finding:
    cycles = facts.vehicle.missed_cycles + 1 if not isinstance(facts.vehicle, NotKnown) else 4
    frames = facts.vehicle.frames_a_cycle if not isinstance(facts.vehicle, NotKnown) else 10
    if link.queue >= cycles * frames:
        return _ok(f"{link.name} queues {link.queue} frames.")
    return _warning(
        f"{link.name} queues {link.queue} frames, fewer than {cycles} cycles have ({cycles * frames}): setpoints may "
        "be lost.",
        f"sudo ip link set {link.name} txqueuelen 100, and TransmitQueueLength=100 in "
        "/etc/systemd/network/20-can0.link",
    )


def receive_buffer(facts: Facts) -> Finding:
    """Frames wait here while the daemon is held up."""
    found = facts.receive_buffer
    if isinstance(found, NotKnown):
        return _not_known(found)
    if found >= RECEIVE_BUFFER:
        return _ok(f"A socket may hold {found / 1024:.0f} KiB of frames that wait.")
    return _warning(
        f"A socket may hold {found / 1024:.0f} KiB of frames that wait, and the daemon asks for 1024.",
        "echo net.core.rmem_max=1048576 | sudo tee /etc/sysctl.d/60-upright.conf && sudo sysctl --system",
    )


# The service


def permissions(facts: Facts) -> Finding:
    """Whoever asks may talk to the daemon, and open the adapter."""
    found = facts.access
    if isinstance(found, NotKnown):
        return _not_known(found)
    if not found.refused:
        return _ok(f"The user {found.user} may use everything that is there.")
    text = "; ".join(f"{path} ({why})" for path, why, _ in found.refused)
    groups = dict.fromkeys(group for _, _, group in found.refused)
    remedy = " && ".join(f"sudo usermod -aG {group} {found.user}" for group in groups)
    return _problem(f"Refused to the user {found.user}: {text}.", f"{remedy}, then log in again")


def unit(facts: Facts) -> Finding:
    """The unit starts the daemon at boot and restarts it."""
    found = facts.unit
    if isinstance(found, NotKnown):
        return _not_known(found)
    if not found.installed:
        return _warning(
            "The systemd unit upright is not installed: nothing starts the daemon again.",
            "see docs/how-to/run-as-a-service.md",
        )
    if found.active == "failed":
        return _problem(
            "The unit upright has failed, and systemd does not start it any more.",
            "journalctl -u upright -n 50 tells why; then sudo systemctl reset-failed upright && "
            "sudo systemctl start upright",
        )
    if found.reload_needed:
        return _warning(
            "The files of the unit upright were changed and do not act yet.",
            "sudo systemctl daemon-reload && sudo systemctl restart upright",
        )
    if found.restarts:
        return _warning(
            f"systemd had to restart the daemon, {found.restarts} times.",
            "journalctl -u upright -n 200 tells why; `upright bundle` packs it",
        )
    return _ok(f"The unit upright is {found.active}.")


def realtime(facts: Facts) -> Finding:
    """The control process goes before everything but interrupts."""
    daemon, given = facts.daemon, facts.unit
    if not isinstance(daemon, NotKnown):
        policy, priority, who = daemon.policy, daemon.priority, "The daemon"
    elif not isinstance(given, NotKnown) and given.installed:
        policy, priority, who = given.policy, given.priority, "The unit's daemon"
    else:
        return _not_known(daemon, "sudo systemctl start upright")
    if policy not in ("fifo", "rr"):
        return _warning(f"{who} has no real-time priority: other processes may hold up a cycle.", REALTIME)
    if priority >= CAN_INTERRUPT:
        return _warning(
            f"{who} has real-time priority {priority}: frames wait for it, as their interrupt has {CAN_INTERRUPT}.",
            "set CPUSchedulingPriority=40 in /etc/systemd/system/upright.service.d/realtime.conf",
        )
    return _ok(f"{who} has real-time priority {priority} ({policy}).")


def memory(facts: Facts) -> Finding:
    """What is locked is never swapped out, and never read from the disk in the middle of a cycle."""
    daemon, given = facts.daemon, facts.unit
    if not isinstance(daemon, NotKnown) and daemon.locked_kb is not None:
        if daemon.locked_kb:
            return _ok(f"The daemon's memory is locked ({daemon.locked_kb / 1024:.0f} MB).")
        return _warning("The daemon's memory is not locked: when memory runs short, a cycle waits.", REALTIME)
    if not isinstance(given, NotKnown) and given.installed:
        if given.memlock == UNLIMITED:
            return _ok("The unit lets the daemon lock its memory.")
        return _warning("The unit does not let the daemon lock its memory (LimitMEMLOCK).", REALTIME)
    limits = facts.limits
    if isinstance(limits, NotKnown):
        return _not_known(limits)
    if limits.memlock == UNLIMITED:
        return _ok("A daemon started here may lock its memory.")
    return _warning(
        f"A daemon started here may lock no more than {limits.memlock / 1e6:.0f} MB, and so locks nothing.",
        "run it as a service with realtime.conf, or `ulimit -l unlimited` as root before",
    )


def softirq(facts: Facts) -> Finding:
    """Frames that arrive while the processor is busy are delivered by a thread of the kernel."""
    found = facts.softirq
    if isinstance(found, NotKnown):
        return _not_known(found)
    remedy = 'for thread in $(pgrep ksoftirqd); do sudo chrt --fifo --pid 50 "$thread"; done    # until the next boot'
    if found in ("fifo", "rr"):
        return _ok("The kernel delivers frames at real-time priority, too.")
    daemon = facts.daemon
    if isinstance(daemon, NotKnown) or daemon.policy not in ("fifo", "rr"):
        return _ok("The kernel delivers frames at the daemon's priority.")
    return _warning(
        "The kernel delivers frames without real-time priority (ksoftirqd): on a busy computer they come late.", remedy
    )


def broker(facts: Facts) -> Finding:
    """Page and commands go over the broker; the vehicle goes on without."""
    found = facts.broker
    if isinstance(found, NotKnown):
        return _not_known(found)
    if not found.trouble:
        return _ok(f"The broker at {found.address} accepts this vehicle.")
    return _warning(
        f"The broker at {found.address} cannot be used: {found.trouble}.",
        "systemctl status mosquitto on its computer, and [mqtt] of the vehicle file "
        "(broker, username, password_file, tls)",
    )


def versions(facts: Facts) -> Finding:
    """The packages that are there are those that were tested, and the daemon is the one that is installed."""
    found, daemon = facts.software, facts.daemon
    if isinstance(found, NotKnown):
        return _not_known(found)
    if found.wrong:
        remedy = "pip install --upgrade upright, in the environment of the command"
        return _problem(f"upright {found.version} requires other packages: {', '.join(found.wrong)}.", remedy)
    if not isinstance(daemon, NotKnown) and daemon.version and daemon.version != found.version:
        text = f"The daemon is upright {daemon.version}, this command {found.version}."
        return _warning(text, "sudo systemctl restart upright, while the vehicle is at rest")
    return _ok(f"upright {found.version} on Python {found.python}, with all packages that it requires.")


def disk(facts: Facts) -> Finding:
    """An experiment that cannot be recorded is not begun."""
    found = facts.disk
    if isinstance(found, NotKnown):
        return _not_known(found)
    if found.obstacle:
        return _problem(found.obstacle, f"df -h {found.folder}; ls -ld {found.folder}")
    free = f"{found.free / 1e9:.1f} GB are free in {found.folder}"
    if isinstance(facts.vehicle, NotKnown):
        return _ok(f"{free}.")
    hours = found.free / facts.vehicle.bytes_a_second / 3600.0
    if hours < 1.0:
        remedy = f"move old recordings from {found.folder} to another disk; the daemon deletes none"
        return _warning(f"{free}, which is less than an hour of recording ({60 * hours:.0f} minutes).", remedy)
    return _ok(f"{free}: {hours:.0f} hours of recording.")


CHECKS = (
    Check("kernel", "kernel", kernel),
    Check("governor", "frequency governor", governor),
    Check("clock", "clock", clock),
    Check("vehicle", "vehicle file", vehicle),
    Check("socketcan", "CAN in the kernel", socketcan),
    Check("interfaces", "CAN interfaces", interfaces),
    Check("bitrate", "CAN bit rate", _of_links(_bitrate)),
    Check("bus_state", "CAN errors", _of_links(_state)),
    Check("restart", "CAN restart", _of_links(_restart)),
    Check("queue", "CAN transmit queue", _of_links(_queue)),
    Check("receive_buffer", "CAN receive buffer", receive_buffer),
    Check("softirq", "delivery of frames", softirq),
    Check("unit", "service", unit),
    Check("permissions", "permissions", permissions),
    Check("realtime", "real-time priority", realtime),
    Check("memory", "locked memory", memory),
    Check("versions", "versions", versions),
    Check("disk", "disk", disk),
    Check("broker", "MQTT broker", broker),
)
