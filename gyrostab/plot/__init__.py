"""Figures of logs, surfaces and products.

Every function returns a `matplotlib.figure.Figure` that belongs to nobody else: no pyplot, no
window, no global state. Save it with ``figure.savefig("name.png", dpi=150)`` or as ``.svg`` or
``.pdf``.
"""

from __future__ import annotations

from gyrostab.plot.adev import plot_adev
from gyrostab.plot.coefficients import plot_coefficients
from gyrostab.plot.correlation import plot_correlation
from gyrostab.plot.figures import save_figures
from gyrostab.plot.signal import plot_signal
from gyrostab.plot.style import COLOURS, MARKERS, new_figure, save_png
from gyrostab.plot.surface import plot_davar, plot_davar_3d

__all__ = [
    "COLOURS",
    "MARKERS",
    "new_figure",
    "plot_adev",
    "plot_coefficients",
    "plot_correlation",
    "plot_davar",
    "plot_davar_3d",
    "plot_signal",
    "save_figures",
    "save_png",
]
