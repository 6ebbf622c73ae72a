"""The tables of gyro error terms of SPE 90408: codes, axes and weighting functions by tool.

References
----------
Torkildsen et al. 2008, "Prediction of wellbore position accuracy when surveyed with gyroscopic
tools", SPE Drilling & Completion 23, doi:10.2118/90408-PA, tables 3, 4 and 6 to 8.
"""

from __future__ import annotations

from gyrostab.io.survey_model import Tool

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
