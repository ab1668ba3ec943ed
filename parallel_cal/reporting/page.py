"""One HTML file that contains text, figures, Plotly and style, and loads nothing else."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from datetime import datetime, timezone
from html import escape
from importlib.resources import files
from pathlib import PurePath
from string import Template
from typing import Any

from parallel_cal import __version__
from parallel_cal.base.arguments import check_arguments
from parallel_cal.base.documents import to_json_value
from parallel_cal.base.errors import ParallelCalError
from parallel_cal.base.threads import single_threaded
from parallel_cal.reporting.identified import name_robot
from parallel_cal.reporting.readable import day
from parallel_cal.reporting.report import Report
from parallel_cal.reporting.sections import body


@check_arguments(ParallelCalError)
@single_threaded()
def page(report: Report, library: str = "") -> str:
    """Make one HTML page of a report.

    Parameters
    ----------
    report : Report
    library : str, optional
        Path, relative to the page, of a copy of Plotly that several pages share. The default puts
        Plotly into the page, which then needs no other file.

    Returns
    -------
    str

    Examples
    --------
    >>> import parallel_cal as pc
    >>> model = pc.read_model("config/delta_mockup_nominal.yaml")
    >>> data = pc.load_dataset("bags/delta_backlash", joints=model.joints)
    >>> html = pc.page(pc.report(model, data, effects=["backlash"]))
    >>> "backlash" in html
    True
    """
    drawn = PageBuilder()
    p, data, stated = report.provenance, report.diagnosis.dataset, report.certificate
    robot = name_robot(stated) or p.mechanism
    used = [entry.get("dataset") for entry in report.diagnosis.model.history]
    sources = {data.source, *(str(one.get("source")) for one in used if isinstance(one, Mapping))}
    return drawn.page(
        name_files(f"{robot} on {data.source}", sources),
        f"{day(p.made)}, {len(data)} samples, {p.mechanism}, model {p.model_sha256[:12]}",
        name_files(body(report, drawn.plot), map(escape, sources)),
        library,
        footer=", ".join(
            filter(None, (stated.number and f"Certificate {stated.number}", name_robot(stated)))
        ),
    )


def name_files(text: str, sources: Iterable[str]) -> str:
    """Replace the paths of recordings by their names: a page is read on other computers. The
    document of the report has the paths. `sources` are paths, joined by `, ` or ` + `."""
    paths = {path for source in sources for path in re.split(r", | \+ ", source)}
    for path in sorted(paths, key=len, reverse=True):  # a path may be the beginning of another
        if "/" in path:
            text = text.replace(path, PurePath(path).name)
    return text


class PageBuilder:
    """The figures of a page, in their order."""

    def __init__(self) -> None:
        self._figures: list[Mapping[str, Any]] = []

    def plot(self, figure: Mapping[str, Any]) -> str:
        """Add a figure to the page; return the HTML of its place. NaN and infinity become null,
        which Plotly draws as a gap, as in the workbench."""
        self._figures.append(to_json_value(figure))
        number, height = len(self._figures) - 1, figure["layout"]["height"]
        return f'<div class="plot" data-figure="{number}" style="height:{height}px"></div>'

    def page(self, title: str, made: str, content: str, library: str = "", footer: str = "") -> str:
        """Make the page with the figures and the `content`, which is HTML; `footer` is printed on
        each sheet of paper, next to its number."""
        figures = json.dumps(self._figures, allow_nan=False, separators=(",", ":"))
        # In a string of CSS, any character may be its code.
        codes = "".join(f"\\{ord(letter):x} " for letter in footer)
        sheet = f'@page {{ @bottom-left {{ content: "{codes}"; font: 9px sans-serif; }} }}\n'
        return Template(_text("page.html")).substitute(
            title=escape(title),
            made=escape(made),
            style=_text("blocks.css") + _text("page.css") + sheet,
            body=content,
            figures=figures.replace("<", "\\u003c"),  # cannot end the script element
            plotly=f'<script src="{library}"></script>'
            if library
            else f"<script>{plotly()}</script>",
            beside=" 'self' file:" if library else "",
            script=_text("page.js"),
        )

    def page_of(self, title: str, parts: Iterable[str]) -> str:
        """Make the page of some sections, with the present time."""
        made = datetime.now(timezone.utc).isoformat(timespec="minutes")
        return self.page(title, f"{day(made)}, parallel_cal {__version__}", "\n".join(parts))


def plotly() -> str:
    """Return Plotly as a script."""
    from plotly.offline import get_plotlyjs

    return str(get_plotlyjs())


def _text(name: str) -> str:
    return files("parallel_cal.reporting").joinpath(name).read_text(encoding="utf-8")
