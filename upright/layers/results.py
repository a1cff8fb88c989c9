"""From the layers: vehicle files, and what fits, compares, diagnoses, prints and draws."""

from __future__ import annotations

from diagnosis.diagnose import Finding as Found
from diagnosis.prediction.compare import Comparison as Compared
from diagnosis.report import Provenance, write_comparison
from diagnosis.report.diagnosis_report import before_and_after
from diagnosis.report.figures.comparison import comparison_figure
from diagnosis.report.figures.drawing import Picture
from diagnosis.report.figures.methods import method_figure
from diagnosis.report.figures.recording import recording_figure
from diagnosis.report.words import headline
from estimators.contract import EstimationError
from estimators.numbers import with_error
from models.file.document import ModelFile
from models.model import Model as GreyBox
from service.offline.compare import compared
from service.offline.diagnose import Diagnosed, diagnosed, report_paths
from service.offline.identify import Identified, identified
from service.offline.machine import name_of, vehicle_of
from service.offline.model_files import identified as identified_file
from service.offline.model_files import now, revised, save, started, with_effect, without_effect
from service.offline.models import Candidates, columns, compared_models, identified_model
from service.offline.provenance import provenance
from service.offline.replay import with_age
from service.pages.compare import print_comparisons
from service.pages.diagnose import print_diagnosis
from service.pages.identify import print_methods
from service.pages.model import print_model
from service.whole_file import write_whole
from vehicles.file import load as load_vehicle
from vehicles.sections import VehicleFile

__all__ = [
    "Candidates",
    "Compared",
    "Diagnosed",
    "EstimationError",
    "Found",
    "GreyBox",
    "Identified",
    "ModelFile",
    "Picture",
    "Provenance",
    "VehicleFile",
    "before_and_after",
    "columns",
    "compared",
    "compared_models",
    "comparison_figure",
    "diagnosed",
    "headline",
    "identified",
    "identified_file",
    "identified_model",
    "load_vehicle",
    "method_figure",
    "name_of",
    "now",
    "print_comparisons",
    "print_diagnosis",
    "print_methods",
    "print_model",
    "provenance",
    "recording_figure",
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
