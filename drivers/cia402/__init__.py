"""CiA 402 servo inverters: state machine, modes and PDO codecs (pure), set-up over SDO."""
