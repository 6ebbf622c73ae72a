"""Write the results of a campaign."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path

from gyrostab import __version__
from gyrostab.store.output import replace_file
from tests.fuzz.campaign import Tally

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


BEGIN, END = "<!-- campaign: begin -->\n", "<!-- campaign: end -->"


def renew_results(page: Path, text: str) -> None:
    """Replace the results on a page, between its markers, and leave all else as written."""
    before, rest = page.read_text(encoding="utf-8").split(BEGIN)
    with replace_file(page) as part:
        part.write_text(f"{before}{BEGIN}{text}\n{END}{rest.split(END)[1]}", encoding="utf-8")


def results(
    totals: Mapping[str, Tally], *, count: int, seed: int, jobs: int, seconds: float
) -> str:
    """Return the results of a campaign, in Markdown, for the page on damaged inputs."""
    tried = sum(tally.codes.total() for tally in totals.values())
    failures = [failure for tally in totals.values() for failure in tally.failures]
    kinds = Counter(
        f"{failure['format']}, `{failure['command']}`: {failure['code']}" for failure in failures
    )
    listed = (
        "\n".join(f"- {kind} ({number} inputs)" for kind, number in kinds.most_common()) or "None."
    )
    stopped = (
        "" if tried == count else f" The campaign was stopped after {tried} of {count} inputs."
    )
    return (
        f"Seed {seed}, jobs {jobs}: {tried} inputs took {seconds / 60.0:.1f} minutes, "
        f"{tried / max(seconds, 1e-9):.0f} inputs per second, with gyrostab {__version__}."
        f"{stopped}\n\n"
        f"{table(totals)}\n\nFailures:\n\n{listed}"
    )
