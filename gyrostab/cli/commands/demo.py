"""The first try."""

from __future__ import annotations

from pathlib import Path

from gyrostab.cli.frame import Output, app, show_stages
from gyrostab.cli.options import Common

__all__ = ["demo"]


@app.command(sort_key=0, help_epilogue="")
def demo(*, output: Output = Path("gyrostab-demo"), common: Common = Common()) -> None:
    """Run the main job on the simulated log that comes with gyrostab.

    Writes the product, the regular log, a report and figures into a folder, and prints the noise
    coefficients before, during and after the vibration.

    Example: gyrostab demo -o demo-output

    Parameters
    ----------
    output
        Folder to write into.
    """
    from gyrostab.jobs.demo import format_summary, run_demo

    with show_stages(common) as stage:
        summary, files = run_demo(output, overwrite=common.overwrite, stage=stage)
    print(format_summary(summary))
    print("\nwritten:", *(f"  {file}" for file in files), sep="\n")
