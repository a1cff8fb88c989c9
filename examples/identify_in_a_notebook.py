"""Identification step by step, cell by cell as in a notebook.

    python examples/identify_in_a_notebook.py [RECORDING]

Without a recording, one is simulated: the virtual vehicle with a static torque of 120 N m, which the first model lacks.
"""

# %% A recording from a file or of the virtual vehicle
import sys

import estimators
from estimators.identify.run import with_values
from models import library
from service.virtual.run import record
from telemetry import storage
from vehicles.file import load

if len(sys.argv) > 1:
    recording = storage.load(sys.argv[1])
else:
    recording = record("monocab", "step", hide=["static_torque"], seed=1)

# %% A model: a shipped one, with the vehicle file's CAD values as start values
vehicle = load("monocab")
known = vehicle.parameters
model = with_values(library.get("monocab_roll"), known.values, known.deviations)

# %% Fit it. In a notebook the last line suffices to show the table
first = estimators.prediction_error(model, [recording])
print(first)
first._repr_html_()

# %% The same with an effect added, as in the paper, and how the prediction changes
second = estimators.prediction_error(model.add("static_torque"), [recording])
print(second)
for channel, percent in second.fit_percent.items():
    print(f"{channel}: {first.fit_percent[channel]:.2f} % -> {percent:.2f} %, half a second ahead")

# %% Values are plain numbers
inertia = second.parameters["inertia"]
print(f"inertia {inertia.value:.0f} ± {inertia.std:.0f} {inertia.unit}; everything known: {second.values}")
