"""Base class of a physical effect, with its methods *generate*, *explain* and *say*.

An effect is one frozen dataclass that inherits from `Effect`. Its fields are its parameters,
declared with `parameter`; class attributes hold the rest. `gyrostab.physics.registry` finds it
automatically. See docs/physics/README.md.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields, replace
from functools import cache
from typing import Any, ClassVar, Literal, Self, get_args

import numpy as np

from gyrostab.arrays import Floats, Ints
from gyrostab.errors import OptionError, SchemaError
from gyrostab.physics.prediction import Prediction, Windows
from gyrostab.wording import format_value, join_words

__all__ = [
    "STAGES",
    "Chunk",
    "Effect",
    "Likeness",
    "Parameter",
    "Prediction",
    "Setup",
    "Stage",
    "Windows",
    "driver_error",
    "parameter",
]

Stage = Literal["motion", "noise", "rate", "sensor", "electronics", "sampling", "logger"]

#: When another effect looks like an effect: "always"; "any spectrum", if their spectra may have any
#: form; "limit", at the end of the range of a parameter, where the other is the simpler one;
#: "single event", if it happens once; "size", if only the size of a step tells them apart.
Likeness = Literal["always", "any spectrum", "limit", "single event", "size"]

#: Stages of the signal path, in order.
STAGES: tuple[Stage, ...] = get_args(Stage)


@dataclass(frozen=True)
class Parameter:
    """Description of one parameter of an effect."""

    unit: str  # unit of the number, for instance "deg/h/degC"; "text" for a word
    meaning: str  # meaning in a few words
    default: Any = None  # value if a model does not give it; None where it must be given
    typical: Any = None  # published or estimated size, for documentation and tests
    low: float = -math.inf  # allowed range, ends included
    high: float = math.inf
    choices: tuple[str, ...] = ()  # allowed words of a text parameter
    many: bool = False  # whether it has one number per axis; see `Effect.expand_to_axes`
    difference: bool = False  # whether it is a difference of two values, such as temperatures
    #: What the value must be, "whole number" or "whole number of fringes"; empty for any number.
    whole: str = ""
    source: str = "estimate"  # source of the typical size: author and year, or "estimate"
    name: str = ""  # name in a model, that of the field

    def check(self, value: Any, effect: str) -> Any:
        """Return `value` as a float, a tuple of floats or a word, or raise `OptionError`."""
        where = f"effect {effect!r}, parameter {self.name!r}"
        if self.choices:
            if value not in self.choices:
                raise OptionError(f"{where}: {value!r} is not one of {', '.join(self.choices)}")
            return value
        numbers = tuple(value) if isinstance(value, list | tuple) else (value,)
        if isinstance(value, list | tuple) and not self.many:
            raise OptionError(f"{where}: give one number in {self.unit}, not the list {value!r}")
        for number in numbers:
            if (
                isinstance(number, bool)
                or not isinstance(number, int | float | np.number)
                or number != number  # not a number
            ):
                raise OptionError(f"{where}: {number!r} is not a number; give one in {self.unit}")
            if isinstance(number, int) and abs(number) > sys.float_info.max:
                raise OptionError(f"{where}: the number is too large; give one in {self.unit}")
            if not self.low <= number <= self.high:
                raise OptionError(
                    f"{where}: {number:g} {self.unit} is outside of the allowed range "
                    f"{self.low:g} to {self.high:g}"
                )
            if self.whole and number != int(number):
                raise OptionError(f"{where}: {number:g} is not a {self.whole}; give one")
        return tuple(float(number) for number in numbers) if self.many else float(value)


def parameter(
    unit: str,
    meaning: str,
    *,
    default: Any = None,
    typical: Any = None,
    limit: float | None = None,
    **options: Any,
) -> Any:
    """Declare a field of an effect; see `Parameter`. The typical size is the default if not given.

    Without a default a model must give it. `limit` is the largest size of either sign.
    """
    if limit is not None:
        options |= {"low": -limit, "high": limit}
    typical = default if typical is None else typical
    definition = Parameter(unit, meaning, default, typical, **options)
    return field(
        default=MISSING if default is None else default, metadata={"parameter": definition}
    )


@dataclass(frozen=True)
class Setup:
    """Properties that are constant over a whole simulation."""

    rate: float  # sampling rate at the effect's stage [Hz]
    size: int  # samples of the whole log at that rate
    axes: tuple[str, ...]  # the effect's axes, in the order of the rows of every array
    #: (axes,): noise coefficients of the model by symbol [unit of the law]: Q, N, B, K, R.
    noise: Mapping[str, Floats] = field(default_factory=dict)
    #: (n, 2): all gaps of the log, [first missing sample, first sample after].
    gaps: Ints = field(default_factory=lambda: np.empty((0, 2), np.int64))
    #: (n, 2): all losses of power, [sample of the loss, sample of the return]; the start of the log
    #: is not among them.
    restarts: Ints = field(default_factory=lambda: np.empty((0, 2), np.int64))
    #: Samples of the instrument in one sampling interval of the log; `rate` is higher by this
    #: factor before the stage "logger".
    oversampling: int = 1


@dataclass(frozen=True)
class Chunk:
    """Input of *generate* for a span of time.

    Sample i covers the interval from ``seconds[i]`` to ``seconds[i] + 1 / rate``.
    """

    setup: Setup  # constant properties: rate, axes, gaps and more
    first: int  # number of the first sample, counted from the start of the log
    size: int  # number of samples
    #: (size,): channels that the effect needs, by the names of `Effect.channels`, without NaN, in
    #: the units given there.
    drivers: Mapping[str, Floats] = field(default_factory=dict)
    #: (size,): true rotation rate of every axis of the log [degree hour-1], including axes that the
    #: effect does not act on; complete after "motion".
    true: Mapping[str, Floats] = field(default_factory=dict)
    #: (size,): recorded rate of the axes of `Effect.recorded_axes` [degree hour-1], without NaN.
    recorded: Mapping[str, Floats] = field(default_factory=dict)
    #: (axes, size): signal before the effect [degree hour-1]; for the stages "sensor" and later.
    signal: Floats = field(default_factory=lambda: np.empty((0, 0)))
    #: (axes, size): Q and N in the signal, as they were added; for the stage "sampling".
    white: Floats = field(default_factory=lambda: np.zeros((1, 1)))
    #: (axes, size): squared noise coefficients by symbol before the effect; for the stage "noise".
    level: Mapping[str, Floats] = field(default_factory=dict)

    @property
    def rate(self) -> float:
        """Sampling rate [Hz]."""
        return self.setup.rate

    @property
    def seconds(self) -> Floats:
        """Time of every sample since the start of the log [s]."""
        return (self.first + np.arange(self.size)) / self.setup.rate

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of the result, (axes, samples)."""
        return len(self.setup.axes), self.size


@dataclass(frozen=True, kw_only=True)
class Effect:
    """A physical effect; subclasses are frozen dataclasses with fields made by `parameter`."""

    name: ClassVar[str] = ""  # name in models, results and documents
    short: ClassVar[str] = ""  # description in a few words
    plain: ClassVar[str] = ""  # what a sentence calls the effect; `short` by default
    #: Measurement that separates it from the effects that it is confused with.
    next_measurement: ClassVar[str] = ""
    stage: ClassVar[Stage] = "rate"  # determines what *generate* returns
    channels: ClassVar[Mapping[str, str]] = {}  # driver -> required unit (`gyrostab.units.INNER`)
    #: Parameters that disable the effect when all of them are zero.
    size_parameters: ClassVar[tuple[str, ...]] = ()
    #: Other effects that a record may not tell from this one -> when; see `Likeness`.
    likeness: ClassVar[Mapping[str, Likeness]] = {}
    is_steady: ClassVar[bool] = False  # whether it acts all the time, with the same size
    follows_axes: ClassVar[bool] = False  # whether it follows the rates of other axes
    #: Whether it changes samples of all its axes at the same instants.
    is_simultaneous: ClassVar[bool] = False
    shapes_spectrum: ClassVar[bool] = False  # whether it changes the form of the spectrum
    terms: ClassVar[str] = "QNBK"  # symbols that an effect of the stage "noise" may change

    axes: tuple[str, ...] = ()  # axes of the log that it acts on; empty for all
    #: Names of its channels in the log, in the order of `channels`; empty if unchanged. Names for
    #: the channels of `needs` alone are completed.
    driver: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for definition in self.parameters():
            object.__setattr__(
                self, definition.name, definition.check(getattr(self, definition.name), self.name)
            )
        for name in ("axes", "driver"):
            value = getattr(self, name)
            object.__setattr__(self, name, (value,) if isinstance(value, str) else tuple(value))
        if len(set(self.axes)) < len(self.axes):
            raise OptionError(
                f"effect {self.name!r}: axes = {list(self.axes)} names an axis twice; name it once"
            )
        if self.driver and len(self.driver) == len(self.needs()):
            renamed = dict(zip(self.needs(), self.driver, strict=True))
            names = tuple(renamed.get(channel, channel) for channel in self.channels)
            object.__setattr__(self, "driver", names)
        if self.driver and len(self.driver) != len(self.channels):
            needs = ", ".join(self.channels) or "no channel"
            raise OptionError(
                f"effect {self.name!r}: driver names {len(self.driver)} channels; "
                f"it takes {needs}, in this order"
            )
        for definition in self.parameters():
            if definition.many and self.axes:
                self.expand_to_axes(definition.name, self.axes)

    @classmethod
    @cache
    def parameters(cls) -> tuple[Parameter, ...]:
        """List the parameters in the order of the class."""
        return tuple(
            replace(item.metadata["parameter"], name=item.name)
            for item in fields(cls)
            if "parameter" in item.metadata
        )

    @classmethod
    def look_alikes(cls, when: Likeness) -> tuple[str, ...]:
        """List the effects that look like this one in this way."""
        return tuple(name for name, condition in cls.likeness.items() if condition == when)

    @classmethod
    def required(cls) -> tuple[str, ...]:
        """List the names of the parameters that a model must give."""
        return tuple(item.name for item in cls.parameters() if item.default is None)

    @classmethod
    def example(cls, **values: Any) -> Self:
        """Make the effect with its typical sizes, except for `values`."""
        return cls(
            **{definition.name: definition.typical for definition in cls.parameters()} | values
        )

    def list_sizes(self) -> tuple[str, ...]:
        """List the size parameters that are not zero."""
        return tuple(name for name in self.size_parameters if getattr(self, name))

    def refer_noise_to(self, drivers: Mapping[str, float]) -> Self:
        """Make the same change of noise for a model whose noise is that at these channel values.

        The effect itself if it does not depend on where the noise of the model is measured.
        """
        return self

    def needs(self) -> tuple[str, ...]:
        """List the channels (of `channels`) that *generate* requires with these parameters."""
        return tuple(self.channels)

    def courses(self) -> tuple[str, ...]:
        """List the channels of which the effect follows the course, not the noise of the sensor."""
        return ()

    def recorded_axes(self) -> tuple[str, ...]:
        """List the axes whose rate *generate* takes from the recording that a log is made like."""
        return ()

    def channel_names(self) -> dict[str, str]:
        """Map each channel of `channels` to its name in the log."""
        return dict(zip(self.channels, self.driver or self.channels, strict=True))

    def expand_to_axes(self, name: str, axes: tuple[str, ...]) -> Floats:
        """Expand a parameter to one number per axis; one number applies to all, none means zeros.

        Raises
        ------
        OptionError
            When the numbers do not fit the axes.
        """
        numbers = np.asarray(getattr(self, name), dtype=np.float64)
        if numbers.size not in (0, 1, len(axes)):
            problem = f"{numbers.size} numbers for {len(axes)} axes"
            raise OptionError(
                f"effect {self.name!r}, parameter {name!r}: {problem}; give one number for each "
                f"of the axes {list(axes)}, or one for all"
            )
        return np.array(np.broadcast_to(numbers if numbers.size else 0.0, len(axes)))

    # --------------------------------------------------------------------------------
    # methods of an effect

    def begin(self, setup: Setup, rng: np.random.Generator) -> Any:
        """Make the state before the first sample: anything copyable, including `rng` if needed."""
        return None

    def generate(self, chunk: Chunk, state: Any) -> tuple[Any, Any]:
        """Compute the effect on a span of time, and the state after it.

        The state may be changed in place. The result must not depend on the division into chunks.

        Returns
        -------
        values
            By stage: "motion" and "rate": contribution to the rate [degree hour-1], shape (axes,
            size) or (size,). "noise": mapping of changed symbols to squared coefficients, from
            `Chunk.level`; its item "rate" is noise of another spectrum [degree hour-1]. "sensor",
            "electronics", "logger": the resulting signal, shape (axes, size). "sampling": the same,
            or ``size / oversampling`` samples where the effect decimates.
        state
        """
        raise NotImplementedError

    def nuisance(self, windows: Windows) -> Mapping[str, Floats]:
        """Map each nonlinear parameter to the values to try on these data."""
        return {}

    def transfer(self, rate: Floats) -> Floats | None:
        """Return the output at each rate; None if the effect does more than change single samples.

        Only for effects that reduce the scatter of noise.
        """
        return None

    def points(self, windows: Windows) -> list[Mapping[str, float | str]]:
        """List the grid points of the nonlinear parameters; empty for all combinations."""
        return []

    def explain(self, windows: Windows) -> Prediction:
        """Predict the reduced data, with the nonlinear parameters at their current values."""
        raise NotImplementedError

    def say(self, errors: Mapping[str, float] | None = None) -> str:
        """Describe the effect in one sentence with its parameters and their standard errors."""
        raise NotImplementedError

    def say_in_record(self, windows: Windows, errors: Mapping[str, float] | None = None) -> str:
        """Describe the effect as `say` does, without what the record does not determine."""
        return self.say(errors)

    # --------------------------------------------------------------------------------
    # phrases

    def on_axes(self) -> str:
        """Format the axes: ``"on axis x"``, ``"on axes x and y"`` or ``"on all axes"``."""
        if not self.axes:
            return "on all axes"
        return f"on ax{'i' if len(self.axes) == 1 else 'e'}s {join_words(self.axes)}"

    def quantity(self, name: str, errors: Mapping[str, float] | None = None) -> str:
        """Format a parameter with its error and unit: ``"0.4 ± 0.1 deg/h"``."""
        unit = next(definition.unit for definition in self.parameters() if definition.name == name)
        value = getattr(self, name)
        error = (errors or {}).get(name)
        values = value if isinstance(value, tuple) else (value,)
        text = join_words([format_value(number, error) for number in values])
        if error:  # a count or a choice has none
            text += f" ± {error:.2g}"
        return text if unit in ("1", "text") else f"{text} {unit}"


def driver_error(effect: Effect, channel: str, present: list[str]) -> SchemaError:
    """Make the error for a missing channel of an effect."""
    name = effect.channel_names()[channel]
    return SchemaError(
        f"effect {effect.name!r} needs the channel {name!r} [{effect.channels[channel]}]; "
        f"the log has {', '.join(present) or 'no channels'}; add it to the environment "
        "or name another with driver = ..."
    )
