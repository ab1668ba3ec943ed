"""Commands that make a model file and list mechanisms, effects and sensors."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.base.files import load_or_compute
from parallel_cal.base.units import PIXEL
from parallel_cal.cli.arguments import Json, Out
from parallel_cal.reporting import console

if TYPE_CHECKING:
    from parallel_cal.model.mechanism import Mechanism
    from parallel_cal.model.model import Model
    from parallel_cal.model.sensor import Sensor

PROBE = "probe"  # the sensor that touches a printer's bed, and its channel
ASSUMED_CLASS = (
    "class {}, because the file is that of a printer's firmware: errors of its drives are usually "
    "larger than those of industrial machines. --class states another one"
)
PARAMETER_FIELDS = ("name", "unit", "nominal", "tolerance", "group", "label")

Option = Annotated[
    list[str] | None, typer.Option(metavar="KEY=VALUE", help="option of the mechanism")
]

MechanismName = Annotated[
    str | None,
    typer.Argument(help="name from 'parallel-cal mechanisms'; omit it with --from"),
]
Configuration = Annotated[
    list[Path] | None,
    typer.Option(
        "--from",
        metavar="FILE",
        help="configuration of a controller (config.g, printer.cfg, ...), a URDF, or an MJCF, "
        "SDF or URDF with loops",
    ),
]
FromLink = Annotated[str, typer.Option(help="first link of the URDF [default: its root]")]
ToLink = Annotated[
    str,
    typer.Option(help="last link of the chain [default: the end link (leaf) that joints move]"),
]
BaseBody = Annotated[
    str,
    typer.Option(
        help="body, link or site of a closed chain that carries {B} [default: the floating "
        "body, or the root]"
    ),
]
PlatformBody = Annotated[str, typer.Option(help="body, link or site of a closed chain that is {P}")]
DrivenJoints = Annotated[
    str,
    typer.Option(
        metavar="JOINT,JOINT,...",
        help="joints of a closed chain with readings, in this order [default: those with "
        "actuators in the file]",
    ),
]
LockedJoints = Annotated[
    str,
    typer.Option(
        metavar="JOINT,JOINT,...",
        help="passive joints of a closed chain that do not move, such as stiff springs",
    ),
]
DriveOption = Annotated[
    str,
    typer.Option(
        metavar="{KEY: VALUE}",
        help="drive of all joints in m, such as '{kind: spool, radius: 0.05, gear: 10}': "
        "recorded angles of the motors are then converted to lengths",
    ),
]
SensorOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME: {KEY: VALUE}", help="measuring set-up, such as 'probe: {height: 0.3}'"
    ),
]
MachineClass = Annotated[
    str | None,
    typer.Option(
        "--class",
        metavar="CLASS",
        help="how large the errors of such a machine usually are: precision, industrial or "
        "hobby [default: hobby with the configuration of a printer's firmware, otherwise "
        "industrial]",
    ),
]


def new(
    output: Out,
    mechanism: MechanismName = None,
    configuration: Configuration = None,
    from_link: FromLink = "",
    to_link: ToLink = "",
    base: BaseBody = "",
    platform: PlatformBody = "",
    driven: DrivenJoints = "",
    locked: LockedJoints = "",
    option: Option = None,
    drive: DriveOption = "",
    sensor: SensorOption = None,
    machine_class: MachineClass = None,
    as_json: Json = False,
) -> None:
    """Write a model file. Its values are nominal, or those of a controller's configuration, of a
    URDF, or of an MJCF, an SDF or a URDF with loops (--from)."""
    from parallel_cal.importing.deltas import PROBE_NOISE_UNKNOWN
    from parallel_cal.model.file.modelfile import model_hash, replace_model
    from parallel_cal.model.machine_class import DEFAULT_CLASS, check_class

    if output.exists():
        raise ParallelCalError(f"{output}: file exists already; remove it or give another name")
    links, ends = (from_link, to_link), (base, platform, driven, locked)
    model, values, remarks = _make_model(mechanism, option, configuration or [], links, ends)
    if drive:
        model = _with_drive(model, drive)
    model = _with_set_ups(model, sensor or [])
    if machine_class is not None:
        model = replace(model, machine_class=check_class(machine_class))
    elif model.machine_class != DEFAULT_CLASS:
        remarks = (*remarks, ASSUMED_CLASS.format(model.machine_class))
    if configuration and PROBE in model.structure.channels_without_sigma:
        remarks = (*remarks, PROBE_NOISE_UNKNOWN)
    replace_model(model, output)
    document = {
        "file": str(output),
        "mechanism": model.mechanism.name,
        "class": model.machine_class,
        "hash": model_hash(model),
    }
    if as_json:
        return console.emit(document | {"parameters": len(model.table), "remarks": list(remarks)})
    name = mechanism or model.mechanism.name
    usual = "" if model.machine_class == DEFAULT_CLASS else f", class {model.machine_class}"
    console.say(f"{output}: {name}, {len(model.table)} parameters {values}{usual}")
    for remark in remarks:
        console.say(f"- {remark}")


def _get_urdf(mechanism: str | None, configuration: list[Path]) -> Path | None:
    """Return the URDF of a serial arm, by its ending or because the arm is called `serial`."""
    if len(configuration) != 1 or mechanism not in (None, "serial"):
        return None
    by_name = mechanism == "serial" or configuration[0].suffix.lower() in (".urdf", ".xacro")
    return configuration[0] if by_name else None


def _is_linkage(configuration: list[Path], stated: bool) -> bool:
    """Return whether the files describe a closed chain. A URDF without loops does, too, if the ends
    or the driven joints of a chain are stated."""
    from parallel_cal.importing.closed_chain import URDF_SUFFIXES, describes_linkage

    if not configuration:
        return False
    path, *others = configuration
    is_urdf = path.suffix.lower() in URDF_SUFFIXES
    return describes_linkage(path) or (is_urdf and (stated or len(others) == 1))


def _make_model(
    mechanism: str | None,
    options: list[str] | None,
    files: list[Path],
    links: tuple[str, str],
    ends: tuple[str, str, str, str],
) -> tuple[Model, str, tuple[str, ...]]:
    """Return the model, the origin of its numbers, and remarks on what the origin lacks.

    It is that of a closed chain, of a serial arm, of a mechanism, or of a controller. `links` are
    the first and the last one of an arm. `ends` are base and platform of a chain, and its driven
    and locked joints.
    """
    from parallel_cal.importing.closed_chain import chain
    from parallel_cal.importing.controller_files import configured
    from parallel_cal.importing.urdf import arm
    from parallel_cal.model.model import new_model

    if mechanism in (None, "chain") and _is_linkage(files, any(ends)):
        base, platform, *lists = ends
        driven, locked = ([*filter(None, text.split(","))] for text in lists)
        found = chain(files, base, platform, driven, locked, **parse_options(options))
        return found.model, f"as in {files[0]}", found.remarks
    if urdf := _get_urdf(mechanism, files):
        found = arm(urdf, *links, **parse_options(options))
        return found.model, f"as in {urdf}", found.remarks
    if (mechanism is None) == (not files) or (files and options) or any(links) or any(ends):
        raise typer.BadParameter(
            "expected a MECHANISM (and its options), or --from FILE; only a URDF, an MJCF or an "
            "SDF has links, driven joints and options"
        )
    if mechanism is not None:
        model = new_model(_mechanism(mechanism, options or []))
        return model, "at their nominal values", model.mechanism.remarks
    found = configured(files)
    return found.model, f"as in {', '.join(map(str, files))}", found.remarks


def _mechanism(name: str, options: list[str]) -> Mechanism:
    from parallel_cal.model.shelf import load_mechanism

    return load_mechanism(name, **parse_options(options))


def parse_options(options: list[str] | None) -> dict[str, Any]:
    """Parse `--option KEY=VALUE`, with the value as in a model file (YAML)."""
    from parallel_cal.model.file.yamltext import parse_yaml

    given: dict[str, Any] = {}
    for item in options or []:
        key, equals, text = item.partition("=")
        if not equals:
            raise ParallelCalError(f"--option {item}: expected KEY=VALUE")
        given[key] = parse_yaml(text, f"--option {key}").data
    return given


def _with_drive(model: Model, item: str) -> Model:
    """Give all joints the same drive, as a model file states it (YAML)."""
    from parallel_cal.model.file.modelfile import parse_model
    from parallel_cal.model.file.writer import dump_model
    from parallel_cal.model.file.yamltext import flow, parse_yaml

    document = parse_yaml(dump_model(model), "model").data
    for joint in document["joints"].values():
        joint["drive"] = parse_yaml(item, "--drive").data
    return parse_model(flow(document), "--drive")


def _with_set_ups(model: Model, items: list[str]) -> Model:
    """Add the sensors; omitted options keep the values of the controller's configuration.

    A camera measures in place of the probe that a configuration has, unless that is stated, too.
    """
    own = {sensor.name: sensor for sensor in model.sensors}
    known = {name: sensor.options for name, sensor in own.items()}
    stated = {sensor.name: sensor for sensor in (_sensor(item, known) for item in items)}
    if any(sensor.unit == PIXEL for sensor in stated.values()) and PROBE not in stated:
        own.pop(PROBE, None)
    return model.with_sensors(tuple((own | stated).values())) if items else model


def _sensor(item: str, known: Mapping[str, Mapping[str, Any]]) -> Sensor:
    """Parse `probe: {height: 0.3}`: a sensor and its options as in a model file (YAML).

    Omitted options have the values in `known`, by the name of the sensor.
    """
    from parallel_cal.model.file.sensoroptions import read_sensor
    from parallel_cal.model.file.yamltext import parse_yaml

    document = parse_yaml(item, "--sensor")
    data = {document.data: {}} if isinstance(document.data, str) else document.data
    if isinstance(data, dict) and len(data) == 1:
        [(name, options)] = data.items()
        if isinstance(options, dict):
            return read_sensor(document, (name,), name, {**known.get(name, {}), **options})
    raise ParallelCalError(f"--sensor {item}: expected 'NAME' or 'NAME: {{KEY: VALUE, ...}}'")


def mechanisms(
    name: Annotated[
        str | None,
        typer.Argument(help="name of a mechanism, or the Python path of your own"),
    ] = None,
    option: Option = None,
    as_json: Json = False,
) -> None:
    """List the mechanisms. With the name of one, list its joints and parameters and state whether
    they can describe every geometric error."""
    if name is not None:
        return _print_mechanism(name, option or [], as_json)
    rows = _rows("mechanisms", _mechanism_row)
    if as_json:
        return console.emit({"mechanisms": rows})
    header = ("mechanism", "joints", "parameters", "controls", "description")
    console.table(
        header,
        [
            (
                r["name"],
                str(len(r["joints"]) or "-"),
                str(r["parameters"] or "-"),
                " ".join(r["controls"]),
                r["description"],
            )
            for r in rows
        ],
    )


def _print_mechanism(name: str, options: list[str], as_json: bool) -> None:
    """Print the parameters, and how many a complete model has (eq. 3.3)."""
    from parallel_cal.identification.completeness import compute_completeness
    from parallel_cal.model.mechanism import Mechanism
    from parallel_cal.model.shelf import load_class, options_of
    from parallel_cal.reporting.readable import in_unit

    cls = load_class("mechanisms", name, Mechanism)
    given = parse_options(options)
    needed = [one for one in options_of(cls) if "=" not in one and one not in given]
    if needed and not as_json:
        _print_description(name, cls)
        console.say(f"To list its joints and parameters, pass --option {needed[0]}=...")
        return
    m = _mechanism(name, options)
    counted = compute_completeness(m)
    if as_json:
        numbers = [{k: getattr(p, k) for k in PARAMETER_FIELDS} for p in m.parameters]
        return console.emit(
            _row(name, type(m), m) | {"parameters": numbers, "completeness": counted.document()}
        )
    _print_description(name, type(m))
    joints = zip(m.joints, m.joint_units, strict=True)
    console.say("joints: " + ", ".join(f"{joint} [{unit}]" for joint, unit in joints))
    console.say(f"moves {' '.join(m.moves)}; controls {' '.join(m.controls)}")
    rows = []
    for p in m.parameters:
        value, unit = in_unit(p.nominal, p.unit)
        rows.append((p.name, value, in_unit(p.tolerance, p.unit)[0], unit, p.label))
    console.table(("parameter", "nominal", "tolerance", "unit", ""), rows)
    console.say(counted.sentence)


def _print_description(name: str, cls: type) -> None:
    """Print what a mechanism is, and its options."""
    console.say(f"{name}: {_sentence(sys.modules[cls.__module__].__doc__)}")
    _, found, described = (inspect.getdoc(cls) or "").partition("\n\nOptions")
    if found:
        console.say(f"\nOptions{described}\n")


def _rows(shelf: str, row: Callable[[str], dict[str, Any]]) -> list[dict[str, Any]]:
    """Make a row for each file on a shelf.

    The rows are cached until a source file changes, because building them takes longest.
    """

    def rows() -> list[dict[str, Any]]:
        from parallel_cal.model.shelf import list_plugins

        return [row(name) for name in list_plugins(shelf)]

    rooms = [Path(__file__).parents[1] / room for room in ("base", "model", shelf)]
    sources = sorted(path for room in rooms for path in room.rglob("*.py"))
    return load_or_compute([Path(__file__), *sources], rows)


def _mechanism_row(name: str) -> dict[str, Any]:
    from parallel_cal.model.mechanism import Mechanism
    from parallel_cal.model.shelf import load_class, options_of

    cls: Any = load_class("mechanisms", name, Mechanism)
    options = options_of(cls)
    # A mechanism that needs options cannot be built here.
    return _row(name, cls, None if any("=" not in option for option in options) else cls())


def _row(name: str, cls: Any, m: Mechanism | None) -> dict[str, Any]:
    from parallel_cal.model.shelf import options_of

    return {
        "name": name,
        "joints": list(m.joints) if m else [],
        "joint_units": list(m.joint_units) if m else [],
        "parameters": len(m.parameters) if m else None,
        "moves": list(m.moves if m else cls.moves),
        "controls": list(m.controls if m else cls.controls),
        "options": options_of(cls),
        "description": _sentence(sys.modules[cls.__module__].__doc__),
    }


def _sentence(doc: str | None) -> str:
    return (doc or "").strip().split("\n\n")[0].replace("\n", " ")


def effects(as_json: Json = False) -> None:
    """List the physical effects. The tables state the conditions that they need, and their
    lookalikes."""
    rows = _rows("effects", _effect_row)
    if as_json:
        return console.emit({"effects": rows})
    console.table(
        ("effect", "needs", "description"),
        [(r["name"], " ".join(r["needs"]) or "-", r["physics"]) for r in rows],
    )
    console.say("")
    console.table(
        ("effect", "resembles", "distinguished by"),
        [
            (r["name"], ", ".join(r["lookalikes"]), r["separated_by"])
            for r in rows
            if r["lookalikes"]
        ],
    )


def _effect_row(name: str) -> dict[str, Any]:
    from parallel_cal.model.shelf import load_effect

    e = load_effect(name)
    return {
        "name": name,
        "needs": list(e.needs),
        "given": list(e.fixed),
        "physics": e.physics,
        "remedy": e.remedy,
        "source": e.source,
        "lookalikes": list(e.lookalikes),
        "separated_by": e.separated_by,
    }


def sensors(as_json: Json = False) -> None:
    """List the measuring set-ups and their options. A device that measures poses needs none of
    them."""
    rows = _rows("sensors", _sensor_row)
    if as_json:
        return console.emit({"sensors": rows})
    console.table(
        ("sensor", "options", "description"),
        [
            # An option is listed as NAME=DEFAULT.
            (r["name"], ", ".join(o.partition("=")[0] for o in r["options"]), r["physics"])
            for r in rows
        ],
    )


def _sensor_row(name: str) -> dict[str, Any]:
    from parallel_cal.model.sensor import Sensor
    from parallel_cal.model.shelf import load_class, options_of

    cls: Any = load_class("sensors", name, Sensor)
    return {
        "name": name,
        "options": options_of(cls),
        "physics": cls.physics,
        "source": cls.source,
    }
