"""What is compiled ahead is what an analysis calls: no kernel of the fit is compiled again."""

from __future__ import annotations

import subprocess
import sys

CODE = """
import sys
import numpy as np
from gyrostab.allan.compile_fit import compile_fit

def compiled():
    found = {}
    for name, module in list(sys.modules.items()):
        if name.startswith("gyrostab.kernels.fit."):
            for item in vars(module).values():
                if hasattr(item, "signatures") and item._cache.cache_path:
                    found[item.__module__, item.__name__] = set(item.signatures)
    return found

compile_fit()
before = compiled()

from gyrostab.allan.davar import davar
from gyrostab.allan.fit import fit_noise
from gyrostab.ingest.make_log import make_log

rate = np.random.default_rng(1).standard_normal((2, 6000))
for lost in (0, 500):
    rate[:, 3000 : 3000 + lost] = np.nan
    product = fit_noise(davar(make_log(rate, rate=10.0, unit="deg/h"), window="1min"))
    assert bool(product["N"].notnull().any())
after = compiled()
assert sum(map(len, before.values())) >= 5, before
assert after == before, {name: after[name] - before.get(name, set()) for name in after}
"""


def test_an_analysis_needs_no_more_kernels_of_the_fit() -> None:
    subprocess.run([sys.executable, "-c", CODE], check=True)
