"""Noise densities for Kalibr: factors by hand, medians of observed values, marked limits."""

from __future__ import annotations

import math

import numpy as np
import pytest
import xarray as xr

import gyrostab
from gyrostab.cli import main
from gyrostab.errors import OutputError, SchemaError
from gyrostab.ingest.uniform import cut_log
from gyrostab.io.datasets import to_netcdf
from gyrostab.io.kalibr import ACCELEROMETER_KEYS, KEYS, convert_terms, to_kalibr
from gyrostab.io.kalibr import _fit_accelerometers as fit_accelerometers
from gyrostab.schema import OBSERVABLE
from tests.support import synthetic

# By hand. 1 deg/sqrt(h) = 0.017453292519943 rad / sqrt(3600 s) = 0.017453292519943 / 60
# rad/sqrt(s), and rad/sqrt(s) = rad/s/sqrt(Hz).
# 1 deg/h^1.5 = 0.017453292519943 rad / (3600 s)^1.5 = 0.017453292519943 / 216000; rad/s^1.5 =
# rad/s^2/sqrt(Hz).
# 1 deg/h = 0.017453292519943 rad / 3600 s.
BY_HAND = {
    "gyroscope_noise_density": 2.908882086657e-4,
    "gyroscope_random_walk": 8.080228018492e-8,
    "gyroscope_bias_instability": 4.848136811095e-6,
}


@pytest.fixture
def product() -> xr.Dataset:
    """Every window observes N = 2, K = 3 and B = 5 on x, twice that on y."""
    product = synthetic.product(axes="xy", windows=6)
    for symbol, value in {"N": 2.0, "K": 3.0, "B": 5.0}.items():
        product[symbol][:] = np.array([[value], [2 * value]])
    product["observable"][:] = OBSERVABLE.index("observed")
    return product


def limit_only(product: xr.Dataset, symbol: str, axis: int, upper: float) -> None:
    product["observable"].loc[{"term": symbol}][axis] = OBSERVABLE.index("upper_limit_only")
    product[f"{symbol}_upper"][axis] = upper
    product[symbol][axis] = 1e9  # what the fit says there is no observation


def parse(path) -> dict:
    """Read the two levels of `key: value  # comment` that the file holds."""
    tree: dict = {}
    parents = {0: tree}
    for line in path.read_text().splitlines():
        text = line.split("#")[0].rstrip()
        if not text:
            continue
        depth = len(text) - len(text.lstrip())
        key, _, value = (part.strip().strip('"') for part in text.partition(":"))
        if value:
            parents[depth][key] = value
        else:
            parents[depth][key] = parents[depth + 2] = {}
    return tree


def test_units_are_those_worked_out_by_hand(product):
    noise = convert_terms(product, KEYS)["x"]
    for key, value in {
        "gyroscope_noise_density": 2.0,
        "gyroscope_random_walk": 3.0,
        "gyroscope_bias_instability": 5.0,
    }.items():
        assert noise[key].value == pytest.approx(value * BY_HAND[key], rel=1e-12)
    assert KEYS["gyroscope_random_walk"][2] == "rad/s^2/sqrt(Hz)"


def test_median_over_observed_windows_only(product):
    product["N"][0] = [1.0, 2.0, 7.0, 1e6, 1e6, np.nan]
    product["observable"].loc[{"term": "N"}][0, 3:] = OBSERVABLE.index("not_observable")
    value = convert_terms(product, KEYS)["x"]["gyroscope_noise_density"]
    assert value.value == pytest.approx(2.0 * BY_HAND["gyroscope_noise_density"])
    assert (value.status, value.observed_share) == ("observed", 0.5)


def test_file_has_the_worst_axis_at_the_top_and_every_axis_below(product, tmp_path):
    text = parse(to_kalibr(product, tmp_path / "imu.yaml"))
    assert float(text["update_rate"]) == 300.0
    for key, factor in BY_HAND.items():
        symbol = KEYS[key][0]
        assert (
            float(text[key])
            == float(text["axes"]["y"][key])
            == pytest.approx(float(product[symbol][1, 0]) * factor, rel=1e-6)
        )
        assert float(text["axes"]["x"][key]) == pytest.approx(
            float(product[symbol][0, 0]) * factor, rel=1e-6
        )
        assert text[f"{key}_meaning"] == "observed"


def test_limit_is_said_to_be_one(product, tmp_path):
    for axis in (0, 1):
        limit_only(product, "K", axis, upper=8.0 - axis)
    path = to_kalibr(product, tmp_path / "imu.yaml")
    text = parse(path)
    assert text["gyroscope_random_walk_meaning"] == "upper_limit_only"
    assert float(text["gyroscope_random_walk"]) == pytest.approx(
        8.0 * BY_HAND["gyroscope_random_walk"], rel=1e-6
    )
    assert "95 % UPPER LIMIT" in next(
        line for line in path.read_text().splitlines() if line.startswith("gyroscope_random_walk:")
    )


def test_worst_axis_may_be_one_with_a_limit_only(product, tmp_path):
    limit_only(product, "K", 0, upper=50.0)
    assert (
        parse(to_kalibr(product, tmp_path / "imu.yaml"))["gyroscope_random_walk_meaning"]
        == "upper_limit_only"
    )


def test_a_dead_axis_is_named(tmp_path):
    log = make_accelerometers(samples=3_000)
    log["rate"][0] = 3.3
    log["accel_z"][:] = 1.0
    product = gyrostab.fit_noise(gyrostab.davar(log, window="10s"))
    text = to_kalibr(product, tmp_path / "imu.yaml", log=log).read_text()
    for axis in ("gyroscope axis x", "accelerometer axis z"):
        assert f"# {axis} is constant: its sensor is dead" in text
    assert text.count("is constant") == 2


def test_what_no_window_shows_is_null(product, tmp_path):
    product["observable"].loc[{"term": "K"}][:] = OBSERVABLE.index("not_observable")
    text = parse(to_kalibr(product, tmp_path / "imu.yaml"))
    assert text["gyroscope_random_walk"] == "null"
    assert text["gyroscope_random_walk_meaning"] == "not_observable"
    product["observable"].loc[{"term": "K"}][0] = OBSERVABLE.index("observed")
    text = parse(to_kalibr(product, tmp_path / "two.yaml"))
    assert float(text["gyroscope_random_walk"]) == pytest.approx(
        3.0 * BY_HAND["gyroscope_random_walk"], rel=1e-6
    )


def test_yaml_readers_see_numbers(product, tmp_path):
    yaml = pytest.importorskip("yaml")
    product = product.assign_coords(axis=["x", "yes: no"])
    text = yaml.safe_load(to_kalibr(product, tmp_path / "imu.yaml").read_text())
    assert all(isinstance(text[key], float) for key in (*BY_HAND, "update_rate"))
    assert isinstance(text["axes"]["yes: no"]["gyroscope_noise_density"], float)


def test_refusals(product, tmp_path):
    with pytest.raises(SchemaError, match="no coefficients yet"):
        convert_terms(synthetic.surface(), KEYS)
    del product.attrs["sampling_rate_hz"]
    with pytest.raises(SchemaError, match="sampling_rate_hz"):
        to_kalibr(product, tmp_path / "imu.yaml")
    (tmp_path / "there.yaml").touch()
    with pytest.raises(OutputError, match="overwrite"):
        to_kalibr(synthetic.product(), tmp_path / "there.yaml")


def test_command(tmp_path, capsys):
    source = str(to_netcdf(synthetic.product(), tmp_path / "product.nc"))
    assert main(["export", source, "-o", str(tmp_path / "imu.yaml"), "--format", "kalibr"]) == 0
    assert set(BY_HAND) <= set(parse(tmp_path / "imu.yaml"))
    assert main(["export", source, "-o", str(tmp_path / "product.zarr"), "--format", "zarr"]) == 0
    xr.testing.assert_equal(
        xr.open_zarr(tmp_path / "product.zarr")["N"], xr.open_dataset(source)["N"]
    )
    assert main(["export", source, "-o", str(tmp_path / "imu.txt"), "--format", "kalibr"]) == 2
    assert ".yaml" in capsys.readouterr().err


def make_accelerometers(rate: float = 100.0, samples: int = 60_000) -> xr.Dataset:
    """Log whose accelerometers have white noise of 1e-4 (x) and 2e-4 (z) m/s^2/sqrt(Hz)."""
    rng = np.random.default_rng(5)
    scatter = {"accel_x": 1e-4, "accel_z": 2e-4}  # m/s^2/sqrt(Hz)
    channels = {
        name: (1.0 + rng.normal(0.0, density * math.sqrt(rate) / 9.80665, samples), "g")
        for name, density in scatter.items()
    }
    gyro = rng.normal(0.0, 6.0, (2, samples))
    return gyrostab.make_log(gyro, rate=rate, unit="deg/h", channels=channels)


class TestAccelerometers:
    def test_density_is_that_of_the_samples(self, tmp_path):
        log = make_accelerometers()
        product = gyrostab.fit_noise(gyrostab.davar(log, window="1min"))
        text = parse(to_kalibr(product, tmp_path / "imu.yaml", log=log))
        densities = {
            axis: values.get("accelerometer_noise_density") for axis, values in text["axes"].items()
        }
        assert float(densities["x"]) == pytest.approx(1e-4, rel=0.02)
        assert float(densities["z"]) == pytest.approx(2e-4, rel=0.02)
        assert densities["y"] is None
        assert text["accelerometer_noise_density"] == densities["z"]
        assert text["accelerometer_random_walk_meaning"] == "upper_limit_only"

    def test_accelerations_in_another_unit_are_converted(self):
        log = make_accelerometers()
        metric = log["accel_x"].copy(data=9.80665 * log["accel_x"].values)
        metric.attrs["units"] = "m s-2"
        product = gyrostab.fit_noise(gyrostab.davar(log, window="1min"))
        expected, got = (
            fit_accelerometers(made, product)["N"].values
            for made in (log, log.assign(accel_x=metric))
        )
        np.testing.assert_allclose(got, expected, rtol=1e-9)

    def test_random_walk_is_that_of_the_samples(self):
        """A random walk of k m/s^3/sqrt(Hz) has steps of k sqrt(interval) from sample to sample."""
        walk, rate = 1e-3, 10.0
        steps = np.random.default_rng(2).normal(0.0, walk / math.sqrt(rate), 40_000)
        acceleration = np.cumsum(steps) / 9.80665
        log = gyrostab.make_log(
            np.random.default_rng(3).normal(size=40_000),
            rate=rate,
            unit="deg/h",
            channels={"accel_y": (acceleration, "g")},
        )
        product = gyrostab.fit_noise(gyrostab.davar(log, window="1000s", step="500s"))
        terms = convert_terms(fit_accelerometers(log, product), ACCELEROMETER_KEYS)
        assert terms["y"]["accelerometer_random_walk"].value == pytest.approx(walk, rel=0.05)

    @pytest.mark.parametrize(
        "cut", [{"time_from": "200s"}, {"time_from": "200.37s"}, {"exclude": "0s/190s"}]
    )
    def test_only_windows_of_the_product_count(self, tmp_path, cut):
        """The tool is shaken for 190 s, which the product leaves out."""
        log = make_accelerometers(samples=30_000)
        for name in ("accel_x", "accel_z"):
            log[name][:19_000] *= 100.0
        product = gyrostab.fit_noise(gyrostab.davar(cut_log(log, **cut), window="10s"))
        path = to_kalibr(product, tmp_path / "imu.yaml", log=log)
        density = float(parse(path)["accelerometer_noise_density"])
        assert density == pytest.approx(2e-4, rel=0.05)
        (line,) = (
            line
            for line in path.read_text().splitlines()
            if line.startswith("accelerometer_noise_density:")
        )
        assert "velocity random walk" in line

    def test_another_log_is_refused(self, tmp_path):
        log = make_accelerometers(samples=4_000)
        product = gyrostab.fit_noise(gyrostab.davar(log, window="10s"))
        with pytest.raises(SchemaError, match="does not cover the windows") as raised:
            to_kalibr(product, tmp_path / "imu.yaml", log=log.isel(time=slice(2_000)))
        assert "--from" not in str(raised.value)  # an option that was not given

    @pytest.mark.parametrize("name", ["window_s", "step_s"])
    def test_attributes_that_are_missing_are_named(self, product, tmp_path, name):
        del product.attrs[name]
        with pytest.raises(SchemaError, match=rf"no attribute '{name}'.*\({name}=\.\.\.\)"):
            to_kalibr(product, tmp_path / "imu.yaml", log=synthetic.log())

    def test_slow_or_missing_channels_are_named(self, tmp_path):
        log = make_accelerometers(samples=2_000)
        product = gyrostab.fit_noise(gyrostab.davar(log, window="10s"))
        log = log.drop_vars(["accel_x", "accel_z"])
        with pytest.raises(SchemaError, match="accel_x, accel_y or accel_z"):
            to_kalibr(product, tmp_path / "imu.yaml", log=log)

    def test_command(self, tmp_path):
        log = make_accelerometers(samples=12_000)
        to_netcdf(log, tmp_path / "log.nc")
        to_netcdf(gyrostab.fit_noise(gyrostab.davar(log, window="30s")), tmp_path / "product.nc")
        given = [str(tmp_path / "product.nc"), "-o", str(tmp_path / "imu.yaml")]
        log_option = ["--log", str(tmp_path / "log.nc")]
        assert main(["export", *given, "--format", "kalibr", *log_option]) == 0
        text = parse(tmp_path / "imu.yaml")
        assert float(text["accelerometer_noise_density"]) == pytest.approx(2e-4, rel=0.05)
        assert main(["export", *given, "--format", "zarr", *log_option]) == 2
