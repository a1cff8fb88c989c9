"""Fits of a model with one effect more: refit from the score test on, masked from elsewhere, finer by more physics,
random_parts with random signals in place of effects, effect_fit for `upright model add`. look_ahead excludes fits that
use future samples, held_out asks data that the fits have not seen; speed_loop_choice is the actuators' own."""
