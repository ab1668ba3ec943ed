"""The view of a discovery as plain data, computed in the worker process."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from parallel_cal.base.documents import to_json_value
from parallel_cal.discovery.law import Discovery
from parallel_cal.reporting.blocks import as_rows
from parallel_cal.reporting.figures import law_over_shape
from parallel_cal.reporting.readable import write_micro
from parallel_cal.reporting.tables import law_table


def make_law_view(found: Discovery, files: Sequence[Path]) -> dict[str, Any]:
    """Make the view of a discovery; `files` are the effect files of its proven laws."""
    figures = [
        {
            "words": f"{law.name}: the error without a formula, and the law over it",
            "figure": to_json_value(law_over_shape(law.shape)),
        }
        for law in (*found.laws, *found.suspected)
        if law.shape is not None
    ]
    return {
        "verdict": found.verdict,
        "words": f"{found.verdict.replace('_', ' ')}: {write_micro(found.summary)}",
        "table": as_rows(law_table(found)),
        "figures": figures,
        "effects": [
            {"name": file.stem, "law": law.name, "file": str(file)}
            for law, file in zip(found.laws, files, strict=True)
        ],
        "advice": [write_micro(words) for words in found.measure_next],
    }
