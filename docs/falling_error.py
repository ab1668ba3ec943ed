"""Draw docs/falling_error.svg from the answers of kinematics_node at held-out poses.

.venv/bin/pip install matplotlib && .venv/bin/python docs/falling_error.py

Both nodes run. Their answers are stored in docs/falling_error.json. With --draw, the script draws
the picture from the stored answers and starts no node.
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from io import StringIO
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("svg")
matplotlib.rcParams["svg.hashsalt"] = "parallel_cal"  # the same picture byte for byte
matplotlib.rcParams["font.family"] = "DejaVu Sans"
import matplotlib.pyplot as plt
import numpy as np

REPOSITORY = Path(__file__).parents[1]
sys.path.insert(0, str(REPOSITORY / "test" / "helpers"))  # both_nodes
RECORD = REPOSITORY / "docs" / "falling_error.json"
PRESET, BAG = (
    REPOSITORY / p for p in ("config/delta_mockup_nominal.yaml", "bags/delta_gear_ripple")
)
STEPS = ("controller's\nnominal model", "geometry\nidentified", "{}\nadded, as diagnosed")
COLOURS = ("#b0413e", "#d98e32", "#2f7f6f")
FOLDS = 8  # each pose is answered for by models identified without it
UM = "\N{MICRO SIGN}m"
PICTURE = REPOSITORY / "docs" / "falling_error.svg"
# On a dark page, light becomes dark and hues stay. The picture has no ground of its own.
DARK = """<style>
@media (prefers-color-scheme: dark) { svg { filter: invert(1) hue-rotate(180deg) brightness(1.4) } }
</style>"""


# ------------------------------------------------------------------ asking the nodes


def measure() -> dict[str, Any]:
    """Positions (m) measured and answered: nominal, identified, with the effect diagnosed."""
    from both_nodes import BothNodes

    with tempfile.TemporaryDirectory() as folder:
        model_file = Path(shutil.copy(PRESET, Path(folder) / "robot.yaml"))
        nominal, parts = model_file.read_bytes(), []
        with BothNodes(model_file, BAG.parent) as session:
            session.load(BAG)
            diagnosis = json.loads(session.diagnose(0.25, quiet).json)
            for fold in range(FOLDS):
                model_file.write_bytes(nominal)
                parts.append(_fold(session, fold, diagnosis["effects"][0]))
    return {
        "summary": diagnosis["summary"],
        "effect": diagnosis["effects"][0],
        "noise": diagnosis["noise"]["floor"]["position_mean"],
        **{key: [row for part in parts for row in part[key]] for key in parts[0]},
    }


def _fold(session: Any, fold: int, effect: str) -> dict[str, Any]:
    from parallel_cal.model.file.modelfile import model_hash

    session.wait_until_served(model_hash(PRESET.read_bytes()))
    session.load(BAG)
    samples, joints = session.samples()
    first = {s.id: s.id if s.replicate_of < 0 else s.replicate_of for s in samples}
    poses = list(dict.fromkeys(first.values()))[fold::FOLDS]
    apart = [s for s in samples if first[s.id] in poses]
    session.remove(apart)
    answers = [session.answers(apart, joints).r]
    for better in (lambda: session.identify(0.0, quiet), lambda: session.add_effect(effect)):
        session.wait_until_served(better().hash)
        answers.append(session.answers(apart, joints).r)
    measured = [s.pose.pose.position for s in apart]
    return {
        "measured": [[p.x, p.y, p.z] for p in measured],
        "answered": np.stack(answers, axis=1).tolist(),
    }


def quiet(stage: str, fraction: float) -> None:
    """Nobody looks on."""


# ------------------------------------------------------------------ the picture


def draw(record: dict[str, Any]) -> None:
    measured, answered = np.array(record["measured"]), np.array(record["answered"])
    norms = np.linalg.norm(measured[:, None] - answered, axis=2) * 1e6  # (poses, steps)
    figure, axes = plt.subplots(figsize=(7.2, 3.8), layout="constrained")
    across = np.arange(3) + np.random.default_rng(0).uniform(-0.28, 0.28, norms.shape)
    one = _typical(norms)
    for k, colour in enumerate(COLOURS):
        axes.scatter(across[:, k], norms[:, k], s=9, color=colour, alpha=0.45, linewidths=0)
        _mean(axes, k, norms[:, k])
    axes.plot(across[one, 1:], norms[one, 1:], "o-", ms=7, mfc="none", color="0.15", lw=0.8)
    _two_answers(axes, measured[one], answered[one, 1:], norms[one, 1:])
    axes.axhline(record["noise"] * 1e6, color="0.35", lw=1, ls=(0, (4, 3)))
    axes.annotate(
        f"noise floor: {record['noise'] * 1e6:.1f} {UM}",
        (-0.45, record["noise"] * 0.88e6),
        va="top",
        fontsize=9,
        color="0.35",
    )
    axes.set(yscale="log", ylim=(3, 2200), xlim=(-0.5, 2.5), xticks=range(3))
    axes.set_xticklabels([step.format(record["effect"].replace("_", " ")) for step in STEPS])
    axes.set_ylabel(f"position error at held-out poses [{UM}]")
    axes.spines[["top", "right"]].set_visible(False)
    drawn = StringIO()
    figure.savefig(drawn, format="svg", transparent=True, metadata={"Date": None})
    PICTURE.write_text(drawn.getvalue().replace("<defs>", f"{DARK}\n <defs>", 1))


def _mean(axes: Any, k: int, values: np.ndarray) -> None:
    mean = values.mean()
    axes.plot([k - 0.33, k + 0.33], [mean, mean], color=COLOURS[k], lw=2.5)
    label = f"{mean:.0f} {UM}" if mean > 100 else f"{mean:.1f} {UM}"
    above = (k, values.max() * 1.2)
    axes.annotate(label, above, ha="center", fontsize=12, weight="bold", color=COLOURS[k])


def _typical(norms: np.ndarray) -> int:
    """The pose whose errors before and after adding the effect are nearest to the means."""
    return int(np.abs(np.log(norms / norms.mean(axis=0)))[:, 1:].sum(axis=1).argmin())


def _two_answers(axes: Any, measured: np.ndarray, answered: np.ndarray, norms: np.ndarray) -> None:
    """The same question to kinematics_node before and after, in its own numbers."""
    rows = [
        ("position at one held-out pose [mm]", "", "0.15"),
        ("measured", _in_mm(measured), "0.15"),
        ("before", f"{_in_mm(answered[0])}   error {norms[0]:.0f} {UM}", COLOURS[1]),
        ("after", f"{_in_mm(answered[1])}   error {norms[1]:.0f} {UM}", COLOURS[2]),
    ]
    for i, (what, text, colour) in enumerate(rows):
        style = {"transform": axes.transAxes, "fontsize": 9, "color": colour, "va": "top"}
        axes.text(0.38, 0.99 - 0.062 * i, what, **style)
        axes.text(0.52, 0.99 - 0.062 * i, text, **style)


def _in_mm(r: np.ndarray) -> str:
    return ", ".join(f"{value * 1e3:.3f}" for value in r).replace("-", "\N{MINUS SIGN}")


if __name__ == "__main__":
    if "--draw" not in sys.argv[1:]:
        RECORD.write_text(json.dumps(measure()) + "\n")
    draw(json.loads(RECORD.read_text()))
