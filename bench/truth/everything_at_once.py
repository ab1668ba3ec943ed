"""Foreign machines that lack everything at once, gone through as a user would: NumPy and SciPy.

    python -m bench.truth.everything_at_once [--only NAME ...]

A Delta, a hexapod, a linear Delta and a serial arm, each in three sizes, have backlash, a drive
whose gain is 3 % off, compliance or a frame that sinks, thermal growth, a tracker that creeps in a
frame of its own, and one sample at which somebody knocked it. Nothing of parallel_cal makes them.
Each session is a table, which is fitted, diagnosed and added to until nothing more is proposed.

Beside them: two sessions in which columns are exchanged or in another unit, which must be refused,
and two of robots whose dimensions are 14 tolerances off and that lack no effect.

One line a session: the error (um rms) at poses that nobody measured, the one that a fit with the
true structure reaches, their ratio, and what was said. The exit status is 1 if more than one of the
twelve ends above 1.25 times what is possible, or if one of the others does not end as it must.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

import parallel_cal as pc
from parallel_cal.kinematics.kinematics import Kinematics

Array = np.ndarray
G = 9.81
MAX_RATIO = 1.25
MAX_ROUNDS = 5
KNOCK = 8e-4  # m


@dataclass(frozen=True)
class Machine:
    """A machine as it was drawn: `pose(geometry, q)` returns position (n, 3) and rotation (n, 3, 3)
    for readings (n, joints); `tolerance` (like `geometry`) is 1 sigma of a made part, and `lengths`
    tells which numbers of the geometry grow with temperature, besides the `scales` of prismatic
    joints. `new` are the words that describe the drawing to the command `new`."""

    joints: tuple[str, ...]
    unit: str
    geometry: Array
    tolerance: Array
    lengths: Array
    pose: Callable[[Array, Array], tuple[Array, Array]]
    readings: Callable[[int, np.random.Generator], Array]
    new: tuple[str, ...]
    sinks: bool  # the frame sinks under the payload; otherwise the drives yield
    loaded: tuple[int, ...] = ()  # joints that yield


def solve_rods(C: Array, B: Array, L: Array, r: Array, R: Array) -> tuple[Array, Array]:
    """Pose from the ends C (n, 6, 3) in the base, B (n, 6, 3) in the platform, and lengths."""
    r, R = r.copy(), R.copy()
    for _ in range(12):
        arm = np.einsum("nij,nkj->nki", R, B)
        way = r[:, None] + arm - C
        far = np.linalg.norm(way, axis=2)
        along = way / far[..., None]
        J = np.concatenate([along, np.cross(arm, along)], axis=2)
        step = np.linalg.solve(J, (L - far)[..., None])[..., 0]
        r += step[:, :3]
        R = Rotation.from_rotvec(step[:, 3:]).as_matrix() @ R
        if np.abs(step).max() < 1e-13:
            break
    return r, R


def turn_z(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def circle(radius: float, degrees: list[float]) -> Array:
    a = np.radians(degrees)
    return radius * np.stack([np.cos(a), np.sin(a), 0 * a], axis=1)


def hexapod(size: float) -> Machine:
    at, on = [-10, 10, 110, 130, 230, 250], [-50, 50, 70, 170, 190, 290]
    C, B = circle(0.25 * size, at), circle(0.15 * size, on)
    height, home = 0.23 * size, np.array([0, 0, 0.23 * size])
    L0 = np.linalg.norm(home + B - C, axis=1)

    def pose(g: Array, q: Array) -> tuple[Array, Array]:
        c, b, n = g[:18].reshape(6, 3), g[18:36].reshape(6, 3), len(q)
        start = np.tile(home, (n, 1)), np.tile(np.eye(3), (n, 1, 1))
        return solve_rods(np.tile(c, (n, 1, 1)), np.tile(b, (n, 1, 1)), g[36:] + q, *start)

    def readings(n: int, rng: np.random.Generator) -> Array:
        r = home + size * rng.uniform(-1, 1, (n, 3)) * [0.05, 0.05, 0.035]
        R = Rotation.from_rotvec(np.radians(12) * rng.uniform(-1, 1, (n, 3))).as_matrix()
        return np.linalg.norm(r[:, None] + np.einsum("nij,kj->nki", R, B) - C, axis=2) - L0

    described = (
        f"base={{radius: {0.25 * size}, angles: {at}}}",
        f"platform={{radius: {0.15 * size}, angles: {on}}}",
        f"height={height}",
    )
    g = np.concatenate([C.ravel(), B.ravel(), L0])
    return Machine(
        tuple(f"leg{i}" for i in range(1, 7)),
        "m",
        g,
        np.full(42, 1e-3),
        np.ones(42, bool),
        pose,
        readings,
        ("stewart42", *described),
        False,
        tuple(range(6)),
    )


def linear_delta(size: float) -> Machine:
    out, inner, rod, bar = 0.13 * size, 0.03 * size, 0.25 * size, 0.025
    frames = [turn_z(2 * np.pi * i / 3) for i in range(3)]
    sides = [np.array([0, bar, 0]), np.array([0, -bar, 0])]
    C = np.array([F @ (np.array([out, 0, 0]) + s) for F in frames for s in sides])
    B = np.array([F @ (np.array([inner, 0, 0]) + s) for F in frames for s in sides])

    def pose(g: Array, q: Array) -> tuple[Array, Array]:
        c, b, L, tilt = g[:18].reshape(6, 3), g[18:36].reshape(6, 3), g[36:42], g[42:].reshape(3, 2)
        rail = np.concatenate([tilt, np.ones((3, 1))], axis=1)
        rail /= np.linalg.norm(rail, axis=1)[:, None]
        ends = c + np.repeat(q[:, :, None] * rail, 2, axis=1)
        r = np.stack(
            [0 * q[:, 0], 0 * q[:, 0], q.mean(axis=1) - np.sqrt(rod**2 - (out - inner) ** 2)]
        )
        start = r.T.copy(), np.tile(np.eye(3), (len(q), 1, 1))
        return solve_rods(ends, np.tile(b, (len(q), 1, 1)), np.tile(L, (len(q), 1)), *start)

    def readings(n: int, rng: np.random.Generator) -> Array:
        r = size * (rng.uniform(-1, 1, (n, 3)) * [0.06, 0.06, 0.07] + [0, 0, 0.1])
        away = np.array([F @ [out - inner, 0, 0] for F in frames]) - r[:, None]
        return r[:, 2:] + np.sqrt(rod**2 - (away[..., :2] ** 2).sum(axis=2))

    g = np.concatenate([C.ravel(), B.ravel(), np.full(6, rod), np.zeros(6)])
    tolerance = np.concatenate(
        [np.full(18, 5e-4), np.full(18, 1e-4), np.full(6, 2e-4), np.full(6, 5e-3)]
    )
    described = (f"base={out}", f"platform={inner}", f"rod={rod}", f"height={0.1 * size}")
    return Machine(
        ("joint1", "joint2", "joint3"),
        "m",
        g,
        tolerance,
        np.arange(48) < 42,
        pose,
        readings,
        ("linear_delta", *described),
        True,
    )


def delta(size: float) -> Machine:
    hub, inner, arm, rod, bar = 0.1 * size, 0.024 * size, 0.12 * size, 0.24 * size, 0.02
    frames = np.array([turn_z(2 * np.pi * i / 3) for i in range(3)])
    along = np.array([0, bar, 0])
    B = np.array([F @ (np.array([inner, 0, 0]) + s * along) for F in frames for s in (-1, 1)])

    def pose(g: Array, q: Array) -> tuple[Array, Array]:
        b, L, hubs = g[:18].reshape(6, 3), g[18:24], g[24:33].reshape(3, 3)
        length, zero, tilt = g[33:36], g[36:39], g[39:].reshape(3, 2)
        a, n = q + zero, len(q)
        # In the chain's frame the axis is y, turned by tilts about x and z.
        bent = Rotation.from_rotvec(
            np.stack([tilt[:, 0], 0 * tilt[:, 0], tilt[:, 1]], 1)
        ).as_matrix()
        tip = np.stack([np.cos(a) * length, 0 * a, np.sin(a) * length], axis=2)
        balls = tip[:, :, None] + np.array([-along, along])
        ends = hubs[:, None] + np.einsum("kij,kjl,nksl->nksi", frames, bent, balls)
        start = np.zeros((n, 3)), np.tile(np.eye(3), (n, 1, 1))
        start[0][:, 2] = arm * np.sin(q).mean(axis=1) + 0.75 * rod
        return solve_rods(ends.reshape(n, 6, 3), np.tile(b, (n, 1, 1)), np.tile(L, (n, 1)), *start)

    def readings(n: int, rng: np.random.Generator) -> Array:
        return rng.uniform(0.0, 1.05, (n, 3))

    hubs = (frames @ [hub, 0, 0]).ravel()
    g = np.concatenate([B.ravel(), np.full(6, rod), hubs, np.full(3, arm), np.zeros(9)])
    parts = [(18, 1e-4), (6, 2e-4), (9, 7e-4), (3, 4e-4), (3, 7e-3), (6, 5e-3)]
    tolerance = np.concatenate([np.full(n, t) for n, t in parts])
    described = (f"base={hub}", f"platform={inner}", f"arm={arm}", f"rod={rod}")
    return Machine(
        ("joint1", "joint2", "joint3"),
        "rad",
        g,
        tolerance,
        np.arange(45) < 36,
        pose,
        readings,
        ("delta54", *described),
        False,
        (0, 1, 2),
    )


def arm(size: float) -> Machine:
    # theta, d, a, alpha, beta of each link, which lead from one axis to the next
    h = np.pi / 2
    rows = (
        size
        * np.array([0, 1, 1, 0, 0])[None]
        * np.array(
            [
                [0, 0.18, 0.03, 0, 0],
                [0, 0, 0.45, 0, 0],
                [0, 0, 0.04, 0, 0],
                [0, 0.42, 0, 0, 0],
                [0, 0, 0, 0, 0],
                [0, 0.09, 0, 0, 0],
            ]
        )
    )
    rows[:, 3] = [h, 0, h, -h, h, 0]
    home = np.array([0, h * 0.9, 0.3, 0, -0.9, 0])
    axes = ["perpendicular", "parallel", "perpendicular", "perpendicular", "perpendicular", None]

    def pose(g: Array, q: Array) -> tuple[Array, Array]:
        r, R = np.zeros((len(q), 3)), np.tile(np.eye(3), (len(q), 1, 1))
        for row, angle in zip(g.reshape(6, 5), q.T, strict=True):
            theta, d, a, alpha, beta = row
            R = R @ Rotation.from_rotvec(np.outer(angle + theta, [0, 0, 1])).as_matrix()
            r = r + R @ np.array([a, 0, d])
            R = R @ Rotation.from_euler("XY", [alpha, beta]).as_matrix()
        return r, R

    def readings(n: int, rng: np.random.Generator) -> Array:
        return home + rng.uniform(-0.8, 0.8, (n, 6)) * [1.2, 0.6, 0.8, 1, 1, 1.5]

    links = [{"joint": None, "axes": "coincident"}]
    for k, (theta, d, a, alpha, _) in enumerate(rows):
        one = {"joint": "R", "theta": theta, "d": float(d), "a": float(a), "alpha": float(alpha)}
        links.append(one | ({"axes": axes[k]} if axes[k] else {}))
    links[1]["theta"] = 0.0
    text = re.sub(r"'", "", str(links).replace("None", "null"))
    text = re.sub(r"np\.float64\(([^)]*)\)", r"\1", text)
    tolerance = np.tile([4e-3, 5e-4, 5e-4, 4e-3, 4e-3], 6)
    tolerance[[4, 14, 19, 24]] = 0.0  # beta where the next axis is not parallel
    tolerance[[6]] = 0.0  # d along parallel axes
    lengths = np.tile([False, True, True, False, False], 6)
    return Machine(
        tuple(f"joint{i}" for i in range(1, 7)),
        "rad",
        rows.ravel(),
        tolerance,
        lengths,
        pose,
        readings,
        ("serial", f"links={text}", f"home={home.tolist()}"),
        False,
        (1, 2),
    )


@dataclass(frozen=True)
class Causes:
    """What the machine has besides its geometry; all zero without."""

    gain: Array  # (joints,)
    play: Array  # (joints,)
    yields: Array  # (joints,) or (2,): compliance, or settle and tilt of the frame
    growth: Array  # (2,): of lengths and of the scales of prismatic joints, 1/K
    creep: Array  # (6,): of the base as the tracker sees it, m/s and rad/s


@dataclass(frozen=True)
class Conditions:
    time: Array
    temperature: Array
    payload: Array
    side: Array  # (n, joints)

    def at(self, rows: Array) -> Conditions:
        return Conditions(
            *(part[rows] for part in (self.time, self.temperature, self.payload, self.side))
        )


def find_levers(m: Machine, g: Array, q: Array) -> Array:
    """Vertical motion of the platform by each joint (n, joints)."""
    columns = []
    for j in range(len(m.joints)):
        step = np.zeros(len(m.joints))
        step[j] = 1e-6
        columns.append((m.pose(g, q + step)[0][:, 2] - m.pose(g, q - step)[0][:, 2]) / 2e-6)
    return np.stack(columns, axis=1)


def find_true_pose(
    m: Machine, g: Array, c: Causes, q: Array, at: Conditions, levers: Array | None = None
) -> tuple[Array, Array]:
    """The pose of the platform in the base as it stands at t = 0."""
    warm = at.temperature - 20.0
    moved = q + q * c.gain - at.side * c.play / 2
    if m.unit == "m":
        moved = moved + q * (c.growth[1] * warm)[:, None]
    if not m.sinks and c.yields.any():
        by = find_levers(m, g, moved) if levers is None else levers
        moved = moved + c.yields * by * (-G * at.payload)[:, None]
    r, R = grown(m, g, c.growth[0], warm, moved)
    if m.sinks:
        weight = np.stack([0 * r[:, 0], 0 * r[:, 0], -G * at.payload], axis=1)
        tilted = Rotation.from_rotvec(c.yields[1] * np.cross(r, weight)).as_matrix()
        r = np.einsum("nij,nj->ni", tilted, r) + c.yields[0] * weight
        R = tilted @ R
    creep = c.creep * at.time[:, None]
    turned = Rotation.from_rotvec(creep[:, 3:]).as_matrix()
    return np.einsum("nij,nj->ni", turned, r) + creep[:, :3], turned @ R


def grown(m: Machine, g: Array, alpha: float, warm: Array, q: Array) -> tuple[Array, Array]:
    """Poses with lengths that are alpha * warm longer: linear in the small growth."""
    r, R = m.pose(g, q)
    h = 1e-4
    larger = m.pose(np.where(m.lengths, g * (1 + h), g), q)
    by = alpha * warm / h
    turned = Rotation.from_matrix(larger[1] @ R.transpose(0, 2, 1)).as_rotvec()
    return r + (larger[0] - r) * by[:, None], Rotation.from_rotvec(
        turned * by[:, None]
    ).as_matrix() @ R


@dataclass(frozen=True)
class Noise:
    joint: float
    position: float
    orientation: float


@dataclass(frozen=True)
class Session:
    """A machine as it was made, what was measured of it, and what nobody measured."""

    name: str
    machine: Machine
    made: Array
    causes: Causes
    noise: Noise
    q: Array
    r: Array
    R: Array
    at: Conditions
    knocked: int | None
    unseen: Array
    unseen_at: Conditions


KINDS = {"delta": delta, "hexapod": hexapod, "linear": linear_delta, "arm": arm}


def make_session(name: str, kind: str, size: float, seed: int, plain: bool = False) -> Session:
    """A session with everything at once, or a `plain` one: no effect, but dimensions of which some
    are more than ten tolerances off."""
    m, rng = KINDS[kind](size), np.random.default_rng([seed, 20])
    n, k = len(m.joints), 90
    sharp = size * (2e-5 if m.unit == "rad" else 4e-6)
    noise = Noise(sharp if m.unit == "m" else 2e-5, 1e-5 * size, 5e-5)
    made = m.geometry + 0.7 * m.tolerance * rng.normal(size=len(m.geometry))
    gain = np.zeros(n)
    gain[rng.integers(n)] = rng.choice([-0.03, 0.03])
    stiff = 1.5e-4 / size**2 if m.unit == "rad" else 1.5e-6
    causes = Causes(
        gain,
        noise.joint * rng.uniform(8, 20, n),
        np.array([1e-6, 3e-6]) * rng.uniform(0.5, 1.5, 2)
        if m.sinks
        else stiff * rng.uniform(0.5, 1.5, n) * np.isin(np.arange(n), m.loaded),
        np.array([12e-6, 8e-6]) * rng.uniform(0.7, 1.4, 2),
        np.concatenate([rng.normal(0, 1.5e-8, 3), rng.normal(0, 2e-8, 3)]),
    )
    if plain:
        causes = Causes(*(0 * part for part in vars(causes).values()))
        far = rng.choice(np.flatnonzero(m.lengths & (m.tolerance >= 4e-4)), 2, replace=False)
        made[far] += 14 * m.tolerance[far] * rng.choice([-1, 1], 2)
    poses = m.readings(k, rng)
    order = np.concatenate([np.arange(k), rng.choice(k, 20, replace=False)])
    q, unseen = poses[order], m.readings(80, rng)

    def conditions(q: Array) -> Conditions:
        way = np.diff(q, axis=0, prepend=m.readings(1, rng))
        t = 12.0 * np.arange(len(q))
        warm = 20 + 6 * np.sin(2 * np.pi * t / 900 + rng.uniform(0, 6)) + rng.normal(0, 0.1, len(t))
        return Conditions(t, warm, rng.choice([0.0, 1.0, 2.0], len(q)), np.sign(way))

    at, unseen_at = conditions(q), conditions(unseen)
    unseen_at = replace(unseen_at, time=0 * unseen_at.time)
    r, R = find_true_pose(m, made, causes, q, at)
    frame = Rotation.random(random_state=seed).as_matrix()
    r, R = r @ frame.T + rng.uniform(-1, 1, 3), frame @ R
    r = r + noise.position * rng.normal(size=r.shape)
    R = Rotation.from_rotvec(noise.orientation * rng.normal(size=r.shape)).as_matrix() @ R
    knocked = None if plain else int(rng.integers(len(q)))
    if knocked is not None:
        r[knocked] += KNOCK * rng.normal(size=3) / np.sqrt(3) * size
    seen = q + noise.joint * rng.normal(size=q.shape)
    return Session(name, m, made, causes, noise, seen, r, R, at, knocked, unseen, unseen_at)


def measure_error(found: tuple[Array, Array], s: Session) -> float:
    """Rms position error (m) at the unseen poses, apart from where base and target are."""
    true = find_true_pose(s.machine, s.made, s.causes, s.unseen, s.unseen_at)[0]
    r, R = found

    def errors(x: Array) -> Array:
        turned = Rotation.from_rotvec(x[:3]).as_matrix()
        return ((r + R @ x[6:]) @ turned.T + x[3:6] - true).ravel()

    x0 = np.zeros(9)
    a, b = r - r.mean(axis=0), true - true.mean(axis=0)
    U, _, Vt = np.linalg.svd(a.T @ b)
    turned = (U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt).T
    x0[:3] = Rotation.from_matrix(turned).as_rotvec()
    x0[3:6] = true.mean(axis=0) - turned @ r.mean(axis=0)
    best = least_squares(errors, x0, x_scale="jac")
    return float(np.sqrt(np.mean(np.sum(best.fun.reshape(-1, 3) ** 2, axis=1))))


def find_possible(s: Session) -> float:
    """The error at the unseen poses after a fit with the true structure."""
    m, n = s.machine, len(s.machine.joints)
    kept = np.setdiff1d(np.arange(len(s.q)), [] if s.knocked is None else [s.knocked])
    q, r, R, at = s.q[kept], s.r[kept], s.R[kept], s.at.at(kept)
    free = np.flatnonzero(m.tolerance > 0)
    plain = not s.causes.gain.any()
    usual = np.concatenate(
        [
            m.tolerance[free] * (20 if plain else 1),
            np.full(n, 0.03),
            np.full(n, 20 * s.noise.joint),
            [2e-6, 5e-6] if m.sinks else np.full(n, 3e-4 if m.unit == "rad" else 3e-6),
            [2e-5, 2e-5],
            np.full(3, 3e-8),
            np.full(3, 3e-8),
            np.full(3, 3.0),
            np.full(3, 1.0),
        ]
    )
    ends = np.cumsum([len(free), n, n, len(s.causes.yields), 2, 6, 3])
    on = np.ones(len(usual), bool)
    if plain:
        on[ends[0] : ends[5]] = False
    if not m.sinks:
        on[ends[2] : ends[3]] &= np.isin(np.arange(n), m.loaded)
    levers = find_levers(m, m.geometry, q)

    def unpack(x: Array) -> tuple[Array, Causes, Array, Array]:
        parts = np.split(x * usual * on, ends)
        g = m.geometry.copy()
        g[free] += parts[0]
        return g, Causes(*parts[1:6]), parts[6], parts[7]

    drawn_r, drawn_R = m.pose(m.geometry, q)
    first = np.linalg.svd(sum(a @ b.T for a, b in zip(R, drawn_R, strict=True)))
    frame0 = first[0] @ np.diag([1, 1, np.linalg.det(first[0] @ first[2])]) @ first[2]
    shift0 = (r - drawn_r @ frame0.T).mean(axis=0)
    columns, back = [], drawn_R.transpose(0, 2, 1)
    for step in 1e-6 * np.eye(n):
        near_r, near_R = m.pose(m.geometry, q + step)
        turned = Rotation.from_matrix(near_R @ back).as_rotvec()
        columns.append(np.concatenate([near_r - drawn_r, turned], axis=1) / 1e-6)
    slopes = np.stack(columns, axis=2)
    own = np.diag([s.noise.position**2] * 3 + [s.noise.orientation**2] * 3)
    seen_by = own + s.noise.joint**2 * slopes @ slopes.transpose(0, 2, 1)
    whiten = np.linalg.inv(np.linalg.cholesky(seen_by))

    def errors(x: Array) -> Array:
        g, c, turn, shift = unpack(x)
        pr, pR = find_true_pose(m, g, c, q, at, levers)
        frame = frame0 @ Rotation.from_rotvec(turn).as_matrix()
        dr = (r - shift0 - shift) @ frame - pr
        dw = Rotation.from_matrix(frame.T @ R @ pR.transpose(0, 2, 1)).as_rotvec()
        seen = np.einsum("nij,nj->ni", whiten, np.concatenate([dr, dw], axis=1))
        return np.concatenate([seen.ravel(), x * np.append(on[:-6], np.zeros(6))])

    x = np.zeros(len(usual))
    for _ in range(3):
        fitted = least_squares(errors, x, method="trf", max_nfev=15)
        x = fitted.x
        g, c, *_ = unpack(x)
        levers = find_levers(m, g, q * (1 + c.gain))
    return measure_error(find_true_pose(m, g, c, s.unseen, s.unseen_at), s)


def write_table(s: Session, folder: Path, spoil: Callable[[Array], Array]) -> Path:
    """Write the table of a session, with the map of its columns beside it."""
    m, at = s.machine, s.at
    names = [f"{j} [{m.unit}]" for j in m.joints]
    names += ["x [m]", "y [m]", "z [m]", "qx", "qy", "qz", "qw", "time [s]", "temperature [degC]"]
    names += ["payload [kg]", *[f"direction.{j}" for j in m.joints]]
    quaternion = Rotation.from_matrix(s.R).as_quat()
    rows = np.column_stack(
        [spoil(s.q), s.r, quaternion, at.time, at.temperature, at.payload, at.side]
    )
    np.savetxt(folder / "data.csv", rows, "%.17g", ",", header=",".join(names), comments="")
    joints = ", ".join(f'{j}: {{column: "{c}"}}' for j, c in zip(m.joints, names, strict=False))
    known = zip(("time", "temperature", "payload"), names[len(m.joints) + 7 :], strict=False)
    columns = [f'{key}: "{c}"' for key, c in known]
    columns += [f"direction.{j}: direction.{j}" for j in m.joints]
    (folder / "data.columns.yaml").write_text(
        f"joints: {{{joints}}}\n"
        'position: {columns: ["x [m]", "y [m]", "z [m]"]}\n'
        "orientation: [qx, qy, qz, qw]\n"
        f"conditions: {{{', '.join(columns)}}}\n"
        f"noise: {{joint: {s.noise.joint}, position: {s.noise.position}, "
        f"orientation: {s.noise.orientation}}}\n"
    )
    return folder / "data.csv"


def draw(m: Machine, folder: Path) -> Any:
    """The model of the drawing, as the command `new` writes it."""
    options = [word for one in m.new[1:] for word in ("--option", one)]
    command = [sys.executable, "-m", "parallel_cal.cli", "new", m.new[0], "-o", "model.yaml"]
    subprocess.run([*command, *options], cwd=folder, check=True, capture_output=True)
    return pc.read_model(folder / "model.yaml")


def compute_error(s: Session, model: Any) -> float:
    """Rms position error (m) of a model at the unseen poses."""
    at = {"time": s.unseen_at.time, "temperature": s.unseen_at.temperature}
    at |= {"payload": s.unseen_at.payload}
    at |= {f"direction.{j}": s.unseen_at.side[:, i] for i, j in enumerate(s.machine.joints)}
    found = Kinematics(model.robot()).direct(s.unseen, at)
    return measure_error((np.asarray(found.position), np.asarray(found.rotation)), s)


def follow(model: Any, data: Any) -> tuple[Any, list[str]]:
    """Fit, and go on as the diagnoses propose; return the last model, and what was said."""
    said = []
    try:
        result = pc.fit(model, data)
        said.append("fit: implausible" if result.implausible else "fit")
        model = model if result.implausible else result.model
        for _ in range(MAX_ROUNDS):
            found = pc.diagnose(model, data)
            said.append(f"{found.verdict.word}: {'+'.join(found.effects) or '-'}")
            knocked = [one.sample for one in found.knocked]
            data = data.excluding(knocked, "because the diagnosis says so")
            if found.addition is None:
                break
            model = pc.add(model, found.addition.text, data).model
    except pc.ParallelCalError as error:
        said.append(f"refused: {error}")
    return model, said


def exchange(q: Array) -> Array:
    return q[:, [0, 2, 1, *range(3, q.shape[1])]]


# name, kind, size, seed, what happens to the readings, words that a refusal must have; the robot of
# a plain one lacks no effect
SESSIONS = [
    *[
        (f"{kind}-{i}", kind, size, 10 * i + 1, np.array, "", False)
        for i, size in enumerate((1.0, 0.6, 1.8))
        for kind in KINDS
    ],
    ("hexapod-exchanged", "hexapod", 1.0, 31, exchange, "leg2", False),
    ("delta-degrees", "delta", 1.0, 32, np.degrees, "deg", False),
    ("delta-drawing", "delta", 1.0, 33, np.array, "", True),
    ("hexapod-drawing", "hexapod", 1.0, 34, np.array, "", True),
]


def main() -> int:
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--only", nargs="*", default=[], help="parts of names")
    only, far, wrong = arguments.parse_args().only, 0, 0
    for name, kind, size, seed, spoil, words, is_plain in SESSIONS:
        if only and not any(part in name for part in only):
            continue
        s = make_session(name, kind, size, seed, is_plain)
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary)
            model = draw(s.machine, folder)
            table = write_table(s, folder, spoil)
            reached, said = follow(model, pc.load_dataset(table, joints=model.joints))
        if words:
            wrong += not (said[-1].startswith("refused") and words in said[-1])
            print(f"{name}: {'; '.join(said)}", flush=True)
            continue
        error, best = compute_error(s, reached), find_possible(s)
        if is_plain:
            wrong += error > MAX_RATIO * best
        else:
            far += error > MAX_RATIO * best
        print(
            f"{name}: {1e6 * error:.2f} of {1e6 * best:.2f} um, {error / best:.2f} times; "
            f"{'; '.join(said)}",
            flush=True,
        )
    return int(far > 1 or wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
