"""Kill runs of the command line at random moments, continue them, and compare the products.

    python benchmarks/kill.py [--kills 50] [--seed 1] [--hours 6]

Each run is a separate process, `gyrostab run`, killed with SIGKILL (with its worker processes,
where it has some) at a moment drawn evenly over the time that an undisturbed run takes; some runs
are killed several times before they may finish. One run in three works with processes instead of
threads. At the end one of them is given the wrong options, which must be refused.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

WINDOW = ("--window", "10min", "--step", "1min", "--taus", "20", "--quiet-progress")


def write_log(path: Path, hours: float) -> Path:
    """Three axes at 100 Hz with a gap, and a temperature every second."""
    from gyrostab import make_log, to_netcdf

    rng = np.random.default_rng(3)
    rate = 5.0 + 0.02 * np.rint(900.0 * rng.standard_normal((3, round(hours * 360_000))))
    rate[:, rate.shape[1] // 3 : rate.shape[1] // 3 + 5000] = np.nan
    log = make_log(rate, rate=100.0, unit="deg/h", start="2026-05-01")
    stamps = log["time"].values[::100]
    log = log.assign_coords(time_temperature=stamps)
    log["temperature"] = (
        "time_temperature",
        20.0 + np.arange(stamps.size) / 1000.0,
        {"units": "degree_Celsius"},
    )
    return to_netcdf(log, path)


def start(log: Path, output: Path, *options: str) -> subprocess.Popen[str]:
    """Begin a run as a user does, in a separate process group."""
    command = [
        sys.executable,
        "-c",
        _COMMAND,
        "run",
        str(log),
        "-o",
        str(output),
        *WINDOW,
        *options,
    ]
    environment = {**os.environ, "SOURCE_DATE_EPOCH": "1700000000"}
    return subprocess.Popen(
        command,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


# The command line itself, with parts of one unit of work, so that this short log has as many as a
# long one.
_COMMAND = """
import sys
if __name__ == "__main__":
    from gyrostab.allan.davar import davar_parts
    davar_parts.__kwdefaults__["samples"] = 1
    from gyrostab.__main__ import main
    sys.exit(main())
"""


def finish(run: subprocess.Popen[str]) -> tuple[int, str]:
    _, message = run.communicate(timeout=900)
    return run.returncode, message


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--hours", type=float, default=6.0)
    given = parser.parse_args()
    draw = random.Random(given.seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        log = write_log(folder / "log.nc", given.hours)
        finish(start(log, folder / "whole.nc"))  # compiles
        begun = time.perf_counter()
        code, message = finish(start(log, folder / "whole.nc", "--overwrite"))
        seconds = time.perf_counter() - begun
        assert code == 0, message
        whole = hashlib.sha256((folder / "whole.nc").read_bytes()).hexdigest()
        kills = parts = runs = 0
        bad: list[str] = []
        while kills < given.kills:
            output = folder / f"product{runs}.nc"
            options = ("--scheduler", "processes") if runs % 3 == 2 else ()
            while (
                not output.exists()
                and kills < given.kills
                and (runs % 5 == 0 or not folder.joinpath(f".{output.name}.job").exists())
            ):
                run = start(log, output, "--resume", *options)
                time.sleep(draw.uniform(0.0, seconds))
                if run.poll() is None:
                    os.killpg(run.pid, signal.SIGKILL)
                    kills += 1
                finish(run)
                if not output.exists() and draw.random() < 0.3:
                    break
            parts += len(list(folder.joinpath(f".{output.name}.job").glob("*.block")))
            code, message = finish(start(log, output, "--resume", *options))
            left = [
                path.name
                for path in folder.iterdir()
                if output.name in path.name and path != output
            ]
            if code or left or hashlib.sha256(output.read_bytes()).hexdigest() != whole:
                bad.append(f"run {runs}: exit {code}, left {left}: {message}")
            runs += 1
        code, message = finish(start(log, output, "--resume", "--terms", "N"))
        print(
            f"seed {given.seed}: {kills} kills in {runs} runs of {seconds:.1f} s; {parts} parts "
            "were found again"
        )
        print(f"{len(bad)} of {runs} products differ from the undisturbed one")
        print(f"resume with another option: exit {code}, {message.strip()}")
        print(*bad, sep="\n")
    return 1 if bad or code != 2 else 0


if __name__ == "__main__":
    sys.exit(main())
