"""All effects that can be drawn, what each one needs, and which names the data cannot be asked to tell apart."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from gyrostab.blindtest.generator import digitisation as words
from gyrostab.blindtest.generator import electronics, motion, wander
from gyrostab.blindtest.generator import out_of_catalogue as strange
from gyrostab.blindtest.generator import thermal as heat
from gyrostab.blindtest.generator.scenario import Effect

__all__ = ["AMBIGUITY", "CATALOGUE", "STRANGE", "Entry", "merged"]


@dataclass(frozen=True)
class Entry:
    """How to draw an effect: its maker, its channel, the power cuts that it needs at least, and what it `needs` of the world."""

    make: Callable[..., Effect]
    channel: str | None = None
    cuts: int = 0
    needs: str = ""
    hidden: bool = False  # can lie below the raw trace and the Allan plot and yet be named


CATALOGUE: dict[str, Entry] = {
    "vibration_noise": Entry(motion.vibration_noise, "vibration", needs="shaking"),
    "vibration_rectification": Entry(
        motion.vibration_rectification, "vibration", needs="shaking", hidden=True
    ),
    "shupe": Entry(heat.shupe, "temperature", needs="heat", hidden=True),
    "temperature_bias": Entry(heat.temperature_bias, "temperature", needs="heat", hidden=True),
    "thermal_hysteresis": Entry(heat.thermal_hysteresis, "temperature", needs="heat", hidden=True),
    "warm_up": Entry(heat.warm_up, cuts=2, hidden=True),
    "temperature_noise": Entry(heat.temperature_noise, "temperature", needs="heat", hidden=True),
    "light_power_noise": Entry(heat.light_power_noise, "light_power", needs="dips", hidden=True),
    "ageing_noise": Entry(heat.ageing_noise, hidden=True),
    "shared_source": Entry(electronics.shared_source, hidden=True),
    "spectral_line": Entry(electronics.spectral_line, hidden=True),
    "earth_rate": Entry(motion.earth_rate, "rotation_rate", needs="turning", hidden=True),
    "rotation_line": Entry(motion.rotation_line, "rotation_rate", needs="turning", hidden=True),
    "scale_factor": Entry(motion.scale_factor, "rotation_rate", needs="turning", hidden=True),
    "misalignment": Entry(motion.misalignment),
    "logger_filter": Entry(electronics.logger_filter),
    "aliased_vibration": Entry(motion.aliased_vibration, "vibration", needs="shaking"),
    "spikes": Entry(electronics.spikes),
    "held_samples": Entry(electronics.held_samples, needs="whole angle"),
    "bias_jump": Entry(electronics.bias_jump, cuts=1, hidden=True),
    "supply_bias": Entry(electronics.supply_bias, "supply_voltage", hidden=True),
    "feedback_reset": Entry(electronics.feedback_reset, "ramp"),
    "rate_quantization": Entry(words.rate_quantization, needs="whole angle"),
    "dead_zone": Entry(words.dead_zone, needs="whole angle"),
    "clipping": Entry(words.clipping, needs="whole angle"),
    "gauss_markov": Entry(wander.gauss_markov),
    "telegraph": Entry(wander.telegraph),
    "ageing_bias": Entry(wander.ageing_bias, hidden=True),
}

STRANGE: dict[str, Entry] = {
    "breathing_noise": Entry(strange.breathing_noise),
    "chirped_line": Entry(strange.chirped_line),
    "slow_memory": Entry(strange.slow_memory),
    "three_levels": Entry(strange.three_levels),
    "informative_gaps": Entry(strange.informative_gaps),
}

#: Names that stand for one another where the record lacks what would tell them apart (section 1.E
#: of the design).
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


def merged(name: str) -> frozenset[str]:
    """All names that count as `name` when classes are merged by the ambiguity sets.

    Examples
    --------
    >>> sorted(merged("gauss_markov")), sorted(merged("logger_filter"))
    (['gauss_markov', 'telegraph'], ['logger_filter'])
    """
    return frozenset({name}).union(*(group for group in AMBIGUITY if name in group))
