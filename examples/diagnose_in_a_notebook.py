"""Which effect a model lacks, cell by cell, as one would in a notebook.

    python examples/diagnose_in_a_notebook.py [RECORDING]

Without a recording, one is made: the virtual vehicle with dry friction at the rail that its model does not know.
"""

# %% A recording, of a file or of the virtual vehicle
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

# %% What `upright diagnose` does: a few effects to look for here, the whole catalogue by default
looked_for = ("coulomb_friction", "viscous_friction", "cubic_stiffness")
answer = diagnosed([recording], load("monocab"), candidates=looked_for, progress=lambda text, share: None)
print(answer.found.verdict, answer.found.reason, sep=": ")

# %% Each finding has its numbers, with what it is tied with and what share of the error it makes
for finding in answer.found.findings:
    for name, each in finding.parameters.items():
        print(f"{name} = {each.value:.3g} ± {each.std:.2g} {each.unit}; tied with: {finding.tied_with or 'none'}")
    print(finding.relevance)

# %% The model with it is a model like any other; the report is text, to be written to a file
print([each.name for each in answer.found.revised.effects])
(part,) = answer.parts[:1]
page = write_report(part.found, part.model, part.recordings, support=answer.support)
print(f"{len(page) // 1024} KiB of HTML")
