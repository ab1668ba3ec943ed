"""The tables and figures of Savoure et al. 2006: the parallelogram, and the same on a Delta."""

from __future__ import annotations

from typing import Any

from bench.documents.tables import delta51, parallelogram


def numbers(draws: int = 50, robots: int = 20) -> dict[str, Any]:
    """The parallelogram over noise draws, the Delta over random robots; seeds 0, 1, ..."""
    tools = parallelogram.TOOLS
    return {
        "draws": draws,
        "robots": robots,
        "base_parameters": parallelogram.rank_analysis(),
        "table_2": parallelogram.identified_errors(draws),
        "parallelogram": {
            parallelogram.label(h): parallelogram.tip_errors(h, draws) for h in tools
        },
        "delta51": {label: delta51.study(robots, size) for size, label in delta51.LABELS.items()},
    }
