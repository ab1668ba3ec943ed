"""The elements of an MJCF file with the values that its defaults and its compiler settings give.

Source: MuJoCo documentation, "XML Reference".
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.base.rotation import quaternion_to_matrix, rotation_matrix
from parallel_cal.base.units import DEGREE
from parallel_cal.importing.located_xml import Element, read_xml, to_numbers

Array = np.ndarray

MAIN = "main"
ORIENTATIONS = ("quat", "axisangle", "euler", "xyaxes", "zaxis")
NEEDS_PACKAGE = ("replicate", "attach", "composite", "flexcomp")  # what only MuJoCo expands


class NeedsMuJoCo(DatasetError):
    """An element that only MuJoCo expands."""


@dataclass
class Settings:
    """The `<compiler>` of a file, and its default classes."""

    degrees: bool = True
    sequence: str = "xyz"
    autolimits: bool = True
    classes: dict[str, dict[str, dict[str, str]]] = field(default_factory=dict)

    @property
    def angle(self) -> float:
        """rad per unit of angle in the file."""
        return DEGREE if self.degrees else 1.0


@dataclass(frozen=True)
class Body:
    """A body with its pose in its parent, its joints, sites and geometries, in the file's order.

    They have the frame (4, 4) in the body of the `<frame>` in which they stand; that of a site or a
    geometry includes its own pose.
    """

    name: str
    parent: str
    pose: Array
    element: Element
    joints: tuple[tuple[Element, dict[str, str], Array], ...] = ()
    sites: tuple[tuple[Element, dict[str, str], Array], ...] = ()
    geoms: tuple[tuple[Element, dict[str, str], Array], ...] = ()
    floats: bool = False


@dataclass
class Document:
    """The elements of a file and of those that it includes."""

    path: Path
    root: Element
    settings: Settings
    bodies: dict[str, Body] = field(default_factory=dict)

    def section(self, tag: str) -> list[Element]:
        """Return the elements of all sections of a kind, such as `equality`."""
        return [one for part in self.root.all(tag) for one in part.children]

    def with_defaults(self, element: Element, kind: str, inherited: str = MAIN) -> dict[str, str]:
        """Return the attributes of an element, completed by its class."""
        name = element.get("class") or inherited
        if name not in self.settings.classes:
            raise DatasetError(
                f"{element.where}: class '{name}' is not in <default>, expected one of "
                f"{', '.join(sorted(self.settings.classes))}"
            )
        return self.settings.classes[name].get(kind, {}) | element.attributes


def read_document(path: Path) -> Document:
    """Read a file and those that it includes; DatasetError names what is not understood."""
    root = read_xml(path, "MJCF")
    if root.tag != "mujoco":
        raise DatasetError(f"{path}: not an MJCF: expected <mujoco>, found <{root.tag}>")
    include_files(root, {path.resolve()})
    found = Document(path, root, read_settings(root))
    for world in root.all("worldbody"):
        add_bodies(found, world, "world", np.eye(4), MAIN)
    return found


def include_files(element: Element, open_files: set[Path]) -> None:
    """Replace every `<include>` below an element by the content of its file."""
    children = list[Element]()
    for child in element.children:
        if child.tag != "include":
            include_files(child, open_files)
            children.append(child)
            continue
        path = child.path.parent / child.required("file")
        if path.resolve() in open_files:
            raise DatasetError(f"{child.where}: {path} includes itself")
        part = read_xml(path, "MJCF")
        include_files(part, {*open_files, path.resolve()})
        for one in part.children:
            one.parent = element
        children += part.children
    element.children = children


def read_settings(root: Element) -> Settings:
    settings = Settings()
    for one in root.all("compiler"):
        settings.degrees = one.get("angle", "degree" if settings.degrees else "radian") == "degree"
        settings.sequence = one.get("eulerseq", settings.sequence)
        settings.autolimits = one.get("autolimits", "true") != "false"
        if one.get("coordinate", "local") != "local":
            raise DatasetError(f"{one.where}: coordinate is 'global', expected local coordinates")
    if len(settings.sequence) != 3 or not set(settings.sequence.lower()) <= set("xyz"):
        raise DatasetError(f"{root.path}: eulerseq is '{settings.sequence}', expected such as xyz")
    settings.classes[MAIN] = {}
    for top in root.all("default"):
        add_class(settings, top, top.get("class", MAIN), settings.classes[MAIN])
    return settings


def add_class(
    settings: Settings, element: Element, name: str, above: dict[str, dict[str, str]]
) -> None:
    own = {kind: dict(values) for kind, values in above.items()}
    for one in element.children:
        if one.tag != "default":
            own[one.tag] = own.get(one.tag, {}) | one.attributes
    settings.classes[name] = own
    for one in element.all("default"):
        add_class(settings, one, one.required("class"), own)


def add_bodies(found: Document, element: Element, name: str, pose: Array, style: str) -> None:
    """Add what a body, or a `<frame>` in it, contains."""
    parts = list[tuple[Element, Array, str]]()
    joints = list[tuple[Element, dict[str, str], Array]]()
    sites = list[tuple[Element, dict[str, str], Array]]()
    geoms = list[tuple[Element, dict[str, str], Array]]()
    floats = False

    def collect(part: Element, at: Array, style: str) -> None:
        nonlocal floats
        for one in part.children:
            if one.tag == "frame":
                inner = at @ read_pose(one, one.attributes, found.settings)
                collect(one, inner, one.get("childclass") or style)
            elif one.tag == "body":
                parts.append((one, at, style))
            elif one.tag == "freejoint" or (one.tag == "joint" and one.get("type") == "free"):
                floats = True
            elif one.tag == "joint":
                joints.append((one, found.with_defaults(one, "joint", style), at))
            elif one.tag in ("site", "geom"):
                values = found.with_defaults(one, one.tag, style)
                own = (one, values, at @ read_pose(one, values, found.settings))
                (sites if one.tag == "site" else geoms).append(own)
            elif one.tag in NEEDS_PACKAGE:
                raise NeedsMuJoCo(
                    f"{one.where}: <{one.tag}> is expanded by MuJoCo only: install it "
                    "(pip install 'parallel_cal[mjcf]')"
                )

    collect(element, np.eye(4), style)
    if element.tag == "body":
        body = found.bodies[name]
        found.bodies[name] = replace(
            body, joints=tuple(joints), sites=tuple(sites), geoms=tuple(geoms), floats=floats
        )
    else:
        found.bodies.setdefault(name, Body(name, "", np.eye(4), element))
        body = found.bodies[name]
        found.bodies[name] = replace(body, sites=(*body.sites, *sites))
    for one, at, its_style in parts:
        its_name = one.get("name") or f"body{len(found.bodies)}"
        if its_name in found.bodies:
            raise DatasetError(f"{one.where}: another body has this name")
        inner = at @ read_pose(one, one.attributes, found.settings)
        found.bodies[its_name] = Body(its_name, name, inner, one)
        add_bodies(found, one, its_name, inner, one.get("childclass") or its_style)


def read_pose(element: Element, values: dict[str, str], settings: Settings) -> Array:
    """Return the frame (4, 4) of `pos` and one of quat, axisangle, euler, xyaxes and zaxis."""
    T = np.eye(4)
    T[:3, 3] = _numbers(element, values, "pos", 3, "0 0 0")
    stated = [key for key in ORIENTATIONS if key in values]
    if not stated:
        return T
    key, angle = stated[0], settings.angle
    if key == "quat":
        w, x, y, z = _numbers(element, values, key, 4)
        T[:3, :3] = quaternion_to_matrix([x, y, z, w])
    elif key == "axisangle":
        *axis, turn = _numbers(element, values, key, 4)
        T[:3, :3] = rotation_matrix(np.array(axis) / np.linalg.norm(axis) * turn * angle)
    elif key == "euler":
        turns = _numbers(element, values, key, 3) * angle
        for letter, turn in zip(settings.sequence, turns, strict=True):
            step = rotation_matrix(np.eye(3)["xyz".index(letter.lower())] * turn)
            # Lower case turns about the axes of the moving frame, upper case about fixed ones.
            T[:3, :3] = T[:3, :3] @ step if letter.islower() else step @ T[:3, :3]
    elif key == "xyaxes":
        x, y = np.split(_numbers(element, values, key, 6), 2)
        x = x / np.linalg.norm(x)
        y = y - x * (x @ y)
        y = y / np.linalg.norm(y)
        T[:3, :3] = np.column_stack([x, y, np.cross(x, y)])
    else:
        T[:3, :3] = rotation_from_z(_numbers(element, values, key, 3))
    return T


def rotation_from_z(direction: Array) -> Array:
    """Return the smallest rotation that brings z to a direction."""
    z = direction / np.linalg.norm(direction)
    normal = np.array([-z[1], z[0], 0.0])
    sine = float(np.linalg.norm(normal))
    if sine < 1e-10:
        normal, sine = np.array([1.0, 0.0, 0.0]), 0.0
    else:
        normal = normal / sine
    return rotation_matrix(normal * np.arctan2(sine, z[2]))


def _numbers(
    element: Element, values: dict[str, str], key: str, n: int, default: str = ""
) -> Array:
    return to_numbers(element.where, key, values.get(key, default), n)
