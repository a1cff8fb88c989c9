"""The nodes on the bus: drive_node is a CANopen slave with its objects and object_dictionary, drive_application what
runs on it through the power_state, as a servo_drive or, without a brake (free_drive), as a torque_drive or a
voltage_drive; imu_node streams; a machine is what moves them, and port reads and writes the bus."""
