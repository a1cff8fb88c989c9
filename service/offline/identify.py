"""Identify the parameters of a machine from recordings, by several methods: what `upright identify` and
`upright.identify` do."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import tau
from pathlib import Path
from typing import Any

from upright.diagnosis.prediction.compare import Comparison, compare
from upright.diagnosis.report import Provenance, write_identification
from upright.estimators.identify.run import Progress, identify
from upright.estimators.identify.subject import NOTHING_OWN
from upright.models.model import Model
from upright.service.offline.inputs.machine import as_measured, is_of, loops_of, support_of
from upright.service.offline.inputs.question import asked_of
from upright.service.offline.models import identified_model
from upright.telemetry.errors import UprightError
from upright.telemetry.recording import Recording
from upright.vehicles import registry
from upright.vehicles.experiment.load import refuse_loads
from upright.vehicles.sections import VehicleFile


@dataclass(frozen=True, slots=True)
class Identified:
    """The `document` of `identify --json` about `model`, as it was before, and the `recordings` of `vehicle`."""

    document: Mapping[str, Any]
    model: Model
    vehicle: VehicleFile | None
    recordings: Sequence[Recording]

    @property
    def fitted(self) -> Model | None:
        """The model with the values and standard deviations of the recommended method; None if none is."""
        best = self.document["best"]
        if not best:
            return None
        names = {parameter.name for parameter in self.model.parameters}
        entries = self.document["methods"][best]["parameters"].items()
        known = {name: each for name, each in entries if name in names and each["value"] is not None}
        return self.model.change(
            {name: each["value"] for name, each in known.items()},
            deviations={name: each["std"] for name, each in known.items()},
        )

    def page(
        self,
        provenance: Provenance | None = None,
        truth: Mapping[str, float] | None = None,
        progress: Callable[[str], None] = lambda text: None,
    ) -> str:
        """The report as HTML, with predictions by the estimates and by the values before. `truth`: known values."""
        progress("comparing the estimates with the CAD values")
        comparisons, why = self._compared(progress)
        return write_identification(
            self.document,
            self.model.name,
            truth=truth or {},
            comparisons=comparisons,
            why=why,
            provenance=provenance,
            progress=progress,
        )

    def _compared(self, progress: Callable[[str], None]) -> tuple[list[Comparison], str]:
        """The model before and with the recommended estimates, compared with all recordings; or why that is not
        possible."""
        fitted = self.fitted
        if fitted is None:
            return [], "No method can be recommended, so no model is compared with the recordings."
        models = {"CAD": self.model, self.document["best"]: self.model.change(fitted.values)}
        support = support_of(self.model, self.vehicle)
        try:
            loops = loops_of(self.model, self.vehicle, self.recordings)
            return compare(models, self.recordings, support=support, loops=loops, progress=progress), ""
        except UprightError as error:
            return [], f"The models could not be simulated with the recordings: {error}"


def identified(
    recordings: Sequence[Recording],
    vehicle: VehicleFile | None,
    *,
    model: str | Path | Model | None = None,
    methods: Sequence[str] = (),
    every: bool = False,
    bandwidth: float | None = None,
    progress: Progress = lambda method, label, done, total: None,
) -> Identified:
    """Estimate the parameters of `model`, by default of the `vehicle`'s own, from all `recordings` together and from
    each of them.

    `methods`: names of estimators.identify.table, by default all that suit. With `every`, each gets all recordings.
    `bandwidth` Hz, of the filter of the regressions. `progress` is called with the method, the recording, the number of
    fits done and of all. KeyboardInterrupt ends it early: the document says so (`cancelled`).
    Raises ModelError and EstimationError for an invalid model or name, RecordingError for a recording with a load,
    DataError for a table that is to be read otherwise.
    """
    subject = as_measured(identified_model(model, vehicle), vehicle, recordings)
    values: Mapping[str, float] = {}
    deviations: Mapping[str, float] = {}
    own = NOTHING_OWN
    if vehicle is not None and is_of(subject, vehicle):
        known, (found, scatter) = vehicle.parameters, registry.measured(vehicle, recordings)
        values, deviations = {**known.values, **found}, {**known.deviations, **scatter}
        own = registry.of(vehicle.vehicle.kind).identification()
    refuse_loads(recordings)
    support = support_of(subject, vehicle)
    if asked := asked_of(subject, recordings, support):
        raise asked
    document = identify(
        recordings,
        values,
        support,
        methods,
        deviations=deviations,
        model=subject,
        own=own,
        every=every,
        bandwidth=None if bandwidth is None else tau * bandwidth,
        progress=progress,
    )
    return Identified(document, subject, vehicle, recordings)
