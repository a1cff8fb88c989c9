"""What a diagnosis works on: usable refuses records that cannot tell; ready and time_offsets make a model ready for
them; candidates are the effects that it may lack; workspace holds the samples on which all are judged, actuator_samples
those of the actuators alone."""
