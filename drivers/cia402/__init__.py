"""CiA 402 servo inverters over CANopen: state machine, PDO codecs and emergencies (pure), set-up over SDO."""
