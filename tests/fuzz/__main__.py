"""Run a campaign: ``python -m tests.fuzz --count 100000 --jobs 2 --output docs/fuzzing.md``.

A stopped campaign continues when it is started again with the same seed and the same code;
``--fresh`` restarts it. ``--replay FOLDER`` tries saved failing inputs again.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import multiprocessing
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from pathlib import Path

from tests.fuzz.campaign import (
    BATCH,
    FORMATS,
    Tally,
    ignore_interrupts,
    load_input,
    run_batch,
    server,
)
from tests.fuzz.table import renew_results, results, table

ROOT = Path(__file__).parents[2]


def state_of_code() -> str:
    """Return a digest of the package and the harness; results of other code are not reused."""
    digest = hashlib.sha256()
    for path in sorted(
        [*(ROOT / "gyrostab").rglob("*.py"), *(ROOT / "tests" / "fuzz").glob("*.py")]
    ):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def batches(count: int, formats: Sequence[str], size: int) -> Iterator[tuple[str, int, int]]:
    """Yield format, first number and size of each batch, all formats in turn."""
    for first in range(0, -(-count // len(formats)), size):
        for place, form in enumerate(formats):
            total = count // len(formats) + (place < count % len(formats))
            if first < total:
                yield form, first, min(size, total - first)


def run(
    count: int, seed: int, jobs: int, formats: Sequence[str], *, work: Path, fresh: bool
) -> tuple[dict[str, Tally], float, bool]:
    """Try `count` inputs; return the tallies by format, the seconds, and whether it finished."""
    work.mkdir(parents=True, exist_ok=True)
    key = f"{state_of_code()} {seed}"
    done: dict[tuple[str, int, int], Tally] = {}
    earlier = 0.0
    log = work / "batches.jsonl"
    if fresh:
        log.unlink(missing_ok=True)
    for line in log.read_text().splitlines() if log.exists() else ():
        entry = json.loads(line)
        if entry["key"] == key:
            done[entry["format"], entry["first"], entry["count"]] = Tally.from_json(entry["tally"])
            earlier = entry["seconds"]
    size = min(BATCH, max(10, count // len(formats) // jobs + 1))
    planned = list(batches(count, formats, size))
    left = [batch for batch in planned if batch not in done]
    begun, complete = time.monotonic(), True
    failures = str(work / "failures")
    pool = ProcessPoolExecutor(
        jobs, mp_context=multiprocessing.get_context("spawn"), initializer=ignore_interrupts
    )
    try:
        pending = {}
        queue = iter(left)
        while True:
            while len(pending) < 2 * jobs and (batch := next(queue, None)):
                pending[pool.submit(run_batch, batch[0], seed, batch[1], batch[2], failures)] = (
                    batch
                )
            if not pending:
                break
            for future in wait(pending, return_when=FIRST_COMPLETED).done:
                batch = pending.pop(future)
                done[batch] = future.result()[2]
                seconds = earlier + time.monotonic() - begun
                names = ("key", "format", "first", "count", "seconds", "tally")
                entry = dict(zip(names, (key, *batch, seconds, done[batch].as_json()), strict=True))
                with log.open("a") as file:
                    file.write(json.dumps(entry) + "\n")
                tried = sum(tally.codes.total() for tally in done.values())
                failed = sum(len(tally.failures) for tally in done.values())
                print(
                    f"\r{tried} of {count} inputs, {failed} failures, "
                    f"{tried / max(seconds, 1e-9):.0f} inputs/s ",
                    end="",
                    flush=True,
                )
    except KeyboardInterrupt:
        complete = False
        for process in list(pool._processes.values()):
            process.terminate()  # their children end with them
    finally:
        pool.shutdown(wait=complete, cancel_futures=True)
    print()
    totals = {form: Tally() for form in formats}
    for batch in planned:
        if batch in done:
            totals[batch[0]].add(done[batch])
    return totals, earlier + time.monotonic() - begun, complete


def replay(folder: Path) -> int:
    """Try saved inputs again, print the results, and return the number of failures."""
    failed = 0
    for place in sorted(path.parent for path in folder.rglob("call.json")):
        item = load_input(place)
        outcome = server().try_input(item.files, item.command, item.main, item.options)
        right = outcome.is_right(may_be_interrupted=item.format == "checkpoint")
        failed += not right
        result = f"{outcome.code}, {outcome.seconds:.2f} s {outcome.text[-400:].strip()}"
        print(f"{'right' if right else 'WRONG'} {place.name} {item.command}: {result}")
    return failed


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--count", type=int, default=2000, help="inputs in all")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument(
        "--formats", nargs="*", default=list(FORMATS), choices=FORMATS, metavar="FORMAT"
    )
    parser.add_argument("--output", type=Path, help="Markdown page with markers for the results")
    parser.add_argument(
        "--work",
        type=Path,
        default=ROOT / "fuzz-output",
        help="folder for the state and the failing inputs",
    )
    parser.add_argument(
        "--fresh", action="store_true", help="restart the campaign instead of continuing it"
    )
    parser.add_argument("--replay", type=Path, help="folder of saved inputs to try again")
    given = parser.parse_args()
    if given.replay:
        return min(replay(given.replay), 1)
    totals, seconds, complete = run(
        given.count, given.seed, given.jobs, given.formats, work=given.work, fresh=given.fresh
    )
    print(table(totals))
    for failure in [failure for tally in totals.values() for failure in tally.failures]:
        print(
            f"{failure['format']}-{failure['name']} {failure['command']}: {failure['code']} "
            f"{failure['text']}"
        )
    if given.output:
        text = results(totals, count=given.count, seed=given.seed, jobs=given.jobs, seconds=seconds)
        renew_results(given.output, text)
    return int(not complete or any(tally.failures for tally in totals.values()))


if __name__ == "__main__":
    raise SystemExit(main())
