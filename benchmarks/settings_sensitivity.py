"""Verdicts and names of small diagnoses with each setting of `gyrostab.diagnose` scaled.

    python benchmarks/settings_sensitivity.py
    python benchmarks/settings_sensitivity.py --factors 0.5 2 --records null jump --only clear_sigma
    python benchmarks/settings_sensitivity.py --local

Each record is simulated with known truth and diagnosed with the default settings and then with one
setting scaled. With --local the settings keep their defaults, and all numeric constants of one
module at a time are scaled: those that set only accuracy and cost must change nothing. Prints a
Markdown table; a cell lists the records whose verdict or names change, or is empty.
"""

from __future__ import annotations

import ast
import importlib
import pkgutil
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import xarray as xr
from page import machine, make_parser, table

import gyrostab
from gyrostab.diagnose.settings import DEFAULTS, Settings
from gyrostab.errors import GyrostabError
from gyrostab.simulate import simulate

NOISE = {"N": 0.003, "B": 0.004, "K": 0.02}
VIBRATION = {"profile": "vibration", "points": [[0, 0.02], [200, 3.0], [400, 0.02]]}
TEMPERATURE = {"profile": "ramps", "channel": "temperature", "unit": "degC"}
EFFECTS: dict[str, tuple[list[dict[str, Any]], list[dict[str, Any]]]] = {
    "null": ([], []),
    "jump": ([{"name": "bias_jump", "step": 0.3, "at": 290.0}], []),
    "vibration": ([{"name": "vibration_noise", "white": 0.003}], [VIBRATION]),
    "temperature": (
        [{"name": "temperature_bias", "sensitivity": 0.05}],
        [TEMPERATURE | {"points": [[0, 20], [300, 40], [600, 25]]}],
    ),
    "line": ([{"name": "spectral_line", "frequency": 1.0, "amplitude": 1.0}], []),
}


def main() -> None:
    """Diagnose each record with the defaults and with every number scaled; print the table."""
    parser = make_parser(__doc__, has_page=False)
    parser.add_argument("--factors", type=float, nargs="+", default=[0.5, 0.8, 1.25, 2.0])
    parser.add_argument("--records", nargs="+", choices=EFFECTS, default=list(EFFECTS))
    parser.add_argument("--only", nargs="+", help="settings, or modules with --local")
    parser.add_argument("--local", action="store_true", help="scale constants of modules")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    logs = {name: make_record(name) for name in options.records}
    usual = {name: decide(log) for name, log in logs.items()}
    print(f"{machine()}; 100 null records.\n")
    for name, decision in usual.items():
        print(f"- {name}: {decision[0]}, {', '.join(map(' '.join, decision[1])) or 'no effect'}")
    rows = []
    kind = modules() if options.local else {item.name: item.name for item in fields(Settings)}
    for name, target in kind.items():
        if options.only and name not in options.only:
            continue
        cells = []
        for factor in options.factors:
            changed = [
                record
                for record in logs
                if decide_scaled(logs[record], target, factor) != usual[record]
            ]
            cells.append(", ".join(changed))
        rows.append([f"`{name}`", *cells])
        print(*rows[-1], sep=" | ", flush=True)
    print(table(["number", *(f"times {factor:g}" for factor in options.factors)], rows))


def make_record(name: str) -> xr.Dataset:
    """Simulate 10 min of one axis at 5 Hz."""
    effects, environment = EFFECTS[name]
    model = {
        "log": {"axes": ["x"]},
        "noise": NOISE,
        "effect": effects,
        "environment": environment,
    }
    return simulate(model, duration="600s", rate=5, seed=1)


def decide(log: xr.Dataset, settings: Settings = DEFAULTS) -> tuple[str, list[tuple[str, ...]]]:
    """Return verdict and names, each with its axes."""
    try:
        diagnosis = gyrostab.diagnose(log, nulls=100, settings=settings)
    except GyrostabError as error:
        return type(error).__name__, []
    return diagnosis.verdict, sorted(
        (effect["name"], *effect["axes"]) for effect in diagnosis.effects
    )


def decide_scaled(
    log: xr.Dataset, target: str | ModuleType, factor: float
) -> tuple[str, list[tuple[str, ...]]]:
    """Return verdict and names with one setting, or the constants of a module, scaled."""
    if isinstance(target, str):
        return decide(log, replace(DEFAULTS, **{target: scale(getattr(DEFAULTS, target), factor)}))
    with scaled_constants(target, factor):
        return decide(log)


def scale(value: Any, factor: float) -> Any:
    """Scale a number, or all numbers of a tuple; a whole number changes by at least one.

    Examples
    --------
    >>> scale(3, 1.25), scale((0.5, 2.0), 2.0)
    (4, (1.0, 4.0))
    """
    if isinstance(value, tuple):
        return tuple(scale(item, factor) for item in value)
    if isinstance(value, int):
        return round(value * factor) if round(value * factor) != value else value + (factor > 1.0)
    return value * factor


def modules() -> dict[str, ModuleType]:
    """Return the modules of the diagnosis that have numeric constants."""
    package = importlib.import_module("gyrostab.diagnose.core").__package__
    place = sys.modules[package].__path__
    loaded = {
        item.name: importlib.import_module(item.name)
        for item in pkgutil.walk_packages(place, f"{package}.")
    }
    return {name: module for name, module in loaded.items() if constants(module)}


def constants(module: ModuleType) -> dict[str, Any]:
    """Return the upper-case numbers, and tuples of numbers, that a module defines."""
    body = ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8")).body
    names = [
        target.id
        for node in body
        if isinstance(node, ast.Assign)
        for target in node.targets
        if isinstance(target, ast.Name) and target.id.isupper()
    ]
    return {name: value for name in names if is_number(value := getattr(module, name))}


def is_number(value: Any) -> bool:
    """Return whether a value is a number, or a tuple of numbers."""
    if isinstance(value, tuple):
        return bool(value) and all(map(is_number, value))
    return isinstance(value, int | float) and not isinstance(value, bool)


@contextmanager
def scaled_constants(module: ModuleType, factor: float) -> Iterator[None]:
    """Scale the constants of a module, also where other modules import them."""
    own = constants(module)
    holders = [
        (other, name, value)
        for other in modules().values()
        for name, value in own.items()
        if other is module or (vars(other).get(name) is value and name not in constants(other))
    ]
    for holder, name, value in holders:
        setattr(holder, name, scale(value, factor))
    try:
        yield
    finally:
        for holder, name, value in holders:
            setattr(holder, name, value)


if __name__ == "__main__":
    main()
