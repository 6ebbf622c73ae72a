"""Keep the named effects whose size is away from zero."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from gyrostab.diagnose.estimate.joint_fit import Fitted
from gyrostab.diagnose.identify.components import axes_of, sum_evidence
from gyrostab.diagnose.identify.identification import (
    Identifications,
    Rejection,
    Selection,
    reduce_selection,
)
from gyrostab.physics.registry import effects


def supported_axes(fitted: Fitted) -> tuple[str, ...]:
    """Find the axes on which a size of the effect differs from zero.

    Parameters
    ----------
    fitted : Fitted
        Effect with its sizes. A parameter ``name.axis`` belongs to one axis, any other to all.

    Returns
    -------
    tuple of str
        All axes when no size is measured, as for motion with another form in every band.
    """
    sizes = effects()[fitted.identification.effect].size_parameters
    measured = {
        name: estimate
        for name, estimate in fitted.parameters.items()
        if name.split(".")[0] in sizes
    }
    axes = []
    for axis in fitted.axes:
        axis_sizes = [
            estimate for name, estimate in measured.items() if name.partition(".")[2] in ("", axis)
        ]
        # zero is not in a 95 % interval; an unknown one may contain it
        if not axis_sizes or any(size.low > 0.0 or size.high < 0.0 for size in axis_sizes):
            axes.append(axis)
    return tuple(axes)


def keep_supported(
    identifications: Identifications, fitted: Sequence[Sequence[Fitted]]
) -> Identifications:
    """Keep the effects whose size differs from zero, on the axes where it does.

    What an effect gained on the other axes becomes unidentified if that exceeds its threshold:
    something is there, but the record does not show that this effect caused it.

    Returns
    -------
    Identifications
        `identifications` itself when every effect keeps all of its axes.
    """
    identified: list[Selection] = []
    unknown: list[Selection] = []
    rejected: list[Rejection] = []
    for identification, numbers in zip(identifications.identified, fitted, strict=True):
        good = {axis for fitted_effect in numbers for axis in supported_axes(fitted_effect)}
        if set(identification.axes) <= good or not numbers:
            identified.append(identification)
            continue
        supported = [
            component for component in identification.components if set(component.row) <= good
        ]
        if sum_evidence(supported) > identification.threshold:
            evidence_nats = min(identification.evidence_nats, sum_evidence(supported))
            identified.append(reduce_selection(identification, supported, evidence_nats))
        else:
            supported = []
            rejected.append(
                Rejection(identification.effect, identification.axes, "a size of zero", math.nan)
            )
        lost = tuple(
            component for component in identification.components if component not in supported
        )
        if sum_evidence(lost) > identification.threshold:
            strongest = max(lost, key=lambda component: component.evidence_nats).statistic
            unknown.append(
                Selection(
                    strongest.nuisance_alternative,
                    (),
                    axes_of(lost, identification.axes),
                    lost,
                    sum_evidence(lost),
                    identification.threshold,
                    (identification.effect,),
                )
            )
    if identified == [*identifications.identified]:
        return identifications
    return replace(
        identifications,
        identified=tuple(identified),
        unknown=(*identifications.unknown, *unknown),
        rejected=(*identifications.rejected, *rejected),
    )
