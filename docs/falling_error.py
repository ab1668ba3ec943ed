"""Draws docs/falling_error.svg: the error of a virtual Delta at poses that no fit has seen.

.venv/bin/pip install matplotlib && .venv/bin/python docs/falling_error.py
"""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("svg")
matplotlib.rcParams["svg.hashsalt"] = "parallel_cal"  # the same picture byte for byte
matplotlib.rcParams["font.family"] = "DejaVu Sans"
import matplotlib.pyplot as plt
import numpy as np

from parallel_cal.accuracy import Errors
from parallel_cal.dataset import load_dataset
from parallel_cal.identification import fit
from parallel_cal.modelfile import read_model

REPOSITORY = Path(__file__).parents[1]
STEPS = ("controller's\nnominal model", "geometry\nidentified", "backlash\nadded")
COLOURS = ("#b0413e", "#d98e32", "#2f7f6f")


def steps() -> tuple[list[np.ndarray], float]:
    """Held-out position errors (um) before, after the fit, after adding the effect; noise."""
    model = read_model(REPOSITORY / "config" / "delta_mockup_nominal.yaml")
    data = load_dataset(REPOSITORY / "bags" / "delta_backlash")
    geometry = fit(model, data)
    effect = fit(geometry.model.with_effect("backlash"), data)
    errors: list[Errors] = [geometry.before, geometry.held_out, effect.held_out]
    return [e.norms("position") * 1e6 for e in errors], effect.noise["position_mean"] * 1e6


def draw() -> None:
    norms, noise = steps()
    figure, axes = plt.subplots(figsize=(7.2, 3.6), layout="constrained")
    spread = np.random.default_rng(0).uniform(-0.28, 0.28, (len(norms), len(norms[0])))
    for k, values in enumerate(norms):
        axes.scatter(k + spread[k], values, s=9, color=COLOURS[k], alpha=0.45, linewidths=0)
        mean = values.mean()
        axes.plot([k - 0.33, k + 0.33], [mean, mean], color=COLOURS[k], lw=2.5)
        label = f"{mean:.0f} \N{MICRO SIGN}m" if mean > 100 else f"{mean:.1f} \N{MICRO SIGN}m"
        above = (k, values.max() * 1.25)
        axes.annotate(label, above, ha="center", fontsize=12, weight="bold", color=COLOURS[k])
    axes.axhline(noise, color="0.35", lw=1, ls=(0, (4, 3)))
    axes.annotate(
        f"noise alone: {noise:.1f} \N{MICRO SIGN}m",
        (-0.45, noise * 0.88), va="top", fontsize=9, color="0.35",
    )  # fmt: skip
    axes.set(yscale="log", ylim=(3, 1500), xlim=(-0.5, 2.5), xticks=range(3))
    axes.set_xticklabels(STEPS)
    axes.set_ylabel("position error at unseen poses [\N{MICRO SIGN}m]")
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(REPOSITORY / "docs" / "falling_error.svg", metadata={"Date": None})


if __name__ == "__main__":
    draw()
