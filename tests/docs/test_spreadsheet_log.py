"""The guide to logs with columns of other names: its file gives its command, which reads it."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import numpy as np

from gyrostab.io.opening import open_product
from tests.support.command_line import call

_PAGE = Path(__file__).parents[2] / "docs/how-to/spreadsheet-log.md"
_BLOCKS = re.findall(r"```(\w+)\n(.*?)```", _PAGE.read_text(encoding="utf-8"), re.DOTALL)
_ROWS = 1200


def _find_block(kind: str, begin: str) -> str:
    (text,) = (text for language, text in _BLOCKS if language == kind and text.startswith(begin))
    return text


def _write_log(path: Path) -> None:
    """Write the lines of the page, and rows of the same form after them."""
    values = np.random.default_rng(1).standard_normal((_ROWS, 3)) * 0.6 + (8.2, -3.1, 11.4)
    lines = _find_block("text", "Rig;").splitlines()
    for row in range(2, _ROWS):
        stamp = np.datetime64("2026-03-14T18:00:00.000", "ms") + 100 * row
        clock = str(stamp).split("T")[1][:10]
        numbers = (*values[row], 150 + row / 100, 0.1 + row % 7 / 100, row / 20)
        cells = (f"{number:.3f}".replace(".", ",") for number in numbers)
        lines.append(";".join(["14.03.2026", clock, *cells, "OK"]))
    path.write_text("\n".join(lines) + "\n", encoding="cp1252")


def test_the_file_of_the_page_is_read_by_its_commands(tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    _write_log(tmp_path / "run12.csv")
    assert call("scan", "run12.csv") == 0
    printed = capsys.readouterr().out.splitlines()[-1].removeprefix("# next: ")
    shown = shlex.split(_find_block("text", "gyrostab run").replace("\\\n", ""))
    assert shlex.split(printed) == shown
    assert call(*shown[1:], "--quiet-progress") == 0
    Path("mwd.toml").write_text(_find_block("toml", "# mwd.toml"), encoding="utf-8")
    same = ["run", "run12.csv", "-o", "same.nc", "--map", "mwd.toml", "--quiet-progress"]
    assert call(*same) == 0
    with open_product("product.nc") as product, open_product("same.nc") as other:
        assert {"temperature", "vibration", "rotation_rate"} <= {*product.data_vars}
        assert product["rotation_rate"].max() > 6.0 * 40.0  # 6 deg/s each, of 60 rpm at the end
        assert product.equals(other)
