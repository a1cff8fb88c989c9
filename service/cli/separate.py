"""`upright experiment --separate A B`: choose the experiment and print it before it is run."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from upright.service.output import people
from upright.telemetry.errors import UprightError


class NothingSeparates(UprightError):
    """No safe experiment of the vehicle separates two effects in a reasonable time."""


def chosen_experiment(
    effects: tuple[str, str], recordings: Sequence[str], vehicle: str, begin: float = 0.0, end: float = math.inf
) -> tuple[str, str]:
    """The experiment's name and the vehicle's id. The choice and the reasons against others are printed on stderr.

    `begin`, `end` s: the part of the recordings that is used.

    Raises NothingSeparates, and ModelError for an effect that the vehicle's model cannot have.
    """
    from upright.service.cli.inputs import load_recording, share_done
    from upright.service.offline.models import identified_model
    from upright.service.offline.next_experiment import separating
    from upright.vehicles.file import load

    file = load(vehicle)
    loaded = [load_recording(Path(path), vehicle).between(begin, end) for path in recordings]
    with share_done() as progress:
        choice = separating(file, identified_model(None, file), effects, loaded, progress)
    for outlook in choice.outlooks:
        if outlook.refused:
            people.print(f"  not {outlook.experiment.name}: {outlook.refused}")
    best = choice.best
    if best is None:
        raise NothingSeparates(
            f"no experiment of {file.vehicle.id} separates {effects[0]} from {effects[1]}.",
            remedy="Add one to the vehicle file with more motion, or with other amplitudes or frequencies.",
        )
    whole = file.experiments[best.experiment.name]
    people.print(f"{best.text} ({best.rate:.2g} nats/s expected).")
    people.print(f"Running {best.experiment.name}: {whole.title or whole.excitation}, {whole.duration:g} s.")
    if best.runs > 1:
        people.print(f"This is the first of {best.runs} runs; pass all their recordings to `upright diagnose`.")
    return best.experiment.name, file.vehicle.id
