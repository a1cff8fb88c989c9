"""The nodes on the bus. drive_node is a CANopen slave with its objects and object_dictionary; sdo_server gives its
answers their time. drive_application runs on it, with the states of power_state: as a servo_drive or, without a brake
(free_drive), as a torque_drive or a voltage_drive. imu_node streams the IMU's frames, machine is the interface to the
mechanics, and port reads and writes the bus."""
