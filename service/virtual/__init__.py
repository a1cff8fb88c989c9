"""The virtual vehicle of a vehicle file: vehicle configures it, serving runs it in the daemon, run records it without a
bus."""
