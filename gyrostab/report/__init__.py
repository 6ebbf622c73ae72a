"""Self-contained HTML reports of a product and of a diagnosis."""

from gyrostab.report.diagnosis import write_diagnosis_report as write_diagnosis_report
from gyrostab.report.product import write_report as write_report

__all__ = ["write_diagnosis_report", "write_report"]
