"""Publish the figures of a finished `gyrostab prove` on docs/proof.md.

    python benchmarks/publish_proof.py proof

Copies table.md between the marks of the page, and the curves to docs/figures. Refuses runs of a
tuning seed. The text before the marks, including "What failed, and why", is written by hand and
stays as it is; a note is printed where it describes another run.
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path

from page import renew

from gyrostab.blindtest.runner.folder import FIRST_PUBLIC_SEED

DOCS = Path(__file__).resolve().parents[1] / "docs"
FIGURES = ("completeness", "reliability", "calibration")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path, help="folder of a finished run")
    parser.add_argument(
        "--docs", type=Path, default=DOCS, help="folder of the page and its figures"
    )
    options = parser.parse_args()
    publish(options.run, options.docs)


def publish(run: Path, docs: Path) -> None:
    """Replace the figures of the page, or exit with the reason."""
    if not (run / "table.md").exists():
        raise SystemExit(
            f"{run}: does not hold a finished run; gyrostab prove --resume -o {run} finishes it"
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
    pictures = [f"![{name} of the diagnosis](figures/proof-{name}.png)" for name in FIGURES]
    for name in FIGURES:
        shutil.copyfile(run / f"{name}.png", docs / "figures" / f"proof-{name}.png")
    renew(
        page,
        "proof",
        "\n\n".join([(run / "table.md").read_text(encoding="utf-8").strip(), *pictures]),
    )


if __name__ == "__main__":
    main()
