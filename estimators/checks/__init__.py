"""Whether readings contradict each other while the vehicle runs: the rate and the position of an axis, gyro and
accelerometer, and frames that a bus loses."""
