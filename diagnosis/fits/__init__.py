"""Fits of a model alone and with one effect more: refit from the score test on, masked from elsewhere, finer by more
physics, random_parts with random signals in place of effects. look_ahead excludes fits that use future samples;
speed_loop_choice is the actuators' own."""
