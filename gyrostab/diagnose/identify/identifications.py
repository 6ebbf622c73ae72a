"""What the identification found in a record."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import xarray as xr

from gyrostab.diagnose.identify.examination import Examination
from gyrostab.diagnose.identify.selections import Selection, condition_on_selections
from gyrostab.diagnose.predict.linear_model import State, initial_state


@dataclass(frozen=True)
class Identifications:
    """What the identification found."""

    examination: Examination  # with the expected effects in the model
    identified: tuple[Selection, ...]  # the strongest first
    unidentified: tuple[Selection, ...]
    state: State  # with all of the above, and the expected effects, in the model
    #: Effects that the simulation contains as well, with size and time from the recording.
    expected: tuple[Selection, ...] = ()
    #: Key of each candidate that passed the threshold and was not selected -> another form or a
    #: time-shifted channel, and by how much it explained more [nats].
    beaten: Mapping[str, tuple[str, float]] = field(default_factory=dict)

    def state_without_effects(self, baseline: xr.Dataset) -> State:
        """Return the state without any effect."""
        return initial_state(self.state.blocks, baseline, settings=self.state.settings)

    def state_without(self, identification: Selection, baseline: xr.Dataset) -> State:
        """Return the state with all selections but one in the model, weighted with all of them."""
        chosen: list[Selection] = [*self.expected, *self.identified, *self.unidentified]
        return replace(
            condition_on_selections(self.state_without_effects(baseline), chosen, identification),
            expected_power=self.state.expected_power,
            masked=self.state.masked,
        )
