"""Fits of a model alone and with one more effect: refit starting from the score test, confounded from other starts,
finer with more physics, random_parts with random signals in place of effects. look_ahead excludes fits that use future
samples; speed_loop_choice is for the actuators alone."""
