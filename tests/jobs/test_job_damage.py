"""Job folders with damaged or foreign files: damage is not used, foreign files are not removed."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pytest

from gyrostab import make_log, to_zarr
from gyrostab.errors import OutputError
from gyrostab.jobs.job import (
    begin_job,
    check_job_folder,
    make_fingerprint,
    read_job,
    remove_remains,
)
from gyrostab.jobs.load import check_run_options


def flip(content: bytes, place: int, bit: int) -> bytes:
    return content[:place] + bytes([content[place] ^ 1 << bit]) + content[place + 1 :]


def test_a_flipped_bit_in_the_description_of_a_run_is_noticed(tmp_path):
    begin_job(
        tmp_path,
        make_fingerprint([tmp_path], check_run_options(windows={"window": "10min"})),
        parts=5,
        overwrite=False,
    )
    path = tmp_path / "job.json"
    whole, before = path.read_bytes(), read_job(tmp_path)
    assert before["parts"] == 5
    draw = random.Random(1)
    for _ in range(300):
        path.write_bytes(flip(whole, draw.randrange(len(whole)), draw.randrange(8)))
        assert read_job(tmp_path) in (None, before)
    path.write_bytes(whole[:-40])
    assert read_job(tmp_path) is None


def test_only_finished_parts_of_a_killed_run_are_kept(tmp_path):
    to_zarr(make_log(np.arange(100.0)[None], rate=1.0, unit="deg/h"), tmp_path / "log.zarr")
    names = {"job.json", "lock", "windows-0000000000.block"}
    for name in (*names, ".windows-0000000007.block.gyrostab-0123abcd.part"):
        (tmp_path / name).write_text("half")
    remove_remains(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == names


def test_what_a_run_leaves_is_known_at_every_stage(tmp_path):
    folder = tmp_path / ".out.nc.job"
    check_job_folder(folder)
    folder.mkdir()
    check_job_folder(folder)
    (folder / "lock").write_text("")
    check_job_folder(folder)
    (folder / "lock").write_text("process 12 on host\n")
    (folder / "windows-0000000000.block").write_text("")
    (folder / ".job.json.gyrostab-0123abcd.part").write_text("")
    check_job_folder(folder)
    (folder / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match=r"notes\.txt: .*gyrostab did not make what is there"):
        check_job_folder(folder)


def test_the_published_table_has_no_loss():
    page = (Path(__file__).resolve().parents[2] / "docs" / "durability.md").read_text(
        encoding="utf-8"
    )
    rows = [
        line.strip("| ").split(" | ")
        for line in page.splitlines()
        if line.startswith("| ") and line.split(" | ")[1].strip().isdigit()
    ]
    assert len(rows) == 11
    assert all(trials == good for _, trials, _, good in rows)
