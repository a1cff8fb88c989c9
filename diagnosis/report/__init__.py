"""Results as self-contained HTML pages: of a diagnosis, of a comparison, of an identification."""

from __future__ import annotations

from upright.diagnosis.report.comparison_report import write_comparison
from upright.diagnosis.report.diagnosis_report import write_report
from upright.diagnosis.report.identification_report import write_identification
from upright.diagnosis.report.page import Provenance

__all__ = ["Provenance", "write_comparison", "write_identification", "write_report"]
