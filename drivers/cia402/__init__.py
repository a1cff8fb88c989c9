"""Servo inverters after CiA 402 over CANopen: state machine, PDO codecs and emergencies (pure), set-up over SDO."""
