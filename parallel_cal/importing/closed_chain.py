"""The mechanism `chain` from a file that describes a closed linkage: MJCF, SDF, URDF with loops."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from parallel_cal.base.errors import DatasetError, ModelError, OpenLoopsError, ParallelCalError
from parallel_cal.base.files import read_foreign_text
from parallel_cal.base.rotation import matrix_to_quaternion
from parallel_cal.importing.compound_joints import simplify
from parallel_cal.importing.controller_files import ConfiguredRobot
from parallel_cal.importing.linkage import (
    COORDINATES,
    DRIVABLE,
    Linkage,
    LinkageJoint,
    LinkageLoop,
    Place,
    fuse,
    locate,
    plain_name,
    select,
    with_locked,
    with_plain_names,
)
from parallel_cal.importing.mjcf import read_mjcf
from parallel_cal.importing.mjcf_elements import NeedsMuJoCo
from parallel_cal.importing.sdf import read_sdf
from parallel_cal.importing.urdf_loops import has_loops, read_urdf_loops
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_mechanism

Array = np.ndarray

URDF_SUFFIXES = (".urdf", ".xacro")
READERS: Mapping[str, Callable[[Path], Linkage]] = {
    ".xml": read_mjcf,
    ".mjcf": read_mjcf,
    ".sdf": read_sdf,
    ".world": read_sdf,
    ".urdf": read_urdf_loops,
    ".xacro": read_urdf_loops,
}
GRAVITY = np.array([0.0, 0.0, -9.81])  # m/s^2, in the frame of the file's world
ROUNDING_ERROR = 1e-15
MAX_DRAWN_OPEN = 1e-3  # rad or m: files state angles with few digits
OTHER_ASSEMBLY = (
    "If the robot is assembled otherwise, state values near its own as home of these joints in the "
    "model file"
)


def describes_linkage(path: Path) -> bool:
    """Return whether a file is one of a simulator, or a URDF with loops."""
    suffix = path.suffix.lower()
    if suffix in URDF_SUFFIXES:
        return path.is_file() and has_loops(path)
    if suffix == ".xml":
        return path.is_file() and "<mujoco" in read_foreign_text(path)
    return suffix in READERS


def chain(
    paths: Sequence[Path],
    base: str = "",
    platform: str = "",
    driven: Sequence[str] = (),
    locked: Sequence[str] = (),
    **options: Any,
) -> ConfiguredRobot:
    """Return the model of the closed chain between two bodies of a file.

    Parameters
    ----------
    paths : sequence of Path
        An MJCF, SDF or URDF. The loops of a URDF are in `<constraint>` elements, or in a YAML file:
        the second path, or one beside the URDF.
    base : str
        Body, site or link that carries {B}. By default the floating body, or the root.
    platform : str
        Body, site or link that is {P}.
    driven : sequence of str
        Joints with readings, in this order. By default those with actuators.
    locked : sequence of str
        Passive joints that do not move, such as leaf springs, which are taken as rigid.
    **options
        Further options of the mechanism `chain`.
    """
    path = paths[0]
    linkage = with_locked(read_linkage(paths), locked)
    base = base or linkage.roots[0]
    if not platform:
        names = ", ".join(sorted(name for name in linkage.frames if name != base))
        raise DatasetError(
            f"{path}: choose the body that carries the target with --platform: {names}"
        )
    stated = [plain_name(name) for name in driven or linkage.driven]
    between, place = cut_out(linkage, base, platform, stated)
    known = {one.name: one for one in between.parts}
    used = [name for name in stated if name in known]
    check_driven(between, driven, used)
    remarks = [*linkage.remarks]
    try:
        mechanism, about_home = make_mechanism(between, base, place, used, options)
    except OpenLoopsError as error:
        advice = [*linkage.remarks, *advise_points(linkage, base, platform, used)]
        raise DatasetError(". ".join([str(error), *advice])) from None
    remarks += about_home
    velocities = {joint.name: joint.velocity for joint in between.joints}
    mechanism.joint_rates = tuple(
        (velocities.get(name, np.inf), np.inf) for name in mechanism.joints
    )
    model = replace(new_model(mechanism), frames={"base": base, "platform": platform})
    named = [one.name for one in linkage.parts]
    if renamed := [name for name in named if plain_name(name) in known and name not in known]:
        remarks.append(
            f"dots, blanks and brackets in names are written _: {', '.join(map(repr, renamed))}"
        )
    if not driven:
        remarks.append(f"driven as in the file: {', '.join(used)}")
    if outside := [name for name in stated if name not in known]:
        remarks.append(f"not between {base} and {platform}: {', '.join(outside)}")
    return ConfiguredRobot(model, (*remarks, *mechanism.remarks))


def make_mechanism(
    linkage: Linkage,
    base: str,
    place: Place,
    driven: Sequence[str],
    options: Mapping[str, Any],
) -> tuple[Mechanism, list[str]]:
    """Return the mechanism, and a remark if its loops do not close with driven joints at zero, or
    if it is singular there."""
    described, remarks = describe(linkage, base, place, driven) | {**options}, list[str]()
    try:
        try:
            mechanism = load_mechanism("chain", **described)
        except ModelError as error:
            if not (isinstance(error.__cause__, OpenLoopsError) and error.__cause__.home):
                raise
            closed = error.__cause__
            described, words = with_home(described, closed)
            mechanism = load_mechanism("chain", **described)
            reason = (
                "home is beside the file's zero, where the chain is singular"
                if closed.singular
                else "home is where the loops close next to the file's zero"
            )
            remarks = [f"{reason}: {words}. {OTHER_ASSEMBLY}"]
    except ModelError as error:
        message = f"{linkage.path}: {error}{_hint(linkage)}"
        closes_nowhere = isinstance(error.__cause__, OpenLoopsError)
        raise (OpenLoopsError if closes_nowhere else DatasetError)(message) from None
    return mechanism, remarks or describe_closing(mechanism)


def advise_points(linkage: Linkage, base: str, platform: str, driven: Sequence[str]) -> list[str]:
    """Say if loops that close nowhere would close with points in place of full poses."""
    poses = [loop.name for loop in linkage.loops if loop.kind == "pose"]
    if not poses:
        return []
    points = [replace(one, kind="point") if one.name in poses else one for one in linkage.loops]
    try:
        looser, place = cut_out(replace(linkage, loops=tuple(points)), base, platform, driven)
        make_mechanism(looser, base, place, driven, {})
    except OpenLoopsError:
        return []
    except ParallelCalError:
        pass  # it closes, and lacks something else
    return [
        "The loops do close if those that state a full pose (6d of a URDF, weld of an MJCF) join "
        "points only (3d, connect). A rod that has a ball at its end needs this type: check "
        f"{', '.join(poses)}"
    ]


def describe_closing(mechanism: Any) -> list[str]:
    """Say where passive joints of a `chain` are at home if the file draws its loops open."""
    drawn = {name: value for name, _, value in mechanism.skeleton.passive}
    home = zip(mechanism.passive, mechanism.passive_units, mechanism.home.passive, strict=True)
    moved = [
        f"{name} {value:.6g} {unit}"
        for name, unit, value in home
        if abs(value - drawn[name]) > MAX_DRAWN_OPEN
    ]
    return moved and [
        f"the loops are open as the file draws them; at home they close with {', '.join(moved)}. "
        f"{OTHER_ASSEMBLY}"
    ]


def _hint(linkage: Linkage) -> str:
    """Return what may help if a chain moves although its driven joints do not."""
    springs = [joint.name for joint in linkage.joints if joint.rest is not None]
    words = f"; joints with springs, which --locked takes as rigid: {', '.join(springs)}"
    return words if springs else ""


def with_home(described: Mapping[str, Any], closed: OpenLoopsError) -> tuple[dict[str, Any], str]:
    """Return options of `chain` with a home at which its loops close, and in words the readings
    there and the passive joints that are not as the file draws them."""
    found, said = {**described}, list[str]()
    for key in ("joints", "loops"):
        parts = []
        for one in described.get(key, ()):
            name, count = one["name"], COORDINATES.get(one["type"], 1)
            names = [name] if count == 1 else [f"{name}.{i + 1}" for i in range(count)]
            values = [float(closed.home[each]) for each in names if each in closed.home]
            drawn = np.broadcast_to(one.get("home", 0.0), len(values))
            parts.append(one | ({"home": values[0] if count == 1 else values} if values else {}))
            unit = "m" if one["type"] in ("prismatic", "distance") else "rad"
            said += [
                f"{each} {value:.6g} {unit}"
                for each, value, before in zip(names, values, drawn, strict=False)
                if one.get("driven") or abs(value - before) > MAX_DRAWN_OPEN
            ]
        if parts:
            found[key] = parts
    if "home" in described:
        found["home"] = {"position": closed.position, "quaternion": closed.quaternion}
    return found, ", ".join(said)


def read_linkage(paths: Sequence[Path]) -> Linkage:
    """Return what a file describes, by its suffix."""
    path, *others = paths
    suffix = path.suffix.lower()
    if suffix not in READERS:
        raise DatasetError(f"{path}: expected one of {', '.join(READERS)}")
    if suffix in URDF_SUFFIXES and len(others) == 1:
        return read_urdf_loops(path, others[0])
    if others:
        raise DatasetError(f"{others[0]}: expected one file, or a URDF and the YAML of its loops")
    try:
        return READERS[suffix](path)
    except NeedsMuJoCo:
        if find_spec("mujoco") is None:
            raise
    from parallel_cal.importing.mjcf_compiled import read_compiled_mjcf

    return read_compiled_mjcf(path)


def cut_out(
    linkage: Linkage, base: str, platform: str, driven: Collection[str]
) -> tuple[Linkage, Place]:
    """Return the part of a linkage between two bodies or frames, and where the platform is.

    Fixed joints, hinges that meet in a ball and rods between two balls are joined; the body of the
    base has the frame `base`.
    """
    for name, role in ((base, "base"), (platform, "platform")):
        locate(linkage, name, role)
    fused = fuse(linkage, base)
    place = fused.frames[platform]
    if place.body == base:
        raise DatasetError(
            f"{linkage.path}: no joint moves '{platform}' against '{base}'; choose other bodies "
            "with --base and --platform"
        )
    between = with_plain_names(select(fused, base, place.body))
    return simplify(between, (base, place.body), driven), place


def check_driven(linkage: Linkage, stated: Sequence[str], used: Sequence[str]) -> None:
    drivable = [joint.name for joint in linkage.joints if joint.kind in DRIVABLE]
    drivable += [loop.name for loop in linkage.loops if loop.kind == "distance"]
    unknown = [name for name in stated if name not in drivable]
    if unknown or not used:
        words = (
            f"--driven {unknown[0]} is no joint that can be driven"
            if unknown
            else "the file does not state which joints are driven: state them with --driven"
        )
        raise DatasetError(f"{linkage.path}: {words}; expected some of {', '.join(drivable)}")
    if wrong := [name for name in used if name not in drivable]:
        raise DatasetError(
            f"{linkage.path}: the joint '{wrong[0]}' with an actuator is neither revolute nor "
            f"prismatic; state the driven joints with --driven: {', '.join(drivable)}"
        )


# ------------------------------------------------------------------ options of `chain`


def describe(linkage: Linkage, base: str, place: Place, driven: Sequence[str]) -> dict[str, Any]:
    """Return the options of the mechanism `chain`."""
    order = {name: k for k, name in enumerate(driven)}

    def rank(one: LinkageJoint | LinkageLoop) -> int:
        return order.get(one.name, len(order))

    joints = [
        describe_joint(joint, joint.name in order) for joint in sorted(linkage.joints, key=rank)
    ]
    loops = [describe_loop(loop, loop.name in order) for loop in sorted(linkage.loops, key=rank)]
    document: dict[str, Any] = {"base": base, "platform": place.body, "joints": joints}
    if loops:
        document["loops"] = loops
    if place.body not in {end for joint in linkage.joints for end in (joint.parent, joint.child)}:
        drawn = np.linalg.solve(_drawn(linkage, base), _drawn(linkage, place.body)) @ place.frame
        document["home"] = {"position": _numbers(drawn[:3, 3]), "quaternion": _quaternion(drawn)}
    gravity = _drawn(linkage, base)[:3, :3].T @ linkage.gravity
    if not np.allclose(gravity, GRAVITY, atol=1e-9):
        document["gravity"] = _numbers(gravity)
    bodies = {
        *(end for joint in linkage.joints for end in (joint.parent, joint.child)),
        *(end.body for loop in linkage.loops for end in (loop.a, loop.b)),
    }
    masses: dict[str, dict[str, Any]] = {
        name: {"mass": mass, "centre": _numbers(centre)}
        for name, (mass, centre) in linkage.masses.items()
        if mass > 0 and name in bodies
    }
    for loop in linkage.loops:
        for name, mass, end, distance in loop.rod.masses if loop.rod else ():
            at = {"rod": loop.name, "end": end, "distance": distance}
            masses |= {name: {"mass": mass, **at}} if mass > 0 else {}
    if masses:
        document["masses"] = masses
    if not np.array_equal(place.frame, np.eye(4)):
        document["target"] = _numbers(place.frame[:3, 3])
        if not np.array_equal(place.frame[:3, :3], np.eye(3)):
            document["target_quaternion"] = _quaternion(place.frame)
    return document


def _drawn(linkage: Linkage, name: str) -> Array:
    """Return the frame (4, 4) of a body or of a frame on it as the file draws it."""
    return linkage.poses[name]


def describe_joint(joint: LinkageJoint, driven: bool) -> dict[str, Any]:
    found: dict[str, Any] = {
        "name": joint.name,
        "type": joint.kind,
        "parent": joint.parent,
        "child": joint.child,
        "origin": _numbers(joint.origin[:3, 3]),
    }
    if not np.array_equal(joint.origin[:3, :3], np.eye(3)):
        found["quaternion"] = _quaternion(joint.origin)
    if joint.anchor.any():
        found["anchor"] = _numbers(joint.anchor)
    if joint.kind == "universal":
        found["axes"] = [_numbers(axis) for axis in joint.axes]
    elif joint.kind != "spherical":
        found["axis"] = _numbers(joint.axes[0])
    home = [*joint.home]
    if driven:
        found["driven"] = True
        if np.isfinite(joint.limits).all():
            found["limits"] = _numbers(np.array(joint.limits))
        if joint.zero:
            found["zero"] = joint.zero
        low, high = joint.limits
        home = [value - joint.zero for value in home or [0.0]]
        if not low <= home[0] <= high:  # the file draws it beyond its limits
            home = [(low + high) / 2] if np.isfinite(low + high) else [float(np.clip(0, low, high))]
    if any(home):
        found["home"] = home[0] if len(home) == 1 else home
    return found


def describe_loop(loop: LinkageLoop, driven: bool) -> dict[str, Any]:
    found: dict[str, Any] = {"name": loop.name, "type": loop.kind}
    for key, end in (("a", loop.a), ("b", loop.b)):
        found[key] = {"body": end.body, "point": _numbers(end.frame[:3, 3])}
        if loop.kind == "pose":
            found[key]["quaternion"] = _quaternion(end.frame)
    if loop.length is not None:
        found["length"] = loop.length
    if driven:
        found["driven"] = True
        if np.isfinite(loop.limits).all():
            found["limits"] = _numbers(np.array(loop.limits))
    return found


def _quaternion(frame: Array) -> list[float]:
    return _numbers(matrix_to_quaternion(frame[:3, :3]))


def _numbers(values: Array) -> list[float]:
    """Return plain numbers, with rounding errors of zero as 0."""
    return np.where(np.abs(values) < ROUNDING_ERROR, 0.0, values).tolist()
