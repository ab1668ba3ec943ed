"""Pictures that stay on the page while those of the next step are made."""

from __future__ import annotations

from typing import Any

# What stays of a view while the numbers of the next one are shown, until its pictures are made.
PICTURES = (
    *("machine", "field", "residuals", "pictures", "samples", "names", "measured"),
    *("parameters", "drawing", "cannot_tell", "separation"),
)
EARLIER = "The pictures and tables are those before this step, until the new ones are made."


def keep_pictures(view: dict[str, Any], before: dict[str, Any] | None) -> dict[str, Any]:
    """Keep the pictures and tables of the view before in one that has only numbers, and say so.

    What the view before judged is not kept.
    """
    if before is None or "residuals" in view or "residuals" not in before:
        return view
    kept = {key: before[key] for key in PICTURES if key in before}
    return kept | {"shown": EARLIER} | view
