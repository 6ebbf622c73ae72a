"""The gyro terms of a survey tool, with their origin and validity, and the tables they come from.

References
----------
Torkildsen et al. 2008, "Prediction of wellbore position accuracy when surveyed with gyroscopic
tools", SPE Drilling & Completion 23, doi:10.2118/90408-PA, tables 3, 4 and 6 to 8.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from gyrostab.wording import format_rounded

Status = Literal["observed", "upper_limit_only", "not_observable"]
Tool = Literal["xyz", "xy", "z"]


@dataclass(frozen=True)
class SurveyTerm:
    """One error term of a tool.

    Attributes
    ----------
    code : str
        Name in SPE 90408 and in the tool codes of OWSG, such as ``GXY-RN``.
    value : float
        Standard deviation (1 sigma) of the error source [`unit`]; NaN if not observable.
    low, high : float
        The same from the 5 % and 95 % quantiles of the coefficients over the windows, or from the
        95 % interval of a diagnosis [`unit`]. A coefficient that is an upper limit enters `low` as
        0 and `high` as the limit.
    status : str
        ``observed``; ``upper_limit_only`` if the upper limit of a coefficient entered;
        ``not_observable`` if a coefficient has neither value nor limit.
    unit : str
        ``deg/h``, ``deg/sqrt(h)`` or ``deg/h/g``.
    mode : str
        ``stationary`` or ``continuous``.
    propagation : str
        ``Random`` (independent between stations) or ``Systematic`` (the same in a survey).
    derivation : str
        Coefficients and axes from which the value was computed.
    """

    code: str
    value: float
    low: float
    high: float
    status: Status
    unit: str
    mode: str
    propagation: str
    derivation: str


@dataclass(frozen=True)
class SurveyModel:
    """Gyro terms of a tool, with their origin and the conditions they hold for.

    Attributes
    ----------
    tool : str
        Gyro axes of the tool: ``xyz``, ``xy`` or ``z``.
    terms : tuple of SurveyTerm
        In the order of the tables of SPE 90408.
    validity : mapping of str to (float, float, str)
        Smallest and largest mean of a window and unit of each channel that was logged.
    origin, notes : tuple of str
        Sentences on the record and the settings, and on what to observe.
    """

    tool: Tool
    terms: tuple[SurveyTerm, ...]
    validity: Mapping[str, tuple[float, float, str]]
    origin: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def conditions(self) -> str:
        """Return the conditions of the record in a sentence."""
        ranges = [f"{name} {a:.4g} to {b:.4g} {u}" for name, (a, b, u) in self.validity.items()]
        if not ranges:
            return "No channel was logged: the conditions for which the terms hold are unknown."
        return f"Measured at (means of windows) {', '.join(ranges)}."

    @property
    def remarks(self) -> tuple[str, ...]:
        """Return all sentences on the terms."""
        return (*self.origin, self.conditions, *self.notes)

    def __repr__(self) -> str:
        """Return the terms as an aligned table, followed by the remarks."""
        rows = [("term", "1 sigma", "5 % to 95 %", "unit", "mode", "propagation", "from")]
        for term in self.terms:
            value = f"{'< ' * (term.status == 'upper_limit_only')}{format_rounded(term.value, 3)}"
            spread = f"{format_rounded(term.low, 3)} to {format_rounded(term.high, 3)}"
            numbers = (value, spread if term.status == "observed" else "")
            rows.append(
                (term.code, *(numbers if term.value >= 0.0 else ("-", "")), term.unit, term.mode,
                 term.propagation, term.derivation)
            )  # fmt: skip
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
        return "\n".join([*lines, "", *self.remarks])


Groups = tuple[tuple[str, ...], ...]

# Groups of axes, or of pairs of a gyro axis and an axis of acceleration.
_XY: Groups = (("x", "y"),)
_Z: Groups = (("z",),)
_AXIAL: Groups = (("xz", "yz"),)

# fmt: off
_H = "(EarthRate * Cos(Latitude))"
_STEP = "(MD - MDPrev) / "
_MEAN = "((Inc + IncPrev) / 2)"
#: Tool -> rows of code, kind, groups, and weighting function of the azimuth in the notation of
#: ISCWSA. Tables 3 and 6, 4 and 7, and 8 of the reference.
TABLES: dict[Tool, tuple[tuple[str, str, Groups, str], ...]] = {
    "xyz": (
        ("GXYZ-XYRN", "noise", _XY, f"Sqr(1 - Sin(AzT) ^ 2 * Sin(Inc) ^ 2) / {_H}"),
        ("GXYZ-XYB1", "bias", _XY, f"Sin(AzT) * Cos(Inc) / {_H}"),
        ("GXYZ-XYB2", "bias", _XY, f"Cos(AzT) / {_H}"),
        ("GXYZ-XYG1", "g", (("xy", "yx"),), f"Cos(AzT) * Sin(Inc) / {_H}"),
        ("GXYZ-XYG2", "g", _AXIAL, f"Cos(AzT) * Cos(Inc) / {_H}"),
        ("GXYZ-XYG3", "g", _AXIAL, f"Sin(AzT) * Cos(Inc) ^ 2 / {_H}"),
        ("GXYZ-XYG4", "g", (("xx", "yy"),), f"Sin(AzT) * Sin(Inc) * Cos(Inc) / {_H}"),
        ("GXYZ-ZRN", "noise", _Z, f"Sin(AzT) * Sin(Inc) / {_H}"),
        ("GXYZ-ZB", "bias", _Z, f"Sin(AzT) * Sin(Inc) / {_H}"),
        ("GXYZ-ZG1", "g", (("zx", "zy"),), f"Sin(AzT) * Sin(Inc) ^ 2 / {_H}"),
        ("GXYZ-ZG2", "g", (("zz",),), f"Sin(AzT) * Sin(Inc) * Cos(Inc) / {_H}"),
        ("GXYZ-GD", "drift", _XY + _Z, f"XYZ_Gyro_Drift + {_STEP}GXYRunningSpeed"),
        ("GXYZ-GRW", "walk", _XY + _Z, f"Sqr(XYZ_Gyro_Random_Walk ^ 2 + {_STEP}GXYRunningSpeed)"),
    ),
    "xy": (
        ("GXY-RN", "noise", _XY, f"Sqr(1 - Cos(AzT) ^ 2 * Sin(Inc) ^ 2) / ({_H} * Cos(Inc))"),
        ("GXY-B1", "bias", _XY, f"Sin(AzT) / ({_H} * Cos(Inc))"),
        ("GXY-B2", "bias", _XY, f"Cos(AzT) / {_H}"),
        ("GXY-G1", "g", (("xy", "yx"),), f"Cos(AzT) * Sin(Inc) / {_H}"),
        ("GXY-G2", "g", _AXIAL, f"Cos(AzT) * Cos(Inc) / {_H}"),
        ("GXY-G3", "g", _AXIAL, f"Sin(AzT) / {_H}"),
        ("GXY-G4", "g", (("xx", "yy"),), f"Sin(AzT) * Tan(Inc) / {_H}"),
        ("GXY-GD", "drift", _XY, f"XY_Gyro_Drift + {_STEP}(GXYRunningSpeed * Sin{_MEAN})"),
        ("GXY-GRW", "walk", _XY,
         f"Sqr(XY_Gyro_Random_Walk ^ 2 + {_STEP}(GXYRunningSpeed * Sin{_MEAN} ^ 2))"),
    ),
    "z": (
        ("GZ-GD", "drift", _Z, f"Z_Gyro_Drift + {_STEP}(GXYRunningSpeed * Cos{_MEAN})"),
        ("GZ-GRW", "walk", _Z,
         f"Sqr(Z_Gyro_Random_Walk ^ 2 + {_STEP}(GXYRunningSpeed * Cos{_MEAN} ^ 2))"),
    ),
}
#: Kind -> mode, propagation, unit, derivation.
KINDS = {
    "noise": ("stationary", "Random", "deg/h", "N / sqrt(station time)"),
    "bias": ("stationary", "Systematic", "deg/h", "N, B, K since the calibration"),
    "g": ("stationary", "Systematic", "deg/h/g", "g_sensitivity"),
    "drift": ("continuous", "Systematic", "deg/h", "N, B, K since the calibration"),
    "walk": ("continuous", "Systematic", "deg/sqrt(h)", "N"),
}
# fmt: on
