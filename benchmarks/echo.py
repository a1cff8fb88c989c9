"""The minimal responder to an IMU frame set in Python: blocking read, blocking write.  echo.py IFACE TRIGGER REPLY"""

from __future__ import annotations

import socket
import struct
import sys

channel, trigger, reply = sys.argv[1], int(sys.argv[2], 16), int(sys.argv[3], 16)
bus = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
bus.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, struct.pack("=II", trigger, 0xC000_07FF))
bus.bind((channel,))
setpoint = struct.pack("=IB3x8s", reply, 6, bytes(8))
while True:
    bus.recv(16)
    bus.send(setpoint)
