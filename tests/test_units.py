"""Every unit spelling against UDUNITS or plain arithmetic."""

from __future__ import annotations

import cf_units
import numpy as np
import pytest

from gyrostab.errors import UnitError
from gyrostab.schema import VARIABLES
from gyrostab.units import INNER, known_units, on_disk, parse_unit


@pytest.mark.parametrize(
    ("text", "udunits"),
    [
        ("deg/h", "degree hour-1"), ("deg/s", "degree s-1"), ("rad/s", "radian s-1"),
        ("mrad/s", "1e-3 radian s-1"),
        ("urad/s", "1e-6 radian s-1"), ("nrad/s", "1e-9 radian s-1"),
        ("arcsec/s", "arcsecond s-1"), ("rpm", "6 degree s-1"),
        ("rad s^-1", "radian s-1"), ("0.1 arcsec/s", "0.1 arcsecond s-1"), ("deg", "degree"),
        ("arcsec", "arcsecond"),
        ("rad", "radian"), ("degC", "degree_Celsius"), ("K", "kelvin"),
        ("degF", "degree_Fahrenheit"), ("g", "9.80665 m s-2"),
        ("m/s^2", "m s-2"), ("m s^-2", "m s-2"), ("mg", "9.80665e-3 m s-2"), ("mV", "mV"),
        ("uW", "uW"), ("psi", "psi"), ("bar", "bar"),
        ("uT", "uT"), ("G", "1e-4 T"),
    ],
)  # fmt: skip
def test_conversion_agrees_with_udunits(text, udunits):
    unit = parse_unit(text)
    inner = cf_units.Unit(on_disk(INNER[unit.quantity]))
    for value in (0.0, 1.0, -37.5):
        assert value * unit.factor + unit.offset == pytest.approx(
            cf_units.Unit(udunits).convert(value, inner), rel=1e-9, abs=1e-9
        )


@pytest.mark.parametrize(
    "text",
    [
        "rad.s-1", "rad*s**-1", "s-1 rad", "radians/second", "Degree/Second", "DEGREE/HOUR",
        "degree per hour", "°/s", "mrad.s^-1",
        "microradians/second", "millidegree s-1", "arc_second/second", "arcsec/sec",
        "arc_minute s-1", "turn/min", "revolutions/minute",
        "cycle s-1", "rad/ms", "degree/day", "1e-3 rad.s-1", "m s^-2", "meter second-2", "cm/s2",
    ],
)  # fmt: skip
def test_what_udunits_reads_is_read_alike(text):
    unit = parse_unit(text)
    inner = cf_units.Unit(on_disk(INNER[unit.quantity]))
    assert unit.factor == pytest.approx(cf_units.Unit(text).convert(1.0, inner), rel=1e-14)


@pytest.mark.parametrize(
    ("text", "plain"),
    [
        ("DEG/HR", "degree/hour"), ("degrees_per_second", "degree/second"),
        ("deg.h^-1", "degree/hour"), ("RAD/S", "radian/second"),
        ("deg/(s)", "degree/second"), ("°·s⁻¹", "degree/second"), ("deg⋅s⁻¹", "degree/second"),
        ("rad · s^-1", "radian/second"),
        ("mRad/S", "1e-3 radian/second"), ("dps", "degree/second"), ("mdps", "1e-3 degree/second"),
        ("mdeg/s", "1e-3 degree/second"),
    ],
)  # fmt: skip
def test_spellings_of_data_sheets(text, plain):
    assert parse_unit(text).factor == pytest.approx(
        cf_units.Unit(plain).convert(1.0, cf_units.Unit("degree hour-1")), rel=1e-14
    )


def test_every_unit_we_write_is_read_by_udunits_as_it_is_meant():
    for name, attributes in VARIABLES.items():
        if "units" in attributes:
            unit = cf_units.Unit(attributes["units"])
            assert not unit.is_unknown(), name
    hour, degree = 3600.0, np.pi / 180
    for text, value in (
        ("degree2 hour-1", degree**2 / hour),
        ("degree2 hour-3", degree**2 / hour**3),
        ("degree hour-2", degree / hour**2),
    ):
        assert cf_units.Unit(text).convert(
            1.0, cf_units.Unit(text.replace("degree", "radian").replace("hour", "s"))
        ) == pytest.approx(value)


@pytest.mark.parametrize(
    "text",
    [
        "furlong/fortnight",
        "deg//h",
        "0 deg/h",
        "nan deg/h",
        "1e400 deg/h",
        "1e308 deg/s",
        "MRAD/S",
        "deg/h/h",
        "rad s -1",
        "rad/s-1",
        "/s",
        "deg/",
        "MS",
    ],
)
def test_what_is_not_a_unit_is_refused_with_what_is(text):
    with pytest.raises(UnitError):
        parse_unit(text)
    with pytest.raises(UnitError, match="deg/h, arcsec/s"):
        parse_unit("quux")


@pytest.mark.parametrize("text", ["r/s", "R/S", "r s^-1", "rps", "0.01 r/s"])
def test_revolutions_and_radians_are_not_confused(text):
    for quantity in (None, "rate", "rotation_rate"):
        with pytest.raises(UnitError, match="write rev/s or rad/s"):
            parse_unit(text, quantity)
    assert parse_unit("r/min").factor == 6 * 3600


@pytest.mark.parametrize("text", ["21", "2.1", "1.1", "1e-11", "0.1", "1.2.3 deg"])
def test_a_number_is_not_a_factor_of_its_last_digit(text):
    with pytest.raises(UnitError, match="not known"):
        parse_unit(text)


def test_factors_in_front_of_units():
    units = ("0.1 arcsec/s", "1e-3deg", "2*deg/s", "10 1", "2. deg", "1e-11 rad", "9.80665 m s-2")
    factors = [parse_unit(text).factor for text in units]
    assert factors == pytest.approx([0.1, 1e-3, 7200, 10, 2, 1.8e-9 / np.pi, 1])


def test_known_units_lists_the_contract():
    listed = known_units("rate")
    for text in ("deg/h", "deg/s", "rad/s", "mrad/s", "urad/s", "nrad/s", "arcsec/s", "rpm"):
        assert text in listed


@pytest.mark.parametrize(
    ("spellings", "meant"),
    [
        (
            "Celsius|celsius|°C|ºC|deg C|deg_C|degrees Celsius|degree_Celsius|DEGC|C",
            "degree_Celsius",
        ),
        ("Kelvin|K|deg K", "kelvin"),
        ("degF|°F|DEGF|Fahrenheit", "degree_Fahrenheit"),
        ("deg/hr|DEG/HR|DEG/H|°/hr|° / h|degrees per hour|deg h^-1|degree h-1", "degree hour-1"),
        (
            "deg/sec|dps|°/s|º/s|Deg/Sec|degrees/second|degrees per second|deg.s-1|deg s⁻¹",
            "degree s-1",
        ),
        ("rad/sec|RAD/S|rad*s**-1|rad·s⁻¹|radians/second|rad.s^-1", "radian s-1"),
        ("mdps|mdeg/s", "1e-3 degree s-1"),
        ("rpm|RPM|rev/min|revs per minute", "6 degree s-1"),
        ("rev/s|Rev/sec|revolutions per second", "360 degree s-1"),
        ("µrad/s|μrad/s|urad/sec", "1e-6 radian s-1"),
        ("m/s²|m s⁻²|m/sec^2|m/s/s|M/S2|m.s-2", "m s-2"),
        ("ug|µg", "9.80665e-6 m s-2"),
        ("dbar|DBAR|decibar", "1e4 Pa"),
        ("mbar|millibar|hPa|HPA", "100 Pa"),
        ("mG|milligauss|mGauss", "1e-7 T"),
        ("Gauss|gauss|GAUSS", "1e-4 T"),
        ("nT|NT|nanotesla", "1e-9 T"),
        ("mT", "1e-3 T"),
        ("mV|mv|millivolts|MILLIVOLTS", "1e-3 V"),
        ("mPa", "1e-3 Pa"),
    ],
)
def test_spellings_of_other_programs(spellings, meant):
    for text in spellings.split("|"):
        unit = parse_unit(text)
        inner = cf_units.Unit(on_disk(INNER[unit.quantity]))
        for value in (1.0, -37.5):
            expected = cf_units.Unit(meant).convert(value, inner)
            assert value * unit.factor + unit.offset == pytest.approx(
                expected, rel=1e-9, abs=1e-9
            ), text


def test_the_expected_quantity_decides_where_case_does_not():
    assert parse_unit("G").quantity == "magnetic"
    assert parse_unit("G", "acceleration").quantity == "acceleration"
    assert parse_unit("MPS2").quantity == "acceleration"
    assert parse_unit("uG").quantity == "magnetic"
    # mega or milli, acceleration or field, tesla or tonne
    for unclear in ("MPA", "MW", "MV", "MT", "MDPS", "MG", "UG", "t"):
        with pytest.raises(UnitError):
            parse_unit(unclear)
    for unclear, quantity in (("MG", "magnetic"), ("MW", "power"), ("2 MV", "voltage")):
        with pytest.raises(UnitError):
            parse_unit(unclear, quantity)
