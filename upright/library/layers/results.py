"""From the layers: vehicle files, and what fits, compares, diagnoses and prints."""

from __future__ import annotations

from upright.diagnosis.diagnose import Finding as Found
from upright.diagnosis.prediction.compare import Comparison as Compared
from upright.diagnosis.report import Provenance, write_comparison
from upright.diagnosis.report.diagnosis_report import before_and_after
from upright.diagnosis.report.words import headline
from upright.estimators.contract import EstimationError
from upright.estimators.numbers import with_error
from upright.models.file.document import ModelFile
from upright.models.model import Model as GreyBox
from upright.service.offline.compare import compared
from upright.service.offline.diagnose import Diagnosed, diagnosed, report_paths
from upright.service.offline.identify import Identified, identified
from upright.service.offline.inputs.machine import name_of, vehicle_of
from upright.service.offline.inputs.replay import with_age
from upright.service.offline.model_files import identified as identified_file
from upright.service.offline.model_files import now, revised, save, started, with_effect, without_effect
from upright.service.offline.models import Candidates, columns, compared_models, identified_model
from upright.service.offline.provenance import provenance
from upright.service.pages.compare import print_comparisons
from upright.service.pages.diagnose import print_diagnosis
from upright.service.pages.identify import print_methods
from upright.service.pages.model import print_model
from upright.service.whole_file import write_whole
from upright.vehicles.file import load as load_vehicle
from upright.vehicles.sections import VehicleFile

__all__ = [
    "Candidates",
    "Compared",
    "Diagnosed",
    "EstimationError",
    "Found",
    "GreyBox",
    "Identified",
    "ModelFile",
    "Provenance",
    "VehicleFile",
    "before_and_after",
    "columns",
    "compared",
    "compared_models",
    "diagnosed",
    "headline",
    "identified",
    "identified_file",
    "identified_model",
    "load_vehicle",
    "name_of",
    "now",
    "print_comparisons",
    "print_diagnosis",
    "print_methods",
    "print_model",
    "provenance",
    "report_paths",
    "revised",
    "save",
    "started",
    "vehicle_of",
    "with_age",
    "with_effect",
    "with_error",
    "without_effect",
    "write_comparison",
    "write_whole",
]
