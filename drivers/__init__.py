"""CAN frames to samples and back: the bus, CANopen, the CiA 402 drives, the IMU. Units become SI here, nowhere else."""
