"""Fill in an HTML template of this package."""

from __future__ import annotations

from datetime import UTC, datetime
from importlib import metadata, resources
from typing import Any

from gyrostab.report.charts import plotly_script


def page_text(template: str, *, title: str, plotly: str = "", **content: Any) -> str:
    """Render a template, with the time and the version that made the page.

    Parameters
    ----------
    template : str
        Name of the template, which extends ``frame.html.jinja``.
    plotly : str
        Address of plotly.js, relative to the page; by default the page holds all of it.
    """
    import jinja2

    templates = jinja2.Environment(
        loader=jinja2.PackageLoader("gyrostab", "report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
    )
    script = resources.files("gyrostab.report").joinpath("charts.js")
    made = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    return templates.get_template(template).render(
        title=title,
        made=made,
        version=metadata.version("gyrostab"),
        plotly="" if plotly else plotly_script(),
        plotly_address=plotly,
        charts_script=script.read_text(encoding="utf-8"),
        **content,
    )
