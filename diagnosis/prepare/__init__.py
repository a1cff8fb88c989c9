"""The input of a diagnosis: usable refuses records that cannot distinguish effects; ready and time_offsets prepare a
model for the recordings; candidates are the effects that it may lack; workspace holds the samples on which all models
are judged, actuator_samples those of the actuators alone."""
