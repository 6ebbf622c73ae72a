"""Inputs of the commands that write, and what lies in a folder before and after them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from gyrostab import davar, fit_noise, open_log, to_netcdf, to_zarr
from tests.support.command_line import call, write_log


def read_tree(folder: Path) -> dict[str, object]:
    """What lies in a folder: content of files, target of links, None for folders."""
    return {
        path.relative_to(folder).as_posix(): os.readlink(path)
        if path.is_symlink()
        else path.read_bytes()
        if path.is_file()
        else None
        for path in sorted(folder.rglob("*"))
    }


def write_inputs(folder: Path, *, seconds: float, **windows: Any) -> Path:
    """A log as text, file and store, a product and a model."""
    write_log(folder / "log.csv", seconds)
    assert call("ingest", folder / "log.csv", "-o", folder / "log.nc", "--quiet-progress") == 0
    log = open_log(folder / "log.nc")
    to_zarr(log, folder / "log.zarr")
    to_netcdf(fit_noise(davar(log, **windows)), folder / "product.nc")
    (folder / "model.toml").write_text("[noise]\nN = 0.02\n")
    return folder
