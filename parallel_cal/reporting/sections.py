"""The sections of a report in the order they are read: verdict first."""

from __future__ import annotations

from parallel_cal.reporting import evidence, failures, identified, overview
from parallel_cal.reporting.markup import Document, Plot, section


def body(document: Document, plot: Plot) -> str:
    """Everything below the page's head; sections without data say so."""
    parts = [
        overview.verdict(document),
        overview.numbers(document),
        section("History", overview.history(document, plot)),
        section("What is left, in space", failures.in_space(document, plot)),
        section("What is left, along everything", failures.along_everything(document, plot)),
        section("Which effect is missing", evidence.candidates(document)),
        section("What to measure next", evidence.measure_next(document)),
        section("Parameters", identified.parameters(document, plot)),
        section("What the data cannot tell", identified.combinations(document)),
        section("Unexplained structure", failures.structure(document, plot)),
        section("Samples", failures.samples(document)),
        section("Provenance", identified.provenance(document)),
    ]
    if document["against"]:
        parts.insert(-2, section("Two models side by side", identified.against(document, plot)))
    return "\n".join(parts)
