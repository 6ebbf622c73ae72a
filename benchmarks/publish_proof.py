"""Put the figures of a finished `gyrostab prove` on docs/proof.md.

    python benchmarks/publish_proof.py proof

Takes table.md between the marks of the page, and the curves to docs/figures. Refuses runs of a
tuning seed. What stands before the marks, "What failed, and why" too, is written by hand and stays
as it is; where it speaks of another run that is said.
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path

from page import renew

from gyrostab.blindtest.runner.folder import FIRST_PUBLIC_SEED

DOCS = Path(__file__).resolve().parents[1] / "docs"
FIGURES = ("completeness", "reliability")


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
    """Renew the page and the figures, or say why not."""
    if not (run / "table.md").exists():
        raise SystemExit(
            f"{run}: holds no finished run; gyrostab prove --resume -o {run} finishes it"
        )
    job = json.loads((run / "benchmark.json").read_text(encoding="utf-8"))
    seed = job["seed"]
    if seed < FIRST_PUBLIC_SEED:
        raise SystemExit(
            f"{run}: was made with seed {seed}; seeds below {FIRST_PUBLIC_SEED} are for tuning, publish a run of another one"
        )
    page = docs / "proof.md"
    if f"Seed {seed}," not in page.read_text(encoding="utf-8"):
        print(
            f'{page}: "What failed, and why" was written of an earlier run; say there what failed in this one, and what was mended since'
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
