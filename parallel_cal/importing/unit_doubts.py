"""Lengths that contradict the size of the machine by the ratio of two units."""

from __future__ import annotations

from parallel_cal.base.units import LENGTHS, MM

UNITS = {"in": "inches", "m": "m"}  # that owners write in the place of mm
# What is used of a machine: less is no session, more is out of reach. 1 / 25.4 is below it.
USED = (0.2, 1.05)


def doubt_unit(
    share: float, what: str, machine: str, used: tuple[float, float] = USED
) -> list[str]:
    """Name the unit with which lengths fit their machine, if they do not with mm.

    Parameters
    ----------
    share : float
        The largest length over the largest that the machine can have.
    what : str
        The lengths, a plural such as `x and y of the touches`.
    machine : str
        What they are compared with, a plural.
    used : tuple of float
        The least and the largest usual share.

    Returns
    -------
    list of str
        One sentence; empty if the lengths fit, or with no unit.

    Examples
    --------
    >>> doubt_unit(0.035, "the places", "the sizes of the sheet")
    ['the places are 3.5 % of the sizes of the sheet: they fit if they are in inches, not mm']
    >>> doubt_unit(0.8, "the places", "the sizes of the sheet")
    []
    """
    for unit, word in UNITS.items():
        ratio = LENGTHS[unit] / MM
        for factor, wrong in ((ratio, "they"), (1 / ratio, machine)):
            if used[0] <= share * factor <= used[1]:
                size = f"{100 * share:.2g} % of" if share < 1 else f"{share:.3g} times"
                fits = f"they fit if {wrong} are in {word}, not mm"
                return [f"{what} are {size} {machine}: {fits}"]
    return []
