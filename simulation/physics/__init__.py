"""What all virtual vehicles are made of: friction, contact, motor-driven axes and what is hidden in their inputs, and
what others do to a vehicle: random torques and loads."""
