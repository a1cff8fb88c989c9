"""Diagnosis: a model against a measurement, where it fails, and which physical effect it lacks. No I/O, no clock.

In this order: prepare/ the samples and the candidates; fits/ of the model alone; score/ what a little of each effect
would do; contenders are fitted, gates decide between them, which together is one step; exchange looks at each beside
the others; lack_of_fit/ tests what is left. diagnose goes this way for one model, parts for a vehicle and its
actuators; findings hold what came out. Then revise/ puts an effect into a model, next_experiment says what would tell
rivals apart, report/ shows it. prediction/ compares a model with records without naming anything, live/ asks while the
vehicle runs.
"""
