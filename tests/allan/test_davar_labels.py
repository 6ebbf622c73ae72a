"""Times, channels, options and inputs of the DAVAR."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from gyrostab.allan.davar import davar, davar_parts
from gyrostab.errors import OptionError, SchemaError
from gyrostab.ingest.make_log import make_log


def log_of(x, rate=100.0, unit="deg/h", **options):
    return make_log(x, rate=rate, unit=unit, **options)


def test_windows_have_times_and_bounds():
    x = np.zeros((1, 3000))
    result = davar(log_of(x, rate=300.0, start="2026-01-01"), window="2s", step="1s")
    np.testing.assert_array_equal(
        result.time.values[:2],
        np.array(["2026-01-01T00:00:01", "2026-01-01T00:00:02"], "datetime64[ns]"),
    )
    np.testing.assert_array_equal(
        result.time_bounds.values[1],
        np.array(["2026-01-01T00:00:01", "2026-01-01T00:00:03"], "datetime64[ns]"),
    )
    assert result.attrs["window_samples"] == 600
    assert all(
        "units" in result[name].attrs
        for name in ("avar", "count", "coverage", "edf", "window_mean", "tau")
    )


def test_channels_follow_the_windows():
    n = 6000
    t = np.arange(n) / 100.0
    temperature = 20 + t / 3600 * 60  # 60 K/h
    temperature[1000:1500] = np.nan
    log = log_of(
        np.zeros(n),
        channels={"temperature": (temperature, "degC"), "vibration": (np.full(n, 2.0), "g")},
    )
    slow_times = np.arange(0, n, 100)
    log["pressure"] = ("time_pressure", 1e5 + slow_times, {"units": "Pa"})
    log = log.assign_coords(time_pressure=log.time.isel(time=slice(0, None, 100)).values)
    result = davar(log, window="1000samples", step="500samples")
    np.testing.assert_allclose(result.temperature_rate.values[[0, 5]], 60.0, rtol=1e-9)
    assert result.temperature_rate.units == "K hour-1"
    np.testing.assert_allclose(result.temperature.values[6], temperature[3000:4000].mean())
    np.testing.assert_allclose(result.vibration.values, 2.0)
    np.testing.assert_allclose(result.pressure.values[0], 1e5 + slow_times[:10].mean())


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda t: t.astype(object), "values of type object, .*astype.float"),
        (lambda t: t.astype(str), "text, not numbers"),
        (lambda t: t > 2.0, "values of type bool"),
        (lambda t: t + 0j, "values of type complex128"),
        (lambda t: t["time"].copy(), "values of type datetime64"),
        (
            lambda t: t.expand_dims({"axis": ["x"]}),
            r"dimensions \('axis', 'time'\).*isel.axis=0",
        ),
    ],
)
@pytest.mark.parametrize("compute", [davar, davar_parts])
def test_warns_of_channels_that_are_left_out(change, reason, compute):
    log = log_of(np.zeros(60), channels={"level": (np.arange(60.0), "1")})
    log = log.assign(level=change(log.level), pump=log.level)
    with pytest.warns(UserWarning, match=rf"^channel 'level' is left out: it \w+ {reason}"):
        compute(log, window="20samples")
    with pytest.warns(UserWarning, match="is left out"):
        surface = davar(log, window="20samples")
    assert "level" not in surface
    assert surface.pump.values[0] == np.arange(20).mean()


def test_channel_without_units_has_none_in_the_surface():
    log = log_of(np.zeros(60)).assign(temperature=("time", np.arange(60.0)))
    surface = davar(log, window="20samples")
    assert "units" not in surface.temperature.attrs
    assert surface.temperature.values[0] == np.arange(20).mean()
    assert "temperature_rate" not in surface


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"window": "1h"}, "longer than the record .*; give a shorter window .--window"),
        ({"window": "10s", "step": "11s"}, "longer than the window"),
        ({"window": "10s", "taus": [6.0]}, "longer than half of the window"),
        ({"window": "10s", "taus": [0.001]}, "shorter than one sample"),
        ({"window": "10s", "tau_max": "9s"}, "does not fit the window"),
        ({"window": "3samples"}, "at least 4"),
        ({"window": "10"}, "has no unit; write '10s' for seconds or '10samples' for samples"),
        ({"window": 10}, "has no unit; write '10s' for seconds or '10samples' for samples"),
        ({"window": 10.0}, "has no unit; write '10.0s' for seconds"),
        ({"window": np.int64(1000)}, "has no unit; write '1000s' for seconds or '1000samples'"),
        ({"window": "10s", "step": 100}, "step 100 has no unit"),
        ({"window": "soon"}, "not a duration"),
        ({"window": "-10s"}, "longer than zero"),
        ({"window": "10s", "taus": 0}, "above 0"),
        ({"window": "10s", "taus": ["soon"]}, "40 .how many., octave, all or 0.1s.*for taus"),
        ({"window": "10s", "axis": "q"}, "axis 'q' is not in the log; it has x"),
        ({"window": "10s", "axis": 0}, "axis '0' is not in the log; it has x"),
        ({"window": "10s", "axis": []}, r"axis=\[\] names no axis; the log has x"),
        ({"window": True}, "window True is not a duration"),
        ({"window": "10s", "min_strict": "0.3"}, "min_strict='0.3': give a share from 0 to 1"),
        ({"window": "10s", "min_strict": -0.1}, "min_strict=-0.1"),
        ({"window": "10s", "min_coverage": 5}, "min_coverage=5"),
        ({"window": "10s", "min_coverage": np.nan}, "min_coverage=nan"),
    ],
)
def test_wrong_options_are_explained(options, words):
    with pytest.raises(OptionError, match=words):
        davar(log_of(np.zeros(6000)), **options)


def test_input_other_than_a_log_is_refused():
    with pytest.raises(SchemaError, match="rate"):
        davar(xr.Dataset({"omega": ("time", np.zeros(5))}), window="1s")
    log = log_of(np.zeros(100))
    log.rate.attrs["units"] = "count"
    with pytest.raises(SchemaError, match="degree hour-1"):
        davar(log, window="1s")
