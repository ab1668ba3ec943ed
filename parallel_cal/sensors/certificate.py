"""The accuracy of the pose device from its certificate, as tolerances of its effects."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from parallel_cal.base.errors import ModelError, format_suggestion
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Parameter, ParameterTable
from parallel_cal.model.sensor import Sensor

# Volumetric accuracy (m) and scale (1) over a robot's workspace, from data sheets
KINDS = {
    "cmm": (5e-6, 5e-6),  # ISO 10360-2: 2-5 um and 3-5 um/m
    "laser_tracker": (30e-6, 10e-6),  # ISO 10360-10: 15 um and 6 um/m
    "measuring_arm": (50e-6, 50e-6),  # ISO 10360-12: 30-60 um
    "cameras": (100e-6, 100e-6),  # VDI 2634: 50-100 um with coded targets
    "motion_capture": (300e-6, 500e-6),  # 0.2-0.5 mm after a wand calibration
}
REFERENCE_ACCURACY_M = 20e-6  # of the device for which the catalogue's drift tolerances hold


@dataclass(frozen=True)
class Certificate(Sensor):
    """Accuracy of the pose device: its `kind`, or `volumetric_accuracy` and `scale`.

    The tolerances of `device_field`, `device_axes` and `base_drift` are set so that each causes
    this error at the corner of the workspace.

    Parameters
    ----------
    kind : str
        One of `KINDS`. Default: not stated.
    volumetric_accuracy : float, optional
        Standard deviation of a position, m. Default: that of the kind.
    scale : float, optional
        Standard deviation of the scale, 1. Default: that of the kind.
    """

    kind: str = ""
    volumetric_accuracy: float | None = None
    scale: float | None = None

    physics = "the errors of a device are about as large as its certificate allows, seldom larger"
    source = "ISO 10360, VDI 2634"

    def __post_init__(self) -> None:
        if self.kind and self.kind not in KINDS:
            known = (
                format_suggestion(self.kind, list(KINDS)) or f"; expected one of {', '.join(KINDS)}"
            )
            raise ModelError(f"certificate: no kind '{self.kind}'{known}")
        if self._accuracy is None or min(self._accuracy, self._scale or 1.0) <= 0:
            raise ModelError(
                "certificate: expected a kind of device, or a volumetric_accuracy (m) "
                "and a scale, both above 0"
            )

    @property
    def _accuracy(self) -> float | None:
        return self.volumetric_accuracy or KINDS.get(self.kind, (None, None))[0]

    @property
    def _scale(self) -> float | None:
        return self.scale or KINDS.get(self.kind, (None, None))[1]

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        return []

    def tolerances(self, table: ParameterTable, mechanism: Mechanism) -> Mapping[str, float]:
        accuracy = self._accuracy or REFERENCE_ACCURACY_M
        # m: distance from the middle of the workspace to its corner
        low, high = np.array(mechanism.workspace.low), np.array(mechanism.workspace.high)
        along = [c in ("x", "y", "z") for c in mechanism.controls]
        reach = float(np.linalg.norm((high - low)[along])) / 2 or mechanism.length
        found = {}
        for p in table:
            effect, _, number = p.name.partition(".")
            if effect == "device_field":  # six parameters per axis
                found[p.name] = accuracy / (6**0.5 * reach**2)
            elif effect == "device_axes":  # up to three
                known = self._scale if number.startswith("scale") else None
                found[p.name] = known or accuracy / (3**0.5 * reach)
            elif effect == "base_drift":
                found[p.name] = p.tolerance * accuracy / REFERENCE_ACCURACY_M
        return found
