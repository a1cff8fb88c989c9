"""Find the effect that a model lacks, cell by cell as in a notebook.

    python examples/diagnose_in_a_notebook.py [RECORDING]

Without a recording, one is simulated: the virtual vehicle with dry friction at the rail, which its model lacks.
"""

# %% A recording from a file or of the virtual vehicle
import sys

from diagnosis.report import write_report
from service.offline.diagnose import diagnosed
from service.virtual.run import record
from telemetry import storage
from vehicles.file import load

if len(sys.argv) > 1:
    recording = storage.load(sys.argv[1])
else:
    recording = record("monocab", "multisine", hide=["coulomb_friction"], seed=1)

# %% The same as `upright diagnose`: here with a few effects to look for, by default with the whole catalogue
looked_for = ("coulomb_friction", "viscous_friction", "cubic_stiffness")
answer = diagnosed([recording], load("monocab"), candidates=looked_for, progress=lambda text, share: None)
print(answer.found.verdict, answer.found.reason, sep=": ")

# %% Each finding has its parameters, the effects that it is tied with, and its share of the error
for finding in answer.found.findings:
    for name, each in finding.parameters.items():
        print(f"{name} = {each.value:.3g} ± {each.std:.2g} {each.unit}; tied with: {finding.tied_with or 'none'}")
    print(finding.relevance)

# %% The revised model is a model like any other; the report is a text that can be written to a file
print([each.name for each in answer.found.revised.effects])
(part,) = answer.parts[:1]
page = write_report(part.found, part.model, part.recordings, support=answer.support)
print(f"{len(page) // 1024} KiB of HTML")
