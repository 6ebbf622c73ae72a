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
from gyrostab.store.output import replace_file, write_text
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
    """Compute the SHA-256 of a committed text."""
    return hashlib.sha256(text.encode()).hexdigest()


def commit_case(log: xr.Dataset, truth: dict[str, Any], directory: Path, *, name: str) -> str:
    """Write ``recordings/NAME.nc``, then ``truth/NAME.json``; return the SHA-256 of the latter.

    `gyrostab.read_log` reads the recording like any foreign NetCDF file. The name must not reveal
    the content, and the SHA-256 is to be published before the recording is diagnosed.
    """
    text, handed = truth_text(truth), log.copy()
    for variable in handed.variables.values():
        if "units" in variable.attrs:
            variable.attrs = {**variable.attrs, "units": on_disk(variable.attrs["units"])}
    packing: dict[Any, dict[str, Any]] = {
        str(key): {"zlib": True, "complevel": 1} for key in handed.data_vars if handed[key].ndim
    }
    packing |= {
        str(key): {"dtype": "int64", "units": "nanoseconds since 1970-01-01"}
        for key in handed.variables
        if np.issubdtype(handed[key].dtype, np.datetime64)
    }
    with replace_file(directory / "recordings" / f"{name}.nc") as temporary:
        handed.to_netcdf(temporary, engine="netcdf4", encoding=packing)
    write_text(directory / "truth" / f"{name}.json", text)
    return fingerprint(text)


def open_truth(path: Path, *, sha256: str) -> dict[str, Any]:
    """Read a truth; raise `FormatError` unless it is the one that was committed as `sha256`."""
    text = path.read_text(encoding="utf-8")
    if fingerprint(text) != sha256:
        raise FormatError(
            f"{path}: the truth was changed after it was committed "
            f"(SHA-256 {fingerprint(text)[:12]}..., committed as {sha256[:12]}...)"
        )
    return dict(json.loads(text))
