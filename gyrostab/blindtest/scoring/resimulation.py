"""Compare a recording with records simulated from the model of its diagnosis, without any refit.

The model is simulated several times on the stamps and channels of the recording, with and without
its effects, and with the noise that was calibrated before any effect was known. Statistics of these
records have a mean and a scatter in each ensemble, and the recording has a likelihood under each (a
synthetic likelihood: Wood 2010, Nature 466, 1102, doi:10.1038/nature09319, here with independent
statistics). All have the same seeds: statistics that no effect changes cancel.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping
from itertools import combinations, pairwise
from typing import Any

import numpy as np
import xarray as xr
from numpy.lib.stride_tricks import sliding_window_view
from scipy.special import ndtri

from gyrostab.arrays import Array, Complexes, Floats
from gyrostab.errors import GyrostabError
from gyrostab.time.stamps import to_nanoseconds

_RECORDS = 8  # simulated with and without effects; limits time
_SEGMENTS = 32  # of a record, for statistics that change over time
_MEANS = 1024  # of a record, from which differences of all lengths are taken
_BANDS, _LINES = 10, 512  # octaves below half of the rate; frequencies of the mean spectrum
_RAMP_BINS = 36
_MIN_TURNS = 2.0  # in a segment, of which an amplitude at multiples of the rotation is measured
_MIN_CHANNEL_SHARE = 0.9  # values per sample of a channel that is compared sample by sample
_TAIL_FREEDOM = 5.0  # of Student's law, which bounds what a single statistic decides
_ROUNDS = 50  # of the iteration for the scale
_NEIGHBOURS = 4  # samples on either side, from the median of which an outlier departs
#: Least scatter of roots of counts: that of a Poisson count is 1/2.
_MIN_SCATTER = {"count": 0.5, "ramp": 1e-6, "levels": 0.02}


def check_model(
    log: xr.Dataset, model: Mapping[str, Any], calibrated: Mapping[str, Mapping[str, float]]
) -> dict[str, Any]:
    """Simulate the model of a diagnosis like its recording, in memory, and compare both.

    The noise coefficients `calibrated`, by axis, are those without the effects. The noise of the
    model lacks what its effects add, and is easy to beat where they change the noise. Return
    ``runs``, whether the model can be simulated, and ``nats``, the log-likelihood ratio of the
    recording under the model with its effects over the more likely one of the model without them
    and of the calibrated noise; or ``reason``.
    """
    from gyrostab import read_model

    rivals = [{**model, "effect": [], "noise": noise} for noise in (model["noise"], calibrated)]
    if rivals[0] == rivals[1]:
        del rivals[1]
    try:
        with_effects, *rival_ensembles = (
            simulate_statistics(log, read_model(dict(tables))) for tables in (model, *rivals)
        )
    except GyrostabError as error:
        return {"runs": False, "reason": str(error)}
    measured = measure_statistics(log)
    return {
        "runs": True,
        "nats": min(
            likelihood_ratio(measured, with_effects, ensemble) for ensemble in rival_ensembles
        ),
    }


def simulate_statistics(log: xr.Dataset, model: Any) -> list[dict[str, Floats]]:
    """Compute the statistics of records simulated from a model like a recording.

    They have the stamps, channels and lost samples of the recording, and no noise on axes that the
    model does not name.
    """
    from gyrostab import simulate

    lost = ~np.isfinite(log["rate"].values)
    statistics = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for seed in range(1, _RECORDS + 1):
            rate = simulate(model, like=log, seed=seed)["rate"]
            rate = rate.reindex(axis=log["axis"].values, fill_value=0.0)
            statistics.append(record_statistics(np.where(lost, np.nan, rate.values), log))
    return statistics


def measure_statistics(log: xr.Dataset) -> dict[str, Floats]:
    """Compute the statistics of a recording."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return record_statistics(log["rate"].values, log)


def likelihood_ratio(
    recorded: Mapping[str, Floats],
    with_effects: list[dict[str, Floats]],
    without: list[dict[str, Floats]],
) -> float:
    """Return the log-likelihood ratio of statistics under two ensembles of simulated records.

    Statistics of one group have a common scatter and Student's distribution.
    """
    total = 0.0
    for name, values in recorded.items():
        drawn = np.stack(
            [[record[name] for record in ensemble] for ensemble in (with_effects, without)]
        )
        good = np.isfinite(drawn).all(axis=(0, 1)) & np.isfinite(values)
        logs = []
        for ensemble in drawn[..., good] if good.any() else ():
            min_scatter = _MIN_SCATTER.get(re.split("[ /]", name)[0], 1e-12)
            scatter = max(_fit_scatter(ensemble), min_scatter)
            z = (values[good] - np.median(ensemble, axis=0)) / scatter
            logs.append(-np.log(scatter) - (_TAIL_FREEDOM + 1) / 2 * np.log1p(z**2 / _TAIL_FREEDOM))
        if logs:
            total += float((logs[0] - logs[1]).sum())
    return total


def _fit_scatter(ensemble: Floats) -> float:
    """Return the scale of Student's law of new values about the medians of an ensemble.

    It is the most likely one. Mean and variance would be far too large for most values where a few
    records, at random, have a large one: the tails of the law describe these.
    """
    count = len(ensemble)
    square = (ensemble - np.median(ensemble, axis=0)) ** 2 * (count + 0.5 * np.pi) / (count - 1.0)
    scale = max(float(square.mean()), 1e-300)
    for _ in range(_ROUNDS):
        scale = max(
            float(((_TAIL_FREEDOM + 1.0) * square / (_TAIL_FREEDOM + square / scale)).mean()),
            1e-300,
        )
    return float(np.sqrt(scale))


def record_statistics(rate: Floats, log: xr.Dataset) -> dict[str, Floats]:
    """Compute the statistics of a record (axis, time), in groups of equal scatter.

    Differences of means at all lengths, powers in octaves over time, the mean spectrum, coherencies
    of axes, sample counts, and the coupling to the phase of a ramp, to rotation and to channels.
    """
    out: dict[str, Floats] = {}
    hertz = float(log.attrs["sampling_rate_hz"])
    channels = _channels_at_samples(log)
    for row, values in enumerate(rate):
        for group, numbers in {
            **_mean_differences(values),
            **_octave_powers(values),
            **_sample_counts(values),
            **_channel_couplings(values, channels, hertz),
        }.items():
            out[f"{group}/{row}"] = numbers
    spectra = [_segment_spectra(values, 8) for values in rate]
    for row, spectrum in enumerate(spectra):
        lines = np.array_split((np.abs(spectrum[:, 1:]) ** 2).mean(axis=0), _LINES)
        with np.errstate(divide="ignore"):
            out[f"lines/{row}"] = np.log([np.mean(line) for line in lines if line.size])
            out[f"peaks/{row}"] = np.log([np.max(line) for line in lines if line.size])
    for first, second in combinations(range(len(rate)), 2):
        out[f"coherency/{first}{second}"] = _measure_coherencies(spectra[first], spectra[second])
    return out


def _cut_segments(values: Floats, count: int) -> Floats:
    """Return (segment, sample), without the last samples."""
    size = max(values.size // count, 1)
    return values[: size * (values.size // size)][: size * count].reshape(-1, size)


def _mean_differences(values: Floats) -> dict[str, Floats]:
    """Return differences of adjacent means, by the number of means; across gaps where they are."""
    segments = _cut_segments(values, min(_MEANS, max(values.size // 16, 2)))
    count = np.isfinite(segments).sum(axis=1)
    means = np.nanmean(segments[count >= max(count.max() / 2.0, 1.0)], axis=1)
    out = {}
    while means.size >= 2:
        pairs = means[: means.size // 2 * 2].reshape(-1, 2)
        out[f"means {means.size}"] = pairs[:, 1] - pairs[:, 0]
        means = pairs.mean(axis=1)
    return out


def _segment_spectra(values: Floats, count: int) -> Complexes:
    """Return the spectra of tapered segments (segment, frequency); missing samples are 0."""
    segments = _cut_segments(values, count)
    centred = np.nan_to_num(segments - np.nanmean(segments, axis=1, keepdims=True))
    return np.asarray(np.fft.rfft(centred * np.hanning(segments.shape[1]), axis=1))


def _list_octaves(size: int) -> list[tuple[int, int]]:
    """List first frequency and end of the octaves below half of the rate."""
    edges = np.unique(size // 2 ** np.arange(_BANDS + 1))
    return list(pairwise(edges[edges > 0].tolist()))


def _octave_powers(values: Floats) -> dict[str, Floats]:
    """Return log powers of segments, by octave."""
    power = np.abs(_segment_spectra(values, _SEGMENTS)) ** 2
    with np.errstate(divide="ignore"):
        return {
            f"octave {low}": np.log(power[:, low:high].mean(axis=1))
            for low, high in _list_octaves(power.shape[1])
        }


def _measure_coherencies(spectrum: Array, other_spectrum: Array) -> Floats:
    """Return real and imaginary coherency of two axes by octave, in standard deviations."""
    out = []
    for low, high in _list_octaves(spectrum.shape[1]):
        first, second = spectrum[:, low:high], other_spectrum[:, low:high]
        size = np.sqrt((np.abs(first) ** 2).sum() * (np.abs(second) ** 2).sum())
        out.append((first * second.conj()).sum() / size * np.sqrt(2.0 * first.size))
    return np.array([part for number in out for part in (number.real, number.imag)])


def _sample_counts(values: Floats) -> dict[str, Floats]:
    """Return roots of counts: zeros, repeats, range ends, outliers, copies; log number of levels.

    With them, the logarithm of the largest departure of a sample from its neighbours.

    They are of the whole record. Losses are drawn at other instants in each simulated record, so
    that most segments have none and few have many: a common scatter would not describe them.
    """
    steps = np.diff(values, append=np.nan)
    good = values[np.isfinite(values)]
    outliers, largest = _measure_outliers(values)
    counts = {
        "zeros": (values == 0.0).sum(),
        "repeats": ((steps == 0.0) & (values != 0.0)).sum(),
        "ends": ((good == good.min()) | (good == good.max())).sum(),
        "outliers": outliers,
        "copies": good.size - np.unique(good).size,
    }
    return {
        **{f"count {name}": np.sqrt([count + 0.375]) for name, count in counts.items()},
        "levels": np.array([np.log(np.unique(good[:20_000]).size)]),
        "largest departure": np.array([largest]),
    }


def _measure_outliers(values: Floats) -> tuple[int, float]:
    """Count samples that depart from the median of their neighbours by more than chance allows.

    Normal noise has one such sample in a record. Returned with the count is the logarithm of the
    largest departure in units of their standard deviation.
    """
    windows = sliding_window_view(values, 2 * _NEIGHBOURS + 1)
    neighbours = np.delete(windows, _NEIGHBOURS, axis=1)
    departure = np.abs(windows[:, _NEIGHBOURS] - np.median(neighbours, axis=1))
    typical = 1.4826 * np.nanmedian(departure)
    with np.errstate(divide="ignore", invalid="ignore"):
        largest = float(np.log(np.nanmax(departure) / typical))
    return int((departure > -typical * float(ndtri(0.5 / departure.size))).sum()), largest


def _channel_couplings(
    values: Floats, channels: Mapping[str, Floats], hertz: float
) -> dict[str, Floats]:
    """Return the coupling to ramp, rotation, and sample by sample to other channels."""
    out = {}
    centred = values - np.nanmean(values)
    for name, channel in channels.items():
        if name == "ramp":
            low, high = np.nanmin(channel), np.nanmax(channel)
            place = np.nan_to_num((channel - low) / max(high - low, 1e-300) * _RAMP_BINS)
            bins = np.clip(place.astype(np.int64), 0, _RAMP_BINS - 1)
            good = np.isfinite(channel) & np.isfinite(values)
            count = np.bincount(bins[good], minlength=_RAMP_BINS)
            total = np.bincount(bins[good], weights=centred[good], minlength=_RAMP_BINS)
            out["ramp"] = total / np.maximum(count, 1)
        elif name == "rotation_rate":
            turned = np.cumsum(np.nan_to_num(channel)) / hertz / 360.0
            turns = np.abs(np.diff(_cut_segments(turned, _SEGMENTS)[:, [0, -1]], axis=1)[:, 0])
            for order in (1, 2, 3):
                wave = np.exp(-2j * np.pi * order * turned) * np.nan_to_num(centred)
                sums = _cut_segments(wave, _SEGMENTS).mean(axis=1)
                sums[turns < _MIN_TURNS] = np.nan  # at rest it is the mean
                out[f"order {order}"] = np.concatenate([sums.real, sums.imag])
        else:
            products = np.diff(channel) * np.diff(values)
            sums = np.nanmean(_cut_segments(products, _SEGMENTS), axis=1)
            out[f"coupling {name}"] = sums
    return out


def _channels_at_samples(log: xr.Dataset) -> dict[str, Floats]:
    """Return the channels with a value for each sample of the rate, whatever their stamps."""
    from gyrostab.schema import log_channels

    at = to_nanoseconds(log["time"].values)
    channels = {}
    for name in log_channels(log):
        channel = log[name]
        if channel.ndim != 1 or channel.size < _MIN_CHANNEL_SHARE * at.size:
            continue
        stamps = to_nanoseconds(channel[channel.dims[0]].values)
        nearest = np.clip(np.searchsorted(stamps, at), 1, stamps.size - 1)
        nearest -= at - stamps[nearest - 1] < stamps[nearest] - at
        channels[name] = channel.values.astype(np.float64)[nearest]
    return channels
