"""Calibrations without a device beside a tracker: errors at unseen poses, and their coverage.

For each robot and set-up: the median and the largest rms position error (um) at 100 unseen poses,
after the best rigid displacement, because no touch shows where {B} is; the error that `plan`
expected before anybody measured; and how many of the predicted 95 % intervals of the distances
between unseen positions hold the truth. Robots are drawn within their tolerances.
Usage: `python -m bench.truth.without_device [robots]`; `update` compares ten touches with
`fit --update` to ten and a hundred from scratch.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace

import numpy as np

import parallel_cal as pc
from parallel_cal.base.errors import ParallelCalError
from parallel_cal.base.threads import single_threaded
from parallel_cal.identification.options import FitOptions
from parallel_cal.identification.update import list_culprits
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import Model, Noise, new_model
from parallel_cal.model.sensor import Sensor
from parallel_cal.model.shelf import load_mechanism, load_sensor
from parallel_cal.planning.posepool import make_pool

POSES, UNSEEN, STEP = 96, 100, 1e-3
TRACKER_M = 30e-6
UR5 = (
    ("perpendicular", 0.0, 0.089159, np.pi / 2),
    ("parallel", -0.425, 0.0, 0.0),
    ("parallel", -0.39225, 0.0, 0.0),
    ("perpendicular", 0.0, 0.10915, np.pi / 2),
    ("perpendicular", 0.0, 0.09465, -np.pi / 2),
    (None, 0.0, 0.0823, 0.0),
)


def arm() -> Model:
    """A UR5 by its data sheet."""
    links: list[dict[str, object]] = [{"joint": None, "axes": "coincident"}]
    for axes, a, d, alpha in UR5:
        links.append({"joint": "R", "a": a, "d": d, "alpha": alpha})
        links[-1] |= {"axes": axes} if axes else {}
    home = (0.3, -1.2, 1.4, -0.8, -1.3, 0.4)
    return new_model(load_mechanism("serial", links=links, home=home))


ROBOTS = {
    "Delta": lambda: new_model("delta24"),
    "hexapod": lambda: new_model("stewart42"),
    "arm": arm,
    "five-bar": lambda: new_model("five_bar"),
}


def set_ups(plane: bool, size: float) -> Iterator[tuple[str, Sensor | None]]:
    """The devices of the table; a planar robot has those of its plane."""
    axes = "xy" if plane else "xyz"
    grid = [(x, y, z) for z in ([0] if plane else [0, 1]) for x in (-1, 0, 1) for y in (-1, 0, 1)]
    plate = tuple((size * x, size * y, size * z) for x, y, z in grid)
    yield "tracker, 30 um", None
    yield "plate, known holes", load_sensor("sockets", holes=plate, axes=axes, sigma=20e-6)
    pair = ((0.0, 0.0, 0.0), (0.05, 0.0, 0.0))
    yield "two sockets, 50 mm apart", load_sensor("sockets", holes=pair, axes=axes, sigma=50e-6)
    yield "three sockets, places unknown", load_sensor("sockets", n=3, axes=axes, sigma=50e-6)
    yield "straight edge", load_sensor("straight_edge", axes=axes)
    if not plane:
        yield "plumb line", load_sensor("straight_edge", direction=(0.0, 0.0, 1.0), plumb=True)
        yield "inclinometer, 0.5 mrad", load_sensor("inclinometer")


def prepare(model: Model, sensor: Sensor | None) -> Model:
    joint = 2e-5 if model.mechanism.joint_units[0] == "rad" else 5e-6
    noise = Noise(joint, None if sensor else TRACKER_M, None)
    return replace(model.with_sensors((sensor,) if sensor else ()), noise=noise)


def drawn(model: Model, seed: int) -> Model:
    """A robot within its tolerances; its set-up is where the model has it."""
    rng = np.random.default_rng([seed, 52])
    geometry = [p.group != "sensor" for p in model.table] & ~np.asarray(model.fixed)
    spread = np.where(geometry, model.table.tolerance, 0.0)
    return model.with_values(model.values + spread * rng.standard_normal(len(spread)))


def positions(model: Model, q: np.ndarray) -> np.ndarray:
    return Kinematics(model).direct(q).position


def compute_rms(found: np.ndarray, truth: np.ndarray) -> float:
    """Rms distance (m) after the best rigid displacement."""
    a, b = truth - truth.mean(axis=0), found - found.mean(axis=0)
    U, _, V = np.linalg.svd(b.T @ a)
    turn = U @ np.diag([1, 1, np.sign(np.linalg.det(U @ V))]) @ V
    return float(np.sqrt(((a - b @ turn) ** 2).sum(axis=1).mean()))


def covered(result: pc.FitResult, robot: Model, q: np.ndarray) -> float:
    """Share of distances between neighbours among the unseen positions inside 1.96 sigma."""
    model, found, free = result.model, result.estimate, np.flatnonzero(result.free)

    def distances(m: Model) -> np.ndarray:
        r = positions(m, q)
        return np.asarray(np.linalg.norm(r - np.roll(r, 1, axis=0), axis=1))

    # Along directions that the data do not determine, the tolerances tell.
    table = model.table
    seen = found.spectrum
    scale = (table.prior_sigma if seen.held else table.tolerance)[free]
    unseen = seen.directions[seen.rank :] * scale
    P = seen.covariance + unseen.T @ unseen
    here, columns = distances(model), []
    for k in free:
        step = np.where(np.arange(len(table)) == k, STEP * table.tolerance[k], 0.0)
        columns.append((distances(model.with_values(model.values + step)) - here) / step[k])
    J = np.array(columns).T
    sigma = np.sqrt(np.einsum("ij,jk,ik->i", J, P, J))
    return float(np.mean(np.abs(here - distances(robot)) < 1.96 * sigma))


def line(name: str, device: str, nominal: Model, robots: int) -> str:
    """One row of the table."""
    expected, before, after, share, failed = np.nan, [], [], [], 0
    with suppress(ParallelCalError):
        expected = pc.plan(nominal, POSES, pool=150).expected.position_rms
    for seed in range(robots):
        robot = drawn(nominal, seed)
        rng = np.random.default_rng([seed, 9])
        q = make_pool(robot, UNSEEN, rng, False).poses.joints
        try:
            session = pc.simulate(robot, POSES, seed=seed, with_device=not nominal.sensors)
            result = pc.fit(nominal, session.dataset(), hold_out=0.0, insist=True)
        except ParallelCalError:
            failed += 1
            continue
        before.append(compute_rms(positions(nominal, q), positions(robot, q)))
        after.append(compute_rms(positions(result.model, q), positions(robot, q)))
        share.append(covered(result, robot, q))
    if not after:
        return f"| {name} | {device} | | {expected * 1e6:.0f} | no fit | | |"
    return (
        f"| {name} | {device} | {np.median(before) * 1e6:.0f} | {expected * 1e6:.0f} "
        f"| {np.median(after) * 1e6:.0f} | {max(after) * 1e6:.0f} "
        f"| {np.mean(share):.0%} | {failed} |"
    )


def update(robots: int) -> Iterator[str]:
    """Ten touches with the last calibration as prior, beside ten and a hundred from scratch."""
    yield "| robot | not fitted | 10, update | sigma | 10, scratch | 100, scratch |"
    for name in ("Delta", "hexapod"):
        nominal = prepare(ROBOTS[name](), None)
        rows = []
        for seed in range(robots):
            robot = drawn(nominal, seed)
            first = pc.fit(nominal, pc.simulate(robot, 100, seed=seed).dataset(), hold_out=0).model
            rng = np.random.default_rng([seed, 10])
            drift = sum(c.change * rng.standard_normal() for c in list_culprits(robot))
            today = robot.with_values(robot.values + drift)
            q = make_pool(today, UNSEEN, np.random.default_rng([seed, 9]), False).poses.joints
            few = pc.simulate(today, 10, seed=seed + 1000).dataset()
            many = pc.simulate(today, 100, seed=seed + 2000).dataset()
            quick = FitOptions(hold_out=0.0)
            new = pc.fit(first, few, replace(quick, update=True))
            models = [first, new.model]
            models += [pc.fit(nominal, data, quick).model for data in (few, many)]
            truth = positions(today, q)
            errors = [np.sqrt(((positions(m, q) - truth) ** 2).sum(axis=1).mean()) for m in models]
            rows.append([*errors, predicted_sigma(new, q)])
        a, b, c, d, sigma = np.sqrt(np.mean(np.square(rows), axis=0)) * 1e6
        yield f"| {name} | {a:.0f} | {b:.0f} | {sigma:.0f} | {c:.0f} | {d:.0f} |"


def predicted_sigma(result: pc.FitResult, q: np.ndarray) -> float:
    """Rms of the position's standard deviation (m) that the covariance predicts at joints q."""
    model, total = result.model, 0.0
    here, columns = positions(model, q), []
    free = np.flatnonzero(result.free)
    for k in free:
        step = np.zeros(len(model.values))
        step[k] = STEP * model.table.tolerance[k]
        columns.append((positions(model.with_values(model.values + step), q) - here) / step[k])
    J = np.array(columns)
    total = np.einsum("anx,ab,bnx->", J, result.estimate.spectrum.covariance, J) / len(q)
    return float(np.sqrt(total))


def main() -> None:
    asked = sys.argv[1:]
    robots = next((int(a) for a in asked if a.isdigit()), 20)
    with single_threaded():
        if "update" in asked:
            for row in update(robots):
                print(row, flush=True)
            return
        print(f"{robots} robots a row, {POSES} poses; um")
        print("| robot | device | before | planned | median | largest | 95 % intervals | failed |")
        for name, make in ROBOTS.items():
            plane = name == "five-bar"
            for device, sensor in set_ups(plane, 0.05 if name != "five-bar" else 0.03):
                print(line(name, device, prepare(make(), sensor), robots), flush=True)


if __name__ == "__main__":
    main()
