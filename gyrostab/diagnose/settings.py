"""Numbers that decide what a diagnosis reports: value, unit and source of each.

Other numbers are local to their modules: those that define what a block or a statistic measures,
because null records are measured and scored alike, and those that set only the accuracy or the cost
of a computation. `benchmarks/settings_sensitivity.py` scales each of them and compares the
diagnoses; `benchmarks/settings_derivations.py` computes probabilities that some of them come from.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any

#: Probabilities at the ends of all reported intervals; `diagnosis.json` fixes them to 95 %.
INTERVAL_TAILS = (0.025, 0.975)


def _make_setting(value: float, unit: str, meaning: str, source: str) -> Any:
    return field(default=value, metadata={"unit": unit, "meaning": meaning, "source": source})


@dataclass(frozen=True, kw_only=True, repr=False)
class Settings:
    """Numbers that decide what a diagnosis reports.

    Each field has the metadata ``unit``, ``meaning`` and ``source``: the derivation, the citation
    or the script that the default comes from. The defaults are in ``DEFAULTS``.

    Raises
    ------
    ValueError
        When a number is negative or not finite.

    Examples
    --------
    >>> strict = Settings(ambiguous_nats=4.6)  # odds of 100 to 1
    >>> strict, strict.reject_nats
    (Settings(ambiguous_nats=4.6), 9.2)
    """

    majority_share: float = _make_setting(
        0.5,
        "1",
        "Share that makes a part the larger one: common time of two regions that are one, "
        "blocks that a motion may move, evidence that a filter leaves of a line, variance of "
        "a switching course that another effect explains, Q^2 of an angle counter, equal share of "
        "what several effects explain of a mismatch, correlation of a time-shifted surrogate with "
        "its channel, amplitude at the averaging times of a region divided by the largest.",
        "nearer to the whole than to nothing; no other value separates two alternatives equally",
    )
    component_nats: float = _make_setting(
        2.0,
        "nat",
        "Evidence that an axis must add to be named with the others.",
        "odds of 7 to 1: positive evidence is 1 to 3 nats (Kass and Raftery, 1995)",
    )
    ambiguous_nats: float = _make_setting(
        3.0,
        "nat",
        "Difference of evidence within which two effects are alternatives, beyond what an error of "
        "form costs, and by which another form must be better than a jump or two levels.",
        "odds of 20 to 1, ln 20 = 3.0 (strong evidence: Kass and Raftery, 1995, "
        "doi:10.1080/01621459.1995.10476572)",
    )
    disagreement_nats: float = _make_setting(
        8.0,
        "nat",
        "Half of the chi-square by which the eighths of a record may differ, or spectrum and means "
        "about B and K.",
        "chi-square of 16: P = 0.025 with 7 and 0.0003 with 2 degrees of freedom",
    )
    form_error_share: float = _make_setting(
        0.01,
        "1",
        "Share of the evidence of an effect that an error of its form may leave to others.",
        "choice: square of a size error of 10 %, as evidence grows with the square of the size",
    )
    spectrum_error_share: float = _make_setting(
        0.1,
        "1",
        "Share of the evidence that an error of the spectrum, or of the course in time, may leave.",
        "choice: square of a size error of 32 %; 0.08 occurs in simulated strong vibration",
    )
    size_error_share: float = _make_setting(
        0.04,
        "1",
        "Error of the form of an effect as a share of its size, added to its standard error.",
        "coverage of intervals with wrong forms: docs/diagnosis-method.md, benchmarks/intervals.py",
    )
    clear_sigma: float = _make_setting(
        3.0,
        "standard error",
        "Distance from its allowed range at which a size is impossible, from the earlier level at "
        "which the level after an event is another one, from noise at which a cell belongs to the "
        "mismatch next to it, and from a known sine at which a stronger one is another.",
        "two-sided P = 0.0027 for a normal error",
    )
    visible_sigma: float = _make_setting(
        2.0,
        "standard error",
        "Size of a harmonic of the rotation below which it is dropped, and score of a short window "
        "that belongs to a mismatch of a long one.",
        "two-sided P = 0.046 for a normal error",
    )
    min_switches: float = _make_setting(
        5.0,
        "switch",
        "Expected switches below which a bias has no two levels.",
        "choice: one or two switches are jumps",
    )
    two_level_nats: float = _make_setting(
        10.0,
        "nat",
        "Evidence by which two levels within blocks must exceed normal noise of any spectrum.",
        "twice the 5 nats of very strong evidence (Kass and Raftery, 1995), as an "
        "autoregression fits the spectrum of the rival, normal noise",
    )
    surrogate_share: float = _make_setting(
        0.05,
        "1",
        "Share of a channel and its time-shifted surrogates that may explain as much as it.",
        "usual level of a test",
    )
    term_correlation: float = _make_setting(
        0.999,
        "1",
        "Correlation of the errors of two terms above which the data do not separate them.",
        "standard errors are 1 / sqrt(1 - r^2) = 22 times those of one term",
    )
    fast_blocks: float = _make_setting(
        2.0,
        "block",
        "Mean time on a level up to which sub-blocks show two levels better than block means.",
        "choice: a course of shorter stays is rarely on one level for a whole block",
    )
    refuted_blocks: float = _make_setting(
        3.0,
        "block",
        "Mean time on a level up to which sub-blocks can refute a telegraph bias.",
        "choice: sub-blocks show every switch, blocks of one level only from there",
    )
    max_level_sigma: float = _make_setting(
        8.0,
        "standard deviation",
        "Deviation of the noise level of a block beyond which it is clipped.",
        "choice: one block adds 32 nats at most to the evidence of a level that wanders",
    )
    max_event_share: float = _make_setting(
        0.1,
        "1",
        "Share of the record that an event between two equal levels lasts at most.",
        "choice: longer ones are two jumps",
    )
    reweight_thresholds: float = _make_setting(
        3.0,
        "threshold",
        "Evidence of the strongest power, from which all powers are weighted with it.",
        "choice: an effect of three thresholds raises some powers several times",
    )
    min_comb_lines: int = _make_setting(
        3, "1", "Lines that may be one comb.", "two lines define a spacing; the third tests it"
    )
    min_fringe_step: float = _make_setting(
        6e4,
        "degree hour-1",
        "Smallest step that may be a fringe hop.",
        "one fringe, lambda c / (L D), of 5 km of fiber on a coil of 30 cm at 1.55 um",
    )
    min_rotation_share: float = _make_setting(
        1e-5,
        "1",
        "Share of the rotation that an axis must sense for real motion.",
        "choice: alignment of 10 urad (2 arcsec), beyond that of any mounting",
    )
    max_misalignment_share: float = _make_setting(
        0.02,
        "1",
        "Share of the rotation that an axis across it may sense; a larger one is along it.",
        "choice: sine of 1.1 degrees, a coarse mounting error",
    )
    step_power_ratio: float = _make_setting(
        5.0,
        "1",
        "Squared step of the mean times the length of a block, divided by the noise density of "
        "its lowest band, above which the mean moves within the block.",
        "a step of D within T seconds adds D^2 T / pi^2 to the density at 1 / T: half of the noise",
    )
    rest_sigma: float = _make_setting(
        6.0,
        "standard deviation",
        "Distance from the level at rest within which the mean of a block is at rest.",
        "choice: P = 2e-9 for normal noise; means that wander scatter more",
    )
    motion_sigma: float = _make_setting(
        100.0,
        "standard deviation",
        "Distance from the level at rest that an unexplained motion must reach to be left out.",
        "choice: smaller motion is left to the effects; a rotation of the tool exceeds it by far",
    )
    max_moving_share: float = _make_setting(
        2.0 / 3.0,
        "1",
        "Largest share of the blocks in which an axis may move if its level at rest is taken from "
        "the closest quarter of the means; otherwise the steadiest stretch gives the level.",
        "choice: a third at rest contains the quarter",
    )
    motion_margin_blocks: int = _make_setting(
        2,
        "block",
        "Blocks on either side of a motion that belong to it.",
        "choice: a ramp at its begin and end",
    )
    min_rest_blocks: int = _make_setting(
        12,
        "block",
        "Blocks at rest that determine level and scatter.",
        "scatter to 20 %: 1/sqrt(2n)",
    )

    # calibration of the noise
    calm_share: float = _make_setting(
        0.2,
        "1",
        "Quantile of vibration and rotation over the blocks that is their level at rest.",
        "choice: below `quiescent_share`, so that a quarter at rest suffices",
    )
    calm_ratio: float = _make_setting(
        2.0,
        "1",
        "Ratio of vibration or rotation to its level at rest up to which a block is quiescent.",
        "choice: noise by rectification is then 4 times that at rest",
    )
    calm_slope_share: float = _make_setting(
        0.3,
        "1",
        "Rate of change of temperature up to which a block is quiescent, as a share of the "
        "largest.",
        "choice: a Shupe bias is then below a third of its largest",
    )
    noisy_sigma: float = _make_setting(
        4.5,
        "standard deviation",
        "Excess of the noise level of a block above which it is not quiescent.",
        "P = 8e-6 a block of 1000 lines, 0.008 in 1000 blocks; 6e-5 with 49 lines "
        "(benchmarks/settings_derivations.py)",
    )
    excess_sigma: float = _make_setting(
        4.0,
        "standard deviation",
        "Excess above which the noise of the mean of a block is raised, and difference from the "
        "noise terms above which a band does not count in the noise of means, or has a separate "
        "form in a simulation.",
        "P = 6e-5 a block of 1000 lines, 0.06 in 1000 blocks, and then by the excess "
        "(benchmarks/settings_derivations.py)",
    )
    quiescent_share: float = _make_setting(
        0.25,
        "1",
        "Share of the blocks that must be quiescent; below it the quietest are taken.",
        "choice: the error of N from a quarter of a record is twice that from the whole",
    )
    min_quiescent_blocks: int = _make_setting(
        16,
        "block",
        "Quiescent blocks that must be found; below it the quietest are taken.",
        "choice: drift is known up to 16 blocks",
    )
    steady_share: float = _make_setting(
        0.3,
        "1",
        "Share of the blocks at rest that must be left without the noisy ones; below it all stay.",
        "choice: the noise of a third of the record or more is not an event",
    )
    min_information_share: float = _make_setting(
        1e-4,
        "1",
        "Share of its information that N must keep with the effects in the model.",
        "the standard error of N is then 100 times that without effects, above N itself",
    )
    max_level_step: float = _make_setting(
        0.2,
        "1",
        "Relative change of the noise level from block to block, above which kurtosis and "
        "outliers are not those of steady noise.",
        "excess kurtosis 3 var(s^2) / mean(s^2)^2 = 0.01 for a linear change of 0.2 within a "
        "block, the error sqrt(24 / n) of n = 240 000 samples",
    )
    after_restart_s: float = _make_setting(
        900.0,
        "s",
        "Time after a restart that is not quiescent, at most a tenth of the record.",
        "choice: warm-up of a fiber-optic gyro without temperature control, some minutes",
    )
    coherency_probability: float = _make_setting(
        1e-4,
        "1",
        "Chance probability of the coherency of two axes of a simulation below which it is real.",
        "three pairs of axes add 3e-4, 3 % of the default false-alarm probability",
    )
    known_line_sigma: float = _make_setting(
        5.0,
        "standard error",
        "Excess over a known line above which it is another line.",
        "P = 7e-4 a line and part of the shortest record, 5e-6 of 1000 blocks "
        "(benchmarks/settings_derivations.py)",
    )
    line_nats: float = _make_setting(
        12.0,
        "nat",
        "Evidence of a line of a simulation above which it is known.",
        "the largest evidence of 1000 lines of noise is 7.3 nats in 400 records of 24 blocks, "
        "and 3.0 of 1000 blocks (benchmarks/settings_derivations.py)",
    )
    # thresholds from null records
    tail_share: float = _make_setting(
        0.25,
        "1",
        "Share of the null records, the largest, to which an exponential tail is fitted.",
        "a hundred of the 400 null records: the scale of the tail is known to 10 %",
    )
    pooled_records: float = _make_setting(
        100.0,
        "null record",
        "Weight of the variance over windows of one length in the variance of a cell.",
        "choice: as many records give the variance of a single cell to sqrt(2 / n) = 14 %",
    )
    # regions of mismatches
    window_sum_share: float = _make_setting(
        0.8,
        "1",
        "Share of the score of a window that its short windows must reach to set its ends.",
        "choice: the share is 1 for a constant deviation; moves the ends of regions",
    )
    whole_record_sigma: float = _make_setting(
        0.7,
        "standard deviation",
        "Score by which a part of the record must exceed the whole to be the region.",
        "choice; moves the ends of regions",
    )
    gap_time_share: float = _make_setting(
        0.25,
        "1",
        "Gap between two regions that are one, as a share of the longer.",
        "choice; moves the ends of regions",
    )
    line_tau_ratio: float = _make_setting(
        4.0,
        "1",
        "Ratio of the averaging time to that at which the Allan variance of a line is largest, "
        "up to which the line shows.",
        "the variance of a sine, sin(x)^4 / x^2, falls to 0.09 of its largest value above, to 0.15 "
        "below",
    )
    line_width_share: float = _make_setting(
        0.02,
        "1",
        "Difference of two frequencies that are one line, as a share of the frequency.",
        "choice: slow changes of the speed of a pump or a tool",
    )
    max_mean_regions: int = _make_setting(
        3,
        "region",
        "Regions of the mean of an axis beyond which its mean wanders.",
        "choice; one mismatch of a wandering mean replaces many",
    )
    # attribution of mismatches to effects, and verdict
    active_share: float = _make_setting(
        0.1,
        "1",
        "Share of the largest contribution of an effect above which it acts, and of its largest "
        "step above which it moves the rate within a block.",
        "choice: 1 % of the largest power",
    )
    overlap_share: float = _make_setting(
        0.3,
        "1",
        "Share of the shorter of effect and mismatch that must overlap for them to coincide.",
        "choice: the ends of a region are known to one of its short windows",
    )
    outlier_law_error: float = _make_setting(
        0.1,
        "1",
        "Relative error of number and size of outliers, as the law of their sizes is unknown.",
        "choice; at least half of the logarithm of the share of outliers that is seen",
    )
    coverage_tolerance: float = _make_setting(
        0.013,
        "1",
        "Fall of the share of cells within their 95 % band that counts as worse.",
        "two standard errors, 2 sqrt(0.95 * 0.05 / 1080): 36 stretches, 3 windows, 10 averaging "
        "times",
    )

    max_delay_s: float = _make_setting(
        300.0,
        "s",
        "Largest delay of a channel against the rates that is looked for.",
        "choice: clocks that are set by hand differ by minutes",
    )

    set_probability: float = _make_setting(
        0.966,
        "1",
        "Probability that an effect of large evidence, or one of its alternatives, is right.",
        "fitted to 271 names of seed 555452035 (benchmarks/name_probability.py fits others)",
    )
    even_odds_nats: float = _make_setting(
        7.3,
        "nat",
        "Evidence at which an identified effect or one of its alternatives is right at even odds.",
        "fitted to 271 names of seed 555452035 (benchmarks/name_probability.py fits others); the "
        "log score of 59 names of another simulator improves by 3.7 nats",
    )
    alternative_weight: float = _make_setting(
        0.2,
        "1",
        "Probability of an alternative with equal evidence, relative to the name.",
        "fitted to 271 names of seed 555452035 (benchmarks/name_probability.py fits others)",
    )

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if not (math.isfinite(value) and value >= 0.0):
                raise ValueError(f"{item.name}={value!r}: give a number from 0 up")

    def __repr__(self) -> str:
        changed = {
            item.name: value
            for item in fields(self)
            if (value := getattr(self, item.name)) != item.default
        }
        return f"Settings({', '.join(f'{name}={value!r}' for name, value in changed.items())})"

    @property
    def min_surrogates(self) -> int:
        """Time-shifted surrogates without which a channel is not tested.

        Fewer cannot show that the channel is among the `surrogate_share` that explain most.
        """
        return math.ceil(1.0 / self.surrogate_share) if self.surrogate_share else 1

    @property
    def score_error_share(self) -> float:
        """Share of the score of a mismatch that an error of the form of its effect may leave.

        The root of `spectrum_error_share`, because evidence is the square of a score.
        """
        return math.sqrt(self.spectrum_error_share)

    @property
    def reject_nats(self) -> float:
        """Evidence that rejects the simpler of two forms, such as one filter for all axes [nats].

        The square of the odds of `ambiguous_nats`.
        """
        return 2.0 * self.ambiguous_nats

    @property
    def refuting_nats(self) -> float:
        """Evidence of means within blocks, not of two levels, that refutes a telegraph bias [nats].

        The square of the odds of `two_level_nats`.
        """
        return 2.0 * self.two_level_nats

    @property
    def misfit_nats(self) -> float:
        """Model error of two levels that each switch may have: 1 nat with the fewest switches."""
        return 1.0 / max(self.min_switches, 1.0)

    @property
    def rest_share(self) -> float:
        """Share of the largest contribution below which an effect rests: half of `active_share`.

        Also the share of the blocks at rest that makes zero its level at rest.
        """
        return 0.5 * self.active_share

    def allow_form_error(self, evidence_nats: float) -> float:
        """Return by how much another form must be better than one with this evidence [nats]."""
        return self.ambiguous_nats + self.form_error_share * evidence_nats

    @classmethod
    def table(cls) -> str:
        """Return the settings with value, unit, meaning and source as a Markdown table."""
        rows = [
            f"| `{item.name}` | {item.default:.4g} | {item.metadata['unit']} | "
            f"{item.metadata['meaning']} | {item.metadata['source']} |"
            for item in fields(cls)
        ]
        return "\n".join(
            ["| name | value | unit | meaning | source |", "|---|---|---|---|---|", *rows]
        )

    def to_dict(self) -> dict[str, float]:
        """Return the numbers by name."""
        return asdict(self)


DEFAULTS = Settings()


def stored_settings(values: Mapping[str, Any]) -> Settings:
    """Make settings of those that a diagnosis recorded, perhaps with another version of gyrostab.

    Names that this version does not know are left out; those that it lacks have their defaults.
    """
    names = {field.name for field in fields(Settings)}
    return Settings(**{name: value for name, value in values.items() if name in names})
