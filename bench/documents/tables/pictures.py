"""The pictures of docs/tables.md, drawn from the numbers in docs/tables.json (needs matplotlib)."""

from __future__ import annotations

import re
from io import StringIO
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes

from bench.documents.tables.parallelogram import COMMANDED
from bench.documents.tables.slider_crank import QUANTITIES, TABLE_5_11

matplotlib.use("svg")
matplotlib.rcParams.update(
    {
        "svg.hashsalt": "parallel_cal",  # the same picture byte for byte
        "svg.fonttype": "none",  # text as text: small files
        "font.family": "DejaVu Sans",
        "font.size": 9,
        "axes.spines.top": False,
        "axes.spines.right": False,
    }
)
import matplotlib.pyplot as plt  # noqa: E402

OURS, THESIS, THIRD = "#2f7f6f", "#b0413e", "#d98e32"
COLOURS = {"none": "0.55", "classical": THIRD, "improved": OURS, "exact": "#3b6ea5"}
LABELS = {
    "a": "error of a [um]",
    "b": "error of b [um]",
    "q0": "error of q0 [arcsec]",
    "Q": "merit Q [mm^4]",
    "F_pos": "factor of improvement, position",
    "F_joint": "factor of improvement, joint",
}


def draw(document: dict[str, Any], folder: Path) -> None:
    folder.mkdir(exist_ok=True)
    figures = {
        "slider_crank_methods": slider_crank_methods(document["slider_crank"]["methods"]),
        "slider_crank": slider_crank(document["slider_crank"]["figures"]),
        "delta_number_of_poses": number_of_poses(document["delta"]["figure_5_17"]),
        "paper_parallelogram": parallelogram(document["paper"]["parallelogram"]),
        "paper_delta51": delta51(document["paper"]["delta51"]),
    }
    for name, figure in figures.items():
        (folder / f"{name}.svg").write_text(_svg(figure))
        plt.close(figure)


def _svg(figure: Any) -> str:
    """The picture with coordinates to a hundredth of a point, and fonts for every machine."""
    file = StringIO()
    figure.savefig(file, format="svg", metadata={"Date": None})
    short = re.sub(r"(\d\.\d\d)\d+", r"\1", file.getvalue())
    return short.replace("'DejaVu Sans'", "'DejaVu Sans', Verdana, sans-serif")


def slider_crank_methods(methods: dict[str, Any]) -> Any:
    """Ranges of 99 % (thin) and 90 % (thick), median, and the thesis' number, a row a method."""
    figure, axes = plt.subplots(2, 3, figsize=(9.6, 4.8), sharey=True, layout="constrained")
    names = list(TABLE_5_11)
    for panel, key in zip(axes.flat, QUANTITIES, strict=True):
        for row, name in enumerate(names):
            entry = methods[name][key]
            least, low, middle, high, most = entry["quantiles"]
            panel.plot([least, most], [row, row], color=OURS, lw=1)
            panel.plot([low, high], [row, row], color=OURS, lw=5, alpha=0.45, solid_capstyle="butt")
            panel.plot(middle, row, "|", color=OURS, ms=10, mew=2)
            panel.plot(entry["printed"], row, "D", color=THESIS, ms=5)
        panel.set(xlabel=LABELS[key], yticks=range(len(names)), ylim=(len(names) - 0.5, -0.5))
        panel.set_yticklabels(names)
    handles = [
        plt.Line2D([], [], color=OURS, lw=1, label="ours, 99 % of the draws"),
        plt.Line2D([], [], color=OURS, lw=5, alpha=0.45, label="90 %"),
        plt.Line2D([], [], color=OURS, ls="", marker="|", ms=10, mew=2, label="median"),
        plt.Line2D([], [], color=THESIS, ls="", marker="D", ms=5, label="thesis"),
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=4, frameon=False)
    return figure


def slider_crank(figures: dict[str, Any]) -> Any:
    figure, (points, before, off) = plt.subplots(1, 3, figsize=(9.6, 3.0), layout="constrained")
    points.plot(figures["5.5"]["q_deg"], figures["5.5"]["x_mm"], ".", color=OURS)
    points.set(title="figure 5.5: points", xlabel="crank angle q [deg]", ylabel="slider x [mm]")
    at = 1 + np.arange(len(figures["5.8"]["before_mm2"]))
    before.bar(at, figures["5.8"]["before_mm2"], color="0.8", label="before")
    before.bar(at, figures["5.8"]["after_mm2"], color=OURS, label="after")
    before.set(title="figure 5.8: residuals", xlabel="point", ylabel="residual [mm^2]")
    before.set(ylim=(-165, 15))
    before.legend(frameon=False, loc="lower center", ncols=2)
    curves, x = figures["5.10"], figures["5.10"]["x_mm"]
    least, low, high, most = curves["quantiles_arcmin"]
    off.fill_between(x, least, most, color=OURS, alpha=0.15, lw=0, label="ours, 99 %")
    off.fill_between(x, low, high, color=OURS, alpha=0.3, lw=0, label="90 %")
    off.plot(x, curves["printed_arcmin"], color=THESIS, label="thesis")
    off.set(title="figure 5.10: inverse solution")
    off.set(xlabel="slider x [mm]", ylabel="error of q [arcmin]")
    off.legend(frameon=False, fontsize=8)
    return figure


def number_of_poses(numbers: dict[str, Any]) -> Any:
    figure, axes = plt.subplots(figsize=(6.4, 3.4), layout="constrained")
    n = numbers["poses"]
    for key, colour, label in (
        ("measured_um", THESIS, "on the 74 measured poses, as in figure 5.17"),
        ("unseen_um", OURS, "at 300 unseen poses"),
    ):
        low, middle, high = np.array(numbers[key]).T
        axes.fill_between(n, low, high, color=colour, alpha=0.2, lw=0)
        axes.plot(n, middle, ".-", color=colour, label=label)
    axes.axhline(numbers["before_um"], color="0.5", ls="--", lw=1, label="before calibration")
    _plain(axes, [5, 10, 20, 50, 100, 200, 500])
    axes.set(xlabel="poses measured", ylabel="mean position error [um]")
    axes.legend(frameon=False)
    return figure


def parallelogram(tools: dict[str, Any]) -> Any:
    """Above all three ways (mm), below the improved one alone (um)."""
    figure, axes = plt.subplots(2, 2, figsize=(8.4, 4.6), sharex=True, layout="constrained")
    at = np.degrees(COMMANDED[:, 0])
    for (above, below), (h, ways) in zip(axes.T, tools.items(), strict=True):
        errors = ways["first draw_um"]
        for way, values in errors.items():
            above.plot(at, np.array(values) / 1e3, color=COLOURS[way], label=way)
        below.plot(at, errors["improved"], color=COLOURS["improved"])
        above.set(title=f"tool {h}")
        below.set(xlabel="commanded angle [deg]")
        for panel in (above, below):
            panel.axhline(0, color="0.8", lw=0.8, zorder=0)
    axes[0, 0].set(ylabel="error of the tip [mm]")
    axes[1, 0].set(ylabel="improved [um]")
    axes[0, 1].legend(frameon=False, loc="upper left", bbox_to_anchor=(1, 1))
    return figure


def _plain(axes: Axes, ticks: list[float]) -> None:
    """A logarithmic axis with numbers as people write them."""
    axes.set_yscale("log")
    axes.set_yticks(ticks, [f"{t:g}" for t in ticks])
    axes.minorticks_off()


def delta51(sizes: dict[str, Any]) -> Any:
    figure, axes = plt.subplots(1, 2, figsize=(9.6, 3.2), sharey=True, layout="constrained")
    for panel, (size, tools) in zip(axes, sizes.items(), strict=True):
        for k, (way, colour) in enumerate(COLOURS.items()):
            low, middle, high = np.array([e[way]["quantiles"][1:4] for e in tools.values()]).T
            at = np.arange(len(tools)) + 0.18 * (k - 1.5)
            panel.vlines(at, low, high, color=colour, lw=5, alpha=0.4)
            panel.plot(at, middle, "o", color=colour, ms=5, label=way)
        panel.set(title=f"robots off by {size}", xlabel="tool beyond the plate")
        panel.set_xticks(range(len(tools)), list(tools))
    _plain(axes[0], [1, 10, 100, 1000, 10000])
    axes[0].set(ylabel="mean error of the tip [um]")
    axes[1].legend(frameon=False, loc="upper left", bbox_to_anchor=(1, 1))
    return figure
