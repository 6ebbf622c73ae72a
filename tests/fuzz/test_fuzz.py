"""Test a short campaign, the seeds of all campaigns, and the inputs that once failed."""

from __future__ import annotations

import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import pytest

import gyrostab
from tests.fuzz.campaign import (
    FORMATS,
    Input,
    Tally,
    load_input,
    make_input,
    run_batch,
    seeds,
    server,
)
from tests.fuzz.child import call, own_fault
from tests.fuzz.seeds import move_job
from tests.fuzz.server import arguments_of
from tests.fuzz.table import BEGIN, END, renew_results, results

REGRESSIONS = Path(__file__).parent / "regressions"
SEED = 7
COUNT = 40  # inputs of each format


@pytest.mark.full
def test_every_seed_is_read() -> None:
    """The inputs are valid before the harness damages them."""
    wrong = []
    for group in seeds().values():
        for seed in group:
            for command in dict.fromkeys(seed.commands):
                outcome = server().try_input(seed.files, command, seed.main, seed.options)
                if outcome.code != 0:
                    wrong.append((seed.format, seed.main, command, outcome.code, outcome.text))
    assert not wrong, "\n".join(map(str, wrong))


def test_results_of_a_campaign_leave_the_text_of_their_page(tmp_path: Path) -> None:
    written = (Path(__file__).parents[2] / "docs" / "fuzzing.md").read_text(encoding="utf-8")
    page = tmp_path / "fuzzing.md"
    page.write_text(written, encoding="utf-8")
    totals = {"text": Tally()}
    renew_results(page, results(totals, count=10, seed=3, jobs=1, seconds=60.0))
    renewed = page.read_text(encoding="utf-8")
    assert "Seed 3, jobs 1: 0 inputs took 1.0 minutes" in renewed
    assert f"with gyrostab {gyrostab.__version__}." in renewed
    assert renewed.split(BEGIN)[0] == written.split(BEGIN)[0]
    assert renewed.split(END)[1] == written.split(END)[1]


@pytest.mark.full
@pytest.mark.timeout(900)
def test_damaged_inputs_end_with_exit_code_0_or_2() -> None:
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as pool:
        batches = [pool.submit(run_batch, form, SEED, 0, COUNT, None) for form in FORMATS]
        failures = [failure for batch in batches for failure in batch.result()[2].failures]
    assert not failures, "\n".join(map(str, failures))


@pytest.mark.full
def test_an_input_follows_from_its_number() -> None:
    assert make_input("netcdf4", SEED, 3) == make_input("netcdf4", SEED, 3)


def kept() -> list[Path]:
    return sorted(path.parent for path in REGRESSIONS.glob("*/call.json"))


@pytest.mark.parametrize("place", kept(), ids=lambda place: place.name)
def test_an_input_that_once_failed(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from gyrostab import cli

    item: Input = load_input(place)
    for name, data in item.files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(
            move_job(data, "@FOLDER@", str(tmp_path)) if name.endswith("job.json") else data
        )
    state: dict = {"error": None}
    describe_error = cli.describe_error

    def spy(error: Exception) -> int:
        state["error"] = error
        return describe_error(error)

    monkeypatch.setattr(cli, "describe_error", spy)
    answer = call(arguments_of(item.command, tmp_path, item.main, item.options), state)
    assert answer["code"] in ((0, 2, 3) if item.format == "checkpoint" else (0, 2)), answer
    assert not answer["fault"]


def test_exception_of_our_own_code_is_distinguished_from_one_of_a_library() -> None:
    import json

    from gyrostab import errors

    package = str(Path(errors.__file__).parent)
    with pytest.raises(errors.DamageError) as library, errors.reading_of("log.nc"):
        json.loads("{")
    assert own_fault(library.value, package) == ""
    with pytest.raises(errors.DamageError) as own, errors.reading_of("log.nc"):
        errors.DamageError.nothing  # noqa: B018  # raised here, as if this file were of the package
    assert "AttributeError" in own_fault(own.value, str(Path(__file__).parent))
