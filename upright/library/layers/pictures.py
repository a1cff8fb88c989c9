"""From the layers: what draws. It imports matplotlib, for which only `plot()` waits."""

from __future__ import annotations

from upright.diagnosis.report.figures.comparison import comparison_figure
from upright.diagnosis.report.figures.drawing import Picture
from upright.diagnosis.report.figures.methods import method_figure
from upright.diagnosis.report.figures.recording import recording_figure

__all__ = ["Picture", "comparison_figure", "method_figure", "recording_figure"]
