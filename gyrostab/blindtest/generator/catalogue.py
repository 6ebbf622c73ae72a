"""Effects that can be drawn, what each one needs, and the ambiguity sets used for scoring."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from gyrostab.blindtest.generator import (
    digitisation,
    electronics,
    motion,
    out_of_catalogue,
    thermal,
    wander,
)
from gyrostab.blindtest.generator.scenario import Effect


@dataclass(frozen=True)
class Entry:
    """How to draw an effect.

    `make` draws it, `channel` drives it, `cuts` is the least number of power cuts, and `needs`
    names what the scenario must contain. `can_be_sub_threshold` is set where the effect can be
    invisible in the raw trace and the Allan plot, yet identifiable.
    """

    make: Callable[..., Effect]
    channel: str | None = None
    cuts: int = 0
    needs: str = ""
    can_be_sub_threshold: bool = False


CATALOGUE: dict[str, Entry] = {
    "vibration_noise": Entry(motion.vibration_noise, "vibration", needs="vibration"),
    "vibration_rectification": Entry(
        motion.vibration_rectification, "vibration", needs="vibration", can_be_sub_threshold=True
    ),
    "shupe": Entry(thermal.shupe, "temperature", needs="heat", can_be_sub_threshold=True),
    "temperature_bias": Entry(
        thermal.temperature_bias, "temperature", needs="heat", can_be_sub_threshold=True
    ),
    "thermal_hysteresis": Entry(
        thermal.thermal_hysteresis, "temperature", needs="heat", can_be_sub_threshold=True
    ),
    "warm_up": Entry(thermal.warm_up, cuts=2, can_be_sub_threshold=True),
    "temperature_noise": Entry(
        thermal.temperature_noise, "temperature", needs="heat", can_be_sub_threshold=True
    ),
    "light_power_noise": Entry(
        thermal.light_power_noise, "light_power", needs="dips", can_be_sub_threshold=True
    ),
    "ageing_noise": Entry(thermal.ageing_noise, can_be_sub_threshold=True),
    "shared_source": Entry(electronics.shared_source, can_be_sub_threshold=True),
    "spectral_line": Entry(electronics.spectral_line, can_be_sub_threshold=True),
    "earth_rate": Entry(
        motion.earth_rate, "rotation_rate", needs="rotation", can_be_sub_threshold=True
    ),
    "rotation_line": Entry(
        motion.rotation_line, "rotation_rate", needs="rotation", can_be_sub_threshold=True
    ),
    "scale_factor": Entry(
        motion.scale_factor, "rotation_rate", needs="rotation", can_be_sub_threshold=True
    ),
    "misalignment": Entry(motion.misalignment),
    "logger_filter": Entry(electronics.logger_filter),
    "aliased_vibration": Entry(motion.aliased_vibration, "vibration", needs="vibration"),
    "spikes": Entry(electronics.spikes),
    "held_samples": Entry(electronics.held_samples, needs="unquantized angle"),
    "bias_jump": Entry(electronics.bias_jump, cuts=1, can_be_sub_threshold=True),
    "supply_bias": Entry(electronics.supply_bias, "supply_voltage", can_be_sub_threshold=True),
    "feedback_reset": Entry(electronics.feedback_reset, "ramp"),
    "rate_quantization": Entry(digitisation.rate_quantization, needs="unquantized angle"),
    "dead_zone": Entry(digitisation.dead_zone, needs="unquantized angle"),
    "clipping": Entry(digitisation.clipping, needs="unquantized angle"),
    "gauss_markov": Entry(wander.gauss_markov),
    "telegraph": Entry(wander.telegraph),
    "ageing_bias": Entry(wander.ageing_bias, can_be_sub_threshold=True),
}

OUT_OF_CATALOGUE: dict[str, Entry] = {
    "breathing_noise": Entry(out_of_catalogue.breathing_noise),
    "chirped_line": Entry(out_of_catalogue.chirped_line),
    "slow_memory": Entry(out_of_catalogue.slow_memory),
    "three_levels": Entry(out_of_catalogue.three_levels),
    "informative_gaps": Entry(out_of_catalogue.informative_gaps),
}

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
