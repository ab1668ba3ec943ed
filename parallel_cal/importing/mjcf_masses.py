"""Masses of the bodies of an MJCF: as its `<inertial>` elements state them, or of its geometries.

MuJoCo computes the mass of a body without `<inertial>` from its geometries, with 1000 kg/m^3 where
the file states neither mass nor density.

Source: MuJoCo documentation, XML reference, "body/inertial", "body/geom" and "compiler".
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.importing.linkage import add_mass
from parallel_cal.importing.located_xml import Element, to_numbers
from parallel_cal.importing.mjcf_elements import Document

Array = np.ndarray

DENSITY = 1000.0  # kg/m^3
SIZES = {"sphere": 1, "capsule": 2, "cylinder": 2, "ellipsoid": 3, "box": 3}  # numbers in `size`
WEIGHTLESS = ("plane", "hfield")


def read_masses(document: Document) -> tuple[dict[str, tuple[float, Array]], list[str]]:
    """Return mass (kg) and centre (3,) m of the bodies that have one, and remarks."""
    compiler = {k: v for one in document.root.all("compiler") for k, v in one.attributes.items()}
    choice = compiler.get("inertiafromgeom", "auto")
    low, high = map(float, compiler.get("inertiagrouprange", "0 5").split())
    found, unknown = dict[str, tuple[float, Array]](), list[str]()
    for name, body in document.bodies.items():
        stated = body.element.all("inertial") if choice != "true" else []
        for inertial in stated:
            mass = float(inertial.numbers("mass", 1, "")[0])
            add_mass(found, name, mass, inertial.numbers("pos", 3, "0 0 0"))
        if stated or choice == "false" or not body.parent:
            continue
        used = [one for one in body.geoms if low <= float(one[1].get("group", "0")) <= high]
        masses = [_mass_of_geometry(one, values) for one, values, _ in used]
        if None in masses:
            unknown.append(name)
            continue
        for weight, (one, values, frame) in zip(masses, used, strict=True):
            if weight:
                add_mass(found, name, weight, _centre(one, values, frame))
    total = float(compiler.get("settotalmass", "-1"))
    if total > 0 and (whole := sum(mass for mass, _ in found.values())):
        found = {name: (mass * total / whole, centre) for name, (mass, centre) in found.items()}
    if not unknown:
        return found, []
    return found, [
        f"the masses of {', '.join(unknown)} follow from meshes, which were not read: if the "
        "weight of these links matters, state it in the option masses"
    ]


def _mass_of_geometry(element: Element, values: Mapping[str, str]) -> float | None:
    """Return the mass (kg); None if it follows from a mesh, or its centre does."""
    kind = values.get("type", "mesh" if "mesh" in values else "sphere")
    stated = {key: float(values[key]) for key in ("mass", "density") if key in values}
    if kind in WEIGHTLESS or 0.0 in [*stated.values()][:1]:
        return 0.0
    if kind not in SIZES or "mesh" in values or values.get("shellinertia") == "true":
        return None
    if "mass" in stated:
        return stated["mass"]
    return stated.get("density", DENSITY) * _volume(element, kind, values)


def _volume(element: Element, kind: str, values: Mapping[str, str]) -> float:
    """Return the volume (m^3) of a simple geometry."""
    size = [float(number) for number in values.get("size", "").split()]
    if "fromto" in values and size:  # the length is between both points
        half = float(np.linalg.norm(np.subtract(*_ends(element, values)))) / 2
        size = [*size[:1] * (SIZES[kind] - 1), half]
    if len(size) < SIZES[kind]:
        raise DatasetError(
            f"{element.where}: size is '{values.get('size', '')}', expected {SIZES[kind]} numbers"
        )
    a, b, c = [*size, 0.0, 0.0][:3]
    return {
        "sphere": 4 / 3 * np.pi * a**3,
        "capsule": np.pi * a**2 * (2 * b + 4 / 3 * a),
        "cylinder": 2 * np.pi * a**2 * b,
        "ellipsoid": 4 / 3 * np.pi * a * b * c,
        "box": 8 * a * b * c,
    }[kind]


def _centre(element: Element, values: Mapping[str, str], frame: Array) -> Array:
    """Return the centre (3,) m of a simple geometry in its body; `frame` (4, 4) has its pose, or of
    one that is stated by its ends, that of the `<frame>` around it."""
    at = np.zeros(3) if "fromto" not in values else np.mean(_ends(element, values), axis=0)
    return np.asarray((frame @ [*at, 1.0])[:3])


def _ends(element: Element, values: Mapping[str, str]) -> list[Array]:
    return np.split(to_numbers(element.where, "fromto", values["fromto"], 6), 2)
