"""The noise with which samples are weighted, by its kinds, and where each figure comes from."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from parallel_cal.identification.observations import (
    ESTIMATED,
    SCATTER,
    UNSTATED,
    Observations,
    list_noise_kinds,
)
from parallel_cal.model.model import Model, Noise

BADLY_KNOWN = 2.0  # times an estimated noise: where it may be larger, people are told


@dataclass(frozen=True)
class NoiseFigure:
    """A standard deviation (1 sigma, SI) with which samples were weighted, and its source; what it
    is `at_most`, within two standard errors, if it was estimated."""

    name: str
    value: float
    unit: str
    source: str
    at_most: float | None = None

    def describe(self, write: Callable[[float, str], str]) -> str:
        """Name its value, which `write` writes with its unit; if it was estimated badly, what it is
        at most, too."""
        text = f"{self.name} {write(self.value, self.unit)}"
        if self.at_most is None or self.at_most < BADLY_KNOWN * self.value:
            return text
        return f"{text}, at most {write(self.at_most, self.unit)}"


def list_noise(model: Model, observations: Observations) -> list[NoiseFigure]:
    """List the noise of joints, device and sensors: its rms over the samples."""
    sources = observations.noise_from
    unknown = {kind.name: kind for kind in observations.unknown}

    def figure(name: str, value: float, unit: str, source: str) -> NoiseFigure:
        if name not in unknown:
            return NoiseFigure(name, value, unit, source)
        kind = unknown[name]
        at_most = None if kind.at_most is None else value * kind.at_most
        return NoiseFigure(name, value, unit, kind.source, at_most)

    found = []
    for name, unit, own, rms in _measure_kinds(model, observations):
        source = sources["joint" if own[: len(model.joints)].any() else "pose"]
        # Another part of the joints or of the device may be the unknown one.
        stated = "model file" if source in (UNSTATED, SCATTER, ESTIMATED) else source
        found.append(figure(name, rms, unit, stated))
    sigma = observations.get_reading_sigma(model)
    for sensor in model.sensors:
        own = np.isin(model.structure.channels, sensor.channels)
        used = np.isfinite(observations.reading) & own
        if used.any():
            # Without a stated sigma, the noise of images was measured or is unknown.
            stated = "model file" if sensor.sigma is not None else sources.get("reading", UNSTATED)
            rms = float(np.sqrt(np.mean(sigma[used] ** 2)))
            found.append(figure(sensor.name, rms, sensor.unit, stated))
    return found


def noise_in_use(model: Model, observations: Observations, estimated: bool = False) -> Noise:
    """Return the noise of joints and device with which observations are weighted; None for what is
    neither stated nor estimated. With `estimated`, only what was estimated."""
    n = len(model.joints)
    known = {kind.name: kind.estimated for kind in observations.unknown}
    joints: dict[str, float] = {}
    device: list[float | None] = [None, None]
    for name, unit, own, sigma in _measure_kinds(model, observations):
        if not known.get(name, not estimated):
            continue
        if own[:n].any():
            joints[unit] = sigma
        else:
            device[int(own[n + 3 : n + 6].any())] = sigma
    return Noise(joints or None, device[0], device[1])


def _measure_kinds(
    model: Model, observations: Observations
) -> Iterator[tuple[str, str, np.ndarray, float]]:
    """Name, unit, columns (nq+6,) and rms over the samples of every kind of noise of joints and
    device that was measured."""
    variance = np.diagonal(observations.S, axis1=1, axis2=2)
    for name, unit, own in list_noise_kinds(model):
        used = observations.measured & own
        if used.any():
            yield name, unit, own, float(np.sqrt(variance[used].mean()))
