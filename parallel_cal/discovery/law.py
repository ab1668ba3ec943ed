"""A law that was found, and the result of a search for laws."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from parallel_cal.base.documents import to_json_value
from parallel_cal.base.notebook import ShownInNotebook
from parallel_cal.discovery.effect_file import (
    Coefficient,
    write_effect_file,
)
from parallel_cal.discovery.folds import Choice
from parallel_cal.discovery.shape import Shape
from parallel_cal.identification.prediction_errors import Summary
from parallel_cal.model.model import Model
from parallel_cal.recordings.dataset import Dataset


@dataclass(frozen=True)
class Law:
    """A law that was found: where an error enters, on what it depends, and its formula.

    Attributes
    ----------
    place : str
        The quantity that errs: a joint, a parameter (`chain1.La_y`), `pose.z` or `device.z`, or
        several of them, such as `joints`.
    drivers : tuple of str
        The quantities that the error depends on, such as `load.joint2`.
    formula : str
        The error as a sum of terms, with the names of `parameters`.
    unit : str
        Unit of the error.
    parameters : tuple of Coefficient
        The coefficients, identified together with the geometry, and the constants of terms.
    share : float or None
        Share of the error above the noise floor that the law accounts for.
    before, after, noise_floor : Summary
        Validation errors without and with the law; the noise floor.
    tested : dict of (float, float)
        The range of each driver in the samples.
    alternatives : tuple of str
        Laws that describe the data equally well, each as `PLACE by DRIVER`.
    choice : Choice
        The residuals at held-out poses if its form and its constants are chosen without them.
    evidence, threshold : float
        Log evidence of place and drivers without a formula, and the value that the best of all
        hypotheses exceeds in one of a hundred sessions without a law.
    against : str
        Why the law is not proven; empty if it is.
    device_may_err : bool
        Whether the reason is that robot and measuring device may both cause the error.
    of_device : bool
        Whether the measuring device errs.
    text : str
        The effect file.
    rivals : dict of str
        The effect file of each of `alternatives`, by its name.
    """

    place: str
    drivers: tuple[str, ...]
    formula: str
    unit: str
    parameters: tuple[Coefficient, ...]
    share: float | None
    before: Summary
    after: Summary
    noise_floor: Summary
    tested: Mapping[str, tuple[float, float]]
    alternatives: tuple[str, ...]
    choice: Choice
    evidence: float
    threshold: float
    against: str
    device_may_err: bool
    of_device: bool
    sentence: str
    text: str = field(repr=False)
    shape: Shape | None = field(repr=False, default=None)
    rivals: Mapping[str, str] = field(repr=False, default_factory=dict)

    @property
    def name(self) -> str:
        """`PLACE by DRIVER and DRIVER`."""
        return f"{self.place} by {' and '.join(self.drivers)}"

    def document(self) -> dict[str, Any]:
        """The law as JSON data; SI, None for unknown values."""
        return {
            "place": self.place,
            "drivers": list(self.drivers),
            "formula": self.formula,
            "unit": self.unit,
            "parameters": {
                c.name: {"value": c.value, "sigma": c.sigma, "unit": c.unit}
                for c in self.parameters
            },
            "share": to_json_value(self.share),
            "validation": {
                "before": self.before.document(),
                "after": self.after.document(),
                "noise_floor": self.noise_floor.document(),
                "residuals_ratio": to_json_value(self.choice.ratio),
                "residuals_ratio_chosen_anew": to_json_value(self.choice.ratio_anew),
            },
            "tested": {name: list(span) for name, span in self.tested.items()},
            "or": list(self.alternatives),
            "of_device": self.of_device,
            "against": self.against,
            "evidence": to_json_value(self.evidence),
            "threshold": to_json_value(self.threshold),
        }


@dataclass(frozen=True)
class Discovery(ShownInNotebook):
    """The result of `discover`.

    Attributes
    ----------
    model : Model
    dataset : Dataset
    laws : tuple of Law
        The proven laws, best first.
    suspected : tuple of Law
        Laws beyond chance that the same judgement as that of `add` refuses; `against` says why.
    verdict : str
        `described` (laws were found and proven at held-out poses), `robot_or_device` (the
        measuring device may cause the error), `suspected` or `nothing`.
    summary : str
    measure_next : tuple of str
        What to measure to decide between laws that describe the data equally well.
    described : Model
        The fitted model with the proven laws, for use in this process. To write a model file, write
        the effect first and add it with `add`.
    needs_larger_model : bool
        Whether the measured pose varies in coordinates that the model holds at one value.
    """

    model: Model
    dataset: Dataset
    laws: tuple[Law, ...]
    suspected: tuple[Law, ...]
    verdict: str
    summary: str
    measure_next: tuple[str, ...]
    described: Model
    needs_larger_model: bool = False

    def __repr__(self) -> str:
        found = "; ".join(law.name for law in self.laws) or "no law"
        return (
            f"Discovery({self.model.mechanism.name}, {len(self.dataset)} samples, "
            f"{self.verdict}: {found})"
        )

    def write(self, path: str | Path) -> list[Path]:
        """Write the proven laws as effect files: the first to `path`, further ones to
        `path` with `_2` and `_3` behind the name. ModelError for a name that cannot be imported."""
        path = Path(path)
        paths = [
            path.with_stem(f"{path.stem}_{k}") if k > 1 else path
            for k in range(1, len(self.laws) + 1)
        ]
        for law, own in zip(self.laws, paths, strict=True):
            write_effect_file(own, law.text)
        return paths

    def document(self, files: Sequence[str | Path] = ()) -> dict[str, Any]:
        """The JSON document of `parallel-cal discover`; SI, None for unknown values."""
        return {
            "verdict": self.verdict,
            "summary": self.summary,
            "laws": [law.document() for law in self.laws],
            "suspected": [law.document() for law in self.suspected],
            "measure_next": list(self.measure_next),
            "needs_larger_model": self.needs_larger_model,
            "file": str(files[0]) if files else None,
            "files": [str(file) for file in files],
            "samples": len(self.dataset),
            "dataset": {"source": self.dataset.source, "sha256": self.dataset.sha256},
        }
