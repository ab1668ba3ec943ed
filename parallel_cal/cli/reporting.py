"""The report: a page for people, a document for programs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.base.files import write_atomically
from parallel_cal.cli.calibration import model_and_data
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.reporting import console
from parallel_cal.reporting.page import page
from parallel_cal.reporting.report import report as reported

PAGE, DOCUMENT = (".html", ".htm"), (".json",)


def report(
    model_file: Path,
    bags: list[Path],
    output: Path | None,
    against: Path | None,
    data: list[str],
    as_json: bool,
    **options: Any,
) -> None:
    """Diagnose, write the page or the document, and say where it is."""
    if output is not None:
        _check_writable(output)  # before seconds are spent
    other = None if against is None else read_model(against)
    model, dataset = model_and_data(model_file, bags, data)
    made = reported(model, dataset, against=other, progress=console.progress, **options)
    document = console.plain(made.document())
    if output is not None:
        console.progress("writing the report", 0.95)
        write_atomically(output, _text(document, output.suffix))
    console.progress("", 1.0)
    console.warn(document["diagnosis"]["warnings"])
    if as_json:
        extra = {} if output is None else {"output": str(output)}
        return console.emit(document | extra)
    console.say(f"{document['diagnosis']['verdict']}: {document['diagnosis']['summary']}")
    console.say(f"written: {output}")


def _check_writable(output: Path) -> None:
    if output.suffix.lower() not in PAGE + DOCUMENT:
        raise ParallelCalError(
            f"{output}: expected a name that ends in .html (page) or .json (document)"
        )
    if not output.parent.is_dir():
        raise ParallelCalError(f"{output}: there is no folder {output.parent}; make it first")


def _text(document: dict[str, Any], suffix: str) -> str:
    if suffix.lower() in PAGE:
        return page(document)
    return json.dumps(document, indent=1, allow_nan=False) + "\n"
