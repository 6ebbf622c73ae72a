"""The page on `diagnosis.nc` lists what the file holds."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.result.surfaces import make_surfaces
from gyrostab.ingest.make_log import make_log

PAGE = Path(__file__).parents[3] / "docs" / "diagnosis.md"


def test_page_lists_the_variables_with_their_dimensions_and_units():
    rates = np.random.default_rng(1).standard_normal((2, 12_000))
    temperature = np.linspace(20.0, 30.0, 12_000)
    log = make_log(rates, rate=20.0, unit="deg/h", channels={"temperature": (temperature, "degC")})
    blocks = reduce_log(log)
    baseline = calibrate_noise(blocks)
    surfaces = make_surfaces(blocks, baseline, baseline)
    page = PAGE.read_text(encoding="utf-8")
    (table,) = re.findall(r"<!-- surfaces: begin -->\n(.*)<!-- surfaces: end -->", page, re.DOTALL)
    listed = {}
    for row in table.splitlines()[2:]:
        names, dimensions, unit, _ = (cell.strip() for cell in row.strip("|").split("|"))
        for name in re.findall(r"`(\w+)`", names.replace("NAME", "temperature")):
            listed[name] = ({*dimensions.split(", ")}, unit.strip("`"))
    unit, _ = listed["channel_temperature"][1], listed.pop("channel_temperature")
    assert unit == "as in the product"
    assert listed == {
        str(name): ({*map(str, variable.dims)}, variable.attrs.get("units") or "–")
        for name, variable in surfaces.variables.items()
        if name not in ("case", "axis", "channel_temperature")
    }
    assert "channel_temperature" in surfaces
