"""Diagnosis: a model against a measurement, where it fails, and which physical effect it lacks. No I/O, no clock.

diagnose goes this way, for one model; parts for a vehicle and its actuators:

    prepare/ the data -> fits/ of the model alone -> search/ for effects: score/, fits, gates -> lack_of_fit/ -> verdict

findings hold what came out. Then revise/ puts an effect into a model, next_experiment says what would tell rivals
apart, report/ shows it. prediction/ compares a model with records without naming anything, live/ asks while the vehicle
runs.
"""
