"""Commit a case: write the recording and the ground truth, and hash the truth before the run."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.blindtest.generator.scenario import stream
from gyrostab.errors import FormatError
from gyrostab.units import on_disk


def truth_text(truth: dict[str, Any]) -> str:
    """Format a truth as the text to commit: JSON with sorted keys, and a nonce against guessing.

    Examples
    --------
    >>> truth_text({"seconds": 1.0, "plan": {"seed": 1, "index": 0}})[:10]
    '{"nonce": '
    """
    plan = truth.get("plan") or {}
    nonce = stream(int(plan.get("seed", 0)), "nonce", int(plan.get("index", 0))).bytes(16).hex()
    return json.dumps({"nonce": nonce, **truth}, sort_keys=True, default=_to_json_type) + "\n"


def _to_json_type(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    raise TypeError(f"a truth cannot hold {type(value).__name__}")


def fingerprint(text: str) -> str:
    """Compute the SHA-256 of a committed text.

    Examples
    --------
    >>> fingerprint("")[:8]
    'e3b0c442'
    """
    return hashlib.sha256(text.encode()).hexdigest()


def commit_case(log: xr.Dataset, truth: dict[str, Any], directory: str | Path, *, name: str) -> str:
    """Write ``recordings/NAME.nc`` and ``truth/NAME.json``; return the SHA-256 of the latter.

    `gyrostab.read_log` reads the recording like any foreign NetCDF file.

    Parameters
    ----------
    directory : path
        Parent of both folders.
    name : str
        Stem of the files; it must not reveal the content.

    Returns
    -------
    str
        SHA-256 to publish before the recording is diagnosed.
    """
    base = Path(directory)
    for folder in ("recordings", "truth"):
        (base / folder).mkdir(parents=True, exist_ok=True)
    text = truth_text(truth)
    (base / "truth" / f"{name}.json").write_text(text, encoding="utf-8")
    handed = log.copy()
    for variable in handed.variables.values():
        if "units" in variable.attrs:
            variable.attrs = {**variable.attrs, "units": on_disk(variable.attrs["units"])}
    packing: dict[Any, dict[str, Any]] = {
        str(key): {"zlib": True, "complevel": 1} for key in handed.data_vars if handed[key].ndim
    }
    packing |= {
        str(key): {"dtype": "int64", "units": "nanoseconds since 1970-01-01"}
        for key in handed.variables
        if _is_time(handed, key)
    }
    handed.to_netcdf(base / "recordings" / f"{name}.nc", engine="netcdf4", encoding=packing)
    return fingerprint(text)


def _is_time(log: xr.Dataset, key: Any) -> bool:
    return bool(np.issubdtype(log[key].dtype, np.datetime64))


def open_truth(path: str | Path, *, sha256: str) -> dict[str, Any]:
    """Read a committed truth.

    Parameters
    ----------
    path : path
        File in the folder ``truth``.
    sha256 : str
        Hash from `commit_case`.

    Raises
    ------
    FormatError
        When the file is not the one that was committed.
    """
    text = Path(path).read_text(encoding="utf-8")
    if fingerprint(text) != sha256:
        raise FormatError(
            f"{path}: the truth was changed after it was committed "
            f"(SHA-256 {fingerprint(text)[:12]}..., committed as {sha256[:12]}...)"
        )
    return dict(json.loads(text))
