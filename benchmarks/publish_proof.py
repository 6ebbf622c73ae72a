"""Publish the figures of a finished `gyrostab prove` on docs/proof.md.

    python benchmarks/publish_proof.py proof

Copies table.md between the marks of the page and the figures to docs/figures, and adds the line of
the run to the register of seeds. Refuses runs of a tuning seed. The text before the marks,
including "What failed, and why", is written by hand and stays as it is; a note is printed where it
describes another run.
"""

from __future__ import annotations

import json
import shutil
from datetime import date
from pathlib import Path
from typing import Any

from page import make_parser, renew

from gyrostab.blindtest.runner.folder import FIRST_PUBLIC_SEED

DOCS = Path(__file__).resolve().parents[1] / "docs"
FIGURES = ("completeness", "roc", "reliability", "calibration", "ranks")
#: Columns of the register, with the quantity of each in table.md.
REGISTER = {
    "named on null records": "false alarms: effect named on a null record",
    "detected, strength 1.5 or more": "detected, strength 1.5 or more",
    "of these named": "named correctly, of the detected (sets merged)",
    "intervals that contain the truth": "95 % intervals that contain the truth",
    "evidence relative to the oracle": "evidence relative to the oracle, median",
    "models nearer to the recording": (
        "simulated records nearer to the recording with the effects, without refit"
    ),
}


def main() -> None:
    parser = make_parser(__doc__, has_page=False)
    parser.add_argument("run", type=Path, help="folder of a finished run")
    parser.add_argument(
        "--docs", type=Path, default=DOCS, help="folder of the page and its figures"
    )
    options = parser.parse_args()
    publish(options.run, options.docs)


def publish(run: Path, docs: Path) -> None:
    """Replace the figures of the page, or exit with the reason."""
    files = ("table.md", *(f"{name}.png" for name in FIGURES))
    lacking = [name for name in files if not (run / name).exists()]
    if lacking:
        raise SystemExit(
            f"{run}: does not hold a finished run, or one of an earlier version ({lacking[0]} is "
            f"missing); gyrostab prove --resume -o {run} finishes it"
        )
    job = json.loads((run / "benchmark.json").read_text(encoding="utf-8"))
    seed = job["seed"]
    if seed < FIRST_PUBLIC_SEED:
        raise SystemExit(
            f"{run}: was made with seed {seed}; seeds below {FIRST_PUBLIC_SEED} are for tuning, "
            "publish a run of another seed"
        )
    page = docs / "proof.md"
    if f"Seed {seed}," not in page.read_text(encoding="utf-8"):
        print(
            f'{page}: "What failed, and why" describes an earlier run; '
            "describe what failed in this one, and what was fixed since"
        )
    table = (run / "table.md").read_text(encoding="utf-8").strip()
    pictures = [f"![{name} of the diagnosis](figures/proof-{name}.png)" for name in FIGURES]
    for name in FIGURES:
        shutil.copyfile(run / f"{name}.png", docs / "figures" / f"proof-{name}.png")
    renew(page, "proof", "\n\n".join([table, *pictures]))
    register(page, job, table)


def register(page: Path, job: dict[str, Any], table: str) -> None:
    """Add the line of a run to the register of seeds, or replace it."""
    figures = {cells[0]: cells[1:] for cells in map(split_line, table.splitlines()) if cells}
    entries = page.read_text(encoding="utf-8").split("<!-- register: begin -->")[1]
    lines = entries.split("<!-- register: end -->")[0].strip().splitlines()
    mine = f"| {job['seed']} |"
    opened = next((split_line(line)[2] for line in lines if line.startswith(mine)), date.today())
    cells = [str(value) for value in (job["seed"], job["begun"], opened, job["cases"])]
    cells.append(" then ".join(job["code"]))
    for column, quantity in REGISTER.items():
        value, number = (figures.get(quantity, ["-"] * 4)[place] for place in (0, 3))
        if column == "named on null records" and value != "-":
            value = f"{round(float(value) * int(number))} of {number}"
        cells.append(value)
    other_lines = [line for line in lines if not line.startswith(mine)]
    renew(page, "register", "\n".join([*other_lines, f"| {' | '.join(cells)} |"]))


def split_line(line: str) -> list[str]:
    """Split a line of a Markdown table into cells; other lines have none."""
    return [cell.strip() for cell in line.strip("|").split("|")] if line.startswith("|") else []


if __name__ == "__main__":
    main()
