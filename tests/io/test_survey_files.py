"""Gyro terms as a table, for welleng, and as WITSML: what other programs read from the files."""

from __future__ import annotations

import csv
import json
import math
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from gyrostab.cli import main
from gyrostab.errors import OptionError, OutputError
from gyrostab.io.datasets import to_netcdf
from gyrostab.io.survey_files import WEIGHTS, to_iscwsa
from gyrostab.io.survey_terms import survey_terms
from tests.io.test_survey_terms import make_product, set_state

WITSML = "{http://www.energistics.org/energyml/data/witsmlv2}"
BASE = "https://github.com/iscwsa/error-models/blob/main/schemas/"
COMMON = "{http://www.energistics.org/energyml/data/commonv2}"


def read_json(path: Path) -> dict:
    return json.loads(path.read_text(encoding="utf-8"))


def test_table_holds_every_term_and_comments(tmp_path):
    product = make_product()
    set_state(product, "B", "not_observable")
    model = to_iscwsa(product, tmp_path / "tool.csv")
    lines = (tmp_path / "tool.csv").read_text(encoding="utf-8").splitlines()
    comments = [line for line in lines if line.startswith("#")]
    assert any("survey engineer" in line for line in comments)
    assert any("temperature 65 to 85 degree_Celsius" in line for line in comments)
    rows = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    assert [row["code"] for row in rows] == [term.code for term in model.terms]
    assert [float(row["value"]) for row in rows] == pytest.approx(
        [term.value for term in model.terms], nan_ok=True
    )


def test_json_leaves_out_terms_without_a_value_and_continuous_ones_without_a_speed(tmp_path):
    product = make_product("xy")
    to_iscwsa(product, tmp_path / "tool.json")
    names = [term["name"] for term in read_json(tmp_path / "tool.json")["terms"]]
    assert names == ["GXY-RN", "GXY-B1", "GXY-B2"]
    set_state(product, "B", "not_observable")
    to_iscwsa(product, tmp_path / "fast.json", running_speed=0.5)
    names = [term["name"] for term in read_json(tmp_path / "fast.json")["terms"]]
    assert names == ["GXY-RN", "GXY-RN-INIT", "GXY-GRW"]


def test_json_has_every_term_with_its_status(tmp_path):
    product = make_product("z")
    set_state(product, "K", "upper_limit_only", upper=6.0)
    to_iscwsa(product, tmp_path / "tool.json", running_speed=0.5)
    content = read_json(tmp_path / "tool.json")
    assert [(row["code"], row["status"]) for row in content["x_gyrostab"]] == [
        ("GZ-GD", "upper_limit_only"),
        ("GZ-GRW", "observed"),
    ]
    assert content["parameters"]["gxy_running_speed"] == 1800.0


def test_json_follows_the_draft_schema_of_iscwsa(tmp_path):
    """Except for what the draft has no place for: continuous surveys, their units, our table."""
    welleng = pytest.importorskip("welleng")
    import jsonschema
    import referencing

    folder = Path(welleng.__file__).parent / "errors" / "iscwsa_schema"
    registry = referencing.Registry()
    for path in folder.rglob("*.json"):  # some of the files state another name than their own
        name = (BASE + path.relative_to(folder).as_posix()).lower()
        schema = json.loads(path.read_text(encoding="utf-8")) | {"$id": name}
        registry = registry.with_resource(name, referencing.Resource.from_contents(schema))
    to_iscwsa(make_product(), tmp_path / "tool.json")
    content = read_json(tmp_path / "tool.json")
    assert content.pop("x_gyrostab")
    assert content["parameters"].pop("noise_reduction_factor") == 1.0
    schema = registry.contents(f"{BASE}draft.json")
    validator = jsonschema.Draft202012Validator(schema, registry=registry)
    assert [error.message for error in validator.iter_errors(content)] == []


def propagate(path: Path, inclination: float = 40.0, azimuth: float = 30.0) -> dict:
    """Covariance (north, east) of each term at the end of a straight well of 1000 m, by welleng."""
    welleng = pytest.importorskip("welleng")
    header = welleng.survey.SurveyHeader(
        name="well", latitude=60.0, longitude=2.0, b_total=5e4, dip=70.0, declination=0.0,
        convergence=0.0, G=9.80665, azi_reference="true", earth_rate=math.radians(15.041),
    )  # fmt: skip
    depth = np.linspace(0.0, 1000.0, 101)
    survey = welleng.survey.Survey(
        md=depth, inc=np.full(101, inclination), azi=np.full(101, azimuth), header=header,
        error_model=read_json(path),
    )  # fmt: skip
    return {
        code: float(np.sqrt(np.trace(error.cov_NEV[-1])))
        for code, error in survey.err.errors.errors.items()
    }


@pytest.mark.parametrize("axes", ["xy", "xyz"])
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_welleng_propagates_stationary_terms_as_by_hand(axes, tmp_path):
    """A constant azimuth error moves the end by it times the horizontal length (1000 m sin I)."""
    model = to_iscwsa(make_product(axes), tmp_path / "tool.json")
    errors = propagate(tmp_path / "tool.json")
    inclination, azimuth = math.radians(40.0), math.radians(30.0)
    north = 15.041 * math.cos(math.radians(60.0))
    for term in model.terms:
        if term.code.endswith(("B1", "B2", "ZB")):
            weight = {
                "GXY-B1": math.sin(azimuth) / math.cos(inclination),
                "GXYZ-XYB1": math.sin(azimuth) * math.cos(inclination),
                "GXYZ-ZB": math.sin(azimuth) * math.sin(inclination),
            }.get(term.code, math.cos(azimuth))
            expected = term.value * weight / north * 1000.0 * math.sin(inclination)
            assert errors[term.code] == pytest.approx(expected, rel=0.01), term.code
        elif term.code.endswith("RN"):  # independent at 100 stations
            assert errors[term.code] < 0.2 * term.value / north * 1000.0


@pytest.mark.parametrize(
    ("axes", "name", "factor"),
    [
        ("xy", "GXY", 1.0 / math.sin(math.radians(40.0))),
        ("xyz", "GXYZ", 1.0),
        ("z", "GZ", 1.0 / math.cos(math.radians(40.0))),
    ],
)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_welleng_propagates_continuous_terms_as_by_hand(axes, name, factor, tmp_path):
    """The azimuth error grows as GD t and GRW sqrt(t), over the inclination's sine or cosine."""
    speed = 0.5
    model = to_iscwsa(make_product(axes), tmp_path / "tool.json", running_speed=speed)
    errors = propagate(tmp_path / "tool.json")
    values = {term.code: math.radians(term.value) for term in model.terms}
    hours = np.linspace(0.0, 1000.0, 101) / speed / 3600.0
    horizontal = 1000.0 * math.sin(math.radians(40.0))
    drift, walk = (np.trapezoid(error, hours) / hours[-1] for error in (hours, np.sqrt(hours)))
    assert errors[f"{name}-GD"] == pytest.approx(
        factor * values[f"{name}-GD"] * drift * horizontal, rel=0.02
    )
    assert errors[f"{name}-GRW"] == pytest.approx(
        factor * values[f"{name}-GRW"] * walk * horizontal, rel=0.02
    )


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_welleng_carries_the_stationary_error_into_the_continuous_survey(tmp_path):
    """Below the limit stations alone; above it their last systematic error stays."""
    to_iscwsa(make_product("xy"), tmp_path / "tool.json", running_speed=0.5, continuous_from=50.0)
    to_iscwsa(make_product("xy"), tmp_path / "stations.json")
    gated, stations = (propagate(tmp_path / f"{name}.json") for name in ("tool", "stations"))
    assert gated["GXY-GD"] == 0.0
    assert gated["GXY-RN"] == pytest.approx(stations["GXY-RN"])
    assert gated["GXY-B1"] == pytest.approx(stations["GXY-B1"])


class TestWitsml:
    def make(self, tmp_path: Path, **options) -> ET.Element:
        product = make_product("xy")
        product.attrs["source_files"] = ["a & b <c>.csv"]
        to_iscwsa(product, tmp_path / "tool.xml", **options)
        return ET.parse(tmp_path / "tool.xml").getroot()

    def test_terms_with_units(self, tmp_path):
        root = self.make(tmp_path, running_speed=0.5)
        expected = {term.code: term.value for term in survey_terms(make_product("xy")).terms}
        magnitudes = {
            value.find(f"{WITSML}ErrorTerm/{COMMON}Title").text: value.find(f"{WITSML}Magnitude")
            for value in root.iter(f"{WITSML}ErrorTermValue")
        }
        assert {code: float(magnitude.text) for code, magnitude in magnitudes.items()} == expected
        assert magnitudes["GXY-RN"].get("uom") == "dega/h"
        assert magnitudes["GXY-GRW"].get("uom") == "dega/sqrt(h)"

    def test_names_are_escaped(self, tmp_path):
        assert "a & b <c>.csv" in self.make(tmp_path).find(f"{WITSML}Source").text
        assert "a &amp; b &lt;c&gt;.csv" in (tmp_path / "tool.xml").read_text(encoding="utf-8")

    def test_status_is_provisional(self, tmp_path):
        authorization = self.make(tmp_path).find(f"{WITSML}Authorization")
        assert authorization.find(f"{WITSML}Status").text == "provisional"
        assert "survey engineer" in authorization.find(f"{WITSML}ApprovalAuthority").text

    def test_conditions_are_ranges(self, tmp_path):
        ranges = {
            element.find(f"{WITSML}Title").text: element
            for element in self.make(tmp_path).iter(f"{WITSML}CustomRange")
        }
        assert float(ranges["temperature"].find(f"{WITSML}End").text) == 85.0
        assert ranges["temperature"].find(f"{WITSML}Uom").text == "degC"

    def test_units_of_conditions_are_those_of_energistics(self, tmp_path):
        product = make_product("xy")
        units = {
            "rotation_rate": ("degree s-1", "dega/s"),
            "temperature_rate": ("K hour-1", "degC/h"),
            "vibration": ("g", "gn"),
            "x" * 70: ("V", "V"),
            "flow": ("L/min of mud", None),
        }
        for name, (unit, _) in units.items():
            product[name] = ("time", np.arange(float(product.sizes["time"])), {"units": unit})
        to_iscwsa(product, tmp_path / "tool.xml")
        root = ET.parse(tmp_path / "tool.xml").getroot()
        found = {
            element.find(f"{WITSML}Title").text: element.find(f"{WITSML}Uom").text
            for element in root.iter(f"{WITSML}CustomRange")
        }
        del found["temperature"]
        assert found == {name[:64]: unit for name, (_, unit) in units.items() if unit}
        assert "flow 0 to 5 L/min of mud" in root.find(f"{WITSML}Application").text

    @pytest.mark.full
    @pytest.mark.parametrize("speed", [None, 0.5])
    def test_standard_binding_reads_and_writes_the_same_elements(self, tmp_path, speed):
        """Names, order, types and required elements are those of the schema of WITSML 2.1."""
        witsml = pytest.importorskip("energyml.witsml.v2_1.witsmlv2")
        from xsdata.formats.dataclass.parsers import XmlParser
        from xsdata.formats.dataclass.parsers.config import ParserConfig
        from xsdata.formats.dataclass.serializers import XmlSerializer

        root = self.make(tmp_path, running_speed=speed)
        config = ParserConfig(fail_on_unknown_properties=True, fail_on_converter_warnings=True)
        model = XmlParser(config=config).from_path(tmp_path / "tool.xml", witsml.ToolErrorModel)
        reread = ET.fromstring(XmlSerializer().render(model))
        assert [element.tag for element in reread.iter()] == [
            element.tag for element in root.iter()
        ]
        assert list(find_missing(model)) == []


def find_missing(part: object):
    """Find required values that are absent, in a binding made from the schema."""
    for name, field in getattr(part, "__dataclass_fields__", {}).items():
        value = getattr(part, name)
        if field.metadata.get("required") and value is None:
            yield f"{type(part).__name__}.{name}"
        if len(value if isinstance(value, str | list) else "") > field.metadata.get(
            "max_length", math.inf
        ):
            yield f"{type(part).__name__}.{name} is too long"
        for item in value if isinstance(value, list) else [value]:
            yield from find_missing(item)


def test_every_exported_code_has_a_weight(tmp_path):
    for axes in ("xyz", "xy", "z"):
        assert {term.code for term in survey_terms(make_product(axes)).terms} <= set(WEIGHTS)


@pytest.mark.parametrize(
    ("axes", "name", "options", "error"),
    [
        ("xy", "tool.yaml", {}, OptionError),
        ("z", "tool.json", {}, OptionError),
        ("xy", "tool.json", {"running_speed": 0.0}, OptionError),
        ("xy", "tool.csv", {"running_speed": math.nan}, OptionError),
        ("xy", "tool.csv", {"continuous_from": math.nan}, OptionError),
        ("xy", "tool.csv", {"continuous_from": 200.0}, OptionError),
        ("xy", "nowhere/tool.json", {}, OutputError),
    ],
)
def test_wrong_calls_are_refused(axes, name, options, error, tmp_path):
    with pytest.raises(error):
        to_iscwsa(make_product(axes), tmp_path / name, **options)


class TestCommand:
    @pytest.fixture
    def product(self, tmp_path) -> Path:
        to_netcdf(make_product(), tmp_path / "product.nc")
        return tmp_path / "product.nc"

    def test_prints_the_table_and_the_file(self, product, capsys):
        out = product.with_name("tool.json")
        given = ["--format", "iscwsa", "--station-time", "15min", "--running-speed", "0.5"]
        assert main(["export", str(product), "-o", str(out), *given]) == 0
        printed = capsys.readouterr().out
        assert "GXYZ-GRW" in printed
        assert printed.splitlines()[-1] == str(out)
        assert read_json(out)["parameters"]["gxy_running_speed"] == 1800.0

    @pytest.mark.parametrize(
        ("given", "message"),
        [
            (["--format", "kalibr", "--station-time", "1min"], "for --format iscwsa"),
            (["--format", "iscwsa", "--diagnosis", "nowhere"], "no such folder"),
            (["--format", "iscwsa", "--section-time", "soon"], "--section-time"),
        ],
    )
    def test_wrong_options_are_one_message(self, given, message, product, capsys):
        name = "imu.yaml" if "kalibr" in given else "tool.xml"
        assert main(["export", str(product), "-o", str(product.with_name(name)), *given]) == 2
        assert message in capsys.readouterr().err
