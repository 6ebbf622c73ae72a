"""Effects that can be drawn, what each one needs, and the ambiguity sets used for scoring."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from gyrostab.blindtest.generator import (
    digitisation,
    electronics,
    motion,
    out_of_catalogue,
    thermal,
    wander,
)
from gyrostab.blindtest.generator.detection_limits import NATS, fitted_nats
from gyrostab.blindtest.generator.record import UNITS
from gyrostab.blindtest.generator.scenario import HiddenEffect, Scenario

_ROUNDS = 30  # at most, to raise a strength in fitted noise: that of slow effects grows slowly
_MARGIN = 1.02  # of the strength above that proportion
_MAX_FACTOR = 8.0  # of the strength in known noise over the one in fitted noise


@dataclass(frozen=True)
class Entry:
    """How to draw an effect.

    `draw` has the name of the effect, `driver` drives it, `cuts` is the least number of power cuts,
    and `needs` names what the scenario must contain. `can_be_sub_threshold` is set where the effect
    can be invisible in the raw trace and the Allan plot, yet identifiable.
    """

    draw: Callable[..., HiddenEffect]
    driver: str | None = None
    cuts: int = 0
    needs: str = ""
    can_be_sub_threshold: bool = False

    @property
    def channel(self) -> str | None:
        """Driver that is a channel of the log."""
        return self.driver if self.driver in UNITS else None

    def make(
        self,
        scenario: Scenario,
        rng: np.random.Generator,
        *,
        strength: float,
        in_fitted_noise: bool = False,
    ) -> HiddenEffect:
        """Draw the effect at a strength in known noise, or at least at this one in fitted noise.

        Its strength in known noise is at most `_MAX_FACTOR` times larger: a filter of a quantized
        angle, for instance, may be invisible in fitted noise at any strength.
        """
        start, raised = copy.deepcopy(rng), strength
        effect = self.draw(scenario, rng, strength=strength)
        for _ in range(_ROUNDS if in_fitted_noise else 0):
            reached = math.sqrt(fitted_nats(scenario, effect) / NATS) / strength
            if reached >= 1 or raised >= _MAX_FACTOR * strength:
                break
            raised = min(_MARGIN * raised / max(reached, 1 / _MAX_FACTOR), _MAX_FACTOR * strength)
            effect = self.draw(scenario, copy.deepcopy(start), strength=raised)
        return replace(effect, name=self.draw.__name__, driver=self.driver, strength=raised)


def _by_name(*entries: Entry) -> dict[str, Entry]:
    return {entry.draw.__name__: entry for entry in entries}


CATALOGUE = _by_name(
    Entry(motion.vibration_noise, "vibration", needs="vibration"),
    Entry(
        motion.vibration_rectification, "vibration", needs="vibration", can_be_sub_threshold=True
    ),
    Entry(thermal.shupe, "temperature", needs="heat", can_be_sub_threshold=True),
    Entry(thermal.temperature_bias, "temperature", needs="heat", can_be_sub_threshold=True),
    Entry(thermal.thermal_hysteresis, "temperature", needs="heat", can_be_sub_threshold=True),
    Entry(thermal.warm_up, cuts=2, can_be_sub_threshold=True),
    Entry(thermal.temperature_noise, "temperature", needs="heat", can_be_sub_threshold=True),
    Entry(thermal.light_power_noise, "light_power", needs="dips", can_be_sub_threshold=True),
    Entry(thermal.ageing_noise, "time", can_be_sub_threshold=True),
    Entry(electronics.shared_source, can_be_sub_threshold=True),
    Entry(electronics.spectral_line, can_be_sub_threshold=True),
    Entry(motion.earth_rate, "rotation_rate", needs="rotation", can_be_sub_threshold=True),
    Entry(motion.rotation_line, "rotation_rate", needs="rotation", can_be_sub_threshold=True),
    Entry(motion.scale_factor, "rotation_rate", needs="rotation", can_be_sub_threshold=True),
    Entry(motion.misalignment, "other axes"),
    Entry(electronics.logger_filter),
    Entry(motion.aliased_vibration, "vibration", needs="vibration"),
    Entry(electronics.spikes),
    Entry(electronics.held_samples, needs="unquantized angle"),
    Entry(electronics.bias_jump, cuts=1, can_be_sub_threshold=True),
    Entry(electronics.supply_bias, "supply_voltage", can_be_sub_threshold=True),
    Entry(electronics.feedback_reset, "ramp"),
    Entry(digitisation.rate_quantization, needs="unquantized angle"),
    Entry(digitisation.dead_zone, needs="unquantized angle"),
    Entry(digitisation.clipping, needs="unquantized angle"),
    Entry(wander.gauss_markov),
    Entry(wander.telegraph),
    Entry(wander.ageing_bias, "time", can_be_sub_threshold=True),
)

OUT_OF_CATALOGUE = _by_name(
    Entry(out_of_catalogue.breathing_noise),
    Entry(out_of_catalogue.chirped_line),
    Entry(out_of_catalogue.slow_memory),
    Entry(out_of_catalogue.three_levels),
    Entry(out_of_catalogue.informative_gaps),
)

#: Effects that the data may be unable to distinguish.
AMBIGUITY: tuple[frozenset[str], ...] = tuple(
    frozenset(names.split())
    for names in (
        "temperature_bias shupe warm_up ageing_bias thermal_hysteresis thermal_gradient",
        "vibration_rectification g_sensitivity",
        "bias_jump vibration_random_walk",
        "vibration_noise aliased_vibration real_motion",
        "temperature_noise ageing_noise light_power_noise",
        "shared_source real_motion",
        "misalignment real_motion scale_factor",
        "gauss_markov telegraph",
        "earth_rate rotation_line g_sensitivity magnetic",
        "spectral_line feedback_reset",
    )
)


def merge_ambiguous(name: str) -> frozenset[str]:
    """List all names that count as `name` when ambiguity sets are merged.

    Examples
    --------
    >>> sorted(merge_ambiguous("gauss_markov")), sorted(merge_ambiguous("logger_filter"))
    (['gauss_markov', 'telegraph'], ['logger_filter'])
    """
    return frozenset({name}).union(*(group for group in AMBIGUITY if name in group))
