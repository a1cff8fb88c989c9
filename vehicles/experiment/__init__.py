"""What is done to a vehicle in an experiment: its phases, the excitation, the load that somebody puts on, and the
controller that held the vehicle up, as recorded."""
