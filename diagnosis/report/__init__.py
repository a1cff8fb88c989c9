"""A diagnosis as one self-contained HTML page: `write_report`."""

from __future__ import annotations

from diagnosis.report.report import Provenance, write_report

__all__ = ["Provenance", "write_report"]
