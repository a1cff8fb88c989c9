"""CAN frames to samples and back: the bus, CANopen, the CiA 402 drives and the IMU. Units become SI here, nowhere else."""
