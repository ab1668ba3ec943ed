"""The command that writes the report as a page or as a document."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.cli.arguments import (
    Also,
    Bags,
    Data,
    FittingOrUpdating,
    Json,
    ModelFile,
    Tested,
    with_options,
)
from parallel_cal.cli.calibration import read_model_and_data
from parallel_cal.reporting import console

if TYPE_CHECKING:
    from parallel_cal.reporting.certificate import CertificateFields
    from parallel_cal.reporting.report import Report

PAGE, DOCUMENT = (".html", ".htm"), (".json",)
ReportFile = Annotated[
    Path | None, typer.Option("-o", "--output", help="page (.html) or document (.json)")
]
PdfFile = Annotated[
    Path | None,
    typer.Option("--pdf", metavar="R.pdf", help="the page on A4, printed by Chromium"),
]
CertificateFile = Annotated[
    Path | None,
    typer.Option(metavar="FIELDS.yaml", help="fields of the certificate: serial_number, ..."),
]
CertificateField = Annotated[
    list[str] | None,
    typer.Option(metavar="NAME=VALUE", help="one field of the certificate; repeatable"),
]


@with_options
def report(
    model: ModelFile,
    bags: Bags,
    *,
    output: ReportFile = None,
    against: Annotated[
        Path | None,
        typer.Option(metavar="OTHER.yaml", help="another model, for comparison on the same data"),
    ] = None,
    pdf: PdfFile = None,
    certificate: CertificateFile = None,
    field: CertificateField = None,
    effect: Tested = None,
    also: Also = None,
    options: FittingOrUpdating,
    data: Data = None,
    as_json: Json = False,
) -> None:
    """Write the diagnosis as one offline page. It shows errors, residuals, effects, parameters, and
    a certificate."""
    from parallel_cal.model.file.modelfile import read_model
    from parallel_cal.reporting import report as reports

    def make(stated: CertificateFields) -> Report:
        other = None if against is None else read_model(against)
        judged, dataset = read_model_and_data(model, bags, data)
        return reports.report(
            judged,
            dataset,
            against=other,
            effects=effect or (),
            also=also or (),
            certificate=stated,
            options=options,
            progress=console.progress,
        )

    write_report(make, output, pdf, certificate, field or (), as_json)


def write_report(
    make: Callable[[CertificateFields], Report],
    output: Path | None,
    pdf: Path | None,
    certificate: Path | None,
    field: Sequence[str],
    as_json: bool,
) -> None:
    """Make a report with the stated fields of the certificate, write its files, and show the
    verdict."""
    if output is None and pdf is None and not as_json:
        raise typer.BadParameter("expected -o R.html (or .json), --pdf R.pdf, or --json")
    # Report what cannot work before the diagnosis, which takes seconds.
    if output is not None:
        _check_writable(output, PAGE + DOCUMENT, ".html (page) or .json (document)")
    from parallel_cal.base.files import write_atomically
    from parallel_cal.reporting.age import describe_age
    from parallel_cal.reporting.certificate import CertificateFields

    stated = CertificateFields.read(certificate, field)
    browser = ""
    if pdf is not None:
        from parallel_cal.reporting.pdf import find_browser

        _check_writable(pdf, (".pdf",), ".pdf")
        browser = find_browser()
    made = make(stated)
    if output is not None:
        console.progress("writing the report", 0.95)
        write_atomically(output, _text(made, output.suffix))
    if pdf is not None:
        from parallel_cal.reporting.pdf import print_to_pdf

        console.progress("printing the report", 0.97)
        print_to_pdf(_text(made, PAGE[0]), pdf, browser)
    console.progress("", 1.0)
    console.warn(made.diagnosis.best.fitted.warnings)
    if as_json:
        written = {"output": output, "pdf": pdf}
        extra = {key: str(path) for key, path in written.items() if path is not None}
        return console.emit(made.document() | extra)
    console.say(f"{made.diagnosis.verdict.word}: {made.diagnosis.verdict.summary}")
    for decision in made.conformity:
        console.say(decision.description)
    console.say(f"trusted: {describe_age(made.age)}")
    for file in filter(None, (output, pdf)):
        console.say(f"written: {file}")


def _check_writable(output: Path, suffixes: Sequence[str], expected: str) -> None:
    if output.suffix.lower() not in suffixes:
        raise ParallelCalError(f"{output}: expected a name that ends in {expected}")
    if not output.parent.is_dir():
        raise ParallelCalError(
            f"{output}: the folder {output.parent} does not exist; create it first"
        )


def _text(made: Report, suffix: str) -> str:
    if suffix.lower() in PAGE:
        from parallel_cal.reporting.page import page

        return page(made)
    return json.dumps(made.document(), indent=1, allow_nan=False) + "\n"
