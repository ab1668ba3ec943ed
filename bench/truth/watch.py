"""How soon a watch notices a change, what it names, and how often it is wrong.

The robots are points and distances between them, written here; nothing of them comes from the
package. Each is calibrated by `fit`, then followed through one short recording a day in which
nobody measures a pose. On the tenth day something changes:

- the zero of one joint jumps by 3, 5 or 10 sigmas of its encoder;
- it drifts by one sigma a day;
- the frame, or an arm, is warm (the temperature is recorded, where it is the frame);
- the reading of one joint scatters by 5 sigmas more, as with a loose ball.

Usage: `python -m bench.truth.watch [robots] [months] [robot or change ...]` prints the table
of docs/watch.md, or its rows of some robots and changes; 0 months count no false alarms.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache

import numpy as np

import parallel_cal as pc
from parallel_cal.watch.watch import DAY, TEMPERATURE, Watch

START = 1.7e9  # s since 1970
SURE = 0.95  # probability at which a part counts as named
ONSET, FOLLOWED = 10, 30  # days before a change, and for which it is followed
JUMPS = {f"{k} sigma": float(k) for k in (3, 5, 10)}
FAULTS = (*JUMPS, "drift", "warm", "loose")
EXPANSION, WARMTH_K = 23e-6, 10.0  # 1/K of aluminium, K
FIXED_FRAME = {
    "belts": ("line4.A_?", "line3.A_y"),
    "hexapod": ("leg1.?_?", "leg3.?_y", "leg3.?_z", "leg5.?_z"),
    "five-bar": (),
    "Delta": (),
}


@dataclass
class Fault:
    """What has changed: shift and scatter of one reading, warmth of the frame or an arm, K."""

    joint: int = 0
    shift: float = 0.0
    scatter: float = 0.0
    warmth: float = 0.0
    recorded: bool = field(default=True)


class Belts:
    """Four belts hold a tool in a plane; each reading is the distance to an anchor."""

    name, sigma, samples = "belts", 0.3e-3, 20
    drawn = np.array([[-1.5, 1.0], [1.5, 1.0], [1.5, -1.0], [-1.5, -1.0]])
    parts = tuple(f"line{k}" for k in (1, 2, 3, 4))

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng([seed, 1])
        self.anchors = self.drawn + rng.normal(0, 5e-3, (4, 2))
        self.anchors[3] = self.drawn[3]
        self.anchors[2, 1] = self.drawn[2, 1]
        self.zero = rng.normal(0, 1e-3, 4)

    def model(self) -> pc.Model:
        shape = pc.mechanisms.load("cable", anchors=self.drawn.tolist(), zero="anchors")
        return pc.new_model(shape)

    def readings(self, rng: np.random.Generator, n: int, fault: Fault) -> dict[str, np.ndarray]:
        places = rng.uniform(-1, 1, (n, 2)) * [1.0, 0.7]
        anchors = self.anchors * (1 + EXPANSION * fault.warmth)
        return {"q": np.linalg.norm(places[:, None] - anchors, axis=2) - self.zero}

    warm_parts = (TEMPERATURE,)


class Hexapod:
    """Eight legs, two of them sensors only; each reading is a length."""

    name, sigma, samples = "hexapod", 5e-6, 20
    parts = tuple(f"leg{k + 1}" for k in range(8))
    warm_parts = (TEMPERATURE,)

    @staticmethod
    def ring(radius: float, degrees: Sequence[float]) -> np.ndarray:
        angles = np.radians(degrees)
        return radius * np.column_stack([np.cos(angles), np.sin(angles), 0 * angles])

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng([seed, 2])
        self.base = np.vstack(
            [self.ring(0.25, (-10, 10, 110, 130, 230, 250)), [[0.1, 0.05, -0.1], [-0.1, 0.15, 0]]]
        )
        self.plate = np.vstack(
            [self.ring(0.15, (-50, 50, 70, 170, 190, 290)), [[0, 0, 0], [0.05, -0.1, 0.05]]]
        )
        self.drawn = self.base.copy(), self.plate.copy()
        stray = rng.normal(0, 0.5e-3, (2, 8, 3))
        stray[:, 0] = stray[:, 2, 1:] = 0
        stray[:, 4, 2] = 0
        self.base += stray[0]
        self.plate += stray[1]
        model = self.model()
        drawn = np.array([model.value(f"leg{k + 1}.L0") for k in range(8)])
        self.zero = drawn + rng.normal(0, 0.5e-3, 8)

    def model(self) -> pc.Model:
        base, plate = (points.tolist() for points in self.drawn)
        return pc.new_model(pc.mechanisms.load("stewart42", base=base, platform=plate))

    @staticmethod
    def turn(w: np.ndarray) -> np.ndarray:
        """Rotation matrices (n, 3, 3) of rotation vectors (n, 3): Rodrigues' formula."""
        angle = np.linalg.norm(w, axis=1)[:, None, None]
        K = np.zeros((len(w), 3, 3))
        K[:, 0, 1], K[:, 0, 2], K[:, 1, 2] = -w[:, 2], w[:, 1], -w[:, 0]
        K = (K - K.transpose(0, 2, 1)) / angle
        return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K

    def readings(self, rng: np.random.Generator, n: int, fault: Fault) -> dict[str, np.ndarray]:
        r = np.array([0, 0, 0.3]) + rng.uniform(-0.05, 0.05, (n, 3))
        R = self.turn(rng.uniform(-0.25, 0.25, (n, 3)))
        base = self.base * (1 + EXPANSION * fault.warmth)
        heads = r[:, None] + np.einsum("nij,kj->nki", R, self.plate)
        return {"q": np.linalg.norm(heads - base, axis=2) - self.zero}


class FiveBar:
    """Two cranks and two rods; the motors and both elbows have encoders."""

    name, sigma, samples = "five-bar", 2e-5, 20
    parts = ("left", "right")
    warm_parts = ("left_elbow",)  # the left elbow is at the end of the left crank
    elbow_sigma, sight = 5e-5, 2e-5  # rad, m

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng([seed, 3])
        self.base = np.array([[-0.05, 0.0], [0.05, 0.0]]) + rng.normal(0, 2e-4, (2, 2))
        self.crank, self.rod = 0.1 + rng.normal(0, 2e-4, 2), 0.15 + rng.normal(0, 2e-4, 2)
        self.zero, self.elbow_zero = rng.normal(0, 3e-3, 2), rng.normal(0, 3e-3, 2)

    def model(self) -> pc.Model:
        joints, ends = [], []
        for side, sign, angle in (("left", -1, 2.2), ("right", 1, 0.9)):
            turns = {"type": "revolute", "axis": [0, 0, 1]}
            joints += [
                turns
                | {"name": side, "parent": "frame", "child": f"{side}_crank", "driven": True}
                | {"origin": [sign * 0.05, 0, 0], "home": angle}
                | {"limits": [angle - 1.2, angle + 1.2]},
                turns
                | {"name": f"{side}_elbow", "parent": f"{side}_crank", "child": f"{side}_rod"}
                | {"origin": [0.1, 0, 0], "home": sign * 1.3},
            ]
            ends.append({"body": f"{side}_rod", "point": [0.15, 0, 0], "axis": [0, 0, 1]})
        loop = {"name": "tip", "type": "axis", "a": ends[0], "b": ends[1]}
        shape = {"base": "frame", "platform": "left_rod", "target": [0.15, 0, 0]}
        shape |= {"moves": ["x", "y"], "joints": joints, "loops": [loop]}
        elbows = pc.sensors.load(
            "passive_encoder", joints=("left_elbow", "right_elbow"), sigma=self.elbow_sigma
        )
        return pc.new_model(pc.mechanisms.load("chain", **shape), sensors=[elbows])

    def readings(self, rng: np.random.Generator, n: int, fault: Fault) -> dict[str, np.ndarray]:
        angles = np.array([2.2, 0.9]) + rng.uniform(-0.5, 0.5, (n, 2))
        crank = self.crank * [1 + EXPANSION * fault.warmth, 1]
        tips = crank[:, None, None] * np.array([np.cos(angles.T), np.sin(angles.T)]).transpose(
            1, 0, 2
        )
        elbow = self.base + tips.transpose(2, 0, 1)
        way = elbow[:, 1] - elbow[:, 0]
        far = np.linalg.norm(way, axis=1)
        along = (far**2 + self.rod[0] ** 2 - self.rod[1] ** 2) / (2 * far)
        up = np.sqrt(self.rod[0] ** 2 - along**2)
        unit = way / far[:, None]
        tip = elbow[:, 0] + along[:, None] * unit
        tip = tip + up[:, None] * np.column_stack([-unit[:, 1], unit[:, 0]])
        rods = tip[:, None] - elbow
        turned = np.arctan2(rods[:, :, 1], rods[:, :, 0]) - angles
        turned = np.angle(np.exp(1j * turned)) - self.elbow_zero
        turned = turned + rng.normal(0, self.elbow_sigma, turned.shape)
        elbows = {f"reading.{s}_elbow": turned[:, k] for k, s in enumerate(self.parts)}
        return {"q": angles - self.zero, "tip": tip, **elbows}


class Delta:
    """Three arms hinged on a base carry a platform that cannot turn by a rod each; an encoder reads
    how each rod turns against its arm, in the plane of the arm."""

    name, sigma, samples = "Delta", 2e-5, 20
    parts = ("joint1", "joint2", "joint3")
    warm_parts = ("elbow1",)  # the elbow is at the end of the arm
    elbow_sigma, sight = 5e-5, 2e-5  # rad, m
    azimuths = np.radians([0.0, 120.0, 240.0])
    base, length, rod_length = 0.1, 0.12, 0.24  # m, as drawn
    middle, reach = np.array([0.0, 0.0, -0.2]), np.array([0.06, 0.06, 0.04])

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng([seed, 4])
        self.hinges = self.hinges_at(self.base) + rng.normal(0, 2e-4, (3, 3))
        self.arm, self.rod = self.length + rng.normal(0, 2e-4, 3), 0.24 + rng.normal(0, 2e-4, 3)
        self.zero, self.elbow_zero = rng.normal(0, 3e-3, 3), rng.normal(0, 3e-3, 3)

    @classmethod
    def hinges_at(cls, radius: float) -> np.ndarray:
        c, s = np.cos(cls.azimuths), np.sin(cls.azimuths)
        return radius * np.column_stack([c, s, 0 * c])

    @classmethod
    def angles(
        cls, hinges: np.ndarray, arm: np.ndarray, rod: np.ndarray, tip: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The angles (n, 3) of the arms below the base, and those of their rods in the plane of the
        arm and across it, for a platform at `tip` (n, 3): circles of the elbows cut spheres."""
        c, s = np.cos(cls.azimuths), np.sin(cls.azimuths)
        away = tip[:, None] - hinges
        out, across, down = away[..., 0] * c + away[..., 1] * s, away[..., 1] * c, -away[..., 2]
        across = across - away[..., 0] * s
        # |away - arm| = rod: out cos(q) + down sin(q) = (out^2 + down^2 + arm^2 - rod'^2) / (2 arm)
        flat = rod**2 - across**2
        k = (out**2 + down**2 + arm**2 - flat) / (2 * arm)
        far = np.hypot(out, down)
        q = np.arctan2(down, out) - np.arccos(k / far)  # elbows outside
        x, z = out - arm * np.cos(q), down - arm * np.sin(q)
        turned = np.angle(np.exp(1j * (np.arctan2(z, x) - q)))
        return q, turned, np.arcsin(across / rod)

    def model(self) -> pc.Model:
        q, turned, tilted = self.angles(
            self.hinges_at(self.base),
            np.full(3, self.length),
            np.full(3, self.rod_length),
            self.middle[None],
        )
        joints, end = [], {"point": [self.rod_length, 0, 0]}
        for k, hinge in enumerate(self.hinges_at(self.base)):
            half = self.azimuths[k] / 2
            joints += [
                {"name": f"joint{k + 1}", "type": "revolute", "parent": "frame", "driven": True}
                | {"child": f"arm{k + 1}", "origin": hinge.tolist(), "axis": [0, 1, 0]}
                | {"quaternion": [0, 0, float(np.sin(half)), float(np.cos(half))]}
                | {"home": float(q[0, k]), "limits": [float(q[0, k]) - 1.2, float(q[0, k]) + 1.2]},
                # A universal joint of two hinges, so that its angles are coordinates.
                {"name": f"elbow{k + 1}", "type": "revolute", "parent": f"arm{k + 1}"}
                | {"child": f"fork{k + 1}", "origin": [self.length, 0, 0], "axis": [0, 1, 0]}
                | {"home": float(turned[0, k])},
                {"name": f"swing{k + 1}", "type": "revolute", "parent": f"fork{k + 1}"}
                | {"child": f"rod{k + 1}", "axis": [0, 0, 1], "home": float(tilted[0, k])},
            ]
        loops = [
            {"name": f"tip{k}", "type": "point"}
            | {"a": {"body": "rod1", **end}, "b": {"body": f"rod{k}", **end}}
            for k in (2, 3)
        ]
        shape = {"base": "frame", "platform": "rod1", "target": end["point"], "loops": loops}
        shape |= {"moves": ["x", "y", "z"], "joints": joints}
        elbows = tuple(f"elbow{k}" for k in (1, 2, 3))
        encoders = pc.sensors.load("passive_encoder", joints=elbows, sigma=self.elbow_sigma)
        return pc.new_model(pc.mechanisms.load("chain", **shape), sensors=[encoders])

    def readings(self, rng: np.random.Generator, n: int, fault: Fault) -> dict[str, np.ndarray]:
        tip = self.middle + rng.uniform(-1, 1, (n, 3)) * self.reach
        arm = self.arm * [1 + EXPANSION * fault.warmth, 1, 1]
        q, turned, _ = self.angles(self.hinges, arm, self.rod, tip)
        turned = turned - self.elbow_zero + rng.normal(0, self.elbow_sigma, turned.shape)
        elbows = {f"reading.elbow{k + 1}": turned[:, k] for k in range(3)}
        return {"q": q - self.zero, "tip": tip, **elbows}


ROBOTS = (Belts, Hexapod, FiveBar, Delta)


@cache
def drawn_model(kind) -> pc.Model:
    """The model as drawn, which all robots of a kind have in common."""
    return kind(0).model()


def record(robot, rng, n, time, fault=None, measured=False) -> pc.Dataset:
    """Samples of a robot, without poses unless `measured`."""
    fault = fault or Fault()
    seen = robot.readings(rng, n, fault)
    q = seen.pop("q")
    q = q + rng.normal(0, robot.sigma, q.shape)
    q[:, fault.joint] += fault.shift + rng.normal(0, fault.scatter or 1e-300, n)
    tip, r = seen.pop("tip", None), np.zeros((n, 3))
    shown = np.zeros((n, 6), bool)
    if measured and tip is not None:
        axes = slice(0, tip.shape[1])
        r[:, axes], shown[:, axes] = tip + rng.normal(0, robot.sight, tip.shape), True
    conditions = seen | {"time": time + 10.0 * np.arange(n)}
    if fault.recorded:
        conditions["temperature"] = np.full(n, 20.0 + fault.warmth)
    names = drawn_model(type(robot)).joints
    return pc.Dataset.from_arrays(
        names, q, r, measured=shown, joint_sigma=robot.sigma, conditions=conditions,
        pose_cov=np.eye(6) * getattr(robot, "sight", 1.0) ** 2, source=f"at {time}",
    )  # fmt: skip


def calibrate(robot, rng) -> pc.Model:
    dataset = record(robot, rng, 150, START - 10 * DAY, Fault(recorded=False), measured=True)
    return pc.fit(drawn_model(type(robot)), dataset, fix=FIXED_FRAME[robot.name]).model


def fault_on(robot, name: str, day: int, joint: int, rng: np.random.Generator) -> Fault:
    """The state of a robot on a day."""
    room = rng.normal(0, 0.3)  # K
    if day < ONSET:
        return Fault(warmth=room if robot.warm_parts == (TEMPERATURE,) else 0.0)
    if name in JUMPS:
        return Fault(joint, shift=JUMPS[name] * robot.sigma)
    if name == "drift":
        return Fault(joint, shift=(day - ONSET + 1) * robot.sigma)
    if name == "loose":
        return Fault(joint, scatter=5 * robot.sigma)
    warmth = WARMTH_K * rng.uniform(0.5, 1.5)
    return Fault(warmth=warmth, recorded=robot.warm_parts == (TEMPERATURE,))


@dataclass(frozen=True)
class Outcome:
    """Days from the change to the alarm, and until a part has 95 % of the probability (None: not in
    the days that were followed); whether that part is right; whether the alarm was false."""

    delay: int | None
    named: int | None
    right: bool
    false: bool


def follow(kind, name: str, seed: int) -> Outcome:
    """One robot with one fault."""
    robot, rng = kind(seed), np.random.default_rng([seed, FAULTS.index(name), 7])
    joint = seed % len(robot.parts)
    watch = Watch(calibrate(robot, rng))
    wanted = robot.warm_parts if name == "warm" else (robot.parts[joint],)
    delay = None
    for day in range(ONSET + FOLLOWED):
        fault, time = fault_on(robot, name, day, joint, rng), START + DAY * day
        watch = watch.add(record(robot, rng, robot.samples, time, fault), time)
        if watch.alarm and day < ONSET:
            return Outcome(None, None, False, True)
        if watch.alarm:
            delay = delay or day - ONSET + 1
            part, probability = next(iter(watch.parts.items()))
            if probability >= SURE:
                return Outcome(delay, day - ONSET + 1, is_part(part, wanted), False)
    return Outcome(delay, None, False, False)


def is_part(name: str, wanted: Sequence[str]) -> bool:
    """Whether a named part is one of those wanted, or its encoder."""
    return name.split(".")[-1] in wanted


def count_false_alarms(kind, months: int, days: int = 60) -> tuple[int, float]:
    """False alarms and the days until them; each robot is followed to its first, or for `days`."""
    alarms, watched, seed = 0, 0.0, 0
    while watched < 30 * months:
        robot, rng = kind(1000 + seed), np.random.default_rng([seed, 99])
        watch = Watch(calibrate(robot, rng))
        for day in range(days):
            time = START + DAY * day
            watch = watch.add(record(robot, rng, robot.samples, time, Fault()), time)
            if watch.alarm:
                break
        alarms += watch.alarm is not None
        watched += (watch.visits[-1].time - watch.visits[0].time) / DAY
        seed += 1
    return alarms, watched


def rate_interval(alarms: int, days: float) -> tuple[float, float]:
    """The exact 95 % interval of the number of false alarms a month (Garwood)."""
    from scipy.stats import chi2

    low = chi2.ppf(0.025, 2 * alarms) / 2 if alarms else 0.0
    return float(low * 30 / days), float(chi2.ppf(0.975, 2 * alarms + 2) / 2 * 30 / days)


def say_days(days: Sequence[int | None]) -> str:
    """Median and 90 % of the days, and how many never came."""
    known = sorted(day for day in days if day is not None)
    if not known:
        return "never"
    words = f"{np.median(known):.0f}, 90 %: {known[int(0.9 * (len(known) - 1))]}"
    missed = len(days) - len(known)
    return f"{words} ({missed} of {len(days)} never)" if missed else words


def main() -> None:
    robots = int(sys.argv[1]) if len(sys.argv) > 1 else 30
    months = int(sys.argv[2]) if len(sys.argv) > 2 else 100
    asked = sys.argv[3:]
    if unknown := set(asked) - {kind.name for kind in ROBOTS} - set(FAULTS):
        raise SystemExit(f"{', '.join(unknown)}: expected a robot or one of {', '.join(FAULTS)}")
    chosen = [kind for kind in ROBOTS if kind.name in asked] or list(ROBOTS)
    faults = [name for name in FAULTS if name in asked] or list(FAULTS)
    print("| robot | change | robots | days to the alarm | days until a part has 95 % | right |")
    print("|---|---|---|---|---|---|")
    for kind in chosen:
        for name in faults:
            found = [follow(kind, name, seed) for seed in range(robots)]
            kept = [one for one in found if not one.false]
            named = [one for one in kept if one.named is not None]
            alarm, part = (
                say_days([getattr(one, key) for one in kept]) for key in ("delay", "named")
            )
            right = f"{sum(one.right for one in named)} of {len(named)}"
            print(
                f"| {kind.name} | {name} | {len(kept)} | {alarm} | {part} | {right} |", flush=True
            )
    for kind in chosen if months else ():
        alarms, days = count_false_alarms(kind, months)
        low, high = rate_interval(alarms, days)
        rate = f"{alarms * 30 / days:.2f} a month, 95 % interval {low:.2f} to {high:.2f}"
        print(f"{kind.name}: {alarms} false alarms in {days / 30:.0f} months: {rate}", flush=True)


if __name__ == "__main__":
    main()
