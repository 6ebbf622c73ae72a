"""Keep the named effects whose size is away from zero."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from gyrostab.diagnose.estimate.joint_fit import Estimate, Fitted
from gyrostab.diagnose.identify.components import sum_evidence
from gyrostab.diagnose.identify.identification import Identification, Identifications, Unidentified
from gyrostab.diagnose.predict.condition import Component
from gyrostab.physics.registry import effects

__all__ = ["has_zero", "keep_supported", "supported_axes"]

#: View of a part of an effect -> nuisance alternative that its unexplained rest is reported as.
_REST = {
    "mean": "~bias(t)", "levels": "~bias(t)", "wander": "~red", "power": "~N(t)", "cross": "~cov",
    "marks": "~outliers",
}  # fmt: skip


def has_zero(estimate: Estimate) -> bool:
    """Return whether the 95 % interval of a parameter holds zero, or is not known."""
    return not (estimate.low > 0.0 or estimate.high < 0.0)


def supported_axes(fitted: Fitted) -> tuple[str, ...]:
    """Find the axes on which a size of the effect is away from zero.

    Parameters
    ----------
    fitted : Fitted
        Effect with its numbers. A parameter ``name.axis`` belongs to one axis, any other to all.

    Returns
    -------
    tuple of str
        All axes when no size is measured, as for motion that has another form in every band.
    """
    sizes = effects()[fitted.claim.effect].size_parameters
    measured = {name: one for name, one in fitted.parameters.items() if name.split(".")[0] in sizes}
    found = []
    for axis in fitted.axes:
        own = [one for name, one in measured.items() if name.partition(".")[2] in ("", axis)]
        if not own or not all(has_zero(one) for one in own):
            found.append(axis)
    return tuple(found)


def keep_supported(naming: Identifications, fitted: Sequence[Sequence[Fitted]]) -> Identifications:
    """Keep the effects whose size is away from zero, on the axes where it is.

    What an effect gained on the other axes stays in the naming as something unknown where that
    is more than its threshold: it was found, but the record does not say that this effect did it.

    Parameters
    ----------
    naming : Naming
    fitted : sequence of sequence of Fitted
        Numbers of each claim of `naming`, in the same order.

    Returns
    -------
    Naming
        `naming` itself when every effect keeps all of its axes.
    """
    claims: list[Identification] = []
    unknown: list[Unidentified] = []
    changed = False
    for claim, numbers in zip(naming.claims, fitted, strict=True):
        good = {axis for one in numbers for axis in supported_axes(one)}
        kept = tuple(part for part in claim.parts if set(part.row) <= good)
        if set(claim.axes) <= good or not numbers:
            claims.append(claim)
            continue
        lost = tuple(part for part in claim.parts if part not in kept)
        if sum_evidence(kept) > claim.threshold:
            axes = tuple(axis for axis in claim.axes if axis in good)
            gain = min(claim.gain, sum_evidence(kept))
            claims.append(replace(claim, parts=kept, axes=axes, gain=gain))
        else:
            lost = claim.parts
        if sum_evidence(lost) > claim.threshold:
            unknown.append(_unsupported(claim, lost))
        changed = True
    if not changed:
        return naming
    return replace(naming, claims=tuple(claims), unknown=(*naming.unknown, *unknown))


def _unsupported(claim: Identification, parts: tuple[Component, ...]) -> Unidentified:
    """Turn the parts of an effect whose size may be zero into something unknown."""
    strongest = max(parts, key=lambda part: part.gain).candidate.view
    axes = tuple(axis for axis in claim.axes if any(axis in part.row for part in parts))
    generic = _REST.get(strongest, "~S(f)")
    return Unidentified(generic, axes, sum_evidence(parts), claim.threshold, (claim.effect,), parts)
