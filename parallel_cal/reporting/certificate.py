"""The calibration certificate of a report: who measured what, and whether the robot conforms."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from parallel_cal.base.errors import ParallelCalError, format_suggestion
from parallel_cal.base.files import read_text
from parallel_cal.base.units import ERROR_UNITS
from parallel_cal.identification.prediction_errors import Summary
from parallel_cal.model.file.yamltext import parse_yaml
from parallel_cal.reporting.readable import with_sigma

COVERAGE_FACTOR = 2.0  # k of the expanded uncertainty U = k sigma: about 95 %
# The limits of a certificate: kind of error and unit.
LIMITS = {"limit_um": "position", "limit_arcmin": "orientation"}
PASS, FAIL, UNDECIDED = "pass", "fail", "not decided"


class CertificateError(ParallelCalError):
    """A field of a certificate is unknown or has a wrong value."""


def _text(words: str) -> Any:
    return field(default="", metadata={"words": words})


@dataclass(frozen=True)
class CertificateFields:
    """What the owner states on a certificate; an empty field stays blank for a pen.

    Parameters
    ----------
    number, robot, serial_number, device, device_serial_number, device_certificate : str
        The certificate, the robot and the measuring device.
    operator, place, temperature, measured_on, valid_until : str
        Who measured, where, at which temperature and when.
    limit_um, limit_arcmin : float, optional
        Limits of acceptance of the rms position error (um) and the rms orientation error (arcmin)
        at held-out poses. Default: none, nothing is decided.

    Examples
    --------
    >>> import parallel_cal as pc
    >>> pc.CertificateFields(robot="Delta 4", limit_um=50.0).robot
    'Delta 4'
    """

    number: str = _text("Certificate number")
    robot: str = _text("Robot")
    serial_number: str = _text("Serial number of the robot")
    device: str = _text("Measuring device")
    device_serial_number: str = _text("Serial number of the device")
    device_certificate: str = _text("Certificate of the device")
    operator: str = _text("Operator")
    place: str = _text("Place")
    temperature: str = _text("Temperature")
    measured_on: str = _text("Date of the measurements")
    valid_until: str = _text("Valid until")
    limit_um: float | None = None
    limit_arcmin: float | None = None

    @classmethod
    def read(cls, file: Path | None, options: Iterable[str] = ()) -> CertificateFields:
        """Read the fields of a YAML file and then of options `NAME=VALUE`, which replace them.

        CertificateError for an unknown field or a wrong value, ModelFileError for a file that is
        not YAML.
        """
        found: dict[str, Any] = {}
        if file is not None:
            try:
                document = parse_yaml(read_text(file), str(file)).data
            except (OSError, UnicodeDecodeError) as error:
                reason = getattr(error, "strerror", None) or "it is not text"
                raise CertificateError(f"{file}: cannot be read: {reason}") from None
            if not isinstance(document, Mapping):
                raise CertificateError(f"{file}: expected lines 'FIELD: VALUE'")
            found |= {key: (value, str(file)) for key, value in document.items()}
        for option in options:
            name, equal, value = option.partition("=")
            if not equal:
                raise CertificateError(
                    f"--field '{option}': expected NAME=VALUE, such as operator='A. Smith'"
                )
            found[name.strip()] = value.strip(), f"--field {option}"
        return cls(**{name: _check(name, *given) for name, given in found.items()})


def _check(name: str, value: Any, source: str) -> Any:
    """Return the value of a field: a text, or a positive number for a limit."""
    known = [one.name for one in fields(CertificateFields)]
    if name not in known:
        raise CertificateError(
            f"{source}: a certificate has no field '{name}'{format_suggestion(name, known)}; its "
            f"fields are {', '.join(known)}"
        )
    if name not in LIMITS:
        if isinstance(value, Mapping | list):
            raise CertificateError(f"{source}: {name}: expected a text, got {value!r}")
        return "" if value is None else str(value)
    if value is None or value == "":
        return None
    try:
        limit = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError):
        limit = math.nan
    if not (math.isfinite(limit) and limit > 0):
        unit = name.removeprefix("limit_")
        raise CertificateError(
            f"{source}: {name}: expected a positive number in {unit}, got {value!r}"
        )
    return limit


@dataclass(frozen=True)
class Conformity:
    """The decision on one kind of error, SI: by the rule of ISO 14253-1, with U = 2 sigma.

    U is how much the error varies between poses. It does not contain the device's own uncertainty.

    The robot passes if the error plus U is within the limit, and fails if the error minus U is
    beyond it. Between them nothing is decided.
    """

    kind: str
    error: float | None
    expanded_uncertainty: float | None
    limit: float

    @property
    def result(self) -> str:
        """`pass`, `fail` or `not decided`."""
        if self.error is None or self.expanded_uncertainty is None:
            return UNDECIDED
        if self.error + self.expanded_uncertainty <= self.limit:
            return PASS
        return FAIL if self.error - self.expanded_uncertainty > self.limit else UNDECIDED

    @property
    def description(self) -> str:
        """`position error 32.2 +- 2.8 um (U = 2 sigma, without the device), limit 50 um: pass`."""
        unit, factor = ERROR_UNITS[self.kind]
        shown = with_sigma(self.error, self.expanded_uncertainty, factor).replace("±", "+-")
        limit = f"limit {self.limit * factor:g} {unit}"
        if self.error is None:
            return f"{self.kind} error not known, {limit}: {self.result}"
        known = (
            "U = 2 sigma, without the device"
            if self.expanded_uncertainty is not None
            else "U not known"
        )
        return f"{self.kind} error {shown} {unit} ({known}), {limit}: {self.result}"

    def document(self) -> dict[str, Any]:
        return vars(self) | {"result": self.result}


def decide(
    stated: CertificateFields, errors: Summary, sigmas: Mapping[str, float]
) -> tuple[Conformity, ...]:
    """Decide for each stated limit whether the validation errors conform."""
    found = []
    for name, kind in LIMITS.items():
        limit = getattr(stated, name)
        if limit is not None:
            sigma = sigmas.get(kind)
            expanded = None if sigma is None else COVERAGE_FACTOR * sigma
            found.append(Conformity(kind, errors.rms(kind), expanded, limit / ERROR_UNITS[kind][1]))
    return tuple(found)
