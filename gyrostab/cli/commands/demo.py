"""The demonstration command."""

from __future__ import annotations

from pathlib import Path

from gyrostab.cli.frame import Output, app, show_stages
from gyrostab.cli.options import Common

__all__ = ["demo"]


@app.command(sort_key=0, help_epilogue="")
def demo(*, output: Output = Path("gyrostab-demo"), common: Common = Common()) -> None:
    """Run the whole analysis on the log shipped with gyrostab, a simulated day.

    Writes the product, the log, a report and figures to a folder, and prints the noise coefficients
    for warm-up, rest, vibration and rest.

    Example: gyrostab demo -o demo-output

    Parameters
    ----------
    output
        Folder to write to.
    """
    with show_stages(common) as stage:
        stage("loading the libraries")
        from gyrostab.allan.compile_fit import compile_fit_ahead
        from gyrostab.jobs.demo import format_summary, run_demo

        compile_fit_ahead()
        product, files = run_demo(output, overwrite=common.overwrite, stage=stage)
    print("written:", *(f"  {file}" for file in files), sep="\n", end="\n\n")
    print(format_summary(product))
