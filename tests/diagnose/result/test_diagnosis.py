"""A diagnosis as data and as files: JSON schema, model, folder, report page, and sentences."""

from __future__ import annotations

import copy
import json
import re
import tomllib
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import gyrostab
from gyrostab.diagnose.result.content import VERDICTS, check_diagnosis, make_schema
from gyrostab.diagnose.result.diagnosis import Diagnosis, model_text, tabulate_effect, to_json_types
from gyrostab.diagnose.result.record_text import summary
from gyrostab.diagnose.result.text import (
    chance,
    clock,
    mismatch_statement,
    next_measurement,
    plain_name,
    rejection_text,
    unsized_statement,
)
from gyrostab.errors import FormatError, OptionError, OutputError, SchemaError
from gyrostab.physics.registry import effects, make_effect
from gyrostab.report import write_diagnosis_report
from gyrostab.report.diagnosis import FILES, open_diagnosis, write_diagnosis
from gyrostab.simulate import read_model, simulate
from tests.support.command_line import call
from tests.support.diagnosed import content, diagnosis, model, surfaces


@pytest.fixture
def without_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the figures in tests that are about the text of a page."""
    monkeypatch.setattr("gyrostab.report.diagnosis_charts.static_png", lambda _: "")


plain_pages = pytest.mark.usefixtures("without_figures")

# --------------------------------------------------------------------------------
# ----------------- schema


def test_content_made_by_hand_passes_the_check():
    check_diagnosis(content())
    check_diagnosis(json.loads(diagnosis().to_json()))


def test_published_json_schema_is_that_of_the_models_and_accepts_a_diagnosis():
    path = Path(__file__).resolve().parents[3] / "docs" / "diagnosis.schema.json"
    published = json.loads(path.read_text(encoding="utf-8"))
    assert published == make_schema()
    jsonschema.validate(json.loads(diagnosis().to_json()), published)
    with pytest.raises(jsonschema.ValidationError, match="fine"):
        jsonschema.validate({**content(), "verdict": "fine"}, published)


def test_docs_explain_every_key():
    text = (Path(__file__).resolve().parents[3] / "docs" / "diagnosis.md").read_text(
        encoding="utf-8"
    )
    section = text[text.index("## Contents of `diagnosis.json`") :].split("\n## ")[0]
    keys = {str(key) for place in _places(content()) for key in place[-1:] if isinstance(key, str)}
    assert keys > {"verdict", "held_out", "nats"}
    assert not [key for key in [*keys, *VERDICTS] if f"`{key}`" not in section]


def _places(value: Any, place: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Every key of the content, apart from what may have any name."""
    places = []
    items = (
        value.items()
        if isinstance(value, dict)
        else enumerate(value)
        if isinstance(value, list)
        else ()
    )
    for key, item in items:
        free = (place and place[-1] in ("noise", "parameters", "not_found")) or (
            len(place) > 1 and place[-2] == "noise"
        )
        if isinstance(value, dict) and not free:
            places.append((*place, key))
        places += _places(item, (*place, key))
    return places


@pytest.mark.parametrize("place", _places(content()), ids=lambda place: ".".join(map(str, place)))
def test_missing_keys_and_wrong_types_are_errors(place: tuple[Any, ...]):
    # files of earlier versions have none
    optional = place in (("unused_channels",), ("rejected",)) or place[-1] == "probability"
    for spoil in ("other kind",) if optional else ("leave out", "other kind"):
        spoiled = content()
        table: Any = spoiled
        for key in place[:-1]:
            table = table[key]
        if spoil == "leave out":
            del table[place[-1]]
        else:
            table[place[-1]] = object()
        with pytest.raises(SchemaError):
            check_diagnosis(spoiled)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda c: c.update(verdict="fine"), "verdict is 'fine'"),
        (lambda c: c.update(schema="gyrostab.diagnosis/9"), "expected 'gyrostab.diagnosis/1'"),
        (lambda c: c["mismatches"][0].update(view="taste"), "view is 'taste'"),
        (lambda c: c["mismatches"][0].update(p_value=1.5), "p_value is 1.5"),
        (
            lambda c: c["mismatches"][0].update(explained_by=["shupe"]),
            "'shupe', which is not among the effects",
        ),
        (lambda c: c["mismatches"][1].update(id=1), "are not unique"),
        (lambda c: c["mismatches"][0].update(start="yesterday"), "expected a time in ISO 8601"),
        (lambda c: c["recording"].update(start="NaT"), "start is 'NaT', expected a time in ISO"),
        (lambda c: c["recording"].update(end=""), "end is '', expected a time in ISO 8601"),
        (lambda c: c["recording"].update(missing_share=-7.0), "missing_share is -7.0"),
        (lambda c: c["recording"].update(sampling_rate_hz=np.inf), "sampling_rate_hz is inf"),
        (lambda c: c["held_out"].update(blocks=-1), "blocks is -1"),
        (lambda c: c["held_out"].update(stderr=np.nan), "held_out.stderr is nan"),
        (lambda c: c.update(unexplained=[7]), "mismatch 7"),
        (lambda c: c["baseline"].update(source="guess"), "'guess'"),
        (lambda c: c["effects"][0]["parameters"]["white"].pop("low"), "white.low"),
    ],
)
def test_contradictions_are_errors(change, complaint: str):
    spoiled = content()
    change(spoiled)
    with pytest.raises(SchemaError, match=re.escape(complaint)):
        check_diagnosis(spoiled)


def test_json_has_null_for_infinities():
    assert json.loads(
        json.dumps(
            to_json_types(
                {"a": np.array([1.0, np.inf]), "b": np.bool_(True), "c": (np.float32(2),)}
            )
        )
    ) == {
        "a": [1.0, None],
        "b": True,
        "c": [2.0],
    }
    broken = Diagnosis({**content(), "seconds": float("nan")}, surfaces(), model())
    with pytest.raises(ValueError, match="JSON"):
        broken.to_json()


# --------------------------------------------------------------------------------
# ------------------ model


@pytest.mark.parametrize("name", list(effects()))
def test_effect_tables_round_trip(name: str):
    kind = effects()[name]
    effect = kind.example(axes=("x", "y"))
    written = model_text({"noise": {"N": 0.003}, "effect": [tabulate_effect(effect)]})
    assert read_model(tomllib.loads(written)).effects == (effect,)


@given(
    noise=st.dictionaries(st.sampled_from("QNBK"), st.floats(0.0, 1e6), min_size=1),
    axes=st.lists(
        st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=6),
        min_size=1,
        unique=True,
    ),
)
def test_models_are_valid_toml_with_the_same_numbers(noise: dict[str, float], axes: list[str]):
    tables = {
        "noise": {axis: noise for axis in axes},
        "effect": [{"name": "warm_up", "axes": axes, "amplitude": 0.1}],
    }
    assert tomllib.loads(model_text(tables, heading="made\nby hand")) == tables
    assert "environment" not in model_text({**tables, "environment": []})


@plain_pages
def test_page_says_why_other_effects_were_not_named(tmp_path: Path):
    page = write_diagnosis_report(diagnosis(), tmp_path / "d.html").read_text(encoding="utf-8")
    assert "Why not?" in page
    assert "(vibration rectification) is 4.2 nats larger" in page
    assert "looked for, not seen; its evidence is 6.0 nats below the threshold" in page


@pytest.mark.parametrize(
    ("beaten_by", "nats", "text"),
    [
        ("noise", None, ""),
        ("an impossible size", None, "it would need an impossible size"),
        ("an event that ends", 5.0, "the evidence of an event that ends is 5.0 nats larger"),
        (
            "spikes",
            -5.0,
            "the order of similar effects puts bit errors or outliers first, with 5.0 nats less",
        ),
    ],
)
def test_rejection_names_the_competitor(beaten_by: str, nats: float | None, text: str):
    assert rejection_text(beaten_by, nats).endswith(text)


@plain_pages
def test_the_model_runs(tmp_path: Path):
    folder = tmp_path / "found"
    write_diagnosis(diagnosis(), folder)
    world = [{"profile": "vibration", "points": [[0, 0.02], [60, 6.0]]}]
    given_model = tomllib.loads((folder / "model.toml").read_text()) | {"environment": world}
    log = simulate(given_model, duration="2min", rate=50.0, seed=1).compute()
    quiet, loud = log.rate.sel(axis="x").values[:3000], log.rate.sel(axis="x").values[3000:]
    assert loud.std() > 1.2 * quiet.std()
    assert loud.mean() - quiet.mean() == pytest.approx(0.0022 * (6.0**2 - 0.02**2), abs=0.06)


# --------------------------------------------------------------------------------
# ------------------ files


@plain_pages
def test_folder_of_four_files_round_trips(tmp_path: Path):
    made = diagnosis()
    files = write_diagnosis(made, tmp_path / "found")
    assert [path.name for path in files] == list(FILES)
    assert sorted(path.name for path in (tmp_path / "found").iterdir()) == sorted(FILES)
    assert [path.name for path in tmp_path.iterdir()] == ["found"]
    with pytest.raises(FormatError, match=r"is a file; give the folder of the diagnosis, .*found$"):
        open_diagnosis(tmp_path / "found" / "diagnosis.json")
    with pytest.raises(SchemaError, match="this is a dict, not a diagnosis; gyrostab"):
        write_diagnosis(made.content, tmp_path / "other")
    with pytest.raises(SchemaError, match=r"gyrostab\.write_diagnosis writes its report"):
        gyrostab.write_report(made, tmp_path / "report.html")
    with pytest.raises(OptionError, match=r"of type Diagnosis; give .* \(diagnosis\.model\)"):
        gyrostab.read_model(made)
    assert repr(made) == str(made)
    opened = open_diagnosis(tmp_path / "found")
    assert opened.content == json.loads(made.to_json())
    assert opened.model == made.model
    for name in made.surfaces.data_vars:
        np.testing.assert_array_equal(
            opened.surfaces[name].transpose(*made.surfaces[name].dims).values,
            made.surfaces[name].values,
            err_msg=str(name),
        )


@plain_pages
def test_commands_for_products_name_the_command_for_a_diagnosis(tmp_path: Path, capsys):
    folder = tmp_path / "found"
    write_diagnosis(diagnosis(), folder)
    (tmp_path / "moved.nc").write_bytes((folder / "diagnosis.nc").read_bytes())
    for path in (folder, folder / "diagnosis.nc", folder / "diagnosis.json"):
        assert call("plot", path, "-o", tmp_path / "figures") == 2
        shown = capsys.readouterr().err
        assert f"{path}: is a" in shown
        assert f"diagnosis; 'gyrostab report {folder} -o report.html' draws its figures" in shown
    for path in (folder / "diagnosis.nc", tmp_path / "moved.nc"):
        assert call("report", path, "-o", tmp_path / "report.html") == 2
        assert f"{path}: is a file of a diagnosis" in capsys.readouterr().err
    assert call("fit", folder / "diagnosis.nc", "-o", tmp_path / "product.nc") == 2
    assert "is a file of a diagnosis" in capsys.readouterr().err


@plain_pages
def test_a_file_name_that_is_no_text_is_replaced(tmp_path: Path):
    made = {**content(), "recording": {**content()["recording"], "files": ["a\udcff\x01.csv"]}}
    write_diagnosis(Diagnosis(to_json_types(made), surfaces(), model()), tmp_path / "found")
    assert open_diagnosis(tmp_path / "found").content["recording"]["files"] == ["a?\x01.csv"]


@plain_pages
def test_folder_is_replaced_only_with_overwrite(tmp_path: Path):
    folder = tmp_path / "found"
    write_diagnosis(diagnosis(), folder)
    with pytest.raises(OutputError, match="--overwrite"):
        write_diagnosis(diagnosis(), folder)
    write_diagnosis(diagnosis(), folder, overwrite=True)
    (folder / "thesis.tex").write_text("years of work")
    with pytest.raises(OutputError, match=r"thesis\.tex"):
        write_diagnosis(diagnosis(), folder, overwrite=True)
    assert (folder / "thesis.tex").exists()
    with pytest.raises(OutputError, match="is a file"):
        write_diagnosis(diagnosis(), folder / "thesis.tex", overwrite=True)
    with pytest.raises(OutputError, match="no directory"):
        write_diagnosis(diagnosis(), tmp_path / "not" / "there")


@plain_pages
def test_interrupted_writing_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def fail(*_: Any, **__: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("gyrostab.report.diagnosis.to_netcdf", fail)
    with pytest.raises(OutputError):
        write_diagnosis(diagnosis(), tmp_path / "found")
    assert list(tmp_path.iterdir()) == []


@plain_pages
def test_invalid_content_is_not_written(tmp_path: Path):
    spoiled = copy.deepcopy(content())
    del spoiled["held_out"]
    with pytest.raises(SchemaError, match="held_out"):
        write_diagnosis(Diagnosis(spoiled, surfaces(), model()), tmp_path / "found")
    assert list(tmp_path.iterdir()) == []


@plain_pages
@pytest.mark.parametrize("spoil", ["missing", "{", "{}", "[" * 200_000], ids=len)
def test_opening_something_else_is_an_error(tmp_path: Path, spoil: str):
    folder = tmp_path / "found"
    folder.mkdir()
    if spoil != "missing":
        (folder / "diagnosis.json").write_text(spoil)
    with pytest.raises(FormatError, match="found"):
        open_diagnosis(folder)


# --------------------------------------------------------------------------------
# ------------------- page


class Page(HTMLParser):
    """Text, pictures and foreign addresses of a page; complains about tags that do not close."""

    def __init__(self, text: str):
        super().__init__()
        self.words: list[str] = []
        self.pictures: list[str] = []
        self.addresses: list[str] = []
        self.open: list[str] = []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given_attrs = dict(attrs)
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)
        self.addresses += [
            str(given_attrs[name]) for name in ("src", "href") if name in given_attrs
        ]
        if tag == "img":
            self.pictures.append(str(given_attrs["alt"]))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> Page:
    path = tmp_path_factory.mktemp("page") / "report.html"
    write_diagnosis_report(diagnosis(), path)
    return Page(path.read_text(encoding="utf-8"))


def test_page_is_self_contained(page: Page):
    assert all(address.startswith("data:image/png;base64,") for address in page.addresses)
    assert len(page.pictures) == 4
    assert page.pictures[0] == "Where recording and simulation differ"


def test_page_gives_size_time_evidence_alternatives_and_next_step(page: Page):
    text = re.sub(r"\s+", " ", " ".join(page.words))
    for piece in (
        "Noise that rises with vibration, axis x",
        "25:00 to 30:00 after the start",
        "1.8 times the expected value",
        "1 of 2 500",
        "0.00045",
        "31 ± 6 nats",
        "The name is right with a probability of 62 %.",
        "a bias that follows acceleration (g_sensitivity)",
        "repeat at twice the vibration",
        "no temperature channel",
        "gyrostab simulate model.toml --like RECORDING",
    ):
        assert piece in text, piece


@plain_pages
def test_page_without_findings(tmp_path: Path):
    nothing = content() | {
        "verdict": "no mismatch",
        "mismatches": [],
        "effects": [],
        "unexplained": [],
    }
    write_diagnosis_report(Diagnosis(nothing, surfaces(), {"noise": {}}), tmp_path / "report.html")
    text = " ".join(Page((tmp_path / "report.html").read_text(encoding="utf-8")).words)
    assert "agrees with the simulation within noise" in text
    assert "differs nowhere from the simulation" in text


@plain_pages
def test_page_escapes_names(tmp_path: Path):
    scripted = content()
    scripted["recording"]["files"] = ["<script>alert(1)</script>"]
    write_diagnosis_report(Diagnosis(scripted, surfaces(), model()), tmp_path / "report.html")
    assert "<script>alert" not in (tmp_path / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("axes", ["x", pytest.param("xyz", marks=pytest.mark.full)])
def test_page_has_all_figures_for_any_number_of_axes(tmp_path: Path, axes: str):
    table = content()
    table["recording"]["axes"] = list(axes)
    page = write_diagnosis_report(
        Diagnosis(table, surfaces(axes=axes), model()), tmp_path / "report.html"
    )
    assert page.read_text(encoding="utf-8").count("<img") == 4


@plain_pages
def test_command_report_accepts_the_folder(tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    write_diagnosis(diagnosis(), tmp_path / "found")
    assert (
        call("report", tmp_path / "found", "-o", tmp_path / "again.html", "--quiet-progress") == 0
    )
    assert "Gyro diagnosis" in (tmp_path / "again.html").read_text(encoding="utf-8")
    capfd.readouterr()
    assert call("report", tmp_path / "found", "-o", tmp_path / "again.html") == 2
    assert "--overwrite" in capfd.readouterr().err
    assert call("report", tmp_path / "found", "-o", tmp_path / "other.html", "--log", "x.nc") == 2


# --------------------------------------------------------------------------------
# -------------- sentences


def test_every_effect_has_a_plain_name_and_a_next_measurement():
    for name in effects():
        assert plain_name(name) != name.replace("_", " "), name
        assert next_measurement(name, []).startswith("To confirm it, "), name
    assert next_measurement("vibration_noise", ["real_motion"]).startswith("To tell them apart, ")
    assert next_measurement("no_such_effect", []) == ""


@pytest.mark.parametrize(
    ("statistic", "detail"),
    [
        ("power", "avar"),
        ("mean", "mean"),
        ("cross_spectrum", "in phase"),
        ("common_mode", "slow"),
        ("spectral_line", "line"),
        ("ramp_phase", "order 2"),
        ("sample_counts", "outliers"),
        ("restart", "jump"),
        ("variance_fluctuation", "variance 20 s"),
        ("drifting_line", "drifting 1 2"),
    ],
)
@pytest.mark.parametrize("axes", [["x"], ["x", "y"]])
def test_every_statistic_has_a_sentence(statistic: str, detail: str, axes: list[str]):
    region = {
        "statistic": statistic, "quantity": detail, "axes": axes, "begin": 0.0, "end": 3600.0,
        "tau_min_s": 0.01, "tau_max_s": 0.01, "ratio": 2.0,
        "sign": -1, "p_value": 0.002, "estimate": -0.2, "frequency": 13.0,
    }  # fmt: skip
    sentence = mismatch_statement(region, 3600.0)
    assert sentence[0].isupper()
    assert sentence.endswith(".")
    assert "1 of 500" in sentence
    assert "nan" not in sentence
    for axis in axes:
        assert re.search(rf"\b{axis}\b", sentence)


def test_format_of_times_and_probabilities():
    assert clock(3599.96) == "1:00:00"
    assert chance(0.03) == "noise alone would show this in 1 of 33 such records"
    assert chance(0.0000123).endswith("1 of 81 000 such records")


@pytest.mark.parametrize("verdict", VERDICTS)
def test_every_verdict_has_a_summary(verdict: str):
    table = content() | {"verdict": verdict}
    if verdict in ("no mismatch", "unknown"):
        table |= {"effects": []}
    if verdict == "no mismatch":
        table |= {"mismatches": []}
    if verdict == "partly explained":
        table |= {"unexplained": [1]}
    text = summary(table)
    assert text.endswith(".")
    assert ("vibration" in text) == (verdict in ("explained", "partly explained"))


def test_printed_diagnosis_has_verdict_and_sentences():
    text = str(diagnosis())
    assert text.startswith("explained: The recording differs from the simulation in 2 places")
    assert "- vibration_noise: Vibration raises the noise" in text
    assert (
        make_effect({"name": "vibration_noise", "white": 0.00045, "axes": ["x"]}).say(
            {"white": 2.25e-5}
        )
        in text
    )


@plain_pages
def test_page_with_many_mismatches_lists_probabilities_in_a_column(tmp_path: Path):
    """The phrase on noise alone is not repeated in 24 sentences; each mismatch has its number."""
    made = diagnosis()
    region = made.content["mismatches"][0] | {"p_value": 1e-12, "explained_by": []}
    region["statement"] = (
        "Axis x is noisier than the simulation "
        "(noise alone would show this in fewer than 1 in a million such records)."
    )
    regions = [region | {"id": number} for number in range(1, 25)]
    many = replace(
        made,
        content=made.content
        | {"mismatches": regions, "unexplained": list(range(1, 25)), "effects": []},
    )
    text = write_diagnosis_report(many, tmp_path / "page.html").read_text(encoding="utf-8")
    assert text.count("<td>fewer than 1 in a million</td>") == 24
    assert "noise alone would show" not in text
    assert str(many).count("in a million") == 1


def test_effect_without_a_size_has_a_sentence():
    motion = make_effect({"name": "real_motion", "x": 0.02, "axes": ["z"]})
    assert motion.say() == "The tool really rotates on axis z: tilt 0.02 mrad/g along x."
    text = unsized_statement("real_motion", ["x", "z"])
    assert text == (
        "The record shows real rotation of the tool, not a sensor error, on axes x and z, but does "
        "not determine the size."
    )
