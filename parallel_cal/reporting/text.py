"""Show a result as text or as HTML."""

from __future__ import annotations

from typing import Any

from parallel_cal.reporting.blocks import Block, as_text
from parallel_cal.reporting.markup import as_html
from parallel_cal.reporting.results import describe
from parallel_cal.reporting.summary import summarize, summary_table


def show(result: Any, html: bool = False, details: bool = False) -> str:
    """Format a result as the command line prints it, or as a notebook shows it.

    Parameters
    ----------
    result : FitResult, Step, Comparison, Diagnosis or Discovery
    html : bool, optional
        Make HTML with tables, and with all details, instead of text.
    details : bool, optional
        Add to a text what the options --parameters and --details of the commands add.

    Returns
    -------
    str

    Raises
    ------
    ParallelCalError
        For anything else.

    Examples
    --------
    >>> import parallel_cal as pc
    >>> model = pc.read_model("config/delta_mockup_nominal.yaml")
    >>> data = pc.load_dataset("bags/delta_backlash", joints=model.joints)
    >>> print(pc.show(pc.compare(model, data)).splitlines()[0])
    94 samples: error 606 um, 25 arcmin; noise floor 30 um, 0.433 arcmin
    """
    if html:
        lines = summarize(result)
        return as_html([*describe(result), *(f"{line.label} {line.text}" for line in lines)])
    return as_text(list_blocks(result), ("details", "parameters") if details else ())


def list_blocks(result: Any) -> list[Block]:
    """List the blocks of a result, and at last the table of its last lines."""
    lines = summarize(result)
    return [*describe(result), *([summary_table(lines)] if lines else [])]
