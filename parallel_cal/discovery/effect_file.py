"""The effect of a law that was found: an ordinary effect file, readable and editable."""

from __future__ import annotations

import hashlib
import json
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill, indent
from types import ModuleType

import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.files import write_atomically
from parallel_cal.diagnosis.stations import Stations
from parallel_cal.discovery.drivers import INCLINATION, LOAD, MOMENT, STRETCH, TENSION
from parallel_cal.discovery.formula import Formula, Term
from parallel_cal.discovery.places import BASE, DEVICE, JOINT, PARAMETER, PLATFORM, ROD, Place, Site

WIDTH = 96  # characters of a line of the docstring
# family of a driver -> where the function is that computes it, it, its requirement
FORCES = {
    LOAD: ("_statics", "joint_forces", "needs_weight"),
    TENSION: ("_statics", "rod_forces", "needs_rods"),
    STRETCH: ("_lines", "line_stretches", "needs_hanging_lines"),
}
COMPUTED = FORCES | {INCLINATION: ("_legs", "leg_inclinations", "needs_legs")}
RELATIVE_CONSTANT_TOLERANCE = 0.1  # of a scanned constant, if a user frees it
TEMPLATE = '''"""{title}

{equation}

{found}
"""

import casadi as ca

{imports}


class FoundLaw(Effect):
{docstring}

{attributes}
    physics = (
{physics}
    )
    remedy = "find the cause; until then, keep the correction in the model"
    source = (
{source}
    )

    def parameters(self, mechanism):
        return [
{parameters}
        ]

    def applies(self, mechanism):
{applies}

    def ideal(self, seen, e, at, mechanism):
{ideal}
'''


@dataclass(frozen=True)
class Coefficient:
    """A parameter of the effect: its name there, unit, value and sigma in SI; `scanned` if it is a
    constant of a term, which a fit does not identify."""

    name: str
    unit: str
    value: float
    sigma: float | None
    scanned: bool = False


def list_coefficients(formula: Formula) -> list[Coefficient]:
    """List the parameters of a formula as an effect: coefficients by term and member, then the
    constants that a scan found."""
    site = formula.hypothesis.site
    found = []
    for word, term, values, sigmas in zip(
        _term_names(formula), formula.terms, formula.coefficients, formula.sigma, strict=True
    ):
        unit = _unit(formula, term)
        for m, (value, sigma) in enumerate(zip(values, sigmas, strict=True)):
            name = f"{member_name(site.members[m])}_{word}" if site.each else word
            found.append(Coefficient(name, unit, float(value), float(sigma)))
    for (number, _, value), name in _constant_names(formula).items():
        driver = formula.hypothesis.drivers[number][0]
        unit = driver.unit
        if name.startswith("frequency"):  # rad per unit of the driver
            unit = "1" if unit == "rad" else f"rad/{unit}"
        found.append(Coefficient(name, unit, value, None, scanned=True))
    return found


def member_name(place: Place) -> str:
    """A member of a site in the name of a parameter: `joint1`, `chain1`, `x`."""
    if place.kind in (JOINT, ROD):
        return _identifier(place.name)
    if place.kind == PARAMETER:
        return _identifier(place.name.partition(".")[0])
    return place.name.rpartition(".")[2]


def _identifier(name: str) -> str:
    """A name as part of a Python name: a joint may be called `shoulder-pan`."""
    return re.sub(r"\W", "_", name)


def _plain(text: str) -> str:
    """Text that can stand in a Python string of any kind, whatever a file or a joint is called."""
    return text.replace("\\", "/").replace('"', "'").encode("ascii", "replace").decode()


def _term_names(formula: Formula) -> list[str]:
    """One name for each term; a number tells equal ones apart."""
    words = [term.word for term in formula.terms]
    return [
        word if words.count(word) == 1 else f"{word}{words[: k + 1].count(word)}"
        for k, word in enumerate(words)
    ]


def _constant_names(formula: Formula) -> dict[tuple[int, str, float], str]:
    """Names of the scanned constants by driver, kind and value; sine and cosine share one."""
    found: dict[tuple[int, str, float], str] = {}
    for term in formula.terms:
        for number, factor in term.factors:
            for kind, value in zip(factor.constant_names, factor.constants, strict=False):
                if (number, kind, value) not in found:
                    count = 1 + sum(key[1] == kind for key in found)
                    found[number, kind, value] = kind if count == 1 else f"{kind}{count}"
    return found


def _unit(formula: Formula, term: Term) -> str:
    """The unit of a term's coefficient: that of the site over those of the drivers."""
    powers: dict[str, int] = {}
    for number, factor in term.factors:
        unit = formula.hypothesis.drivers[number][0].unit
        if unit != "1" and factor.dimension:
            powers[unit] = powers.get(unit, 0) + factor.dimension
    if not powers:
        return formula.hypothesis.site.unit
    parts = []
    for unit, power in powers.items():
        own = f"({unit})" if " " in unit or "/" in unit else unit
        parts.append(own if power == 1 else f"{own}^{power}")
    below = " ".join(parts)
    return f"{formula.hypothesis.site.unit}/{below if len(parts) == 1 else f'({below})'}"


def write_formula(formula: Formula) -> str:
    """The formula for people: `cubic * load^3`, in the names of the effect's parameters."""
    names = [own[0].name if len(own) == 1 else own[0].family for own in formula.hypothesis.drivers]
    shown = [
        f"({name} - {own[0].zero:g})" if own[0].zero else name
        for name, own in zip(names, formula.hypothesis.drivers, strict=True)
    ]
    return _sum(formula, _term_names(formula), shown, "")


def _sum(formula: Formula, words: Sequence[str], variables: Sequence[str], prefix: str) -> str:
    constants = _constant_names(formula)
    parts = []
    for word, term in zip(words, formula.terms, strict=True):
        factors = []
        for number, factor in term.factors:
            own = [
                ("e." if prefix else "") + constants[number, kind, value]
                for kind, value in zip(factor.constant_names, factor.constants, strict=False)
            ]
            factors.append(factor.write(variables[number], own, prefix))
        parts.append(" * ".join([("e." if prefix else "") + word, *factors]))
    return " + ".join(parts)


def write_effect(
    formula: Formula,
    sentence: str,
    found: str,
    *,
    values: Mapping[str, tuple[float, float | None]] | None = None,
) -> str:
    """The text of an effect file.

    `sentence` says where an error enters and on what it depends, `found` in which data and range it
    was found. `values` are coefficients and sigmas after a refit with the geometry.
    """
    sentence, found = _plain(sentence), _plain(found)
    text = _EffectText(formula, values or {})
    parts: dict[str, Iterable[str]] = {
        "title": [fill(f"{sentence}. Found in data; its cause is not known.", WIDTH)],
        "equation": [text.equation()],
        "found": [fill(found, WIDTH)],
        "imports": [*text.imports(), *text.stations_table()],
        "docstring": [indent(f'"""{fill(sentence + ".", WIDTH - 8)}"""', " " * 4)],
        "attributes": text.attributes(),
        "physics": _string(f"{sentence}; found in data, its cause is not known", 8),
        "source": _string(found, 8),
        "parameters": text.parameters(),
        "applies": text.applies(),
        "ideal": text.ideal(),
    }
    return TEMPLATE.format(**{name: "\n".join(lines) for name, lines in parts.items()})


@dataclass(frozen=True)
class _EffectText:
    """The lines of an effect file that follow from a formula.

    `values` are coefficients and sigmas by name, in place of those of the formula.
    """

    formula: Formula
    values: Mapping[str, tuple[float, float | None]]

    @property
    def site(self) -> Site:
        return self.formula.hypothesis.site

    @property
    def stations(self) -> Stations | None:
        return self.site.members[0].stations

    @property
    def computed(self) -> list[str]:
        """The families of computed drivers that the formula uses."""
        formula = self.formula
        used = {formula.hypothesis.drivers[number][0].family for number in formula.used_drivers}
        return [family for family in COMPUTED if family in used]

    @property
    def weighs(self) -> bool:
        """Whether the masses of the robot are parameters, because it uses forces."""
        return any(family in FORCES for family in self.computed)

    def equation(self) -> str:
        """The equation in words, for the docstring of the file."""
        site = self.site
        words = {JOINT: "q", PLATFORM: "pose", BASE: "pose turned about {B}", DEVICE: "shown pose"}
        name = words.get(site.kind, "length")
        sign = "-" if site.kind in (PLATFORM, BASE, DEVICE) else "+"
        members = ", ".join(place.name for place in site.members)
        law = write_formula(self.formula)
        return fill(_plain(f"ideal {name} = {name} {sign} ({law}), for {members}."), WIDTH)

    def imports(self) -> Iterator[str]:
        """The imports of the package."""
        yield "from parallel_cal import Effect, Parameter"
        if self.site.kind in (PLATFORM, BASE, DEVICE):
            yield "from parallel_cal.base.rotation import cayley"
        if self.stations is not None:
            yield "from parallel_cal.effects._frames import select_station"
        functions = {name: set[str]() for name in ("_legs", "_lines", "_statics")}
        functions["_statics"] |= {"masses"} if self.weighs else set()
        for family in self.computed:
            module, *names = COMPUTED[family]
            functions[module] |= set(names)
        if self.site.kind == ROD:
            functions["_statics"] |= {"lengthen_rods", "needs_rods"}
        for module, own in functions.items():
            if own:
                yield f"from parallel_cal.effects.{module} import {', '.join(sorted(own))}"

    def stations_table(self) -> Iterator[str]:
        """The frames of the device, if it stood elsewhere in each recording."""
        if self.stations is None:
            return
        yield ""
        yield "# recording: rotation and shift (m) from {B} to the frame of the device"
        yield "STATIONS = {"
        for k, (turn, shift) in self.stations.by_recording.items():
            yield f"    {k}: ("
            yield from (f"        {np.round(row, 9).tolist()}," for row in turn)
            yield f"        {np.round(shift, 9).tolist()},"
            yield "    ),"
        yield "}"

    def attributes(self) -> Iterator[str]:
        """What the effect needs, what a fit does not identify, and where it belongs."""
        drivers = self.formula.hypothesis.drivers
        used = [drivers[number][0].needs for number in self.formula.used_drivers]
        needs = [*filter(None, used), *(["session"] if self.stations is not None else [])]
        scanned = [c.name for c in list_coefficients(self.formula) if c.scanned]
        fixed = [*scanned, *(["mass.*"] if self.weighs else [])]
        for name, words in (("needs", dict.fromkeys(needs)), ("fixed", fixed)):
            if words:
                quoted = ", ".join(f'"{word}"' for word in words)
                yield f"    {name} = ({quoted},)"
        yield "    found_in_data = True"
        if self.site.kind == DEVICE:
            yield "    of_device = True"

    def parameters(self) -> Iterator[str]:
        """The parameters: what was found, then name, unit, nominal value and tolerance."""
        for c in list_coefficients(self.formula):
            value, sigma = self.values.get(c.name, (c.value, c.sigma))
            if c.scanned:
                size = abs(value) * RELATIVE_CONSTANT_TOLERANCE
                nominal = repr(float(f"{value:.9g}"))
            else:
                # The usual size is as large as found, so that ten times that is plausible.
                size, nominal = max(abs(value), 2 * (sigma or 0.0), 1e-300), "0.0"
                spread = f" +- {sigma:.2g}" if sigma else ""
                yield f"            # found: {value:.4g}{spread} {c.unit}"
            yield f'            Parameter("{c.name}", "{c.unit}", {nominal}, {size:.3g}),'
        if self.weighs:
            yield "            *masses(mechanism),"

    def applies(self) -> Iterator[str]:
        """The body of `applies`: what the mechanism must have."""
        site = self.site
        joints = [place.name for place in site.members if place.kind == JOINT]
        lengths = [place.name for place in site.members if place.kind == PARAMETER]
        needed = ", ".join(json.dumps(name) for name in (*joints, *lengths))
        if needed:
            known = "{*mechanism.joints, *mechanism.parameters.names}"
            yield f"        missing = {{{needed}}} - {known}"
            yield "        if missing:"
            yield "            return f\"it has no {', '.join(sorted(missing))}\""
        needs = [f"{COMPUTED[family][2]}(mechanism)" for family in self.computed]
        if site.kind == ROD:
            needs = list(dict.fromkeys([*needs, "needs_rods(mechanism)"]))
        yield f"        return {' or '.join(needs) or json.dumps('')}"

    def ideal(self) -> Iterator[str]:
        """The body of `ideal`: the quantities, the error of each member, the corrected input."""
        formula, hypothesis, site = self.formula, self.formula.hypothesis, self.site
        for family in self.computed:
            yield f"        {family} = {COMPUTED[family][1]}(seen, e, at, mechanism)"
        start = {
            JOINT: "q = ca.vertsplit(seen.q)",
            PARAMETER: "changed = {}",
            ROD: "longer = [0.0] * len(mechanism.rod_lengths(seen.p))",
            PLATFORM: "shift, turn = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]",
            DEVICE: "shift, turn = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]",
            BASE: "turn = [0.0, 0.0, 0.0]",
        }
        if any(hypothesis.drivers[k][0].family == MOMENT for k in formula.used_drivers):
            yield "        moment = ca.cross(seen.r, at.payload * ca.DM(mechanism.gravity))"
        yield f"        {start[site.kind]}"
        if self.stations is not None:
            yield "        to_device, origin = select_station(STATIONS, at.session)"
            yield "        shown = to_device @ seen.r + origin"
        known: set[str] = set()
        for m, place in enumerate(site.members):
            variables = []
            for number, own in enumerate(hypothesis.drivers):
                driver = own[m]
                variables.append(f"{_identifier(driver.name)}_value")  # unlike any input's name
                if number in formula.used_drivers and variables[-1] not in known:
                    known.add(variables[-1])
                    less = f" - {driver.zero!r}" if driver.zero else ""
                    yield f"        {variables[-1]} = {driver.code}{less}"
            words = _term_names(formula)
            if site.each:
                words = [f"{member_name(place)}_{word}" for word in words]
            error = _sum(formula, words, variables, "ca.")
            yield from _assign(place, error)
        end = {
            JOINT: "return seen.with_q(ca.vertcat(*q))",
            PARAMETER: "return seen.with_p(changed)",
            ROD: "return lengthen_rods(seen, mechanism, ca.vertcat(*longer))",
            PLATFORM: "return seen.with_pose(seen.r - ca.vertcat(*shift), "
            "cayley(ca.vertcat(*turn)).T @ seen.R)",
            BASE: "back = cayley(ca.vertcat(*turn)).T\n"
            "        return seen.with_pose(back @ seen.r, back @ seen.R)",
        }
        if self.stations is not None:  # from the axes of the device to those of {B}
            end[DEVICE] = (
                "return seen.with_pose(seen.r - to_device.T @ ca.vertcat(*shift), "
                "\n            cayley(to_device.T @ ca.vertcat(*turn)).T @ seen.R)"
            )
        yield f"        {end[PLATFORM if site.kind == DEVICE and DEVICE not in end else site.kind]}"


def _string(text: str, spaces: int) -> Iterator[str]:
    """A long string as lines of Python, joined by the parser."""
    words = fill(text, WIDTH - spaces - 2).splitlines()
    for k, line in enumerate(words):
        space = " " if k < len(words) - 1 else ""
        yield f'{" " * spaces}"{line}{space}"'


def _assign(place: Place, error: str) -> Iterator[str]:
    target = {
        JOINT: f"q[{place.index}] += ",
        PARAMETER: f"changed[{json.dumps(place.name)}] = seen.p[{json.dumps(place.name)}] + ",
        ROD: f"longer[{place.index}] = ",
    }.get(place.kind)
    if target is None:
        part, index = ("shift", place.index) if place.index < 3 else ("turn", place.index - 3)
        target = f"{part}[{index}] = "
    whole = f"        {target}{error}"
    if len(whole) <= WIDTH:
        yield whole
        return
    yield f"        {target}("
    yield indent(error.replace(" + ", "\n+ "), " " * 12)
    yield "        )"


def load_text(text: str) -> str:
    """Make the text of an effect file loadable in this process, without a file; return its name.

    The name follows from the text, because equations are kept by the names of their effects.
    """
    name = f"parallel_cal.discovery.law_{hashlib.sha256(text.encode()).hexdigest()[:12]}"
    if name not in sys.modules:
        module = ModuleType(name)
        try:
            exec(compile(text, f"{name}.py", "exec"), module.__dict__)
        except Exception as error:
            raise ModelError(f"the effect of a law is no valid Python: {error}") from error
        sys.modules[name] = module
    return name


def check_effect_path(path: str | Path) -> Path:
    """Return the path of an effect file; ModelError for a name that cannot be imported."""
    path = Path(path)
    if path.suffix != ".py" or not path.stem.isidentifier():
        raise ModelError(
            f"{path}: an effect is loaded by the name of its file; expected a name such as "
            "my_effect.py"
        )
    return path


def write_effect_file(path: str | Path, text: str) -> None:
    """Write an effect file; ModelError for a name that cannot be imported."""
    write_atomically(check_effect_path(path), text)
