"""Diagnosis: compares a model with measurements and finds where it fails and which physical effect it lacks. No I/O, no
clock.

diagnose runs these steps for one model, parts for a vehicle together with its actuators:

    prepare/ the data -> fits/ of the model alone -> search/ for effects: score/, fits, gates -> lack_of_fit/ -> verdict

findings holds the results. revise/ adds an effect to a model, next_experiment chooses the experiment that distinguishes
rival models, report/ presents the results. prediction/ compares a model with recordings without naming an effect; live/
diagnoses while the vehicle runs.
"""
