"""Opens a CAN interface by its address IFACE:CHANNEL with python-can, or says what to do about it.

`socketcan:can0`, `virtual:NAME` (within this process), `udp_multicast:239.74.163.2` (between processes, without CAN in
the kernel), `slcan:/dev/ttyACM0@115200` (a serial adapter), and every other interface of python-can.
"""

from __future__ import annotations

import errno
import socket
from collections.abc import Sequence
from typing import Any

import can

from upright.drivers.bus.errors import BusError
from upright.drivers.bus.socketcan import STANDARD_ID

IP_MULTICAST_ALL, IPV6_MULTICAST_ALL = 49, 29
BITRATE_OF_INTERFACE = ("socketcan", "virtual", "udp_multicast")
"""Interfaces whose bit rate, if they have one, is set elsewhere."""


def split(address: str) -> tuple[str, str]:
    """Interface and channel of IFACE:CHANNEL. Raises BusError for anything else."""
    interface, colon, channel = address.partition(":")
    if not (interface and colon and channel):
        raise BusError(
            f"{address!r} is not a bus address.",
            bus=address,
            remedy="write IFACE:CHANNEL, for example socketcan:can0, virtual:demo, udp_multicast:239.74.163.2 "
            "or slcan:/dev/ttyACM0.",
        )
    if interface not in can.VALID_INTERFACES:
        raise BusError(
            f"python-can has no interface {interface!r} (in {address!r}).",
            bus=address,
            remedy=f"use one of {', '.join(sorted(can.VALID_INTERFACES))}.",
        )
    return interface, channel


def connect(address: str, bitrate: int | None, can_ids: Sequence[int] | None) -> can.BusABC:
    """The python-can bus at `address`, receiving `can_ids` only (None: everything).

    `bitrate` (bit/s) is for adapters that this process sets up itself. Raises BusError, with the remedy.
    """
    interface, channel = split(address)
    options: dict[str, Any] = {}
    if interface == "socketcan":
        _check_socketcan(address, channel, bitrate)
    elif interface == "virtual":
        options["preserve_timestamps"] = True
    elif bitrate is not None and interface not in BITRATE_OF_INTERFACE:
        options["bitrate"] = bitrate
    if can_ids is not None:
        options["can_filters"] = [
            {"can_id": can_id, "can_mask": STANDARD_ID, "extended": False} for can_id in sorted(set(can_ids))
        ]
    try:
        bus = can.Bus(channel=channel, interface=interface, ignore_config=True, **options)
    except (OSError, can.CanError, ValueError, ImportError) as error:
        raise BusError(
            f"{address} cannot be opened: {error}", bus=address, remedy=_remedy(interface, channel)
        ) from error
    if interface == "udp_multicast":
        _hear_own_group_only(bus.fileno())
    elif interface == "socketcan" and _is_down(bus):
        bus.shutdown()
        raise BusError(f"{address} is down.", bus=address, remedy=f"bring it up: {_link_up(channel, bitrate)}")
    return bus


def _check_socketcan(address: str, channel: str, bitrate: int | None) -> None:
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as error:
        raise BusError(
            f"{address} cannot be opened: this kernel has no SocketCAN ({error.strerror}).",
            bus=address,
            remedy="sudo modprobe can-raw; or, without CAN hardware, use a bus such as udp_multicast:239.74.163.2.",
        ) from error
    try:
        socket.if_nametoindex(channel)
    except OSError as error:
        if channel.startswith("vcan"):
            remedy = f"create it: sudo ip link add dev {channel} type vcan && sudo ip link set {channel} up"
        else:
            remedy = f"connect the CAN adapter (`ip -br link` lists all interfaces), then {_link_up(channel, bitrate)}"
        raise BusError(
            f"{address} cannot be opened: there is no interface {channel}.", bus=address, remedy=remedy
        ) from error


def _link_up(channel: str, bitrate: int | None) -> str:
    if channel.startswith("vcan"):
        return f"sudo ip link set {channel} up"
    return f"sudo ip link set {channel} up txqueuelen 100 type can bitrate {bitrate or 1_000_000}"


def _remedy(interface: str, channel: str) -> str:
    match interface:
        case "slcan":
            return f"check that {channel.partition('@')[0]} is the adapter's serial port and that you may open it."
        case "udp_multicast":
            return "give a multicast address (239.x.y.z or ff15::...) on a network that is up (`ip link set lo up`)."
        case _:
            return f"check channel {channel!r} and what python-can's interface {interface!r} needs."


def _is_down(bus: can.BusABC) -> bool:
    """Whether a freshly bound SocketCAN socket reports its interface down; this also clears the report."""
    descriptor: socket.socket = bus.socket  # type: ignore[attr-defined]
    return descriptor.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR) == errno.ENETDOWN


def _hear_own_group_only(descriptor: int) -> None:
    """Otherwise Linux also delivers the groups that any other socket of the machine has joined on the same port."""
    with socket.socket(fileno=socket.dup(descriptor)) as udp:  # closing the duplicate leaves python-can's open
        if udp.family == socket.AF_INET:
            udp.setsockopt(socket.IPPROTO_IP, IP_MULTICAST_ALL, 0)
        else:
            udp.setsockopt(socket.IPPROTO_IPV6, IPV6_MULTICAST_ALL, 0)
