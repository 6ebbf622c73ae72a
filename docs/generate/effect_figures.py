"""Draw a log with and without each physical effect; write figures and table of docs/physics/.

Each effect has its experiment in effect_figures.toml; ``python docs/generate/effect_figures.py
shupe warm_up`` makes some of them.
"""

import re
import sys
import textwrap
import tomllib
from dataclasses import replace
from pathlib import Path

from effect_comparison import plot_comparison

from gyrostab.physics.registry import effects
from gyrostab.plot.style import save_png
from gyrostab.simulate import read_model, simulate

ROOT = Path(__file__).resolve().parents[2]
PLAN = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
DEFAULTS = PLAN.pop("defaults")
OPTIONS = ("window", "step", "moments", "driver", "difference", "coherency")


def simulate_pair(name):
    """Simulate the experiment of an effect without and with it, from the same seed."""
    entry = PLAN[name]
    model = read_model(
        {part: DEFAULTS[part] | entry.get(part, {}) for part in ("log", "noise")}
        | entry.get("also", {})
    )
    effect = effects()[name].example(**entry.get("values", {}))
    return [
        simulate(replace(model, effects=model.effects + more)).load() for more in ((), (effect,))
    ]


def draw(name, folder):
    """Make the figure of one effect as a small PNG."""
    options = {key: PLAN[name][key] for key in OPTIONS if key in PLAN[name]}
    folder.mkdir(parents=True, exist_ok=True)
    save_png(
        plot_comparison(*simulate_pair(name), **options),
        folder / f"{name}.png",
        dpi=120,
        colours=256,
    )
    return folder / f"{name}.png"


def between(text, mark, new):
    """Put `new` between the markers of that name."""
    begin, end = f"<!-- {mark} -->\n", f"<!-- end of {mark} -->\n"
    return re.sub(
        f"{re.escape(begin)}.*?{re.escape(end)}", lambda _: begin + new + end, text, flags=re.S
    )


def illustrate(page):
    """Give each section of a page the figure of its effect, at its end."""
    parts = re.split(r"(?m)^(?=## )", page.read_text(encoding="utf-8"))
    for number, part in enumerate(parts):
        name = part[3:].split("\n", 1)[0].strip()
        if part.startswith("## ") and name in PLAN:
            if "<!-- figure -->" not in part:
                part = (
                    part.rstrip("\n")
                    + "\n\n<!-- figure -->\n<!-- end of figure -->\n"
                    + "\n" * (number + 1 < len(parts))
                )
            kind = effects()[name]
            image = f"![{kind.plain or kind.short}](../figures/effects/{name}.png)"
            parts[number] = between(
                part,
                "figure",
                f"{image}\n\n{textwrap.fill(PLAN[name]['caption'], 118, break_on_hyphens=False)}\n",
            )
    page.write_text("".join(parts), encoding="utf-8")


def amounts(kind):
    """The parameters of an effect with their typical sizes."""
    for known in kind.parameters():
        sizes = known.typical if isinstance(known.typical, tuple) else (known.typical,)
        numbers = ", ".join(size if isinstance(size, str) else f"{size:g}" for size in sizes)
        yield (
            f"`{known.name}` {numbers} {known.unit}".removesuffix(" 1").removesuffix(" text")
            if sizes
            else f"`{known.name}`"
        )


def rows(pages):
    """The table of all effects."""
    for name, kind in effects().items():
        home = next(
            page.name for page in pages if f"\n## {name}\n" in page.read_text(encoding="utf-8")
        )
        drivers = ", ".join(f"`{channel}`" for channel in kind.channels) or "–"
        cells = (
            f"[{name}]({home}#{name})",
            kind.short,
            drivers,
            kind.stage,
            "; ".join(amounts(kind)),
        )
        yield f"| {' | '.join(cells)} |\n"


if __name__ == "__main__":
    for effect in sys.argv[1:] or PLAN:
        print(draw(effect, ROOT / "docs" / "figures" / "effects"))
    index = ROOT / "docs" / "physics" / "README.md"
    sections = [page for page in index.parent.glob("*.md") if page != index]
    for section in sections:
        illustrate(section)
    columns = "| effect | what it does | driver | stage | parameters and typical sizes |"
    head = f"{columns}\n|---|---|---|---|---|\n"
    index.write_text(
        between(index.read_text(encoding="utf-8"), "effects", head + "".join(rows(sections))),
        encoding="utf-8",
    )
