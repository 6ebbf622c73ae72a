"""Write the result table and the page of a campaign."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from tests.fuzz.campaign import Tally
from tests.fuzz.server import LIMIT_BYTES, LIMIT_SECONDS

HEAD = (
    "| input | tried | exit 0 | exit 2 | exit 3 | failures | processor time, mean [ms] | "
    "slowest [s] | largest memory [MiB] |"
)


def table(totals: Mapping[str, Tally]) -> str:
    """Return the result table: one row for each format, and their sum."""
    whole = Tally()
    for tally in totals.values():
        whole.add(tally)
    rows = [HEAD, "|---|" + "---:|" * 8]
    for name, tally in [*totals.items(), ("**all**", whole)]:
        tried = tally.codes.total()
        mean = 1000.0 * tally.seconds / max(tried, 1)
        codes = " | ".join(f"{tally.codes[code]}" for code in "023")
        rows.append(
            f"| {name} | {tried} | {codes} | {len(tally.failures)} | {mean:.1f} | "
            f"{tally.slowest:.2f} | {tally.bytes / 2**20:.0f} |"
        )
    return "\n".join(rows)


def page(totals: Mapping[str, Tally], *, count: int, seed: int, jobs: int, seconds: float) -> str:
    """Return the page on damaged inputs, in Markdown."""
    tried = sum(tally.codes.total() for tally in totals.values())
    failures = [failure for tally in totals.values() for failure in tally.failures]
    kinds = Counter(
        f"{failure['format']}, `{failure['command']}`: {failure['code']}" for failure in failures
    )
    listed = (
        "\n".join(f"- {kind} ({number} inputs)" for kind, number in kinds.most_common()) or "None."
    )
    done = "" if tried == count else f"\nThe campaign was stopped after {tried} of {count} inputs."
    return PAGE.format(
        tried=tried,
        count=count,
        seed=seed,
        jobs=jobs,
        minutes=seconds / 60.0,
        speed=tried / max(seconds, 1e-9),
        table=table(totals),
        listed=listed,
        done=done,
        limit_seconds=LIMIT_SECONDS,
        limit_memory=LIMIT_BYTES / 2**20,
    )


PAGE = """# Damaged and hostile inputs

Whatever a file contains, gyrostab must exit with code 0 (done) or 2 (one message that names the
file), soon and in bounded memory. A run that continues from a damaged checkpoint may also exit with
3. Exit code 1, a traceback, a signal, more than {limit_seconds:.0f} s or
more than {limit_memory:.0f} MiB of additional memory for one of these tiny
inputs is a failure. An exception that the code of gyrostab raises is also a failure, even if it is
reported as a damaged file (`gyrostab.errors.DamageError`).

The inputs start from small valid files of every format. A mutator flips bits, overwrites counters
and sizes with critical integers, cuts, inserts, repeats and splices bytes, replaces tokens of text,
and removes or exchanges files of a folder. The rows *odd logs*, *odd options* and *odd models* are
well-formed inputs that hypothesis draws from grammars: stamps with bursts, repeats and clock steps,
extreme numbers, names and units. Each input is passed to `scan`, `ingest`, `run`, `davar` or
`simulate`. A child process, in which the program is already loaded, runs the commands; every input
is determined by the seed, the format and its number.

    make fuzz N=100000   # SEED=1 JOBS=2; start it again to continue a stopped campaign
    python -m tests.fuzz --replay fuzz-output/failures

## Results

Seed {seed}, jobs {jobs}: {tried} inputs took {minutes:.1f} minutes,
{speed:.0f} inputs per second.{done}

{table}

*Largest memory* is the growth of the resident memory during one call.

Failures:

{listed}

A short campaign is part of `make test-full`. Inputs that once failed are regression tests in
`tests/fuzz/regressions`.
"""
