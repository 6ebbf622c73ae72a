"""Checks of options before the computation starts."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from gyrostab.errors import OptionError


def check_options(
    *,
    reading: Mapping[str, Any] | None = None,
    windows: Mapping[str, Any] | None = None,
    fitting: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Check the options of a run as far as they do not depend on the log; return them as dicts.

    Raises
    ------
    OptionError
        When one of them cannot be used.
    """
    from gyrostab.allan.fit_inputs import check_fit_options
    from gyrostab.ingest.uniform import check_cut

    options = {
        "reading": dict(reading or {}),
        "windows": dict(windows or {}),
        "fitting": dict(fitting or {}),
    }
    check_cut(**options["reading"])
    _check_windows(**options["windows"])
    check_fit_options(**options["fitting"])
    return options


def _check_windows(
    *,
    window: str | None = None,
    step: str | None = None,
    taus: Any = "40",
    tau_max: str | None = None,
    **other: Any,
) -> None:
    """Check options of `gyrostab.allan.davar.davar`, as text; others than these are ignored.

    Raises
    ------
    OptionError
        When one of them is not a duration, or the step or an averaging time is too long for the
        window.

    Examples
    --------
    >>> _check_windows(window="10", step="1min")
    Traceback (most recent call last):
    gyrostab.errors.OptionError: window 10 has no unit; write '10s' for seconds or '10samples' ...
    """
    from gyrostab.time.durations import TAUS, averaging_factors, duration_seconds, samples

    fine = 1e6  # Hz; the true rate is not known yet
    length = math.inf if window is None else samples(window, fine, "window")
    step_length = samples(step, fine, "step") if step else 1
    if window and step and ("sample" in window) == ("sample" in step) and step_length > length:
        raise OptionError(
            f"the step of {step} is longer than the window of {window}, "
            "so samples would be left out; give a shorter step (--step)"
        )
    # the duration of a number of samples depends on the rate
    half = math.inf if window and "sample" in window else length / fine / 2
    lengths = [(tau_max, duration_seconds(tau_max, "tau_max"))] if tau_max else []
    if isinstance(taus, int) or (isinstance(taus, str) and taus.strip().isdigit()):
        averaging_factors(taus, rate=fine, window=2)
    elif isinstance(taus, str) and taus.strip() not in ("octave", "all"):
        listed = taus.split(",")
        lengths += [(tau, duration_seconds(tau, "tau", example=TAUS)) for tau in listed]
    for tau, seconds in lengths:
        if seconds > half:
            raise OptionError(
                f"tau {tau.strip()} is longer than half of the window of {window}, "
                "so no second difference fits; "
                "give a longer window (--window) or a shorter tau"
            )
