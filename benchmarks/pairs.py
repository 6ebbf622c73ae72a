"""Pairs of effects against each of them alone: what the search names in one environment.

    python benchmarks/pairs.py --draws 8 --group means --folder pairs
    python benchmarks/pairs.py --draws 8 --group means --folder pairs     (again: searches only)

Each draw of the generator of the blind test gives four records with the same noise, gaps and
channels: without an effect, with either, and with both. Both members should be named where each
alone is. The record without an effect gives null records and threshold of the draw; what the
searches start from is kept in the folder, so that a change of the search is measured in seconds.
"""

from __future__ import annotations

import argparse
import pickle
import sys
import time
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

from gyrostab.blindtest.generator.catalogue import CATALOGUE, merge_ambiguous
from gyrostab.blindtest.generator.record import make_channels, make_log, make_record
from gyrostab.blindtest.generator.scenario import stream
from gyrostab.blindtest.scenarios.case import describe_truth, draw_effects, draw_suitable
from gyrostab.blindtest.scenarios.plan import INCOMPATIBLE
from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.baseline.known_lines import remove_known_lines
from gyrostab.diagnose.evidence.folds import fold_blocks
from gyrostab.diagnose.identify.examination import Examination
from gyrostab.diagnose.identify.forward_search import name_effects
from gyrostab.diagnose.identify.nuisance_alternatives import nuisance_alternatives
from gyrostab.diagnose.identify.selection import select_effects
from gyrostab.diagnose.nulls.records import repeatable_null_records
from gyrostab.diagnose.predict.linear_model import initial_state
from gyrostab.diagnose.reduce.aligned_channels import align_channels
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.statistics.candidates import effect_candidates

NULLS = 100
MEMBERS = {"null": (), "first": (0,), "second": (1,), "both": (0, 1)}
#: Effects that share a statistic.
GROUPS = {
    "all": tuple(CATALOGUE),
    "means": (
        "vibration_rectification", "shupe", "temperature_bias", "thermal_hysteresis", "warm_up",
        "earth_rate", "rotation_line", "scale_factor", "bias_jump", "supply_bias", "telegraph",
        "ageing_bias",
    ),
    "powers": (
        "vibration_noise", "temperature_noise", "light_power_noise", "ageing_noise",
        "shared_source", "spectral_line", "logger_filter", "aliased_vibration", "gauss_markov",
        "feedback_reset", "held_samples", "spikes",
    ),
}  # fmt: skip


def main() -> None:
    """Name the effects of the records of each draw, and print the counts."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--draws", type=int, default=8)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1, help="below 1000000: for tuning")
    parser.add_argument("--group", choices=GROUPS, default="all")
    parser.add_argument("--folder", type=Path, required=True)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    options.folder.mkdir(parents=True, exist_ok=True)
    counts: Counter[str] = Counter()
    for index in range(options.first, options.first + options.draws):
        plan = plan_pair(index, options.seed, GROUPS[options.group])
        stored = options.folder / f"{options.group}-{options.seed}-{index}.pickle"
        if not stored.exists():
            stored.write_bytes(pickle.dumps(prepare_examinations(plan)))
        effects = zip(plan["names"], plan["strengths"], strict=True)
        print(f"{index}:", " + ".join(f"{name} {size:g}" for name, size in effects), flush=True)
        counts.update(count_draw(pickle.loads(stored.read_bytes())))
    print(", ".join(f"{key} {value}" for key, value in counts.items()))


def plan_pair(index: int, seed: int, names: tuple[str, ...]) -> dict[str, Any]:
    """Plan a draw: two effects of a strength at which most are named alone."""
    rng = stream(seed, "pairs", index)
    pair = {""}
    while pair == {""} or pair in INCOMPATIBLE:
        pair = {str(name) for name in rng.choice(names, 2, replace=False)}
    return {
        "index": index,
        "seed": seed,
        "kind": "pair",
        "names": sorted(pair),
        "strengths": [float(rng.choice([4.0, 8.0])) for _ in pair],
        "rate": 10.0,
        "seconds": round(float(rng.uniform(900.0, 2400.0))),
        "gaps": float(rng.uniform(0.0, 0.4)) if rng.random() < 0.3 else 0.0,
        "cuts": 0,
        "heavy": False,
        "degradation": None,
    }


def prepare_examinations(plan: dict[str, Any]) -> dict[str, tuple[Examination, dict[str, Any]]]:
    """Draw the four records; return what is searched in each, and the truth."""
    scenario = draw_suitable(plan, [CATALOGUE[name] for name in plan["names"]], 0)
    effects = draw_effects(plan, scenario)
    seed = int(stream(plan["seed"], "case", plan["index"]).integers(2**40))
    channels = make_channels(scenario, effects, stream(seed, "channels"))
    examinations: dict[str, tuple[Examination, dict[str, Any]]] = {}
    null: Any = None
    for part, members in MEMBERS.items():
        chosen = [effects[member] for member in members]
        record = make_record(scenario, chosen, seed=seed)
        log = make_log(record, channels, start=scenario.start, rate=scenario.rate)
        blocks = reduce_log(align_channels(log).log)
        baseline = calibrate_noise(blocks)
        blocks = remove_known_lines(blocks, baseline)
        if null is None:
            records = repeatable_null_records(blocks, baseline, NULLS, 0)
            null = name_effects(blocks, baseline, records())
        candidates = [
            *effect_candidates(blocks, baseline["coefficient"])[0],
            *nuisance_alternatives(blocks),
        ]
        examination = Examination(
            candidates,
            fold_blocks(blocks),
            null.count_evidence,
            null.threshold,
            initial_state(blocks, baseline),
        )
        strengths = [plan["strengths"][member] for member in members]
        truth = describe_truth(scenario, chosen, strengths=strengths)
        examinations[part] = examination, truth
    return examinations


def count_draw(examinations: dict[str, tuple[Examination, dict[str, Any]]]) -> Counter[str]:
    """Repeat the searches of a draw, print the names, and count what is named."""
    counts: Counter[str] = Counter()
    singles_named = True
    for part, (examination, truth) in examinations.items():
        started = time.process_time()
        identified, unidentified, *_ = select_effects(examination)
        seconds = time.process_time() - started
        true = [effect["name"] for effect in truth["effects"]]
        sets = [
            {identification.effect, *identification.alternatives} for identification in identified
        ]
        named = [any(names & merge_ambiguous(name) for names in sets) for name in true]
        right = set(truth["accepted"]).union(*map(merge_ambiguous, true))
        wrong = [
            identification.effect
            for identification in identified
            if not {identification.effect, *identification.alternatives} & right
        ]
        kind = part if part in ("null", "both") else "single"
        possible = kind != "both" or singles_named
        counts.update({
            kind: 1, f"{kind} named": bool(true) and all(named), f"{kind} wrong": len(wrong),
            "pairs possible": kind == "both" and singles_named,
            "pairs named": kind == "both" and singles_named and all(named),
            "seconds": round(seconds),
        })  # fmt: skip
        singles_named = singles_named and (kind == "null" or all(named))
        labels = [
            f"{name}({','.join(finding.axes)}) {finding.evidence_nats:.0f}"
            for name, finding in (
                *((identification.effect, identification) for identification in identified),
                *((mismatch.effect, mismatch) for mismatch in unidentified),
            )
        ]
        flag = "" if all(named) else "MISSED" if possible else "missed"
        print(f"  {part}: {', '.join(labels) or '-'} {flag} {'WRONG' if wrong else ''}", flush=True)
    return counts


if __name__ == "__main__":
    sys.exit(main())
