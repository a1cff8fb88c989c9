"""`upright doctor`: every check judged on facts, and the collector on this computer."""

from __future__ import annotations

import asyncio
import errno
import json
import os
import re
import socket
from collections.abc import AsyncGenerator
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from upright.service.cli import app
from upright.service.control.clients import api
from upright.service.control.clients.server import ApiServer
from upright.service.doctor import collect
from upright.service.doctor.checks import CHECKS, Finding, Status, examine, worst
from upright.service.doctor.collect import Subject
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

CAN0 = CanLink("can0", up=True, queue=100, state="ERROR-ACTIVE", bitrate=1_000_000, restart_ms=100)
VEHICLE = Vehicle("monocab", ("can0",), (), 1_000_000, frames_a_cycle=5, missed_cycles=3, bytes_a_second=150e3)
DAEMON = Process(77, "fifo", 40, 200_000, "1.0")
UNIT = Unit(installed=True, active="active", policy="fifo", priority=40, memlock=UNLIMITED)
SOUND = Facts(
    kernel=Kernel("6.1.0-rt", "#1 SMP PREEMPT_RT Debian"),
    vehicle=VEHICLE,
    links=(CAN0,),
    access=Access("anna"),
    clock=Clock(synchronised=True, error=0.002, source="tsc"),
    governors={"performance": 4},
    limits=Limits(rtprio=0, memlock=8_000_000),
    daemon=DAEMON,
    unit=UNIT,
    softirq="fifo",
    receive_buffer=1 << 20,
    broker=Broker("localhost:1883"),
    software=Software("1.0", "3.11.2"),
    disk=Disk("/var/lib/upright", 50_000_000_000),
)
NO_DAEMON = NotKnown("no daemon answers")


def judge(name: str, facts: Facts) -> Finding:
    return next(check.judge(facts) for check in CHECKS if check.name == name)


def test_sound_computer_has_no_findings_and_no_remedies() -> None:
    found = examine(SOUND)
    assert {finding.status for _, finding in found} == {Status.OK}
    assert not [finding.remedy for _, finding in found if finding.remedy]
    assert worst(finding for _, finding in found) is Status.OK


@pytest.mark.parametrize(
    ("name", "facts", "status", "words", "remedy"),
    [
        (
            "kernel",
            {"kernel": Kernel("6.1", "#1 SMP PREEMPT_DYNAMIC")},
            "warning",
            "6.1 without",
            "linux-image-rt-amd64",
        ),
        ("socketcan", {"kernel": Kernel("6", "", "not supported")}, "problem", "not supported", "modprobe can-raw"),
        ("governor", {"governors": {"powersave": 3, "performance": 1}}, "warning", "3 with powersave", "cpupower"),
        ("clock", {"clock": Clock(False, 16.0, "tsc")}, "warning", "Nothing synchronises", "timedatectl set-ntp true"),
        ("clock", {"clock": Clock(True, 0.001, "hpet")}, "warning", "hpet", "tsc=reliable"),
        ("vehicle", {"notes": ("x.toml: control.rate: wrong.",)}, "problem", "control.rate", "config check"),
        (
            "interfaces",
            {"links": ()},
            "problem",
            "no interface can0",
            "up txqueuelen 100 type can bitrate",
        ),
        ("interfaces", {"links": (replace(CAN0, up=False),)}, "problem", "can0 is down", "ip link set can0 up"),
        ("bitrate", {"links": (replace(CAN0, bitrate=500_000),)}, "problem", "500 kbit/s", "ip link set can0 down &&"),
        ("bus_state", {"links": (replace(CAN0, state="ERROR-PASSIVE"),)}, "warning", "ERROR-PASSIVE", "60 ohm"),
        ("bus_state", {"links": (replace(CAN0, state="BUS-OFF"),)}, "problem", "BUS-OFF", "60 ohm"),
        ("restart", {"links": (replace(CAN0, restart_ms=0),)}, "warning", "restart-ms 0", "RestartSec=100ms"),
        ("queue", {"links": (replace(CAN0, queue=10),)}, "warning", "4 cycles have (20)", "txqueuelen 100"),
        ("receive_buffer", {"receive_buffer": 212_992}, "warning", "208 KiB", "net.core.rmem_max=1048576"),
        ("softirq", {"softirq": "other"}, "warning", "ksoftirqd", "chrt --fifo --pid 50"),
        ("unit", {"unit": Unit(installed=False)}, "warning", "not installed", "run-as-a-service.md"),
        ("unit", {"unit": replace(UNIT, active="failed")}, "problem", "has failed", "reset-failed"),
        ("unit", {"unit": replace(UNIT, reload_needed=True)}, "warning", "changed", "daemon-reload"),
        ("unit", {"unit": replace(UNIT, restarts=3)}, "warning", "3 times", "journalctl"),
        (
            "permissions",
            {"access": Access("anna", (("/run/upright/m.sock", "Permission denied", "upright"),))},
            "problem",
            "/run/upright/m.sock",
            "usermod -aG upright anna",
        ),
        (
            "realtime",
            {"daemon": replace(DAEMON, policy="other", priority=0)},
            "warning",
            "no real-time",
            "realtime.conf",
        ),
        ("realtime", {"daemon": replace(DAEMON, priority=60)}, "warning", "priority 60", "CPUSchedulingPriority=40"),
        ("realtime", {"daemon": NO_DAEMON, "unit": replace(UNIT, policy="other")}, "warning", "unit", "realtime.conf"),
        ("memory", {"daemon": replace(DAEMON, locked_kb=0)}, "warning", "not locked", "realtime.conf"),
        ("memory", {"daemon": NO_DAEMON, "unit": replace(UNIT, memlock=1)}, "warning", "LimitMEMLOCK", "realtime.conf"),
        ("memory", {"daemon": NO_DAEMON, "unit": NotKnown("x")}, "warning", "no more than 8 MB", "ulimit -l"),
        (
            "versions",
            {"software": Software("1.0", "3.11", ("numpy is 1.2, not >=2",))},
            "problem",
            "numpy is 1.2",
            "pip",
        ),
        ("versions", {"software": Software("1.1", "3.11")}, "warning", "daemon is upright 1.0", "restart upright"),
        ("disk", {"disk": Disk("/d", 1, "Nothing would be recorded: why.")}, "problem", "why", "df -h /d"),
        ("disk", {"disk": Disk("/d", 270_000_000)}, "warning", "30 minutes", "move old recordings"),
        (
            "broker",
            {"broker": Broker("b:1883", "Connection refused")},
            "warning",
            "refused",
            "systemctl status mosquitto",
        ),
    ],
)
def test_each_fault_of_a_computer_is_found_with_its_remedy(
    name: str, facts: dict[str, object], status: str, words: str, remedy: str
) -> None:
    changed = replace(SOUND, **facts)  # type: ignore[arg-type]
    finding = judge(name, changed)
    assert (finding.status.value, words in finding.text, remedy in finding.remedy) == (status, True, True), finding
    others = {check.name for check, each in examine(changed) if each.status is not Status.OK}
    assert name in others


def test_what_is_not_known_says_why_and_is_no_problem() -> None:
    found = {check.name: finding for check, finding in examine(Facts())}
    assert {finding.status for finding in found.values()} <= {Status.NOT_KNOWN, Status.OK}
    assert all("not asked" in each.text for each in found.values() if each.status is Status.NOT_KNOWN)
    assert all(found[name].status is Status.NOT_KNOWN for name in ("kernel", "bitrate", "realtime", "broker", "disk"))


def test_virtual_interface_and_vehicle_without_one_need_no_bit_rate() -> None:
    vcan = CanLink("vcan0", up=True, queue=1000, virtual=True)
    names = ("interfaces", "bitrate", "bus_state", "restart", "queue")
    on_vcan = replace(SOUND, vehicle=replace(VEHICLE, interfaces=("vcan0",)), links=(vcan,))
    elsewhere = replace(SOUND, vehicle=replace(VEHICLE, interfaces=(), other_buses=("slcan:/dev/ttyACM0",)), links=())
    for facts in (on_vcan, elsewhere):
        assert [judge(name, facts).status for name in names] == [Status.OK] * 5
    missing = judge("interfaces", replace(on_vcan, links=()))
    assert "ip link add dev vcan0 type vcan" in missing.remedy


def test_gravest_of_two_interfaces_is_what_is_said() -> None:
    two = replace(VEHICLE, interfaces=("can0", "can1"))
    links = (CAN0, replace(CAN0, name="can1", bitrate=250_000))
    finding = judge("bitrate", replace(SOUND, vehicle=two, links=links))
    assert finding.status is Status.PROBLEM
    assert "can1" in finding.text
    assert "can0" not in finding.text


def test_reads_interfaces_as_iproute2_shows_them() -> None:
    shown = {
        "ifname": "can0",
        "flags": ["NOARP", "UP", "LOWER_UP", "ECHO"],
        "txqlen": 10,
        "link_type": "can",
        "linkinfo": {
            "info_kind": "can",
            "info_data": {
                "state": "ERROR-PASSIVE",
                "restart_ms": 100,
                "bittiming": {"bitrate": 500000, "sample_point": "0.875"},
            },
        },
    }
    assert collect._link(shown) == CanLink("can0", True, 10, False, "ERROR-PASSIVE", 500_000, 100)
    virtual = {"ifname": "vcan0", "flags": ["NOARP"], "link_type": "can", "linkinfo": {"info_kind": "vcan"}}
    assert collect._link(virtual) == CanLink("vcan0", False, 0, True)


def test_collector_asks_this_computer_and_leaves_nothing_behind(tmp_path: Path) -> None:
    data = tmp_path / "recordings"
    facts, status = collect.collect(Subject("monocab", tmp_path / "none.sock", data))
    assert status == {}
    assert isinstance(facts.daemon, NotKnown)
    assert isinstance(facts.kernel, Kernel)
    assert facts.kernel.release in Path("/proc/version").read_text()
    assert isinstance(facts.vehicle, Vehicle)
    assert facts.vehicle.interfaces == ("can0",)
    assert isinstance(facts.clock, Clock)
    assert facts.clock.error >= 0.0
    assert isinstance(facts.software, Software)
    assert not facts.software.wrong
    assert isinstance(facts.disk, Disk)
    assert facts.disk.free > 0
    assert not data.exists()


def test_broker_that_refuses_is_reported_in_its_own_words(tmp_path: Path) -> None:
    from served import free_port

    text = (Path(collect.__file__).parents[2] / "vehicles" / "monocab" / "vehicle.toml").read_text()
    file = tmp_path / "vehicle.toml"
    file.write_text(re.sub(r'^broker = ".*"', f'broker = "127.0.0.1:{free_port()}"', text, count=1, flags=re.MULTILINE))
    facts, _ = collect.collect(Subject(str(file), tmp_path / "none.sock", tmp_path))
    assert isinstance(facts.broker, Broker)
    assert "refused" in facts.broker.trouble.lower()


def test_command_exits_with_1_for_a_problem_and_prints_one_document(tmp_path: Path) -> None:
    wrong = tmp_path / "vehicle.toml"
    wrong.write_text("[vehicle]\nid = 1\n")
    done = CliRunner().invoke(app, ["doctor", str(wrong), "--data", str(tmp_path), "--json"])
    assert done.exit_code == 1
    document = json.loads(done.stdout)
    assert document["status"] == "problem"
    checks = {each["check"]: each for each in document["checks"]}
    assert list(checks) == [check.name for check in CHECKS]
    assert str(wrong) in checks["vehicle"]["text"]
    assert set(checks["disk"]) == {"check", "status", "text", "remedy"}


async def test_running_daemon_is_asked_for_its_process_and_its_data(tmp_path: Path) -> None:
    status = {"version": "1.2", "data": str(tmp_path), "observer": {"obstacle": "Nothing would be recorded: full."}}

    async def answer(request: api.Message) -> AsyncGenerator[api.Message]:
        yield api.result(api.ExitCode.DONE, status=status)

    daemon = ApiServer(tmp_path / "s.sock", answer)
    await daemon.start()
    try:
        facts, found = await asyncio.to_thread(collect.collect, Subject("monocab", tmp_path / "s.sock"))
    finally:
        await daemon.close()
    assert found == status
    assert isinstance(facts.daemon, Process)
    assert (facts.daemon.pid, facts.daemon.version) == (os.getpid(), "1.2")
    assert isinstance(facts.disk, Disk)
    assert (facts.disk.folder, facts.disk.obstacle) == (str(tmp_path), "Nothing would be recorded: full.")
    assert judge("versions", facts).status is Status.WARNING


def test_socket_of_somebody_else_is_refused_with_its_group(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: socket.socket, address: str) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    place = tmp_path / "s.sock"
    monkeypatch.setattr(socket.socket, "connect", refuse)
    access = collect._access([place], None)
    assert access.refused == ((str(place), "Permission denied", tmp_path.group()),)
