"""Figures against small pictures in ``baseline/``, which were checked by eye.

After an intended change of a figure, remake them with ``python -m tests.plot.test_figures`` (or
``make baseline``), and check them by eye.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from gyrostab.cli import main
from gyrostab.errors import OptionError, OutputError, SchemaError
from gyrostab.io.datasets import to_netcdf
from gyrostab.noise import LAWS
from gyrostab.plot import plot_coefficients, plot_davar, plot_signal
from gyrostab.plot.figures import product_figures, save_figures
from gyrostab.plot.style import save_png
from tests.support import synthetic
from tests.support.pictures import same_layout

BASELINE = Path(__file__).parent / "baseline"
# pixels of a baseline; downscaling removes font hinting and keeps lines and colours
WIDTH = 240
# root mean square difference, of 255; another font hinting gives 2 to 5, a filled gap 25
TOLERANCE = 8.0


def drawings() -> dict[str, Callable[[], Figure]]:
    product = synthetic.product()
    chosen = {
        name: draw
        for name, draw in product_figures(product).items()
        if not name.endswith(("_y", "_z"))
    }
    return {"signal": lambda: plot_signal(synthetic.log()), **chosen}


def picture(figure: Figure) -> Image.Image:
    buffer = io.BytesIO()
    save_png(figure, buffer, dpi=80)
    whole = Image.open(buffer).convert("RGB")
    return whole.resize((WIDTH, round(whole.height * WIDTH / whole.width)), Image.Resampling.BOX)


def difference(expected: Image.Image, drawn: Image.Image) -> float:
    """Root mean square difference after a blur of three pixels, which hides subpixel shifts."""
    assert expected.size == drawn.size
    small = [
        np.asarray(
            image.resize((expected.width // 3, expected.height // 3), Image.Resampling.BOX),
            dtype=float,
        )
        for image in (expected, drawn)
    ]
    return float(np.sqrt(np.mean((small[0] - small[1]) ** 2)))


def baseline(name: str) -> Image.Image:
    return Image.open(BASELINE / f"{name}.png").convert("RGB")


def remake() -> None:
    BASELINE.mkdir(exist_ok=True)
    for name, draw in drawings().items():
        picture(draw()).save(BASELINE / f"{name}.png", optimize=True)


@same_layout
@pytest.mark.parametrize("name", list(drawings()))
def test_figure_matches_its_baseline(name):
    assert difference(picture(drawings()[name]()), baseline(name)) < TOLERANCE


@same_layout
def test_comparison_detects_a_change_of_content():
    product = synthetic.product()
    filled = product.assign(
        avar=product["avar"].where(product["estimator"] > 0, product["avar"][:, 0])
    )  # no gap
    assert difference(picture(plot_davar(filled)), baseline("davar")) > 2 * TOLERANCE
    noisier = product.assign(
        avar=product["avar"] * np.where(np.arange(product.sizes["time"]) > 30, 9.0, 1.0)[:, None]
    )
    assert difference(picture(plot_davar(noisier)), baseline("davar")) > 2 * TOLERANCE


@same_layout
def test_comparison_ignores_another_font():
    import matplotlib as mpl

    with mpl.rc_context({"font.family": "DejaVu Serif", "text.hinting": "none"}):
        assert difference(picture(drawings()["davar"]()), baseline("davar")) < TOLERANCE


def test_legend_omits_cells_without_estimate_if_there_are_none():
    product = synthetic.product(axes="x")
    whole = product.isel(time=slice(0, 15))
    assert not plot_davar(whole).legends
    (legend,) = plot_davar(product).legends
    assert [text.get_text() for text in legend.get_texts()] == [
        "no estimate (gap, or too few terms)",
        "estimated from incomplete (weighted) clusters",
    ]
    gap = product.isel(time=slice(0, 23))  # the gap without the weighted stretch
    assert [text.get_text() for text in plot_davar(gap).legends[0].get_texts()] == [
        "no estimate (gap, or too few terms)"
    ]


def test_legend_of_coefficients_lists_what_is_drawn():
    product = synthetic.product(axes="x").load()

    def labels():
        (legend,) = plot_coefficients(product).legends
        return [text.get_text() for text in legend.get_texts()]

    observed, limit, hidden = "standard error", "95 % upper limit", "not observable"
    assert labels() == ["axis x", observed, limit, hidden]
    product["observable"] = product.observable.where(product.observable != 0, 1)
    assert labels() == ["axis x", observed, limit]
    product["observable"] = product.observable * 0 + 2
    assert labels() == ["axis x", observed]
    product["observable"] = product.observable * 0
    assert labels() == ["axis x", hidden]


def test_axis_labels_do_not_overlap_tick_labels():
    product = synthetic.product(axes="x")
    figures = [plot_davar(product), plot_davar(product.isel(tau=slice(4, 7)))]
    # linear scale, a log scale of little more than a decade, one of many
    for spread in (1.0, 20.0, 1e4):
        factor = np.geomspace(1.0, spread, product.sizes["time"])
        scaled = product.assign({symbol: factor * product[symbol] for symbol in LAWS})
        figures.append(plot_coefficients(scaled))
    for figure in figures:
        renderer = figure.canvas.get_renderer()
        figure.draw(renderer)
        for panel in figure.axes:
            if panel.get_position().x0 > 0.5:  # the colour bar
                continue
            low, high = panel.get_ylim()
            ticks = [
                label.get_window_extent(renderer)
                for label in panel.get_yticklabels(which="both")
                if label.get_text() and low <= label.get_position()[1] <= high  # is drawn
            ]
            label = panel.yaxis.label.get_window_extent(renderer)
            assert len(ticks) >= 2
            assert label.x0 > 0.0
            assert label.x1 < min(tick.x0 for tick in ticks)


def test_all_figures_of_a_product(tmp_path, capsys):
    source = str(to_netcdf(synthetic.product(axes="x"), tmp_path / "product.nc"))
    target = tmp_path / "new" / "figures"
    assert main(["plot", source, "-o", str(target)]) == 0
    names = [
        "adev_x.png",
        "coefficients.png",
        "davar.png",
        "davar_3d_x.png",
        "davar_change.png",
        "temperature.png",
    ]
    assert sorted(path.name for path in target.iterdir()) == names
    assert sorted(Path(line).name for line in capsys.readouterr().out.splitlines()) == names
    for path in target.iterdir():
        assert Image.open(path).width >= 600
    (target / "davar.png").unlink()
    assert main(["plot", source, "-o", str(target)]) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert not (target / "davar.png").exists()


def test_unusual_axis_names_and_single_windows_are_drawn(tmp_path):
    product = synthetic.product(axes="x").isel(time=[0]).assign_coords(axis=["gyro 1/a"])
    assert [path.name for path in save_figures(product, tmp_path, dpi=50)][3:] == [
        "temperature.png",
        "adev_gyro_1_a.png",
    ]


def test_each_axis_has_its_own_figures(monkeypatch, tmp_path):
    figures = dict.fromkeys(["adev_a/b", "adev_a_b", "adev_A?B"], Figure)
    monkeypatch.setattr("gyrostab.plot.figures.product_figures", lambda product, width: figures)
    saved = [path.name for path in save_figures(synthetic.product(), tmp_path, dpi=20)]
    assert saved == ["adev_a_b.png", "adev_a_b_.png", "adev_A_B__.png"]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(saved)


def test_wrong_input_and_existing_figures_are_refused(tmp_path):
    with pytest.raises(SchemaError, match="no coefficients yet"):
        save_figures(synthetic.surface(), tmp_path)
    for dpi in (0, "300"):
        with pytest.raises(OptionError, match=f"dpi={dpi!r}: give pixels per inch, above 0"):
            save_figures(synthetic.product(), tmp_path, dpi=dpi)
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="is a file; give the name of a folder"):
        save_figures(synthetic.product(), tmp_path / "file")


if __name__ == "__main__":
    remake()
