"""How often a calibration holds its limit at the date that it states, for fleets that drift.

The robots are five-bars of points and distances, written here; nothing of them comes from the
package. Each is calibrated by `fit`, then measured in five sessions of 20 poses, a month apart. It
drifts by one of four laws, every part with a rate of its own:

- `homing`: zeros and lengths differ from session to session, and do not grow;
- `wear`: they change like a random walk;
- `steady`: they change at a constant rate;
- `mixed`: all three together.

The sizes are 0.3, 1, 3 and 10 times those that the package takes as usual. The last session is the
calibration, and states until when its rms error stays within a limit: 250 um times the size, about
twice what one usual drift causes. The true robot then drifts on: the share of robots that are
within the limit at the stated date is to be 95 % or more. With `fleet`, the drift comes from ten
other robots, the robot itself has one session only, each size is drawn from 0.3, 1 and 3, and the
limit is 500 um.
Usage: `python -m bench.truth.age [robots] [fleet] [law ...]`
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import parallel_cal as pc
from parallel_cal.base.threads import single_threaded
from parallel_cal.identification.age import Age, predict_age
from parallel_cal.identification.drift_estimate import Session, estimate_drift, pool_drifts
from parallel_cal.identification.drift_rate import DriftRate
from parallel_cal.model.file.modelfile import write_model
from parallel_cal.model.model import Model, Noise, new_model

DAY = 86400.0
START = 1.7e9  # s since 1970
SESSIONS, EVERY = 5, 30 * DAY
POSES, CALIBRATION = 20, 40
NOISE_Q, NOISE_R = 2e-5, 20e-6  # rad, m
# x, y, crank, rod, zero of the left and the right side; two zeros fix nothing here
NOMINAL = np.array([-0.05, 0, 0.1, 0.15, 0, 0.05, 0, 0.1, 0.15, 0])
TOLERANCE = np.array([2e-4, 2e-4, 2e-4, 2e-4, np.radians(1)] * 2)
# 1 sigma: a length by a tenth of its tolerance, a zero by 0.5 mrad
DRIFT = np.array([2e-5, 2e-5, 2e-5, 2e-5, 0.5e-3] * 2)
LIMIT = 250e-6  # m, times the size of the drift
# Of a fleet every robot has the same limit: one of its own would tell how far it drifts.
FLEET_SIZES, FLEET_LIMIT = (0.3, 1.0, 3.0), 500e-6
LAWS = ("homing", "wear", "steady", "mixed")
SIZES = (0.3, 1.0, 3.0, 10.0)
LOW, HIGH = np.array([-0.04, 0.17]), np.array([0.04, 0.23])


def reach(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Tips (n, 2) of a five-bar with the parameters p at the joint readings q (n, 2)."""
    sides = p.reshape(2, 5)
    angles = q + sides[:, 4]
    elbow = sides[:, :2] + sides[:, 2, None] * np.stack([np.cos(angles), np.sin(angles)], axis=2)
    way = elbow[:, 1] - elbow[:, 0]
    far = np.linalg.norm(way, axis=1)
    along = (far**2 + sides[0, 3] ** 2 - sides[1, 3] ** 2) / (2 * far)
    up = np.sqrt(sides[0, 3] ** 2 - along**2)
    unit = way / far[:, None]
    across = np.column_stack([-unit[:, 1], unit[:, 0]])
    return np.asarray(elbow[:, 0] + along[:, None] * unit + up[:, None] * across)


def turn_to(p: np.ndarray, tips: np.ndarray) -> np.ndarray:
    """Joint readings (n, 2) at the tips (n, 2): elbows to the outside."""
    found = []
    for side, sign in ((p[:5], 1), (p[5:], -1)):
        way = tips - side[:2]
        far = np.linalg.norm(way, axis=1)
        inner = (far**2 + side[2] ** 2 - side[3] ** 2) / (2 * far * side[2])
        found.append(np.arctan2(way[:, 1], way[:, 0]) + sign * np.arccos(inner) - side[4])
    return np.column_stack(found)


class Robot:
    """A five-bar that drifts: its parameters at any time from `START` on."""

    def __init__(self, rng: np.random.Generator, law: str, size: float):
        self.rng, self.law = rng, law
        self.first = NOMINAL + TOLERANCE * rng.standard_normal(10)
        rates = size * DRIFT * np.exp(0.5 * rng.standard_normal(10))
        share = {"mixed": 3**-0.5}.get(law, 1.0)
        self.rates, self.slope = share * rates, share * rates * rng.standard_normal(10)
        self.walk, self.time = np.zeros(10), START

    def at(self, time: float) -> np.ndarray:
        """The parameters (10,) in a session at a time, not before that of the last call. The rates
        are those of a difference after a session's usual distance."""
        months = (time - self.time) / EVERY
        p = self.first.copy()
        self.walk += self.rates * np.sqrt(months) * self.rng.standard_normal(10)
        self.time = time
        if self.law in ("wear", "mixed"):
            p += self.walk
        if self.law in ("steady", "mixed"):
            p += self.slope * (time - START) / EVERY
        if self.law in ("homing", "mixed"):
            p += self.rates / 2**0.5 * self.rng.standard_normal(10)
        return np.asarray(p)


def measure(p: np.ndarray, rng: np.random.Generator, n: int) -> pc.Dataset:
    tips = rng.uniform(LOW, HIGH, (n, 2))
    q = turn_to(p, tips) + rng.normal(0, NOISE_Q, (n, 2))
    r = np.column_stack([tips + rng.normal(0, NOISE_R, (n, 2)), np.zeros(n)])
    shown = np.zeros((n, 6), bool)
    shown[:, :2] = True
    cov = np.eye(6) * NOISE_R**2
    return pc.Dataset.from_arrays(
        ("left", "right"), q, r, measured=shown, joint_sigma=NOISE_Q, pose_cov=cov
    )


def nominal() -> Model:
    return replace(new_model("five_bar"), noise=Noise(NOISE_Q, NOISE_R))


def write_sessions(folder: Path) -> None:
    """Write the drawing of a five-bar and its sessions, a month apart, for docs/age.md."""
    rng = np.random.default_rng(3)
    robot = Robot(rng, "wear", 1.0)
    for k in range(SESSIONS):
        time = START + k * EVERY
        data = measure(robot.at(time), rng, CALIBRATION if k == SESSIONS - 1 else POSES)
        replace(data, time=time + 10.0 * np.arange(len(data))).to_json(folder / f"month{k}.json")
    write_model(nominal(), folder / "drawn.yaml")


@dataclass(frozen=True)
class Outcome:
    """Days until the stated date, whether it is less than the time that was seen, and whether the
    true error was within the limit then."""

    days: float
    is_seen: bool
    held: bool


def follow(law: str, size: float, seed: int, fleet: DriftRate | None = None) -> Outcome:
    """Calibrate one robot, ask it for its date, and let it drift until then."""
    rng = np.random.default_rng([seed, LAWS.index(law), int(10 * size)])
    robot, drawing, sessions = Robot(rng, law, size), nominal(), []
    count = SESSIONS if fleet is None else 1
    for k in range(count):
        time = START + k * EVERY
        p = robot.at(time)
        dataset = measure(p, rng, CALIBRATION if k == count - 1 else POSES)
        sessions.append(Session.of(drawing, dataset, time))
    result, limit = pc.fit(drawing, dataset), size * LIMIT if fleet is None else FLEET_LIMIT
    age = state_age(result, sessions, time, fleet, limit)
    until = age.until
    if until == time:
        return Outcome(0.0, True, True)  # it promises nothing
    q = turn_to(p, rng.uniform(LOW, HIGH, (200, 2)))
    wrong = predict(result.model, q) - reach(robot.at(until), q)
    # A device that checks the robot sees its own noise and that of the joints, too.
    today = predict(result.model, q) - reach(p, q)
    error = result.held_out.summary.position_rms
    seen = error**2 - np.mean(np.sum(today**2, axis=1))
    held = np.sqrt(np.mean(np.sum(wrong**2, axis=1)) + seen) <= limit
    return Outcome((until - time) / DAY, age.trusts[0].is_seen, bool(held))


def state_age(
    result: pc.FitResult,
    sessions: list[Session],
    time: float,
    fleet: DriftRate | None,
    limit: float,
) -> Age:
    rate = estimate_drift(sessions, result.model, fleet)
    errors = {"position": result.held_out.summary.position_rms}
    return predict_age(result.model, rate, time, errors, {"position": limit})


def predict(model: Model, q: np.ndarray) -> np.ndarray:
    return pc.Kinematics(model).direct(q).position[:, :2]


def learn_fleet(law: str, size: float | None, robots: int, seed: int) -> DriftRate:
    drawing, each = nominal(), []
    for k in range(robots):
        rng = np.random.default_rng([seed, k, LAWS.index(law), 99])
        robot = Robot(rng, law, rng.choice(FLEET_SIZES) if size is None else size)
        times = START + EVERY * np.arange(SESSIONS)
        each.append([Session.of(drawing, measure(robot.at(t), rng, POSES), t) for t in times])
    found = pool_drifts(each, drawing)
    assert found is not None
    return found


def describe(law: str, size: float | None, found: list[Outcome]) -> str:
    promised = [one for one in found if one.days > 0]
    kept = sum(one.held for one in promised)
    days = np.median([one.days for one in found])
    ends = sum(not one.is_seen for one in found)
    share = f"{kept} of {len(promised)}" if promised else "-"
    words = "0.3 to 3" if size is None else f"{size:g}"
    return f"| {law} | {words} | {len(found)} | {days:.0f} | {ends} | {share} |"


def main() -> None:
    robots = next((int(a) for a in sys.argv[1:] if a.isdigit()), 40)
    laws = [law for law in LAWS if law in sys.argv] or LAWS
    print("| law | size | robots | median days | all that was seen | within the limit |")
    print("|---|--:|--:|--:|--:|--:|")
    with single_threaded():
        for law in laws:
            for size in (None,) if "fleet" in sys.argv else SIZES:
                fleet = learn_fleet(law, size, 10, 1) if "fleet" in sys.argv else None
                rng = np.random.default_rng(LAWS.index(law))
                sizes = rng.choice(FLEET_SIZES, robots) if size is None else np.full(robots, size)
                found = [follow(law, one, k, fleet) for k, one in enumerate(sizes)]
                print(describe(law, size, found), flush=True)


if __name__ == "__main__":
    main()
