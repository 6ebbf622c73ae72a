"""Find a channel whose time stamps are late or early: moved in time, it explains the rates."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from itertools import chain
from typing import NamedTuple

import numpy as np
import xarray as xr
from scipy.special import ndtr, ndtri

from gyrostab.arrays import Floats, Ints
from gyrostab.diagnose.identify.components import group_components, sum_evidence
from gyrostab.diagnose.identify.examination import Examination
from gyrostab.diagnose.identify.identifications import Identifications
from gyrostab.diagnose.identify.selections import Selection
from gyrostab.diagnose.predict.candidates import Candidate, CandidateEvidence
from gyrostab.diagnose.predict.linear_model import State
from gyrostab.diagnose.predict.windows import channel_units
from gyrostab.diagnose.reduce.log_blocks import channel_means, is_rms_channel
from gyrostab.diagnose.statistics.build_candidates import effect_candidates
from gyrostab.schema.delays import move_channels
from gyrostab.time.grid import grid_times

#: Parts of a block in which a delay is resolved. Design choice.
_PARTS = 16
#: Least length of the record, in largest delays: a channel is also compared at delays that are too
#: large for a clock, and these have to be most of them. Design choice.
_MIN_RECORD_DELAYS = 6
#: Delays too large for a clock with which the best one is compared; limits the time.
_MAX_OTHER_DELAYS = 64
_QUANTILES = 1000  # over which a probability is averaged; exact to 1e-3


def find_late_channel(
    identifications: Identifications,
    baseline: xr.Dataset,
    log: xr.Dataset,
    moved: Collection[str] = (),
) -> tuple[str, float] | None:
    """Return the channel that explains the rates once it is moved, and by how much it is late [s].

    A channel is moved only to explain what no channel explains at its own time. All delays of all
    channels are equally probable, so that the evidence of the best one must exceed the threshold,
    and that of the channel at its own time, by the logarithm of their number. A smooth channel
    explains about as much at its own time, and stays. The evidence must also exceed that of what
    explains the rates without a channel.

    A channel that has nothing to do with the rates explains as much at delays that are too large
    for a clock, round the record (`chance_of_best`). Delays at which the channel resembles itself
    do not count. Channels that an identified effect follows stay, and those in `moved`. None if
    there is no late channel.
    """
    examination, blocks = identifications.examination, identifications.state.blocks
    unexplained = [
        selection
        for selection in (*identifications.identified, *identifications.unidentified)
        if _may_follow_channel(selection)
    ]
    block_s = float(blocks.attrs["block_s"])
    reach = min(
        int(examination.settings.max_delay_s / block_s), blocks.sizes["block"] // _MIN_RECORD_DELAYS
    )
    on_time = {name for effect in identifications.identified for name in effect.driver}
    names = [name for name in channel_units(blocks) if name not in on_time | {*moved}]
    if not unexplained or reach == 0 or not names:
        return None
    explained = [effect for effect in identifications.identified if effect not in unexplained]
    channels = {name: split_channel(name, log, blocks) for name in names}
    search = DelaySearch(examination, examination.state_with(explained), baseline, channels, reach)
    best = search.find_best()
    count = 2 * reach * len(channels)
    on_time_nats = float(search.evidence(best.channel, [0])[0])
    needed_nats = max(examination.threshold, on_time_nats) + math.log(_PARTS * count)
    if best.nats <= needed_nats:
        return None
    best = search.refine(best)
    needed_nats = max(needed_nats, *(selection.evidence_nats for selection in unexplained))
    if best.nats <= needed_nats or not search.exceeds_chance(best, count):
        return None
    return best.channel, float(f"{best.parts * block_s / _PARTS:.4g}")


class Delay(NamedTuple):
    """A delay of a channel, and the evidence of the effect that then follows it best."""

    nats: float
    parts: int  # parts of a block by which the channel is late
    channel: str


def chance_of_best(ratio: float, count: int, others: int) -> float:
    """Return the probability that the best of `count` values is so much larger than of `others`.

    The values are squares of independent normal deviates with one unknown standard deviation, as
    twice the evidence of a channel that has nothing to do with the rates. `ratio` is that of the
    largest ones.

    Examples
    --------
    >>> round(chance_of_best(1.0, 64, 64), 2), round(chance_of_best(2.4, 120, 64), 2)
    (0.5, 0.04)
    """
    middle = (np.arange(_QUANTILES) + 0.5) / _QUANTILES
    largest = ndtri((1.0 + middle ** (1.0 / others)) / 2.0)
    below = 2.0 * ndtr(math.sqrt(ratio) * largest) - 1.0
    return float(np.mean(1.0 - below**count))


def _may_follow_channel(selection: Selection) -> bool:
    """Return whether a selection has a course in time that no channel gives."""
    statistics = [component.statistic for component in selection.components]
    return not any(selection.driver) and not any(
        statistic.is_count or statistic.is_line or statistic.is_pairwise for statistic in statistics
    )


@dataclass(frozen=True)
class DelaySearch:
    """The record in which channels are moved."""

    examination: Examination
    state: State  # with the effects that are explained
    baseline: xr.Dataset
    channels: Mapping[str, Floats]  # in parts of the blocks, as `split_channel` returns them
    reach: int  # blocks in the largest delay of a clock

    def find_best(self) -> Delay:
        """Return the delay of whole blocks with the most evidence, of any channel."""
        shifts = _PARTS * np.delete(np.arange(-self.reach, self.reach + 1), self.reach)
        return max(
            Delay(float(nats), int(shift), channel)
            for channel in self.channels
            for shift, nats in zip(shifts, self.evidence(channel, shifts), strict=True)
        )

    def refine(self, best: Delay) -> Delay:
        """Return the best delay near another one, to a part of a block."""
        step = _PARTS
        while step > 1:
            step //= 2
            shifts = best.parts + step * np.arange(-1, 2)
            nats = self.evidence(best.channel, shifts)
            best = best._replace(nats=float(nats.max()), parts=int(shifts[nats.argmax()]))
        return best

    def exceeds_chance(self, best: Delay, count: int) -> bool:
        """Test whether the best of `count` delays explains more than delays far from it.

        False if the channel resembles itself at most of them.
        """
        settings = self.examination.settings
        parts = self.channels[best.channel]
        shifts = _PARTS * np.arange(self.reach, parts.size // _PARTS - self.reach + 1)
        shifts = shifts[np.abs(_correlate_with_itself(parts, shifts)) <= settings.majority_share]
        if shifts.size < settings.min_surrogates:
            return False
        number = min(shifts.size, _MAX_OTHER_DELAYS)
        shifts = shifts[np.linspace(0, shifts.size - 1, number).astype(int)]
        nats = self.evidence(best.channel, best.parts + shifts, wrap=True).max()
        ratio = best.nats / max(float(nats), 1.0)
        return chance_of_best(ratio, count, number) <= settings.surrogate_share

    def evidence(self, channel: str, shifts: Iterable[int], *, wrap: bool = False) -> Floats:
        """Return the evidence of the effect that follows a channel best, moved by parts [nats].

        With `wrap`, the channel moves round the record, end to start.
        """
        by_shift = [self._find_followers(channel, shift, wrap=wrap) for shift in shifts]
        owner = {
            candidate: place for place, followers in enumerate(by_shift) for candidate in followers
        }
        settings = self.state.settings
        grouped: list[list[CandidateEvidence]] = [[] for _ in by_shift]
        # of all shifts together, so that the noise is whitened once for many designs
        for evidence in self.examination.compute_evidence(list(chain(*by_shift)), self.state):
            grouped[owner[evidence.candidate]].append(evidence)
        return np.array(
            [
                max(
                    map(sum_evidence, group_components(of_shift, settings).values()),
                    default=0.0,
                )
                for of_shift in grouped
            ]
        )

    def _find_followers(self, channel: str, shift: int, *, wrap: bool) -> list[Candidate]:
        """Return the candidates in means and powers that follow a channel moved by parts."""
        parts = self.channels[channel]
        blocks = self.examination.start.blocks.drop_vars(f"fine_{channel}", errors="ignore")
        places = np.arange(parts.size) + shift
        if wrap:
            places %= parts.size
        inside = (places >= 0) & (places < parts.size)
        in_parts = np.where(inside, parts[np.clip(places, 0, parts.size - 1)], np.nan)
        good = np.isfinite(in_parts).reshape(-1, _PARTS)
        sums = np.nansum(in_parts.reshape(-1, _PARTS), axis=1)
        means = sums / np.where(good.any(axis=1), good.sum(axis=1), np.nan)
        values = np.sqrt(means) if is_rms_channel(channel) else means
        name = f"channel_{channel}"
        candidates, _ = effect_candidates(
            blocks.assign({name: ("block", values, blocks[name].attrs)}),
            self.baseline["coefficient"],
            channel=channel,
            settings=self.state.settings,
        )
        return [
            candidate
            for candidate in candidates
            if candidate.statistic.is_linear_in_means or candidate.statistic.is_power
        ]


def split_channel(channel: str, log: xr.Dataset, blocks: xr.Dataset) -> Floats:
    """Return a channel in parts of the blocks; the mean square where the rms matters."""
    count, samples = blocks.sizes["block"], int(blocks.attrs["block_samples"])
    edges = grid_times(
        int(blocks.attrs["start_ns"]),
        float(blocks.attrs["sampling_rate_hz"]),
        np.arange(count * _PARTS + 1) * samples // _PARTS,
    )
    with_stamps = move_channels(log, {channel: 0.0})
    means = channel_means(with_stamps, channel, edges, rms=is_rms_channel(channel))
    return means**2 if is_rms_channel(channel) else means


def _correlate_with_itself(parts: Floats, shifts: Ints) -> Floats:
    """Return the correlations of a channel with itself, moved round the record by parts."""
    centred = np.nan_to_num(parts - np.nanmean(parts))
    spectrum = np.abs(np.fft.rfft(centred)) ** 2
    products = np.fft.irfft(spectrum, centred.size)
    return np.asarray(products[shifts % centred.size] / products[0])
