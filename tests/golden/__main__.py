"""Record reference outputs of a commit and compare those of another one with them.

    python -m tests.golden record FOLDER [NAME ...]
    python -m tests.golden compare FOLDER [NAME ...] [--rtol 1e-9]

`compare` makes the outputs of the present code in a temporary folder and compares every number bit
for bit (or within `--rtol`), every dimension and unit, and every exit code. Text (statements, help,
history) may differ; how much of it does is shown. Both runs must be made on the same machine. The
exit code is 1 where a number differs or an output is missing.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from tests.golden.compare import compare_folders
from tests.golden.outputs import make_outputs


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("action", choices=["record", "compare"])
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*", help="parts of names; all outputs when absent")
    parser.add_argument("--rtol", type=float, default=0.0)
    given = parser.parse_args()
    if given.action == "record":
        make_outputs(given.folder.resolve(), given.names)
        return 0
    with tempfile.TemporaryDirectory(prefix="golden-") as name:
        made = make_outputs(Path(name), given.names)
        differences, texts = compare_folders(
            given.folder.resolve(), Path(name), made, rtol=given.rtol
        )
    print(*differences, sep="\n")
    print(f"{len(made)} outputs; differences: {len(differences)} in numbers, {texts} in text")
    return int(bool(differences))


if __name__ == "__main__":
    sys.exit(main())
