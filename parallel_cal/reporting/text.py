"""Show a result as text or as HTML."""

from __future__ import annotations

from typing import Any

from parallel_cal.reporting.blocks import as_text
from parallel_cal.reporting.markup import as_html
from parallel_cal.reporting.results import describe


def show(result: Any, html: bool = False) -> str:
    """Format a result as the command line prints it, or as a notebook shows it.

    Parameters
    ----------
    result : FitResult, Step, Comparison, Diagnosis or Discovery
    html : bool, optional
        Make HTML with tables instead of text.

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
    94 samples
    """
    blocks = describe(result)
    return as_html(blocks) if html else as_text(blocks)
