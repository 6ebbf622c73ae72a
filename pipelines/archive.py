"""Turn a folder of log files, days of them, into one product with a report and figures. Copy this file and its TOML, and change them.

    python archive.py [archive.toml]

The log may be larger than the memory: it goes to disk on a uniform time axis first, and every later step reads from there.
"""

import sys
import tomllib
from pathlib import Path

import gyrostab
from gyrostab.errors import GyrostabError
from gyrostab.scan import print_scan


def find_logs(folder, *, pattern):
    """List the files of the archive in the order of their names; gyrostab puts them in the order of time."""
    logs = sorted(folder.glob(pattern))
    if not logs:
        raise SystemExit(f"{folder} holds no file {pattern}; change [logs] in the TOML")
    return logs


def make_log(logs, target, *, reading):
    """Put all files on one uniform time axis, with a table of gaps, and open the result without loading it."""
    raw = gyrostab.read_log(logs, **reading)
    gyrostab.to_netcdf(gyrostab.regularise(raw), target, overwrite=True)
    return gyrostab.open_log(target)


def make_product(log, target, *, windows, fitting):
    """Compute the dynamic Allan variance of every axis, and fit the noise coefficients of every window."""
    surface = gyrostab.davar(log, **windows)
    gyrostab.to_netcdf(gyrostab.fit_noise(surface, **fitting), target, overwrite=True)
    return gyrostab.open_product(target)


def show(product):
    """Print a line for each axis: how much was recorded, and the angle random walk where it is observed."""
    for axis in product["axis"].values:
        part = product[["N", "observable", "window_coverage"]].sel(axis=axis).load()
        observed = part["N"].where(part["observable"].sel(term="N") == 2)
        recorded = float(part["window_coverage"].mean())
        print(f"axis {axis}: {recorded:.0%} recorded, N = {float(observed.median()):.3g} deg/sqrt(h), median over the windows")


def main(plan_file):
    """Run the steps; every path in the TOML starts at the folder of the TOML."""
    plan = tomllib.loads(plan_file.read_text(encoding="utf-8"))
    here = plan_file.resolve().parent
    results = here / plan["results"]["folder"]
    results.mkdir(parents=True, exist_ok=True)

    logs = find_logs(here / plan["logs"]["folder"], pattern=plan["logs"]["pattern"])
    print_scan(gyrostab.scan(logs, **plan["reading"]))

    log = make_log(logs, results / "log.nc", reading=plan["reading"])
    product = make_product(log, results / "product.nc", windows=plan["windows"], fitting=plan["fitting"])

    gyrostab.write_report(product, results / "report.html", log=log, overwrite=True)
    gyrostab.save_figures(product, results / "figures", overwrite=True)
    gyrostab.to_kalibr(product, results / "imu.yaml", overwrite=True)
    show(product)


if __name__ == "__main__":
    try:
        main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_suffix(".toml"))
    except GyrostabError as error:
        sys.exit(f"{error}")
