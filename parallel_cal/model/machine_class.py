"""The class of a machine: how large its usual errors are, compared with those of the catalogue."""

from __future__ import annotations

from typing import Literal, get_args

from parallel_cal.base.errors import ModelError
from parallel_cal.model.effect import Effect
from parallel_cal.model.parameters import ParameterTable

MachineClass = Literal["precision", "industrial", "hobby"]
MACHINE_CLASSES: tuple[str, ...] = get_args(MachineClass)
DEFAULT_CLASS: MachineClass = "industrial"

# The usual errors of a class, as a multiple of the catalogue's, which are those of industrial
# machines. The grades of machine elements are about a factor of five apart. Backlash of gears:
# 0.06 mrad (zero-backlash gears), 0.3 mrad (catalogue), 1.5 mrad (belts, plastic gears). Pitch
# error of screws on 300 mm: 8 um (C3, ground), 50 um (C7, rolled), 0.3 mm (threaded rod).
USUAL_SIZE_FACTORS: dict[str, float] = {"precision": 0.2, "industrial": 1.0, "hobby": 5.0}


def check_class(name: str) -> MachineClass:
    """Return a class of machines; ModelError if it is unknown."""
    for known in get_args(MachineClass):
        if name == known:
            return known  # type: ignore[no-any-return]
    raise ModelError(f"class '{name}': expected one of {', '.join(MACHINE_CLASSES)}")


def scale_usual_sizes(
    effect: Effect, table: ParameterTable, machine_class: str, at_least: float = 0.0
) -> ParameterTable:
    """Return an effect's table with the usual sizes of a class of machines.

    Known constants, properties of materials, and errors of the measuring device do not depend on
    the class: a certificate states how far a device errs. The factor is `at_least` so large.
    """
    factor = max(USUAL_SIZE_FACTORS[machine_class], at_least)
    if factor == 1.0 or effect.of_device or not effect.depends_on_class:
        return table
    patterns = effect.fixed_patterns()
    known = table.matching(patterns) if patterns else [False] * len(table)
    return ParameterTable(
        p if constant else p.with_tolerance(factor * p.tolerance)
        for p, constant in zip(table, known, strict=True)
    )
