"""Table 2 and figures 5 to 7 of Savoure et al. 2006: the planar parallelogram.

It is built from joint points and rods, measured with 3 um and 0.003 degrees, identified the
classical way (a simplified model, position only) and the improved way (all joint points, whole
pose), compensated, and judged where the tool's tip ends up.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import virtual_paper as vp

from bench.documents.tables.common import DEGREE, MM, UM, distribution
from parallel_cal.identification.explicit import Prediction
from parallel_cal.identification.observations import Observations, observe
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import Model, new_model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.thesis.methods import sensitivity
from parallel_cal.thesis.solvers import ipr_compensation
from parallel_cal.virtual import robot as vr

NOISE = vr.Noise(joint=1e-9, position=3 * UM, orientation=0.003 * DEGREE)
MEASURED = np.radians(np.arange(-45.0, 46.0, 5.0))[:, None]
COMMANDED = np.radians(np.arange(-45.0, 46.0))[:, None]
TOOLS = (0.0, 200 * MM)
WHOLE, ONLY_X = [True] * 6, [True] + [False] * 5  # measured of x, y, z, rx, ry, rz
WAYS = ("none", "classical", "improved")
# Eqs 70-72: what table 2's errors add up to, mm and degrees.
BASE = {"q0": 0.01, "a2_x": 2.0, "a2_y": 3.0, "b1_x": -1.0, "l1": 1.0, "l2": -1.0}


def label(h: float) -> str:
    return f"{h / MM:.0f} mm"


def measure(h: float, seed: int, columns: list[bool]) -> Dataset:
    """The strayed mechanism of table 2 at 19 angles, what is measured of x, y, z, rx, ry, rz."""
    r, R = strayed(h).forward(MEASURED)
    return dataset(("joint1",), MEASURED, r, R, seed, columns)


def strayed(h: float) -> vp.Parallelogram:
    return vp.Parallelogram(vp.TABLE_2_STRAYED | {"h": h})


def dataset(
    joints: tuple[str, ...],
    q: np.ndarray,
    r: np.ndarray,
    R: np.ndarray,
    seed: int,
    columns: list[bool],
) -> Dataset:
    _, dr, w = NOISE.draw(np.random.default_rng(seed), len(q))
    return Dataset.from_arrays(
        joints,
        q,
        r + dr,
        vr.turn(w) @ R,
        measured=np.tile(columns, (len(q), 1)),
        pose_cov=np.diag([NOISE.position**2] * 3 + [NOISE.orientation**2] * 3),
        joint_sigma=[NOISE.joint] * len(joints),
        pose_id=np.arange(len(q)),
        source="virtual",
    )


def complete(h: float, seed: int) -> tuple[Model, Observations]:
    model = new_model("parallelogram", {"h": h})
    return model, observe(model, measure(h, seed, WHOLE))


@dataclass(frozen=True)
class Base:
    """Independent parameters, and what each of the others adds to them (eqs 70-72):
    identified base_i = base_i + sum_k grouping[i, k] dropped_k."""

    kept: tuple[str, ...]
    dropped: tuple[str, ...]
    grouping: np.ndarray


def base_parameters(model: Model, observations: Observations, free: np.ndarray) -> Base:
    """The base of the free parameters in these poses; earlier ones in the table come first."""
    system = Prediction(model, observations, free, direct=True)(model.values)
    assert system is not None
    columns, names = system.columns, np.array(model.table.names)[free]
    kept = sensitivity.find_base_parameters(columns * model.table.tolerance[free])
    grouping = np.linalg.lstsq(columns[:, kept], columns[:, ~kept], rcond=None)[0]
    return Base(
        tuple(names[kept]), tuple(names[~kept]), np.where(np.abs(grouping) > 1e-6, grouping, 0.0)
    )


def rank_analysis() -> dict[str, Any]:
    """Base parameters of all nine by QR decomposition, and what the others add to them."""
    model, observations = complete(100 * MM, 0)
    free = np.array([name != "h" for name in model.table.names])
    base = base_parameters(model, observations, free)
    sums = {
        name: {k: float(v) for k, v in zip(base.kept, column, strict=True) if abs(v) > 1e-3}
        for name, column in zip(base.dropped, base.grouping.T, strict=True)
    }
    return {"kept": list(base.kept), "dropped": sums}


def improved(h: float, seed: int) -> Model:
    """Eq. 26, one step, six base parameters."""
    model, observations = complete(h, seed)
    return model.with_values(sensitivity.estimate(model, observations, ~model.fixed).values)


def classical(h: float, seed: int) -> Model:
    """One bar, q0 and l from x alone (eqs 34, 38, 74)."""
    model = new_model("parallelogram_simple", {"h": h})
    observations = observe(model, measure(h, seed, ONLY_X))
    return model.with_values(sensitivity.estimate(model, observations, ~model.fixed).values)


def identified_errors(draws: int) -> dict[str, Any]:
    """Identified minus nominal (mm, degrees): one linear step, and the fit repeated to its end."""
    found: dict[str, list[np.ndarray]] = {"linear": [], "iterated": []}
    for seed in range(draws):
        model, observations = complete(100 * MM, seed)
        for name, steps in (("linear", 1), ("iterated", 10)):
            values = sensitivity.estimate(
                model, observations, ~model.fixed, iterations=steps
            ).values
            found[name].append(values - model.values)
    rows = {}
    for name, expected in BASE.items():
        i, unit = model.table.names.index(name), DEGREE if name == "q0" else MM
        each = {k: np.array(v)[:, i] / unit for k, v in found.items()}
        rows[name] = {"expected": expected, **{k: distribution(v) for k, v in each.items()}}
    return rows


def tip_errors(h: float, draws: int) -> dict[str, Any]:
    """Mean and largest error of the tip in x (um) over 91 commanded positions (figures 5 to 7)."""
    asked = np.zeros((len(COMMANDED), 3))
    asked[:, 0], asked[:, 1] = 0.95 * np.sin(COMMANDED[:, 0]), -0.95 - h
    each: dict[str, list[np.ndarray]] = {way: [] for way in WAYS}
    for seed in range(draws):
        joints = {
            "none": Kinematics(new_model("parallelogram_simple", {"h": h})).inverse(asked).joints,
            "classical": Kinematics(classical(h, seed)).inverse(asked).joints,
            "improved": ipr_compensation.inverse(improved(h, seed), asked).joints,
        }
        for way, q in joints.items():
            each[way].append((strayed(h).forward(q)[0] - asked)[:, 0] / UM)
    return {way: _summary(np.array(errors)) for way, errors in each.items()} | {
        "first draw_um": {way: errors[0].tolist() for way, errors in each.items()}
    }


def _summary(errors: np.ndarray) -> dict[str, Any]:
    size = np.abs(errors)
    return {
        "mean_um": distribution(size.mean(axis=1)),
        "largest_um": distribution(size.max(axis=1)),
    }
