"""Parameters of effects: unit, range, typical size and source."""

from __future__ import annotations

import math
from dataclasses import MISSING, dataclass, field
from typing import Any

import numpy as np

from gyrostab.errors import OptionError

__all__ = ["Parameter", "parameter"]


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
                or math.isnan(number)
            ):
                raise OptionError(f"{where}: {number!r} is not a number; give one in {self.unit}")
            if not self.low <= number <= self.high:
                raise OptionError(
                    f"{where}: {number:g} {self.unit} is outside of the allowed range "
                    f"{self.low:g} to {self.high:g}"
                )
            if self.whole and number != int(number):
                raise OptionError(f"{where}: {number:g} is not a {self.whole}; give one")
        return tuple(float(number) for number in numbers) if self.many else float(value)


def parameter(
    unit: str, meaning: str, *, default: Any = None, typical: Any = None, **options: Any
) -> Any:
    """Declare a field of an effect; see `Parameter`. The typical size is the default if not given.

    Without a default a model must give it.
    """
    typical = default if typical is None else typical
    definition = Parameter(unit, meaning, default, typical, **options)
    return field(
        default=MISSING if default is None else default, metadata={"parameter": definition}
    )
