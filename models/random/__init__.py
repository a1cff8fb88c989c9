"""The random parts of a model: `part` is a coloured signal as states, `disturbance` one at a joint, `sensor_error` one
at an output, `input_noise` the noise of a measured input."""
