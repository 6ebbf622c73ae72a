"""Turn a folder of log files, days of them, into one product with a report and figures. Copy this file and its TOML, and change them.

    python archive.py [archive.toml]

The log may be larger than the memory: it goes to disk on a uniform time axis first, and every later
step reads from there. Stopped at any moment, it goes on from there when it is started again. A
damaged file leaves a gap, and the table says so.
"""

import sys
import tomllib
from pathlib import Path

import gyrostab
from gyrostab.errors import GyrostabError
from gyrostab.ingest.scan import print_scan
from gyrostab.jobs.run import load_log, run


def find_logs(folder, *, pattern):
    """List the files of the archive in the order of their names; gyrostab puts them in the order of time."""
    logs = sorted(folder.glob(pattern))
    if not logs:
        raise SystemExit(f"{folder} holds no file {pattern}; change [logs] in the TOML")
    return logs


def is_current(target, *, sources):
    """Whether a result is there and younger than all that it was made of."""
    return target.exists() and all(
        source.stat().st_mtime < target.stat().st_mtime for source in sources
    )


def make_log(logs, target, *, reading):
    """Put all files on one uniform time axis, with a table of gaps."""
    print_scan(gyrostab.scan(logs, **reading))
    gyrostab.to_netcdf(load_log(logs, **reading), target, overwrite=True)


def show(product):
    """Print a line for each axis: how much was recorded, and the angle random walk where it is observed."""
    for axis in product["axis"].values:
        part = product[["N", "observable", "window_coverage"]].sel(axis=axis).load()
        observed = part["N"].where(part["observable"].sel(term="N") == 2)
        recorded = float(part["window_coverage"].mean())
        print(
            f"axis {axis}: {recorded:.0%} recorded, N = {float(observed.median()):.3g} deg/sqrt(h), median over the windows"
        )


def main(plan_file):
    """Run the steps; every path in the TOML starts at the folder of the TOML."""
    plan = tomllib.loads(plan_file.read_text(encoding="utf-8"))
    here = plan_file.resolve().parent
    results = here / plan["results"]["folder"]
    results.mkdir(parents=True, exist_ok=True)

    logs = find_logs(here / plan["logs"]["folder"], pattern=plan["logs"]["pattern"])
    if not is_current(results / "log.nc", sources=[*logs, plan_file]):
        make_log(logs, results / "log.nc", reading=plan["reading"])
    steps = {"windows": plan["windows"], "fitting": plan["fitting"]}
    run(
        [results / "log.nc"],
        results / "product.nc",
        **steps,
        resume=plan["results"]["resume"],
        overwrite=True,
    )

    log, product = (
        gyrostab.open_log(results / "log.nc"),
        gyrostab.open_product(results / "product.nc"),
    )
    gyrostab.write_report(product, results / "report.html", log=log, overwrite=True)
    gyrostab.save_figures(product, results / "figures", overwrite=True)
    gyrostab.to_kalibr(product, results / "imu.yaml", overwrite=True)
    show(product)


if __name__ == "__main__":
    try:
        main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_suffix(".toml"))
    except GyrostabError as error:
        sys.exit(f"{error}")
