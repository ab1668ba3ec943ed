"""The sections of a report in their order, the verdict first."""

from __future__ import annotations

from parallel_cal.reporting import evidence, failures, identified, overview
from parallel_cal.reporting.certificate import CertificateFields
from parallel_cal.reporting.markup import Plot, section
from parallel_cal.reporting.report import Report


def body(report: Report, plot: Plot) -> str:
    """Render all sections; a section without data says so."""
    free = sum(not p.fixed for p in report.parameters.values())
    count = f"{len(report.samples)}, the largest residual first"
    blank = report.certificate == CertificateFields()  # nobody asked for a certificate
    images = failures.over_images(report, plot)  # empty without a camera
    heights = identified.height_changes(report)  # empty without touches
    parts = [
        overview.verdict(report),
        overview.numbers(report),
        section("Certificate", identified.certificate(report), closed=blank),
        section("History", overview.history(report, plot)),
        section("Error budget", overview.budget(report)),
        section("Residuals in space", failures.in_space(report, plot)),
        *([section("What the camera saw", images)] if images else []),
        section("Residuals against quantities", failures.along_everything(report, plot)),
        section("Which effect is missing", evidence.candidates(report, plot)),
        section("What to measure next", evidence.measure_next(report)),
        section("Parameters", identified.parameters(report, plot), f"{free} free", closed=True),
        *([section("Heights if one parameter is wrong", heights, closed=True)] if heights else []),
        section("What the data do not determine", identified.combinations(report), closed=True),
        section("Unexplained structure", failures.structure(report, plot), closed=True),
        section("Provenance", identified.provenance(report), closed=True),
        section("Samples", failures.samples(report), count, closed=True),
    ]
    if report.against:
        parts.insert(
            -2,
            section(
                "Two models side by side",
                identified.render_comparison(report.against, report, plot),
            ),
        )
    return "\n".join(parts)
