"""Gyro terms of a survey tool: mapping by hand, from spectra, and from a diagnosis."""

from __future__ import annotations

import math
import re
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

from gyrostab.errors import OptionError, SchemaError
from gyrostab.io.survey_files import WEIGHTS
from gyrostab.io.survey_terms import drift_rate, survey_terms
from gyrostab.noise import LAWS, model_avar
from gyrostab.schema import OBSERVABLE
from tests.support import synthetic

VALUES = {"N": 2.0, "K": 3.0, "B": 5.0}
TIMES = {"station_time": "15min", "section_time": "90min", "calibration_time": "90min"}
# By hand, axis x. N / sqrt(1/4 h) = 4. Drift with S = C = 1.5 h: N^2 / 1.5 + B^2 4 ln 2 / pi +
# K^2 (3 h) / 3 = 2.66667 + 22.06356 + 9 = 33.73023.
NOISE, DRIFT = 4.0, math.sqrt(33.73023)


def make_product(axes: str = "xyz") -> xr.Dataset:
    """Every window observes N = 2, K = 3 and B = 5 on x, twice that on y, three times on z."""
    product = synthetic.product(axes=axes, windows=6)
    factors = np.array([["xyz".index(axis) + 1.0] for axis in axes])
    for symbol, value in VALUES.items():
        product[symbol][:] = factors * value
    product["observable"][:] = OBSERVABLE.index("observed")
    return product


def set_state(product: xr.Dataset, symbol: str, state: str, upper: float = math.nan) -> None:
    product["observable"].loc[{"term": symbol}] = OBSERVABLE.index(state)
    product[f"{symbol}_upper"][:] = upper
    product[symbol][:] = 1e9


def values(product: xr.Dataset, **options) -> dict[str, float]:
    return {term.code: term.value for term in survey_terms(product, **TIMES, **options).terms}


def test_values_are_those_worked_out_by_hand():
    """Root mean square of x and y across the tool; in continuous mode the larger of xy and z."""
    across = math.sqrt((1.0 + 4.0) / 2.0)
    expected = {
        "GXYZ-XYRN": across * NOISE,
        "GXYZ-XYB1": across * DRIFT,
        "GXYZ-XYB2": across * DRIFT,
        "GXYZ-ZRN": 3.0 * NOISE,
        "GXYZ-ZB": 3.0 * DRIFT,
        "GXYZ-GD": 3.0 * DRIFT,
        "GXYZ-GRW": 6.0,
    }
    assert values(make_product()) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(
    ("axes", "codes"),
    [
        ("xy", ["GXY-RN", "GXY-B1", "GXY-B2", "GXY-GD", "GXY-GRW"]),
        ("x", ["GXY-RN", "GXY-B1", "GXY-B2", "GXY-GD", "GXY-GRW"]),
        ("z", ["GZ-GD", "GZ-GRW"]),
    ],
)
def test_axes_decide_which_terms_apply(axes, codes):
    assert list(values(make_product(axes))) == codes


def test_units_and_modes():
    for term in survey_terms(make_product()).terms:
        assert (term.unit == "deg/sqrt(h)") == term.code.endswith("GRW")
        assert (term.propagation == "Random") == term.code.endswith("RN")
        assert (term.mode == "continuous") == term.code.endswith(("GD", "GRW"))


@given(
    n=st.floats(0.0, 10.0), b=st.floats(0.0, 10.0), k=st.floats(0.0, 10.0),
    tau=st.floats(1.0, 1e5),
)  # fmt: skip
def test_equal_times_give_twice_the_allan_variance(n, b, k, tau):
    """The variance of the difference of adjacent means, without the white noise of the second."""
    drift = drift_rate(n, b, k, section=tau, calibration=tau)
    twice = 2.0 * float(model_avar(tau, {"N": n, "B": b, "K": k})) - float(LAWS["N"].avar(tau, n))
    assert drift**2 == pytest.approx(twice, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("ratio", [0.1, 1.0, 30.0, 1000.0])
def test_flicker_drift_is_the_integral_of_its_spectrum(ratio):
    """One-sided density B^2 / (pi f), times the response of mean after less mean before."""
    calibration, section = 60.0, 60.0 * ratio
    frequency = np.geomspace(1e-9 / section, 1e7 / calibration, 400_001)

    def mean(length, sign):
        turn = 2j * np.pi * frequency * length * sign
        return np.expm1(turn) / turn

    response = np.abs(mean(section, 1.0) - mean(calibration, -1.0)) ** 2
    variance = np.trapezoid(response / np.pi, np.log(frequency))
    drift = drift_rate(0.0, 1.0, 0.0, section=section, calibration=calibration)
    assert drift**2 == pytest.approx(variance, rel=1e-4)


def test_percentile_over_the_windows_that_observe_a_term():
    product = make_product("x")
    product["N"][0] = [1.0, 2.0, 3.0, 4.0, 5.0, 1e6]
    product["observable"].loc[{"term": "N"}][0, 5] = OBSERVABLE.index("not_observable")
    median, high = (
        survey_terms(product, station_time="1h", statistic=name).terms[0]
        for name in ("median", "p95")
    )
    assert (median.value, high.value) == pytest.approx((3.0, 4.8))
    assert (median.low, median.high) == pytest.approx((1.2, 4.8))


def test_limit_stays_marked_as_limit():
    product = make_product("x")
    set_state(product, "K", "upper_limit_only", upper=6.0)
    model = survey_terms(product, **TIMES)
    drift = {term.code: term for term in model.terms}["GXY-GD"]
    assert drift.value == pytest.approx(math.sqrt(33.73023 - 9.0 + 36.0))
    assert (drift.status, drift.low < drift.value) == ("upper_limit_only", True)
    assert f"< {drift.value:.3g}" in str(model) == repr(model)
    assert {term.status for term in model.terms if term.code.endswith(("RN", "RW"))} == {"observed"}


def test_a_ramp_that_is_observed_is_named_with_the_change_of_the_bias():
    product = make_product("xz")
    product["R"][:] = np.array([[4.0], [6.0]])
    product["observable"].loc[{"term": "R", "axis": "x"}] = OBSERVABLE.index("upper_limit_only")
    (note,) = (note for note in survey_terms(product, **TIMES).notes if "ramp" in note)
    assert note.startswith("R of axis z (6 deg/h^2) is in no term")
    assert " by 9 deg/h " in note  # 6 deg/h^2 over the 1.5 h between the middles
    product["observable"].loc[{"term": "R"}] = OBSERVABLE.index("not_observable")
    assert not any("ramp" in note for note in survey_terms(product).notes)
    product.attrs["variance"] = "hadamard"  # blind to a ramp
    assert any("ramp R is in no term, and" in note for note in survey_terms(product).notes)


def test_term_that_no_window_shows_is_named_and_has_no_value():
    product = make_product("x")
    set_state(product, "B", "not_observable")
    model = survey_terms(product)
    assert math.isnan({term.code: term for term in model.terms}["GXY-GD"].value)
    assert any("GXY-B1, GXY-B2, GXY-GD" in note for note in model.notes)


def test_product_that_shows_nothing_is_refused():
    product = make_product("x")
    for symbol in VALUES:
        set_state(product, symbol, "not_observable")
    with pytest.raises(SchemaError, match=r"longer window \(--window\), .* log\.sel\(axis"):
        survey_terms(product)


def test_axis_that_shows_nothing_is_named():
    product = make_product("xy")
    for name in ("N", "N_upper"):
        product[name] = product[name].where(product["axis"] == "x")
    product["observable"] = product["observable"].where(product["axis"] == "x", 0)
    with pytest.raises(SchemaError, match=r"limits N of axis y; .*without that axis"):
        survey_terms(product)
    product["avar"] = product["avar"].where(product["axis"] == "x", 0.0)
    with pytest.raises(SchemaError, match=r"^axis y is constant: .* without it \(--axis, or log"):
        survey_terms(product)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (
            lambda p: p.assign_coords(axis=["u", "v", "w"]),
            SchemaError,
            "axes named u, v, w; .*--map",
        ),
        (lambda p: p.drop_vars("N"), SchemaError, "N"),
        (lambda p: p["N"], SchemaError, "DataArray"),
    ],
)
def test_wrong_products_are_refused(change, error, message):
    with pytest.raises(error, match=message):
        survey_terms(change(make_product()))


@pytest.mark.parametrize(
    "options",
    [
        {"statistic": "mean"},
        {"station_time": "120"},
        {"section_time": "-1h"},
        {"calibration_time": 0},
    ],
)
def test_wrong_options_are_refused(options):
    with pytest.raises(OptionError):
        survey_terms(make_product(), **options)


def make_diagnosis(*effects: dict, limit: float | None = None) -> dict:
    missing = {"upper_limit": limit, "unit": "deg/h/g", "reason": "no acceleration channel"}
    return {
        "recording": {"axes": ["x", "y", "z"]},
        "effects": list(effects),
        "not_found": {} if effects else {"g_sensitivity": missing},
    }


def make_effect(axes: list[str], alternatives=(), **sizes: tuple[float, float, float]) -> dict:
    return {
        "name": "g_sensitivity",
        "axes": axes,
        "parameters": {
            name: dict(zip(("value", "low", "high"), size, strict=True))
            for name, size in sizes.items()
        },
        "alternatives": list(alternatives),
    }


def test_g_dependent_terms_come_from_the_diagnosis():
    """G4: own axis; G1: the other cross axis; G2 and G3: along the tool; z gyro: ZG1 and ZG2."""
    diagnosis = make_diagnosis(
        make_effect(["x"], x=(0.3, 0.2, 0.4), y=(-0.5, -0.7, -0.3), z=(0.1, -0.1, 0.3)),
        make_effect(["x", "y"], ["earth_rate"], **{"y.y": (0.4, 0.3, 0.5)}),
        make_effect(["z"], z=(0.6, 0.5, 0.7)),
    )
    model = survey_terms(make_product(), diagnosis=diagnosis)
    terms = {term.code: term for term in model.terms if term.unit == "deg/h/g"}
    assert {code: term.value for code, term in terms.items()} == pytest.approx(
        {
            "GXYZ-XYG1": 0.5,
            "GXYZ-XYG2": 0.1,
            "GXYZ-XYG3": 0.1,
            "GXYZ-XYG4": math.sqrt((0.09 + 0.16) / 2.0),
            "GXYZ-ZG2": 0.6,
        }
    )
    assert (terms["GXYZ-XYG1"].low, terms["GXYZ-XYG1"].high) == (0.3, 0.7)
    assert (terms["GXYZ-XYG2"].low, terms["GXYZ-XYG2"].high) == (0.0, 0.3)
    assert any("earth_rate" in note for note in model.notes)


def test_a_diagnosis_is_taken_as_its_contents():
    content = make_diagnosis(make_effect(["x"], x=(0.3, 0.2, 0.4)))
    expected = survey_terms(make_product(), diagnosis=content)
    assert survey_terms(make_product(), diagnosis=SimpleNamespace(content=content)) == expected
    with pytest.raises(OptionError, match=r"is a str: give gyrostab\.open_diagnosis\(folder\)"):
        survey_terms(make_product(), diagnosis="run7-diagnosis")


def test_limit_of_a_diagnosis_is_the_limit_of_all_g_dependent_terms():
    model = survey_terms(make_product("xy"), diagnosis=make_diagnosis(limit=0.02))
    terms = [term for term in model.terms if term.unit == "deg/h/g"]
    assert [term.code for term in terms] == ["GXY-G1", "GXY-G2", "GXY-G3", "GXY-G4"]
    assert {(term.value, term.status) for term in terms} == {(0.02, "upper_limit_only")}
    missing = survey_terms(make_product("xy"), diagnosis=make_diagnosis())
    assert any("no acceleration channel" in note for note in missing.notes)


def test_other_effects_of_the_diagnosis_are_named():
    effect = make_effect(["x"]) | {"name": "shupe"}
    model = survey_terms(make_product(), diagnosis=make_diagnosis(effect))
    assert any("found: shupe" in note for note in model.notes)


class TestWeights:
    """Weighting functions against the azimuth of a tool whose gyros err."""

    inclination, azimuth, latitude, rate = 0.7, 0.9, 1.0, 15.041

    def evaluate(self, code: str) -> float:
        formula = WEIGHTS[code].replace("^", "**").replace("Sqr", "sqrt")
        names = {"Inc": self.inclination, "AzT": self.azimuth, "Latitude": self.latitude}
        text = re.sub(r"(Sin|Cos|Tan)\(", lambda m: m[0].lower(), formula)
        functions = {name: getattr(math, name) for name in ("sin", "cos", "tan", "sqrt")}
        return abs(eval(text, {**functions, **names, "EarthRate": self.rate}))

    def measure(self, error: tuple[float, float, float], *, use_z: bool) -> float:
        """Azimuth from the rates of a tool with its x axis on the high side, y to the right."""
        north = self.rate * math.cos(self.latitude)
        down = -self.rate * math.sin(self.latitude)
        sin, cos = math.sin(self.inclination), math.cos(self.inclination)
        x = north * cos * math.cos(self.azimuth) - down * sin + error[0]
        y = -north * math.sin(self.azimuth) + error[1]
        z = north * sin * math.cos(self.azimuth) + down * cos + error[2]
        forward = x * cos + z * sin if use_z else (x + down * sin) / cos
        return math.atan2(-y, forward)

    def slope(self, error: tuple[float, float, float], *, use_z: bool) -> float:
        step = tuple(1e-6 * part for part in error)
        zero = (0.0, 0.0, 0.0)
        return (self.measure(step, use_z=use_z) - self.measure(zero, use_z=use_z)) / 1e-6

    @pytest.mark.parametrize("tool", ["GXY", "GXYZ"])
    def test_stationary(self, tool):
        use_z, name = tool == "GXYZ", "GXYZ-XY" if tool == "GXYZ" else "GXY-"
        x, y, z = (self.slope(tuple(row), use_z=use_z) for row in np.eye(3))
        sin, cos = math.sin(self.inclination), math.cos(self.inclination)  # accelerations [g]
        expected = {
            "B1": x, "B2": y, "RN": math.hypot(x, y),
            "G1": y * sin, "G2": y * cos, "G3": x * cos, "G4": x * sin,
        }  # fmt: skip
        for suffix, slope in expected.items():
            assert self.evaluate(name + suffix) == pytest.approx(abs(slope), rel=1e-4), suffix
        if use_z:
            for suffix, slope in {"ZB": z, "ZRN": z, "ZG1": z * sin, "ZG2": z * cos}.items():
                assert self.evaluate(f"GXYZ-{suffix}") == pytest.approx(abs(slope), rel=1e-4)
