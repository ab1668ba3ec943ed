"""What the tables share: units, distributions beside a printed number, numbers as text."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from textwrap import fill
from typing import Any

import numpy as np

from parallel_cal.identification.methods import forward, inverse
from parallel_cal.identification.methods.implicit import Estimate
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.prediction_errors import Errors
from parallel_cal.model.model import Model

MM, UM = 1e-3, 1e-6
DEGREE = np.pi / 180
ARCMIN, ARCSECOND = DEGREE / 60, DEGREE / 3600
PERCENT = (0.5, 5.0, 50.0, 95.0, 99.5)  # the quantiles that are kept, low to high
UNITS = {"position": UM, "orientation": ARCMIN, "joint": ARCMIN}


def distribution(sample: np.ndarray, printed: float | None = None) -> dict[str, Any]:
    """Mean, deviation and quantiles of our draws, and which percentile the printed number is."""
    entry: dict[str, Any] = {
        "mean": sample.mean(),
        "deviation": sample.std(ddof=1),
        "quantiles": np.percentile(sample, PERCENT).tolist(),
    }
    if printed is not None:
        entry |= {"printed": printed, "percentile": 100 * np.mean(sample < printed)}
    return entry


def error_table(errors: Errors) -> dict[str, dict[str, list[float]]]:
    """Mean and deviation of each component, then of the norm (tables 5.15 to 5.27): um, arcmin."""
    rows = {}
    for kind, unit in UNITS.items():
        norms = errors.norms(kind)[:, None]
        if np.isfinite(norms).all():
            columns = np.hstack([getattr(errors, kind), norms]) / unit
            rows[kind] = {
                "mean": columns.mean(axis=0).tolist(),
                "deviation": columns.std(axis=0, ddof=1).tolist(),
            }
    return rows


def factor(before: Errors, after: Errors, kind: str) -> float:
    """Factor of improvement: sums of norms (eq. 5.20)."""
    return float(before.norms(kind).sum() / after.norms(kind).sum())


def with_noise(observations: Observations, joint: float, pose: float) -> Observations:
    """The same samples, believed to have this noise in every joint and pose coordinate."""
    S = np.diag([joint**2] * (observations.S.shape[1] - 6) + [pose**2] * 6)
    return replace(observations, S=np.tile(S, (len(observations), 1, 1)))


def plain_forward(model: Model, observations: Observations, free: np.ndarray) -> Estimate:
    """Forward calibration as in 5.3.4: pose errors count alike, whatever the joints' noise."""
    return forward.estimate(model, with_noise(observations, 1e-12, 1e-5), free)


def plain_inverse(model: Model, observations: Observations, free: np.ndarray) -> Estimate:
    """Inverse calibration as in 5.3.5: joint errors count alike."""
    return inverse.estimate(model, with_noise(observations, 1e-5, 1e-12), free)


def text(value: float, digits: int = 3, most: int = 4) -> str:
    """A number with so many significant digits, at most so many decimals, and no exponent."""
    if value == 0 or not np.isfinite(value):
        return f"{value:.0f}"
    decimals = min(digits - 1 - int(np.floor(np.log10(abs(value)))), most)
    return f"{round(value, decimals) + 0.0:.{max(decimals, 0)}f}"


def texts(values: Iterable[float], digits: int = 3, most: int = 4) -> str:
    return ", ".join(text(v, digits, most) for v in values)


def ranged(entry: dict[str, Any], digits: int = 3) -> str:
    """Median and the range of 90 % of the draws."""
    _, low, middle, high, _ = entry["quantiles"]
    return f"{text(middle, digits)} ({text(low, digits)} to {text(high, digits)})"


def article(parts: Iterable[str | list[str]]) -> str:
    """Paragraphs, filled; lists as bullets; headings, tables and pictures as they are."""
    return "\n\n".join(_filled(part) for part in parts)


def _filled(part: str | list[str]) -> str:
    if isinstance(part, list):
        return "\n".join(_paragraph(p, "- ", "  ") for p in part)
    return part if part.startswith(("#", "|", "![")) else _paragraph(part)


def _paragraph(words: str, first: str = "", then: str = "") -> str:
    return fill(" ".join(words.split()), 100, initial_indent=first, subsequent_indent=then)


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def rounded(document: Any) -> Any:
    """Plain numbers, six digits and five decimals: what another BLAS changes is left out."""
    if isinstance(document, dict):
        return {key: rounded(value) for key, value in document.items()}
    if isinstance(document, list | tuple):
        return [rounded(value) for value in document]
    if isinstance(document, float | np.floating):
        return float(f"{round(float(document), 5):.6g}") + 0.0
    return document
