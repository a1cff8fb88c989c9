"""What recordings give to fits: segments of usable samples, as_recorded the sensors that a record shows; resting,
quantised, white_noise and input_noise are told from samples without a model, time_scale with it."""
