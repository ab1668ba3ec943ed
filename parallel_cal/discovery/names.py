"""Names of laws and sentences about them."""

from __future__ import annotations

from collections.abc import Mapping

from parallel_cal.discovery.drivers import WORDS
from parallel_cal.discovery.places import (
    BASE,
    DEVICE,
    JOINT,
    PARAMETER,
    PLATFORM,
    ROD,
)
from parallel_cal.discovery.screening import Hypothesis
from parallel_cal.model.words import join_words
from parallel_cal.recordings.dataset import Dataset


def name_place(hypothesis: Hypothesis) -> str:
    site = hypothesis.site
    return f"{site.name}, each its own" if site.each else site.name


def name_law(hypothesis: Hypothesis) -> str:
    return f"{name_place(hypothesis)} by {' and '.join(hypothesis.families)}"


def describe_law(hypothesis: Hypothesis) -> str:
    """Say where an error enters and on what it depends: "The reading of joint2 errs with the load
    on joint2"."""
    site = hypothesis.site
    names = [place.name for place in site.members]
    last = ", ".join(name.rpartition(".")[2] for name in names)
    what = {
        JOINT: f"The reading of {join_words(names)}",
        PARAMETER: f"The parameter {join_words(names)}",
        ROD: f"The length of {join_words(names)}",
        PLATFORM: f"The platform's {last}",
        BASE: f"The rotation {last} of the base, as the device sees it,",
        DEVICE: f"The {last} that the device shows",
    }[site.kind]
    on = " and ".join(
        own[0].words if len({one.name for one in own}) == 1 else WORDS[own[0].family]
        for own in hypothesis.drivers
    )
    each = ", each in its own way" if site.each else ""
    return f"{what} errs with {on}{each}"


def list_ranges(hypothesis: Hypothesis) -> dict[str, tuple[float, float]]:
    drivers = {one.name: one for own in hypothesis.drivers for one in own}
    return {name: one.range for name, one in drivers.items()}


def describe_data(dataset: Dataset, tested: Mapping[str, tuple[float, float]]) -> str:
    spans = ", ".join(f"{name} {low:.4g} to {high:.4g}" for name, (low, high) in tested.items())
    digest = f" (sha256 {dataset.sha256[:12]})" if dataset.sha256 else ""
    return (
        f"parallel-cal discover, {len(dataset)} samples of {dataset.source or 'arrays'}{digest}; "
        f"tested in SI units: {spans}"
    )
