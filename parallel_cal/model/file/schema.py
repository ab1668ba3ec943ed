"""The shape of a model file (pydantic); checks.py checks its values."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    JsonValue,
    Tag,
    ValidationError,
)

from parallel_cal.base.errors import format_suggestion
from parallel_cal.model.file.yamltext import Document, Path
from parallel_cal.model.machine_class import DEFAULT_CLASS, MachineClass

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
VARIANTS = ("<one number>", "<numbers by name>")  # pydantic adds them to the path of an error
NumberOrNumbers = Annotated[
    Annotated[NotNegative | None, Tag(VARIANTS[0])]
    | Annotated[dict[str, NotNegative], Tag(VARIANTS[1])],
    Discriminator(lambda value: VARIANTS[isinstance(value, dict)]),
]
Vector = Annotated[list[float], Field(min_length=3, max_length=3)]
Quaternion = Annotated[list[float], Field(min_length=4, max_length=4)]


class Part(BaseModel):
    """Strict: a number is a number, an unknown key is an error."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)


class MechanismPart(Part):
    """The mechanism and the options of its class (a number of legs)."""

    name: str
    options: dict[str, Any] = {}


class DrivePart(Part):
    """The drive of a joint whose readings are lengths (m).

    `per_rev` is the travel of the joint per turn of the motor. Instead of it, `radius` states that
    of the spool or pulley.
    """

    kind: Literal["spool", "screw", "belt"]
    per_rev: float | None = None
    radius: Positive | None = None
    gear: Positive = 1.0
    advantage: Positive = 1.0
    line: Literal["out", "in"] = "out"


class JointPart(Part):
    """One joint; its key is its name in joint_states.

    Limits are in its unit; None means endless. `velocity` and `acceleration` are the limits of
    joint commands, per s and s^2. `gearing` is the reading per unit of the joint behind the gear.
    """

    unit: str
    low: float | None = None
    high: float | None = None
    velocity: Positive | None = None
    acceleration: Positive | None = None
    gearing: Positive = 1.0
    drive: DrivePart | None = None


class HomePart(Part):
    """A configuration of the assembly mode in which the robot works (m, rad, x y z w)."""

    joints: list[float]
    position: Vector
    quaternion: Quaternion
    passive: list[float] = []  # of a mechanism with passive coordinates; default: its own


class WorkspacePart(Part):
    """The box of controlled coordinates from which poses are drawn (m, rad)."""

    low: list[float]
    high: list[float]


class BoxPart(Part):
    """A box in {B} that no part of the robot may enter (m)."""

    low: Vector
    high: Vector


class FramesPart(Part):
    """Names of {B} and {P} in messages."""

    base: str
    platform: str


class NoisePart(Part):
    """Measurement noise, 1 sigma: rad or m, m, rad; null = unknown."""

    joint: NotNegative | None = None
    position: NotNegative | None = None
    orientation: NotNegative | None = None


class ModelNoisePart(NoisePart):
    """The noise with which a model is fitted, and whether it is assumed, not measured.

    The noise of joints is one value, or values by unit or by joint.
    """

    joint: NumberOrNumbers = None  # type: ignore[assignment]
    assumed: bool = False


class NumberPart(Part):
    """One number of a model."""

    value: float
    unit: str
    sigma: NotNegative | None = None
    fixed: bool = False


class OwnNumberPart(NumberPart):
    """One parameter of an effect or a sensor; `tolerance` if it differs from the catalogue,
    `usual_tolerance` if a fit raised it, because the value is larger than usual."""

    tolerance: Positive | None = None
    usual_tolerance: Positive | None = None


class ParameterPart(NumberPart):
    """One parameter of the mechanism; `nominal` if it differs from the value, `usual_tolerance` if
    a fit raised the tolerance, because the drawing is wrong."""

    nominal: float | None = None
    tolerance: Positive
    usual_tolerance: Positive | None = None


class EffectPart(Part):
    """One effect; the order in the file is the order in which they apply."""

    name: str
    parameters: dict[str, OwnNumberPart]


class SensorPart(Part):
    """One measuring set-up besides the pose device: fields, and parameters (None: nominal)."""

    name: str
    options: dict[str, Any] = {}
    parameters: dict[str, OwnNumberPart] | None = None


class CovariancePart(Part):
    """Covariance of the estimated parameters: names, and the lower triangle row by row."""

    names: list[str]
    lower: list[list[float]]


def _named(value: Any) -> Any:
    """`mechanism: delta54` is short for `mechanism: {name: delta54}`."""
    return {"name": value} if isinstance(value, str) else value


class FilePart(Part):
    """A whole model file."""

    parallel_cal: Literal[1]
    mechanism: Annotated[MechanismPart, BeforeValidator(_named)]
    joints: dict[str, JointPart]
    home: HomePart | None = None
    workspace: WorkspacePart | None = None
    keep_out: list[BoxPart] = []
    frames: FramesPart = FramesPart(base="base", platform="platform")
    gravity: Vector | None = None
    noise: ModelNoisePart = ModelNoisePart()
    parameters: dict[str, ParameterPart]
    effects: list[EffectPart] = []
    sensors: list[SensorPart] = []
    machine_class: Annotated[MachineClass, Field(alias="class")] = DEFAULT_CLASS
    tolerances: dict[str, Positive] = {}
    covariance: CovariancePart | None = None
    history: list[dict[str, JsonValue]] = []


# Position of a key -> the part whose keys are known there; `*` is any name or number.
KNOWN: dict[Path, type[Part]] = {
    (): FilePart,
    ("mechanism",): MechanismPart,
    ("joints", "*"): JointPart,
    ("joints", "*", "drive"): DrivePart,
    ("home",): HomePart,
    ("workspace",): WorkspacePart,
    ("keep_out", "*"): BoxPart,
    ("frames",): FramesPart,
    ("noise",): ModelNoisePart,
    ("parameters", "*"): ParameterPart,
    ("effects", "*"): EffectPart,
    ("effects", "*", "parameters", "*"): OwnNumberPart,
    ("sensors", "*"): SensorPart,
    ("sensors", "*", "parameters", "*"): OwnNumberPart,
    ("covariance",): CovariancePart,
}

EXPECTED = {
    "float_type": "expected a number",
    "finite_number": "expected a finite number",
    "string_type": "expected text",
    "bool_type": "expected true or false",
    "list_type": "expected a list [..]",
    "dict_type": "expected a mapping with keys",
    "model_type": "expected a mapping with keys",
    "greater_than": "expected a number above 0",
    "greater_than_equal": "expected 0 or more",
    "too_short": "too few values",
    "too_long": "too many values",
}


def validate(document: Document, hint: Any) -> FilePart:
    """Check the structure of a document; ModelFileError for the first error.

    `hint(path)` describes the expected value at a path ("m, 0.066 to 0.086").
    """
    try:
        return FilePart.model_validate(document.data)
    except ValidationError as error:
        errors = error.errors(include_url=False)
        first = errors[0]
        if first["type"] == "missing":
            # A misspelt key is missing and unknown: only "unknown" comes with a suggestion.
            unknown = (e for e in errors if e["type"] == "extra_forbidden")
            first = next((e for e in unknown if e["loc"][:-1] == first["loc"][:-1]), first)
        path = tuple(step for step in first["loc"] if step not in VARIANTS)
        more = f" (and {len(errors) - 1} more)" if errors[1:] else ""
        raise document.error(path, sentence(first, path) + hint(path) + more) from None


def sentence(error: Any, path: Path) -> str:
    """Describe pydantic's error in the value at a path."""
    kind = error["type"]
    if kind == "extra_forbidden":
        return "unknown key" + suggestion(str(path[-1]), _known_at(path[:-1]))
    if kind == "missing":
        return "this key is missing"
    value = error["input"]
    if isinstance(value, (dict, list)):
        value = f"{type(value).__name__} of {len(value)}"
    message = error["msg"].removeprefix("Value error, ")  # which pydantic puts before ours
    return f"{EXPECTED.get(kind, message)}, found {value!r}"


def _known_at(path: Path) -> list[str]:
    for pattern, part in KNOWN.items():
        if len(pattern) == len(path) and all(
            a in ("*", b) for a, b in zip(pattern, path, strict=True)
        ):
            return [field.alias or name for name, field in part.model_fields.items()]
    return []


def suggestion(word: str, known: list[str]) -> str:
    """Suggest the nearest known words, or else list the first ones."""
    if near := format_suggestion(word, known):
        return near
    return f"; expected one of {', '.join(known[:24])}" if known else ""
