"""Identification step by step, cell by cell as in a notebook.

    python examples/identify_in_a_notebook.py [RECORDING]

Without a recording, one is simulated: the virtual vehicle with a static torque of 120 N m, which the first model lacks.
"""

# %% A recording from a file or of the virtual vehicle
import sys

import upright
from upright.service.virtual.run import record

if len(sys.argv) > 1:
    recording = upright.load(sys.argv[1])
else:
    recording = record("monocab", "step", hide=["static_torque"], seed=1)

# %% A model: a shipped one, with the vehicle file's CAD values as start values
model = upright.Model.load("monocab_roll", vehicle="monocab")

# %% Fit it. In a notebook the last line suffices to show the table
first = upright.identify(recording, model, methods="prediction_error")
print(first)

# %% The same with an effect added, as in the paper, and how the prediction changes
second = upright.identify(recording, model.add("static_torque"), methods="prediction_error")
print(second)
fits = upright.compare(recording, {"CAD": model, "with static torque": second.model}).to_json()["models"]
for channel in fits[0]["fit_percent"]:
    before, after = (each["fit_percent"][channel] for each in fits)
    print(f"{channel}: {before:.2f} % -> {after:.2f} %, half a second ahead")

# %% Values are plain numbers
inertia = second.parameters["inertia"]
print(f"inertia {inertia}; everything known: {second.parameters}")
