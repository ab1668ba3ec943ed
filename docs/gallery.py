"""Draws docs/gallery/*.svg, and docs/gallery.md about them: `python docs/gallery.py [EFFECT ...]`.

A virtual robot has the effect, each number one tolerance; the model without it is identified, and
the residuals are shown along what tells most. Over them lies the effect's pattern, and beside it
the best that each of its lookalikes makes of the same residuals.
"""

from __future__ import annotations

import dataclasses
import sys
from html import escape
from pathlib import Path

import numpy as np

from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.diagnosis.catalogue import Candidate, candidate
from parallel_cal.diagnosis.patterns import compute_mean_profile
from parallel_cal.diagnosis.signature import (
    Panel,
    compute_explained_residual,
    compute_overlay_pattern,
    compute_pattern_strength,
    signature,
)
from parallel_cal.diagnosis.thresholds import LEVELS
from parallel_cal.identification.fit import fit
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.effect import Effect
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.model.mechanism import Workspace, poses_in_workspace
from parallel_cal.model.model import Model, new_model
from parallel_cal.model.shelf import list_plugins, load_effect, load_sensor
from parallel_cal.posterior.scene import Scene
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.simulate import stated_noise, with_effects
from parallel_cal.reporting.contents import unit_along
from parallel_cal.reporting.readable import value_unit

DOCS = Path(__file__).parent
ROBOTS = ("delta54", "linear_delta", "cable", "stewart42", "arm")  # the first that can have it
ARM = DOCS.parent / "real" / "laser_arms" / "ur5.yaml"
ARM_REACH = (0.25, 0.6)  # m and rad to both sides of the arm's home
POSES, FINE = 160, 0.2  # its instruments have a fifth of the usual noise
HOURS = 2.0  # of a session
LARGER, PLAIN = (1.0, 3.0, 10.0), 0.4  # tolerances that are tried, share of the residuals wanted
PLATFORM_KNOWN = ("target_offset",)  # where its points are free they hide it
GIVEN = {"device_bump": {"time": 3000.0}, "strain_wave_compliance": {"torque": 0.3}}
WIDTH, HEIGHT, LEFT, TOP, FOOT = 240, 168, 36, 22, 30
TEXT_WIDTH = 420  # of the longest line below the panels
STYLE = """
text { font: 11px sans-serif; fill: #57606a } .name { font-weight: bold; fill: #24292f }
.axis { stroke: #8a94a3; stroke-width: 1; fill: none }
.points { stroke: #8a94a3; stroke-width: 3; stroke-linecap: round; opacity: 0.55 }
.pattern { stroke: #d55e00; stroke-width: 2.5; fill: none; stroke-linejoin: round }
@media (prefers-color-scheme: dark) { text { fill: #9198a1 } .name { fill: #e6edf3 } }"""
HEAD = f"""# Gallery of effects

Each picture shows the residuals of a model that lacks one effect. Its first panel shows the pattern
of this effect. The next panels show how well the lookalikes fit these residuals.

- **Grey:** residuals in sigmas, against the quantity on which the pattern depends most. For a gear
  this is the angle within one turn of its input.
- **Orange:** the pattern, as a rolling mean, or as one mean for each level.
- **Percentage:** the share of the residuals' sum of squares that the pattern accounts for. If the
  share of a lookalike is nearly as large, data of this kind do not distinguish the two effects. The
  text names the measurements that do.

The robots are simulated. Each has {POSES} poses. Every parameter of the effect has the size of one
tolerance, or of three or ten if one tolerance would hardly be visible. The noise is a fifth of the
usual noise. All conditions are recorded: direction, travel, velocity, acceleration,
temperature (also that of each part), payload, time and session.

`parallel-cal report` draws these patterns over your own data. `make gallery` writes this page.
"""


def session(robot: Model, seed: int = 0) -> Dataset:
    """Poses that a robot goes to, measured, every condition recorded and varied at random."""
    rng, m = np.random.default_rng(seed), robot.mechanism
    n, nq = POSES, len(robot.joints)
    time = np.linspace(0.0, 3600.0 * HOURS, n)
    way = rng.choice([-1.0, 1.0], (n, nq))
    at = {
        "time": time,
        "session": np.repeat([0.0, 1.0], n // 2),
        "temperature": 21.0 + 4.0 * np.sin(7 * np.pi * time / time[-1]),
        "payload": rng.choice([0.0, 0.5, 1.0], n),
    }
    for k, body in enumerate(m.expanding_bodies):
        course = np.sin((7 + 2 * k) * np.pi * time / time[-1] + k)
        at[f"temperature.{body}"] = at["temperature"] + 6.0 * course
    for j, joint in enumerate(robot.joints):
        at[f"direction.{joint}"] = way[:, j]
        at[f"travel.{joint}"] = way[:, j] * rng.exponential(0.01, n)
        at[f"velocity.{joint}"] = way[:, j] * rng.uniform(0.1, 1.0, n)
        at[f"acceleration.{joint}"] = np.random.default_rng([seed, j]).uniform(-10.0, 10.0, n)
    k, known = Kinematics(robot), {c: at[c] for c in robot.conditions}
    joints = k.inverse(*poses_in_workspace(m, n, rng), known).joints
    found = k.direct(joints, known)
    noise = stated_noise(robot)
    sigma = FINE * np.repeat([noise.position or 0.0, noise.orientation or 0.0], 3)
    e, readings = sigma * rng.standard_normal((n, 6)), {}
    channels = robot.structure.channels
    if channels:
        rows = robot.structure.residuals(
            found.configuration.rows, robot.condition_rows(known, n), robot.values
        )[0][:, -len(channels) :]
        apart = rng.standard_normal(rows.shape) * robot.structure.standard_uncertainty
        readings = {f"reading.{c}": v for c, v in zip(channels, (rows + apart).T, strict=True)}
    seen = np.isin(range(6), m.moved) & (not channels)  # who probes has no other device
    one = FINE * np.nan_to_num(dataclasses.replace(robot, noise=noise).joint_noise)
    return Dataset.from_arrays(
        robot.joints,
        joints + one * rng.standard_normal((n, nq)),
        found.position + e[:, :3],
        rotation_matrix(e[:, 3:]) @ found.rotation,
        measured=np.tile(seen, (n, 1)),
        pose_cov=np.diag(sigma**2),
        joint_sigma=one,
        conditions=at | readings,
        pose_id=np.arange(n),
    )


def found(effect: Effect) -> Candidate:
    """The effect as a candidate where it is hidden, large enough to be seen."""
    for times in LARGER:
        one = candidate(hidden(effect, times), effect.name)
        if one.score is None:
            raise SystemExit(f"{effect.name}: {one.reason}")
        if share(one) > PLAIN:
            break
    return one


def hidden(effect: Effect, times: float) -> Scene:
    """The scene of a model identified on a robot that has the effect, so many tolerances large."""
    if effect.widens:
        larger = new_model("delta54")
        away = larger.table.matching(["*.dalpha", "*.dbeta", "*.dC_?", "*.dLb"])
        way = np.random.default_rng(1).choice([-1.0, 1.0], len(larger.values))
        tolerances = 0.1 * away * way * larger.table.tolerance
        robot, model = larger.with_values(larger.values + tolerances), new_model("delta24")
    else:
        robots = (bare(name, probing=bool(effect.reads)) for name in ROBOTS)
        able = (m for m in robots if not effect.applies(m.mechanism))
        model = next(m for m in able if bool(m.sensors) == bool(effect.reads))
        if effect.name in PLATFORM_KNOWN:
            model = new_model("stewart42")
        robot = with_effects(model, [(effect.name, GIVEN.get(effect.name, {}))])
        own = robot.table.matching([f"{effect.name}.*"]) & ~robot.fixed
        robot = robot.with_values(np.where(own, times, 1.0) * robot.values)
    fix = ["leg*"] if model.sensors else []  # who only probes knows his robot
    fix += ["*.B_?"] if effect.name in PLATFORM_KNOWN else []
    result = fit(model, session(robot), hold_out=0, fix=fix)
    return Scene.of(result.model, result.dataset, result.observations, result.free)


def bare(name: str, probing: bool) -> Model:
    if name == "arm":
        arm = read_model(ARM)
        home = np.array([*arm.mechanism.home.position, *arm.mechanism.home.rotation_vector])
        half = np.repeat(ARM_REACH, 3)
        arm.mechanism.workspace = Workspace(tuple(home - half), tuple(home + half))
        return arm
    probes = probing and name == "stewart42"
    sensors = [load_sensor("probe", height=0.2, mounted=True)] if probes else []
    return new_model(name, sensors=sensors)


def telling(one: Candidate) -> Panel:
    """The panel whose pattern follows its abscissa most."""
    return max(
        signature(one).panels, key=lambda panel: compute_pattern_strength(panel.at, panel.pattern)
    )


def share(one: Candidate) -> float:
    assert one.scene is not None
    r = one.scene.residual
    return float(np.sum(compute_explained_residual(one) ** 2) / (r @ r))


def picture(one: Candidate) -> str:
    """The effect's own panel, then one a lookalike that can be tested, as SVG."""
    effect, scene, panel = one.effect, one.scene, telling(one)
    assert scene is not None
    patterns = [(f"{effect.name}: {share(one):.0%}", panel.pattern)]
    for name in effect.lookalikes[:3]:
        other = candidate(scene, name)
        if other.score is not None and other.scene is one.scene:
            patterns.append((f"{name}: {share(other):.0%}", compute_overlay_pattern(panel, other)))
    size = 1.1 * max(float(np.quantile(abs(panel.residual), 0.98)), 2.0)
    mechanism = scene.model.mechanism
    unit, factor = value_unit(unit_along(mechanism, panel.abscissa))
    panels = [
        drawn(panel, pattern, factor, size, title, k * WIDTH)
        for k, (title, pattern) in enumerate(patterns)
    ]
    within = ", one period" if panel.period else ""
    under = f"{panel.abscissa}{within}" + (f" [{unit}]" if unit else "")
    axes = (
        f'<text x="{LEFT}" y="{HEIGHT - 4}">{escape(panel.component)} residual [σ] '
        f"against {escape(under)}, {escape(mechanism.name)}</text>"
    )
    wide = max(WIDTH * len(patterns), TEXT_WIDTH)
    size_ = f'viewBox="0 0 {wide} {HEIGHT}" width="{wide}"'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" {size_}>'
    return "\n".join([head, f"<style>{STYLE}\n</style>", *panels, axes, "</svg>\n"])


def drawn(
    panel: Panel, pattern: np.ndarray, factor: float, size: float, title: str, shift: int
) -> str:
    """One panel: a frame, points, the pattern's mean."""
    low, high = panel.at.min(), panel.at.max()
    spare = 0.35 * (high - low) if len(np.unique(panel.at)) <= LEVELS else 0.03 * (high - low)
    low, high = low - spare, high + spare
    wide, tall = WIDTH - LEFT - 10, HEIGHT - TOP - FOOT

    def place(x: np.ndarray, y: np.ndarray) -> list[str]:
        across = shift + LEFT + wide * (x - low) / (high - low)
        up = TOP + tall * (1 - (np.clip(y, -size, size) / size + 1) / 2)
        return [f"{a:.1f} {b:.1f}" for a, b in zip(across, up, strict=True)]

    spread = 0.2 * spare * np.random.default_rng(0).uniform(-1, 1, len(panel.at)) * (spare > 0)
    dots = "".join(f"M{at}h0" for at in place(panel.at + spread, panel.residual))
    mean = compute_mean_profile("", panel.at, pattern[:, None])
    x, y = mean.at, mean.mean[:, 0]
    if len(np.unique(panel.at)) <= LEVELS:
        strokes = zip(place(x - 0.6 * spare, y), place(x + 0.6 * spare, y), strict=True)
        line = "".join(f"M{a}L{b}" for a, b in strokes)
    else:
        line = "M" + "L".join(place(x, y))
    zero, left, right = TOP + tall / 2, shift + LEFT, shift + LEFT + wide
    ticks = [(TOP + 8, f"+{size:.0f}"), (zero + 4, "0"), (TOP + tall, f"−{size:.0f}")]
    ends = [("start", left, factor * panel.at.min()), ("end", right, factor * panel.at.max())]
    return "\n".join(
        [
            f'<text class="name" x="{left}" y="14">{escape(title)}</text>',
            f'<path class="axis" d="M{left} {TOP}V{TOP + tall}M{left} {zero:.1f}H{right}"/>',
            *(f'<text x="{left - 4}" y="{h:.0f}" text-anchor="end">{t}</text>' for h, t in ticks),
            *(
                f'<text x="{e}" y="{TOP + tall + 12}" text-anchor="{a}">{v:.4g}</text>'
                for a, e, v in ends
            ),
            f'<path class="points" d="{dots}"/>',
            f'<path class="pattern" d="{line}"/>',
        ]
    )


def page() -> str:
    """The page, one section an effect."""
    parts = [HEAD]
    for name in list_plugins("effects"):
        effect = load_effect(name)
        alike = ", ".join(f"[{other}](#{other})" for other in effect.lookalikes)
        words = [effect.physics + "\n", f"- Lookalikes: {alike or 'none'}."]
        if effect.separated_by:
            words.append(f"- Measurements that distinguish them: {effect.separated_by}.")
        if effect.remedy:
            words.append(f"- Remedy: {effect.remedy}.")
        text = "\n".join(words)
        parts.append(f"## {name}\n\n{text}\n\n![{name}](gallery/{name}.svg)\n")
    return "\n".join(parts)


def main(only: list[str]) -> None:
    (DOCS / "gallery").mkdir(exist_ok=True)
    for name in only or list_plugins("effects"):
        text = picture(found(load_effect(name)))
        (DOCS / "gallery" / f"{name}.svg").write_text(text, encoding="utf-8")
    (DOCS / "gallery.md").write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
