"""Correlate a product with a temperature from another file; write NetCDF and a figure."""

import sys
import tomllib
from pathlib import Path

import gyrostab
from gyrostab.errors import GyrostabError


def chain(plan, folder):
    """Correlate a product with a channel of another file; paths are relative to the plan."""
    product = gyrostab.open_product(folder / plan["product"])
    channel = gyrostab.read_channel(
        folder / plan["channel"]["file"], plan["channel"]["name"], **plan["channel"].get("read", {})
    )
    correlation = gyrostab.correlate(product, channel=channel, **plan["correlate"])
    gyrostab.to_netcdf(correlation, folder / plan["output"], overwrite=True)
    gyrostab.plot_correlation(correlation).savefig(folder / plan["figure"], dpi=150)
    return correlation


def sentences(correlation):
    """List the statements about every axis, variable and driver that is or may be coupled."""
    meanings = correlation["coupling_verdict"].attrs["flag_meanings"].split()
    statements = correlation["statement"].where(
        correlation["coupling_verdict"] >= meanings.index("not_told_apart"), ""
    )
    return [str(sentence) for sentence in statements.values.ravel() if sentence] or [
        "No dependence is seen."
    ]


if __name__ == "__main__":
    plan_file = Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).with_suffix(".toml"))
    try:
        result = chain(tomllib.loads(plan_file.read_text(encoding="utf-8")), plan_file.parent)
    except (GyrostabError, OSError) as error:
        sys.exit(f"{error}")
    print(*sentences(result), sep="\n")
