"""Damaged and missing files of an archive leave a gap."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gyrostab.cli import main
from gyrostab.errors import FormatError, MissingUnitError, OptionError
from gyrostab.ingest import read_log
from gyrostab.ingest.grid.gaps import gap_table
from gyrostab.ingest.grid.regularise import regularise
from gyrostab.io import datasets as export
from gyrostab.io.opening import open_log
from gyrostab.jobs.run import load_log
from tests.support.regular_logs import RATE, cut, log_of, said, signal


@pytest.fixture
def archive(tmp_path: Path) -> list[Path]:
    """Write five raw files of ten seconds, a second apart, named like run_9, run_10."""
    values = signal(2750, holes=0)
    paths = []
    for place in range(5):
        rows = range(place * 550, place * 550 + 500)
        paths.append(tmp_path / f"run_{place + 8}.csv")
        body = "".join(f"{n / RATE:.2f},{values[0, n]:.0f},{values[1, n]:.0f}\n" for n in rows)
        paths[-1].write_text("time [s],gyro_x [deg/h],gyro_y [deg/h]\n" + body)
    return paths


def empty(path: Path) -> None:
    path.write_text("")


def binary(path: Path) -> None:
    path.write_bytes(bytes(range(256)) * 40)


def cut_gzip(path: Path) -> None:
    import gzip

    path.write_bytes(gzip.compress(path.read_bytes())[:2000])


def garbled(path: Path) -> None:
    head, *rows = path.read_text().splitlines()
    path.write_text("\n".join([head, *rows[:5], *("?;!" for _ in rows[5:])]))


@pytest.mark.parametrize("damage", [empty, binary, cut_gzip, garbled, Path.unlink])
def test_a_damaged_raw_file_becomes_a_gap(archive: list[Path], damage) -> None:
    whole = load_log(archive)
    damage(archive[2])
    raw = read_log([*archive[3:], *archive[:3]])
    log = regularise(raw)
    np.testing.assert_array_equal(log.rate[:, :1050], whole.rate[:, :1050])
    np.testing.assert_array_equal(log.rate[:, 1650:], whole.rate[:, 1650:])
    assert gap_table(log)[["samples", "cause"]].to_numpy().tolist() == [
        [50, "missing"],
        [600, "unreadable"],
        [50, "missing"],
    ]
    assert log.attrs["unreadable_files"] == ["run_10.csv"]
    assert log.attrs["source_files"] == ["run_8.csv", "run_9.csv", "run_11.csv", "run_12.csv"]
    note = next(note for note in log.attrs["notes"] if "run_10.csv" in note)
    assert "its time is between 1970-01-01T00:00:20.980 and 1970-01-01T00:00:33.000" in note
    with pytest.raises(FormatError, match=r"run_10\.csv"):
        read_log(archive, strict=True)
    with pytest.raises(FormatError, match=r"run_10\.csv"):
        read_log(archive[2])


def test_the_first_and_the_last_file_leave_no_gap(archive: list[Path]) -> None:
    empty(archive[0])
    log = load_log(archive)
    assert gap_table(log)["cause"].tolist() == ["missing"] * 3
    assert (
        "run_8.csv: the file is empty; copy it again; the file is left out: where no other file "
        "has its time" in said(log)
    )


def test_a_file_without_read_permission_is_left_out(archive: list[Path], monkeypatch) -> None:
    def refuse(path: Path) -> None:
        if path == archive[2]:
            raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr("gyrostab.ingest.files.refuse_unread", refuse)
    raw = read_log(archive)
    assert raw.attrs["unreadable_files"] == ["run_10.csv"]
    assert any("run_10.csv: cannot be read (Permission denied)" in n for n in raw.attrs["notes"])


def test_more_than_half_unreadable_is_an_error(archive: list[Path]) -> None:
    for path in archive[:3]:
        empty(path)
    with pytest.raises(
        FormatError, match=r"run_8.csv.*3 of 5 files cannot be read.*reading options"
    ):
        read_log(archive)
    with pytest.raises(FormatError, match="there is no such file"):
        read_log([path.with_suffix(".txt") for path in archive])
    two = read_log([archive[0], archive[4]])
    assert two.attrs["unreadable_files"] == ["run_8.csv"]


def test_wrong_option_is_not_taken_for_damage(archive: list[Path]) -> None:
    with pytest.raises(OptionError, match="no such column"):
        read_log(archive, map={"wx": "gyro_x"})
    with pytest.raises(FormatError, match="no reader takes this directory"):
        read_log([*archive, archive[0].parent])
    archive[1].write_text("time [s],gyro_x\n11,1\n11.02,2\n")
    with pytest.raises(MissingUnitError, match=r"run_9.csv"):
        read_log(archive)


def test_without_stamps_a_damaged_file_is_an_error(tmp_path: Path) -> None:
    paths = [tmp_path / f"{place}.csv" for place in range(3)]
    for path in paths:
        path.write_text("gyro_x [deg/h]\n1\n2\n")
    empty(paths[1])
    with pytest.raises(FormatError, match=r"1.csv: the file is empty.*no time stamps"):
        read_log(paths, rate=1)


@pytest.mark.parametrize("suffix", [".nc", ".zarr"])
def test_a_damaged_regular_log_becomes_a_gap(tmp_path: Path, suffix: str) -> None:
    values = signal(4000, holes=0)
    write = export.to_netcdf if suffix == ".nc" else export.to_zarr
    paths = [
        write(log, tmp_path / f"{place}{suffix}")
        for place, log in enumerate(cut(values, *((a, a + 1000) for a in range(0, 4000, 1000))))
    ]
    if suffix == ".nc":
        paths[1].write_bytes(paths[1].read_bytes()[:3000])
    else:
        for path in paths[1].glob(".z*"):
            path.write_text("{")
    log = read_log([*paths, tmp_path / f"2a{suffix}"])
    np.testing.assert_array_equal(log.rate[:, :1000], values[:, :1000])
    np.testing.assert_array_equal(log.rate[:, 2000:], values[:, 2000:])
    assert gap_table(log)[["samples", "cause"]].to_numpy().tolist() == [[1000, "unreadable"]]
    assert log.attrs["unreadable_files"] == [f"1{suffix}", f"2a{suffix}"]
    with pytest.raises(FormatError, match=rf"1\{suffix}"):
        read_log(paths, strict=True)


def test_raw_files_and_regular_logs_do_not_mix(archive: list[Path], tmp_path: Path) -> None:
    path = export.to_netcdf(log_of(signal(500)), tmp_path / "log.nc")
    with pytest.raises(
        OptionError, match=r"log.nc is a regular log already and run_8.csv is not.*gyrostab ingest"
    ):
        read_log([path, archive[0]])


def test_progress_is_reported_for_each_file(archive: list[Path]) -> None:
    reports: list[tuple[int, int, str]] = []
    log = load_log(
        archive, on_file=lambda number, total, path: reports.append((number, total, path.name))
    )
    assert reports == [(number, 5, f"run_{number + 7}.csv") for number in range(1, 6)]
    assert "on_file" not in log.attrs["history"]


def test_command_line_continues_unless_strict(
    archive: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    binary(archive[2])
    command = ["ingest", *map(str, archive), "--quiet-progress"]
    assert main([*command, "-o", str(tmp_path / "log.nc")]) == 0
    assert "run_10.csv" in capsys.readouterr().err
    with open_log(tmp_path / "log.nc") as log:
        assert log.attrs["unreadable_files"] == ["run_10.csv"]
        assert "unreadable" in set(gap_table(log)["cause"])
    assert main([*command, "-o", str(tmp_path / "second.nc"), "--strict"]) == 2
    assert "run_10.csv" in capsys.readouterr().err
    assert not (tmp_path / "second.nc").exists()
