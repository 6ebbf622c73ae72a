"""gyrostab: gyro logs to dynamic Allan variance and time-varying noise coefficients.

>>> import gyrostab
>>> raw = gyrostab.read_log("tool.csv")                      # doctest: +SKIP
>>> log = gyrostab.regularise(raw)                           # doctest: +SKIP
>>> surface = gyrostab.davar(log, window="10min")            # doctest: +SKIP
>>> product = gyrostab.fit_noise(surface)                    # doctest: +SKIP
>>> gyrostab.to_netcdf(product, "product.nc")                # doctest: +SKIP

Every public name is loaded on first use, so that importing the package is fast.
"""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gyrostab.allan.confidence import confidence_interval as confidence_interval
    from gyrostab.allan.davar import davar as davar
    from gyrostab.allan.fit import fit_noise as fit_noise
    from gyrostab.blindtest.runner.benchmark import prove as prove
    from gyrostab.correlate import correlate as correlate
    from gyrostab.correlate import correlation_rows as correlation_rows
    from gyrostab.diagnose.core import diagnose as diagnose
    from gyrostab.ingest import read_channel as read_channel
    from gyrostab.ingest import read_log as read_log
    from gyrostab.ingest.convert import from_dataarray as from_dataarray
    from gyrostab.ingest.dataframe import from_dataframe as from_dataframe
    from gyrostab.ingest.grid.gaps import gap_table as gap_table
    from gyrostab.ingest.grid.regularise import regularise as regularise
    from gyrostab.ingest.make_log import make_log as make_log
    from gyrostab.ingest.scan import scan as scan
    from gyrostab.io.datasets import to_csv as to_csv
    from gyrostab.io.datasets import to_netcdf as to_netcdf
    from gyrostab.io.datasets import to_zarr as to_zarr
    from gyrostab.io.kalibr import to_kalibr as to_kalibr
    from gyrostab.io.opening import open_log as open_log
    from gyrostab.io.opening import open_product as open_product
    from gyrostab.io.opening import open_surface as open_surface
    from gyrostab.io.survey_files import to_iscwsa as to_iscwsa
    from gyrostab.io.survey_terms import survey_terms as survey_terms
    from gyrostab.plot import plot_adev as plot_adev
    from gyrostab.plot import plot_coefficients as plot_coefficients
    from gyrostab.plot import plot_correlation as plot_correlation
    from gyrostab.plot import plot_davar as plot_davar
    from gyrostab.plot import plot_davar_3d as plot_davar_3d
    from gyrostab.plot import plot_signal as plot_signal
    from gyrostab.plot import save_figures as save_figures
    from gyrostab.report import write_report as write_report
    from gyrostab.report.diagnosis import open_diagnosis as open_diagnosis
    from gyrostab.report.diagnosis import write_diagnosis as write_diagnosis
    from gyrostab.simulate import make_noise as make_noise
    from gyrostab.simulate import read_model as read_model
    from gyrostab.simulate import simulate as simulate

# module of each public name
_HOME = {
    "confidence_interval": "allan.confidence",
    "correlate": "correlate",
    "correlation_rows": "correlate",
    "davar": "allan.davar",
    "diagnose": "diagnose.core",
    "fit_noise": "allan.fit",
    "from_dataarray": "ingest.convert",
    "from_dataframe": "ingest.dataframe",
    "gap_table": "ingest.grid.gaps",
    "make_log": "ingest.make_log",
    "make_noise": "simulate",
    "open_diagnosis": "report.diagnosis",
    "open_log": "io.opening",
    "open_product": "io.opening",
    "open_surface": "io.opening",
    "plot_adev": "plot",
    "plot_coefficients": "plot",
    "plot_correlation": "plot",
    "plot_davar": "plot",
    "plot_davar_3d": "plot",
    "plot_signal": "plot",
    "prove": "blindtest.runner.benchmark",
    "read_channel": "ingest",
    "read_log": "ingest",
    "read_model": "simulate",
    "regularise": "ingest.grid.regularise",
    "save_figures": "plot",
    "scan": "ingest.scan",
    "simulate": "simulate",
    "survey_terms": "io.survey_terms",
    "to_csv": "io.datasets",
    "to_iscwsa": "io.survey_files",
    "to_kalibr": "io.kalibr",
    "to_netcdf": "io.datasets",
    "to_zarr": "io.datasets",
    "write_diagnosis": "report.diagnosis",
    "write_report": "report",
}

__all__ = ["__version__", *_HOME]


class _Package(ModuleType):
    """Keep ``gyrostab.davar`` the function when Python imports the module of the same name."""

    def __setattr__(self, name: str, value: Any) -> None:
        if not (name in _HOME and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("gyrostab")
    if name in _HOME:
        attribute = getattr(importlib.import_module(f"gyrostab.{_HOME[name]}"), name)
        _register_accessor()
        return attribute
    raise AttributeError(f"module 'gyrostab' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)


def _register_accessor() -> None:
    """Register the accessor ``.gyro`` of xarray objects if xarray is loaded."""
    if "xarray" in sys.modules:
        importlib.import_module("gyrostab.xarray")


_register_accessor()
