"""The folder of a diagnosis: diagnosis.json, model.toml, diagnosis.nc and a page that people read."""

from gyrostab.diagnosis.files import open_diagnosis as open_diagnosis
from gyrostab.diagnosis.files import write_diagnosis as write_diagnosis
from gyrostab.diagnosis.page import write_diagnosis_report as write_diagnosis_report

__all__ = ["open_diagnosis", "write_diagnosis", "write_diagnosis_report"]
