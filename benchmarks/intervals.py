"""How often the 95 % intervals of a diagnosis contain the true value.

Many records are fitted whose statistics are drawn from their laws.

    python benchmarks/intervals.py --output docs/diagnosis-method.md

Every record is an hour of a good gyro, three axes at 10 Hz: its block statistics are those of
noise, to which an effect is added; the fit knows the effect, not its size, and has the noise free.
"Wrong" forms are those that a fit cannot reproduce.
"""

from dataclasses import replace

import numpy as np
import xarray as xr
from page import make_parser, renew, table

from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.estimate.joint_fit import fit_identifications
from gyrostab.diagnose.identify.selections import Selection
from gyrostab.diagnose.nulls.records import null_records
from gyrostab.diagnose.predict.candidates import Component
from gyrostab.diagnose.predict.condition import condition_on
from gyrostab.diagnose.predict.linear_model import initial_state
from gyrostab.diagnose.statistics.build_candidates import effect_candidates
from tests.support.candidates import make_identifications, select_candidate
from tests.support.named import COEFFICIENT, record


def identify_effect(reduced, baseline, effect, statistic, column):
    """Return identifications of the effect on x, with the usual values of its other parameters."""
    known, reasons = effect_candidates(reduced, COEFFICIENT)
    candidate = select_candidate(known, effect, statistic)
    variant = next(
        variant
        for variant in candidate.variants
        if variant.columns == (column,) and variant.values.get("exponent", 1.0) == 1.0
    )
    components = (Component(candidate, variant, ("x",), 50.0),)
    identification = Selection(effect, candidate.driver, ("x",), components, 50.0, 8.0)
    return make_identifications([identification], initial_state(reduced, baseline), known, reasons)


def held(reduced, baseline, drawn, effect, statistic, column, truth, change):
    """Return the share of intervals that contain the true value, and the mean relative error."""
    identifications = identify_effect(reduced, baseline, effect, statistic, column)
    components = list(identifications.identified[0].components)
    inside, ratio = [], []
    for number in range(drawn.sizes["record"]):
        record = reduced.assign(
            mean=drawn["mean"].isel(record=number).transpose("axis", "block"),
            power=drawn["power"].isel(record=number).transpose("axis", "block", "band"),
        )
        state = condition_on(initial_state(change(record), baseline), components)
        (fitted,) = fit_identifications(replace(identifications, state=state), baseline)
        parameter = fitted.parameters[column]
        inside.append(parameter.low <= truth <= parameter.high)
        ratio.append(parameter.value / truth)
    return np.mean(inside), np.mean(ratio) - 1.0, np.std(ratio)


def cases(reduced):
    """Effect, statistic, parameter, level, form, true size, and what it does to a record."""
    g, heat = reduced["channel_vibration"].values, reduced["channel_temperature"].values
    warm = (heat - 25.0) / np.ptp(heat)

    def shifted(shape):
        return lambda record: record.assign(mean=record["mean"] + xr.DataArray(shape, dims="block"))

    def scale_noise(factor):
        return lambda record: record.assign(
            power=record["power"] * xr.DataArray(factor, dims="block")
        )

    for level, size in (("low", 0.1), ("high", 0.5)):
        for form, power in (("right", 2.0), ("wrong", 1.9)):
            change = shifted(size * (g / 6.0) ** power)
            yield "vibration_rectification", "mean", "sensitivity", level, form, size / 36.0, change
    for level, share in (("low", 0.2), ("high", 1.0)):
        for form, power in (("right", 2.0), ("wrong", 1.9)):
            change, size = scale_noise(1.0 + share * (g / 6.0) ** power), 0.003 * share**0.5 / 6.0
            yield "vibration_noise", "power", "white", level, form, size, change
    for level, size in (("low", 0.3), ("high", 2.0)):
        for form, bend in (("right", 0.0), ("wrong", 0.06)):
            shape = size * (warm + bend * (warm - warm.min()) * (warm.max() - warm))
            slope = size / np.ptp(heat)
            yield "temperature_bias", "mean", "sensitivity", level, form, slope, shifted(shape)


def main():
    """Fit, print."""
    parser = make_parser(__doc__)
    parser.add_argument("--records", type=int, default=200)
    options = parser.parse_args()
    count, reduced = options.records, record([])
    baseline, rng = calibrate_noise(reduced), np.random.default_rng(8)
    (drawn,) = null_records(reduced, baseline, count=count, rng=rng, chunk=count)
    rows = []
    for effect, statistic, column, level, form, truth, change in cases(reduced):
        share, bias, scatter = held(
            reduced, baseline, drawn, effect, statistic, column, truth, change
        )
        rows.append([effect, level, form, f"{share:.1%}", f"{bias:+.1%}", f"{scatter:.1%}"])
        print(*rows[-1], sep=" | ", flush=True)
    head = ["effect", "signal", "form", f"inside 95 %, of {count}", "bias", "scatter"]
    renew(options.output, "intervals", table(head, rows))


if __name__ == "__main__":
    main()
