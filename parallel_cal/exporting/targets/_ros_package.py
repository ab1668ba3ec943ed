"""A ROS 2 package around the exported C++ header: a plug-in, its description, and a self-test."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files as resources

import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.exporting.targets import c, cpp
from parallel_cal.kinematics.kinematics import Kinematics, Status
from parallel_cal.kinematics.solutions import Solutions
from parallel_cal.kinematics.solving import controlled_pose
from parallel_cal.mechanisms.serial import Serial
from parallel_cal.model.mechanism import poses_in_workspace
from parallel_cal.model.model import Model

MAX_CONFIGURATIONS = 10_000  # of the self-test; each takes up to 2 kB of the file
COORDINATES = ("x", "y", "z", "rx", "ry", "rz")
FAR = np.array([10.0, 0.0, 10.0])  # by which a pose is moved out of reach, in lengths of the robot
LOOP_NOTE = """\
MoveIt computes the positions of links from a tree of joints, and a parallel robot has loops. For
MoveIt, the position of the tip therefore follows from the passive joints of the robot description,
which a plan for the driven joints does not move. Use this plug-in to find joint goals (service
`compute_ik`, or `RobotState::setFromIK`), and plan to these. A goal constraint on the tip, a
Cartesian path, and collision checks of rods and platform use MoveIt's tree: they are right only
where its passive joints are.
"""
LINK = r"[A-Za-z]\w*"  # a name that needs no quotes in C++, XML, YAML and ROS


@dataclass(frozen=True)
class Plugin:
    """What differs between the plug-ins.

    Attributes
    ----------
    kind : str
        The end of the package's name, and the beginning of the names of its templates.
    base_package, base_class : str
        The package in whose index the plug-in is registered, and the class that it implements.
    description : str
        What the package is, with the name of the robot as {}.
    depends : sequence of str
        The packages whose headers it includes.
    libraries : sequence of str
        The CMake targets that it links to.
    headers : sequence of str
        Templates of further headers.
    """

    kind: str
    base_package: str
    base_class: str
    description: str
    depends: Sequence[str]
    libraries: Sequence[str]
    headers: Sequence[str] = ()


def package(
    model: Model, plugin: Plugin, name: str, poses: int, links: tuple[str, str], **own: str
) -> dict[str, str]:
    """Return the files of a package; `links` are the names of {B} and {P}, empty for the model's.

    `own` are further words of its templates.
    """
    if passive := model.mechanism.passive:
        raise ModelError(
            f"{model.mechanism.name} has passive coordinates ({', '.join(passive)}), which the "
            f"package of {plugin.base_package} does not solve: export it with --to c"
        )
    if not 1 <= poses <= MAX_CONFIGURATIONS:
        raise ModelError(f"poses={poses}: expected 1 to {MAX_CONFIGURATIONS}")
    given = zip(
        ("base", "tip"), links, (model.frames["base"], model.frames["platform"]), strict=True
    )
    base, tip = (_check_link(option, link or frame) for option, link, frame in given)
    if base == tip:
        raise ModelError(f"base={base}, tip={tip}: expected two links")
    made = cpp.files(model, name, poses=2)
    robot = next(file for file in made if file.endswith(".hpp")).removesuffix(".hpp")
    found = neutral_solutions(model, poses)
    words = (
        c.template_words(model, robot)
        | _package_words(model, plugin, robot)
        | {"base": base, "tip": tip, "poses": str(len(found.joints))}
        | own
    )
    include = f"include/{words['package']}"
    templates = {
        "package.xml": "manifest.xml",
        "CMakeLists.txt": "package.cmake",
        "plugin.xml": "plugin.xml",
        "README.md": f"README_{plugin.kind}.md",
        "src/plugin.cpp": f"{plugin.kind}_plugin.cpp",
        "test/self_test.cpp": f"{plugin.kind}_self_test.cpp",
        "test/configurations.hpp": "configurations.hpp",
        **{f"{include}/{robot}_{header}": header for header in plugin.headers},
    }
    folder = resources(__package__).joinpath("_ros")
    written = {
        file: c.fill_template(folder.joinpath(template).read_text(encoding="utf-8"), words)
        for file, template in templates.items()
    }
    # Joints, position, rotation, Jacobian and its inverse, row by row
    parts = [found.joints, found.position, found.rotation, *jacobians(model, found)]
    rows = np.hstack([np.reshape(part, (len(found.joints), -1)) for part in parts])
    names = [*model.joints, *"xyz", *(f"R{i}{j}" for i in "123" for j in "123")]
    names += [f"d_{c}_d_{joint}" for c in COORDINATES for joint in model.joints]
    names += [f"d_{joint}_d_{c}" for joint in model.joints for c in COORDINATES]
    table = [",".join(names), *(",".join(map(repr, row)) for row in rows.tolist())]
    return written | {
        f"{include}/{robot}.hpp": made[f"{robot}.hpp"],
        "test/configurations.csv": "\n".join([*table, ""]),
    }


def _check_link(option: str, link: str) -> str:
    if re.fullmatch(LINK, link):
        return link
    raise ModelError(
        f"{option}={link}: expected the name of a link of letters, digits and underscores"
    )


def _package_words(model: Model, plugin: Plugin, robot: str) -> dict[str, str]:
    name = f"{robot.lower()}_{plugin.kind}"
    depends = list(plugin.depends)
    indented = "\n  ".join(plugin.libraries)
    return {
        "package": name,
        "base_package": plugin.base_package,
        "base_class": plugin.base_class,
        "description": plugin.description.format(model.mechanism.name),
        "depends": "\n".join(f"  <depend>{depend}</depend>" for depend in depends),
        "find_packages": "\n".join(f"find_package({depend} REQUIRED)" for depend in depends),
        "libraries": f"\n  {indented}",
        "dependencies": " ".join(depends),
        "controlled_note": _describe_controlled(model),
        "loop_note": "" if isinstance(model.mechanism, Serial) else LOOP_NOTE,
    }


def _describe_controlled(model: Model) -> str:
    """Say what the solutions mean in the coordinates that a robot does not control."""
    controls = model.mechanism.controls
    free = [name for name in COORDINATES if name not in controls]
    if not free:
        return ""
    return (
        f"The robot controls {' '.join(controls)}. The other coordinates of the pose "
        f"({' '.join(free)}) follow from these: forward kinematics returns them, and inverse "
        "kinematics cannot set them. Their columns in the inverse Jacobian are zero.\n"
    )


def neutral_solutions(model: Model, poses: int) -> Solutions:
    """Return up to `poses` configurations in the workspace, solved by Python under neutral
    conditions; ModelError if there is none."""
    kinematics = Kinematics(model)
    r, R = poses_in_workspace(model.mechanism, 2 * poses, np.random.default_rng(0))
    inverse = kinematics.inverse(*controlled_pose(model, r, R))
    q = inverse.joints[inverse.status == Status.CONVERGED]
    found = kinematics.direct(q) if len(q) else inverse
    if not (converged := np.flatnonzero(found.status == Status.CONVERGED)).size:
        raise ModelError(
            f"no pose in the workspace of {model.mechanism.name} has a solution: expected a "
            "workspace that the robot reaches within its joint limits"
        )
    return found[converged[:poses]]


def is_out_of_reach(model: Model, found: Solutions) -> bool:
    """Return whether the first solution's pose, moved far away, has no solution."""
    if not {"x", "z"} <= set(model.mechanism.controls):
        return True
    position = found.position[:1] + FAR * model.mechanism.length
    far = controlled_pose(model, position, found.rotation[:1])
    return bool((Kinematics(model).inverse(*far).status != Status.CONVERGED).all())


def jacobians(model: Model, found: Solutions) -> tuple[np.ndarray, np.ndarray]:
    """Return d pose / d joints (N, 6, nq) and d joints / d pose (N, nq, 6) along the closure."""
    s, m, n = model.structure, model.mechanism, len(model.joints)
    x = np.atleast_2d(found.configuration.rows)
    C = s.jacobians(x, model.condition_rows(None, len(x)), model.values)[0] / s.scale
    moved, given = [n + i for i in m.moved], [n + i for i in m.controlled]
    unknown = [*range(n), *(n + i for i in m.parasitic)]
    forward, inverse = np.zeros((len(x), 6, n)), np.zeros((len(x), n, 6))
    scale = np.asarray(s.scale, dtype=float).ravel()
    slopes = -np.linalg.pinv(C[:, :, moved]) @ C[:, :, :n]
    forward[:, m.moved] = slopes * scale[:n] / scale[moved][:, None]
    slopes = (-np.linalg.pinv(C[:, :, unknown]) @ C[:, :, given])[:, :n]
    inverse[:, :, m.controlled] = slopes * scale[given] / scale[:n][:, None]
    return forward, inverse
