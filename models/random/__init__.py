"""What is random in a model: part is a coloured signal as states, disturbance one at a joint, sensor_error one at an
output, input_noise that of a measured input."""
