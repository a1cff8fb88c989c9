"""The virtual vehicle: mechanics, CiA 402 drives and IMU as nodes on a CAN bus, written independently of `models`.

It has its own integrator with a finer step, its own friction, quantised sensors and jitter, so that a model tested on
it is not tested on itself. It exchanges data with the rest of upright over the bus only.
"""
