"""The nodes on the bus: drive_node is a CANopen slave with its objects and object_dictionary, drive_application what
runs on it, as a servo_drive or a voltage_drive through the power_state; imu_node streams; a machine is what moves
them, and port reads and writes the bus."""
