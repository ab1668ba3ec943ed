"""Checks of the values and names in a model file; each raises ModelFileError."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from parallel_cal.base.units import si_factor
from parallel_cal.model.file.schema import CovariancePart, DrivePart, JointPart, suggestion
from parallel_cal.model.file.yamltext import Document, Path
from parallel_cal.model.model import Model
from parallel_cal.model.parameters import MAX_TOLERANCES, Parameter, ParameterTable

# Units in which people paste values: one of them may explain an implausible value.
FOREIGN = {
    "m": ("mm", "um", "inch"),
    "rad": ("degrees", "mrad", "arcmin"),
}
CLEARLY_NEARER = 2.0  # an inexact home is so many times nearer to one solution than to the other
MAX_LIMIT_RAD = 50.0  # eight turns; larger limits are probably in degrees


def names(document: Document, path: Path, found: Iterable[str], expected: Iterable[str]) -> None:
    """Check that the file has every expected parameter and no other."""
    known = list(expected)
    for name in found:
        if name not in known:
            raise document.error((*path, name), f"unknown parameter{suggestion(name, known)}")
    missing = [name for name in known if name not in set(found)]
    if missing:
        raise document.error(path, f"parameters missing: {', '.join(missing)}")


def unit(document: Document, path: Path, parameter: Parameter, found: str) -> None:
    """Check a parameter's unit: files contain SI units only."""
    if found != parameter.unit:
        raise document.error(
            (*path, "unit"),
            f"found '{found}', expected '{parameter.unit}' (files contain SI units)",
        )


def length(document: Document, path: Path, values: Sequence[object], n: int, what: str) -> None:
    """Check the length of a list."""
    if len(values) != n:
        raise document.error(path, f"found {len(values)} values, expected {n}, {what}")


def joint(document: Document, name: str, expected: str, part: JointPart) -> None:
    """Check a joint's name, unit and limits."""
    path: Path = ("joints", name)
    if not name or any(c.isspace() or c == "." for c in name):
        raise document.error(path, f"the name {name!r} must not contain spaces or dots")
    if part.unit != expected:
        raise document.error((*path, "unit"), f"found '{part.unit}', expected '{expected}'")
    limits = [v for v in (part.low, part.high) if v is not None]
    if len(limits) == 2 and limits[0] >= limits[1]:
        raise document.error((*path, "low"), f"{limits[0]} is not below high, {limits[1]}")
    if expected == "rad" and any(abs(v) > MAX_LIMIT_RAD for v in limits):
        raise document.error(path, f"limits {limits} rad: are these degrees?")
    if part.drive is not None:
        drive((*path, "drive"), document, expected, part.drive)


def drive(path: Path, document: Document, unit: str, part: DrivePart) -> None:
    """Check that a drive moves a length, and that its travel is stated once."""
    if unit != "m":
        raise document.error(
            path,
            f"the readings of this joint are angles ({unit}), expected a joint in m: remove the "
            "drive, or state the gear ratio as gearing",
        )
    if (part.per_rev is None) == (part.radius is None):
        found = "neither" if part.radius is None else "both"
        raise document.error(
            path, f"found {found} per_rev and radius, expected one of them (m per turn, or m)"
        )
    if part.per_rev == 0:
        raise document.error((*path, "per_rev"), "found 0, expected the travel per turn in m")
    if part.kind == "screw" and part.radius is not None:
        raise document.error((*path, "radius"), "a screw has none; state per_rev, its lead in m")


def box(document: Document, path: Path, low: Sequence[float], high: Sequence[float]) -> None:
    """Check that no low side of a box is above the high one."""
    for i, (a, b) in enumerate(zip(low, high, strict=True)):
        if a > b:
            raise document.error((*path, "low", i), f"{a} is above high, {b}")


def gravity(document: Document, found: Sequence[float]) -> None:
    """Check that gravity is in m/s^2, not in mm/s^2 or a unit vector; zero is weightless."""
    size = math.hypot(*found)
    if size and not 1.5 < size < 25.0:  # m/s^2: from the Moon to Jupiter
        text = f"{[*found]} has the length {size:.6g} m/s^2, expected about 9.81 (zero: weightless)"
        raise document.error(("gravity",), text)


def number(
    document: Document, path: Path, parameter: Parameter, value: float, sigma: float | None
) -> None:
    """Check that a value is plausible: within ten tolerances of nominal and its physical bounds,
    or less than three of its own sigmas beyond."""
    low, high = parameter.plausible_range(sigma or 0.0)
    if low <= value <= high:
        return
    low, high = parameter.plausible_range()
    expected = f"expected {low:.6g} to {high:.6g} {parameter.unit}"
    why = "is physically impossible"
    if parameter.low <= value <= parameter.high:
        away = abs(value - parameter.nominal) / parameter.tolerance
        why = (
            f"is {away:.3g} tolerances from its nominal {parameter.nominal:g} "
            f"(1 tolerance = {parameter.tolerance:g} {parameter.unit})"
        )
    guesses = (
        f"; is it in {name}? That would be {value * factor:.6g} {parameter.unit}"
        for name in FOREIGN.get(parameter.unit, ())
        if low <= value * (factor := si_factor(name)) <= high
    )
    text = f"{value!r} {parameter.unit} {why}; {expected}{next(guesses, '')}"
    raise document.error((*path, "value"), text)


def home(document: Document, model: Model) -> None:
    """Check that home selects one of two poses to which its joints lead with the nominal mechanism.

    Home need not be exact: errors of ten tolerances of the parameters are usual. If it is further
    from a solution, it must be clearly nearer to one of the two.
    """
    s, m = model.structure.ideal, model.mechanism
    p, at = m.parameters, m.home
    neutral = np.empty((1, 0))
    phi = s.closure_batch(at.configuration[None], neutral, p.nominal)[0][0]
    by_parameters = s.jacobians(at.configuration[None], neutral, p.nominal)[1][0]
    usual = np.linalg.norm(by_parameters * p.tolerance, axis=1)
    poses = np.array(s.candidates(at.joints, p.nominal)).T[:, :3]
    if len(poses) != 2 or (np.abs(phi) <= MAX_TOLERANCES * usual + 0.01 * m.length).all():
        return
    near, far = np.sort(np.linalg.norm(poses - at.position, axis=1))
    if CLEARLY_NEARER * near < far:
        return
    leads = "to no position: correct joints and position"
    if np.isfinite(near):
        one, other = (str((pose.round(6) + 0.0).tolist()) for pose in poses)
        leads = f"to {one} or {other} m: state that of them at which the robot works"
    raise document.error(
        ("home",),
        f"with the parameters of this file, the joints do not lead to the position "
        f"{[*at.position]} m, but {leads}, or write a new file (parallel-cal new {m.name} "
        "--option ...)",
    )


class Hint:
    """Describe the expected value at a parameter's key, for errors in the file's structure."""

    def __init__(self, document: Document, table: ParameterTable):
        self._document, self._table = document, table

    def __call__(self, path: Path) -> str:
        name = ""
        if len(path) == 3 and path[0] == "parameters":
            name = str(path[1])
        elif len(path) == 5 and path[0] in ("effects", "sensors") and path[2] == "parameters":
            name = f"{self._document.data[path[0]][path[1]].get('name')}.{path[3]}"
        if name not in self._table.names:
            return ""
        parameter = self._table[name]
        low, high = parameter.plausible_range()
        texts = {
            "value": f"; expected {low:.6g} to {high:.6g} {parameter.unit}",
            "unit": f"; expected '{parameter.unit}'",
        }
        for key in ("nominal", "tolerance", "sigma"):
            texts[key] = f" (in {parameter.unit})"
        return texts.get(str(path[-1]), "")


def covariance(
    document: Document,
    part: CovariancePart | None,
    table: ParameterTable,
    sigmas: Sequence[float | None],
) -> np.ndarray | None:
    """Build the covariance (n, n) from the lower triangle or from sigmas; None without both."""
    if part is None:
        if all(sigma is None for sigma in sigmas):
            return None
        return np.diag([(sigma or 0.0) ** 2 for sigma in sigmas])
    full = _triangle(document, part, table)
    variance = np.diag(full)
    if (variance < 0).any() or (full**2 > np.outer(variance, variance) * (1 + 1e-6)).any():
        raise document.error(("covariance", "lower"), "not a covariance: a correlation is above 1")
    for parameter, sigma, own in zip(table, sigmas, np.sqrt(variance), strict=True):
        if sigma is not None and not math.isclose(sigma, own, rel_tol=1e-6):
            raise document.error(
                ("covariance",),
                f"sigma of {parameter.name} is {sigma}, but the covariance gives "
                f"{own:.6g} {parameter.unit}; change both, or delete 'covariance'",
            )
    return full


def _triangle(document: Document, part: CovariancePart, table: ParameterTable) -> np.ndarray:
    """The full matrix of a lower triangle; zero for parameters that it does not contain."""
    path: Path = ("covariance", "lower")
    unknown = [name for name in part.names if name not in table.names]
    if unknown or len(set(part.names)) != len(part.names):
        found = f"unknown: {', '.join(unknown)}" if unknown else "a name occurs twice"
        raise document.error(("covariance", "names"), found)
    length(document, path, part.lower, len(part.names), "one row for each name")
    index = [table.index_of(name) for name in part.names]
    full = np.zeros((len(table), len(table)))
    for i, row in enumerate(part.lower):
        length(document, (*path, i), row, i + 1, "the lower triangle with its diagonal")
        full[index[i], index[: i + 1]] = full[index[: i + 1], index[i]] = row
    return full
