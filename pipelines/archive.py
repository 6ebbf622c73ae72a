"""Turn a folder of log files into one product with a report and figures.

    python archive.py [archive.toml]

Copy this file and its TOML, and change them. The log may be larger than memory: it is first written
to disk on a uniform time axis, and every later step reads from there. A run that was stopped
continues when it is started again. A damaged file leaves a gap, and the table lists it.
"""

import sys
import tomllib
from pathlib import Path

import gyrostab
from gyrostab.errors import GyrostabError
from gyrostab.ingest.scan_output import print_scan
from gyrostab.jobs.run import find_job_name, load_log, read_job_name, run


def find_logs(folder, *, pattern):
    """List the files of the archive by name; gyrostab sorts them by time."""
    logs = sorted(folder.glob(pattern))
    if not logs:
        raise SystemExit(f"{folder} holds no file {pattern}; change [logs] in the TOML")
    return logs


def make_log(logs, target, *, reading):
    """Place all files on one uniform time axis, unless `target` is of these files and options."""
    job = find_job_name(logs, reading=reading, windows={}, fitting=None)
    if read_job_name(target) != job:
        print_scan(gyrostab.scan(logs, **reading))
        log = load_log(logs, **reading).assign_attrs(gyrostab_job=job)
        gyrostab.to_netcdf(log, target, overwrite=True)


def show(product):
    """Print for each axis the share recorded and the angle random walk where it is observed."""
    for axis in product["axis"].values:
        part = product[["N", "observable", "window_coverage"]].sel(axis=axis).load()
        observed = part["N"].where(part["observable"].sel(term="N") == 2)
        recorded, median = float(part["window_coverage"].mean()), float(observed.median())
        print(f"axis {axis}: {100 * recorded:.0f} % recorded, median N {median:.3g} deg/sqrt(h)")


def main(plan_file):
    """Run the steps; every path in the TOML is relative to the folder of the TOML."""
    plan = tomllib.loads(plan_file.read_text(encoding="utf-8"))
    folder = plan_file.resolve().parent
    results = folder / plan["results"]["folder"]
    results.mkdir(parents=True, exist_ok=True)

    logs = find_logs(folder / plan["logs"]["folder"], pattern=plan["logs"]["pattern"])
    make_log(logs, results / "log.nc", reading=plan["reading"])
    target, steps = results / "product.nc", {key: plan[key] for key in ("windows", "fitting")}
    run([results / "log.nc"], target, **steps, resume=plan["results"]["resume"], overwrite=True)

    log, product = gyrostab.open_log(results / "log.nc"), gyrostab.open_product(target)
    gyrostab.write_report(product, results / "report.html", log=log, overwrite=True)
    gyrostab.save_figures(product, results / "figures", overwrite=True)
    gyrostab.to_kalibr(product, results / "imu.yaml", overwrite=True)
    show(product)


if __name__ == "__main__":
    try:
        main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_suffix(".toml"))
    except (GyrostabError, OSError) as error:
        sys.exit(f"{error}")
