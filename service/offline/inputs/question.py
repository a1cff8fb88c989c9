"""What has to be asked before a table of another origin is used: is it to be read otherwise (estimators.readings)?"""

from __future__ import annotations

from collections.abc import Sequence

from upright.estimators.data.segments import DataError
from upright.estimators.readings.question import question
from upright.models.model import Model
from upright.telemetry.recording import Recording


def asked_of(model: Model, recordings: Sequence[Recording], support: float | None) -> DataError | None:
    """The question that a table raises, as the reason why it is not used; None for what the service recorded itself,
    and for channels whose unit the user stated."""
    tables = [each for each in recordings if "kind" not in each.metadata]
    settled = frozenset[str]().union(*(each.settled for each in tables))
    asked = question(model, tables, settled, support) if tables else None
    return asked.error() if asked else None
