"""Calibrate the real machines in `real/` with the tool and with independent fits, and write
docs/real_machines.md: `python -m bench.truth.real_machines [NAME ...]`.

Each set is divided once into poses for fitting and poses that neither the tool nor the independent
fit sees. All errors are at the latter. The results are kept in docs/real_machines.json;
`python -m bench.truth.real_machines page` writes the page from them and calibrates nothing.
"""

from __future__ import annotations

import contextlib
import io
import json
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import virtual_arm
from arms import AXES, ROWS
from scipy.spatial.transform import Rotation

import parallel_cal as pc
from bench.truth import independent_fits as own
from parallel_cal.base.documents import to_json_value
from parallel_cal.cli import main as cli
from parallel_cal.recordings.loading import load_dataset

ROOT = Path(__file__).parents[2]
REAL = ROOT / "real"
PAGE, RESULTS = ROOT / "docs" / "real_machines.md", ROOT / "docs" / "real_machines.json"
HELD_OUT = 0.25
MAX_EFFECTS = 6  # rounds of diagnose and add

Array = np.ndarray

# Stated revolutions per millimetre of the six strings.
TURNS_PER_MM = (0.01321144, 0.0140456, 0.0138233, 0.014124109, 0.01416007, 0.01403256)


@dataclass(frozen=True)
class HandWork:
    """What an owner did by hand from the published files to the first fit.

    `commands` of parallel-cal, `lines` written into files, and `minutes` by the clock of one
    session (`HAND_WORK_NOTE` says which).
    """

    commands: int
    lines: int
    minutes: int
    what: str


HAND_WORK = {
    "jugglebot": HandWork(
        2,
        9,
        5,
        "`new stewart42` with two radii, twelve angles and a height; a column map with the travel "
        "per turn of each motor. Six more lines, the `drive` of each joint, before the effects of "
        "spools can be tested",
    ),
    "ur5": HandWork(
        2,
        16,
        2,
        "a list of 7 links, a column map of 8 lines, and one line (awk) that adds the published "
        "columns *target* and *measured minus target*",
    ),
    "wam": HandWork(
        2,
        18,
        2,
        "as for the UR5, with 8 links and a column map of 9 lines",
    ),
    "hangprinter_hp4": HandWork(
        2,
        6,
        2,
        "`new cable` with the anchors, the radius, the gear ratio and the advantages; a column "
        "map. The first attempt was refused: the joints were called line1 to line4 instead of "
        "motor1 to motor4. (`mechanisms cable` did not name the joints then; now it does)",
    ),
    "d300vs": HandWork(
        4, 0, 3, "`new --from`, `import`, `fit` and `export --into`; no drawing and no table"
    ),
}

HAND_WORK_NOTE = """## Work of the user

The machines were tried once as a new user would (November 2026): from the files as they were
published, with the documents of this repository and without the files in
[real/](../real/README.md). The minutes are from the first look at the data to the printed errors of
the first fit (for the printer: to the written configuration). They contain the run times of the
commands on two busy cores, which are most of them for the arms and the printer. The minutes of the
two arms were measured together and halved. The documents and files were known before: who reads
them for the first time is slower, so compare the counts. Each further step is one command
(`diagnose` or `add`); the sections list these steps."""


@dataclass
class Machine:
    """A machine, and what was found; errors in m."""

    name: str
    title: str
    unit: str
    samples: int = 0
    registered: float = np.nan
    geometry: float = np.nan
    effects: list[str] = field(default_factory=list)
    with_effects: float | None = None
    own: dict[str, float] = field(default_factory=dict)
    means: dict[str, float] = field(default_factory=dict)  # of the last model, beside the rms
    seconds: dict[str, float] = field(default_factory=dict)
    promised: float | None = None  # by `export`: the rms height at all touches
    notes: list[str] = field(default_factory=list)


def split(n: int) -> tuple[Array, Array]:
    """Return the indices for fitting, and those of the held-out poses."""
    order = np.random.default_rng(0).permutation(n)
    count = round(HELD_OUT * n)
    return np.sort(order[count:]), np.sort(order[:count])


def read(model: pc.Model, table: Path, columns: Path) -> pc.Dataset:
    return load_dataset(table, mechanism=model.mechanism, columns=str(columns))


def timed(machine: Machine, name: str, work: Callable[[], Any]) -> Any:
    began = time.perf_counter()
    found = work()
    seconds = time.perf_counter() - began
    machine.seconds[name] = max(machine.seconds.get(name, 0.0), seconds)
    return found


def calibrate(machine: Machine, model: pc.Model, data: pc.Dataset) -> pc.Model:
    """Fit, then diagnose and add until nothing is named; note the errors at held-out poses."""
    training, held_out = (data.select(index) for index in split(len(data)))

    def error_of(model: pc.Model) -> float:
        summary = pc.compare(model, held_out).errors.summary
        machine.means["parallel_cal"] = float(summary.position_mean)
        return float(summary.position_rms)

    machine.samples = len(data)
    machine.registered = error_of(model)
    fitted = timed(machine, "fit", lambda: pc.fit(model, training))
    machine.geometry = error_of(fitted.model)
    model = fitted.model
    for _ in range(MAX_EFFECTS):
        found = timed(machine, "diagnose", lambda model=model: pc.diagnose(model, training))
        machine.notes.append(f"{found.verdict.word}: {found.verdict.summary}")
        if not found.additions:
            break
        # One by one in the order named; if one of them helps only with the others, together.
        waiting = list(found.additions)
        while waiting:
            try:
                step = timed(machine, "add", lambda: pc.add(model, waiting[0], training))
                taken = waiting[:1]
            except pc.FitError:
                together = "+".join(waiting)
                try:
                    step = timed(machine, "add", lambda: pc.add(model, together, training))
                    taken = waiting
                except pc.FitError as error:
                    machine.notes.append(f"`add {together}` refused: {error}")
                    machine.with_effects = error_of(model)
                    return model
            model = step.model
            machine.effects += taken
            waiting = waiting[len(taken) :]
    machine.with_effects = error_of(model)
    return model


def note_independent_fit(machine: Machine, label: str, errors: Array) -> None:
    """Note the rms of the independent fit's position errors (N, 3), and their mean if it is the
    last fit."""
    machine.own[label] = own.rms(errors)
    machine.means["independent"] = float(np.linalg.norm(errors, axis=1).mean())


def jugglebot(folder: Path) -> Machine:
    """Calibrate the hexapod on strings."""
    machine = Machine(
        "jugglebot",
        "Jugglebot, hexapod on strings and spools",
        "mm",
    )
    source = REAL / "jugglebot"
    model = pc.read_model(source / "model.yaml")
    calibrate(machine, model, read(model, source / "poses_108.csv", source / "columns.yaml"))
    table = np.genfromtxt(source / "poses_108.csv", delimiter=",", names=True)
    turns = np.stack([table[f"leg_length_{i + 1}"] for i in range(6)], axis=1)
    r = 1e-3 * np.stack([table[f"position_{a}"] for a in "xyz"], axis=1)
    R = Rotation.from_quat(
        np.stack([table[f"orientation_{a}"] for a in "xyzw"], axis=1)
    ).as_matrix()
    start = own.hexapod_start(*jugglebot_drawing())
    per_turn = 1e-3 / np.array(TURNS_PER_MM)
    fitting, held_out = split(len(r))
    for label, free in (
        ("geometry", 42),
        ("with a gain of each leg", 48),
        ("with gain and bend of each leg", 54),
    ):
        p = own.fit_hexapod(start, free, turns[fitting], per_turn, r[fitting], R[fitting])
        errors = own.hexapod_errors(p, turns[held_out], per_turn, r[held_out], R[held_out])
        note_independent_fit(machine, label, errors)
    return machine


def jugglebot_angles() -> tuple[list[float], list[float]]:
    """Return the angles of base and platform joints in degrees, as the builders state them."""
    leg = np.arange(6)
    turns, pairs = leg // 2, (leg + 1) // 2
    base = 200.0 + 100 * turns + 20 * pairs
    platform = 154.3012223 + 8.6024446 * turns + 111.3975554 * pairs
    return base.tolist(), platform.round(7).tolist()


def jugglebot_drawing() -> tuple[Array, Array, float]:
    def ring(radius: float, degrees: Sequence[float]) -> Array:
        a = np.radians(degrees)
        return radius * np.stack([np.cos(a), np.sin(a), 0 * a], axis=1)

    base, platform = (
        ring(radius, angles)
        for radius, angles in zip((0.41, 0.219075), jugglebot_angles(), strict=True)
    )
    return base, platform, float(np.linalg.norm(platform[0] + [0, 0, 0.565] - base[0]))


def arm(kind: str, title: str, folder: Path) -> Machine:
    """Calibrate a serial arm from positions of one reflector."""
    machine = Machine(
        kind,
        title,
        "um",
    )
    source = REAL / "laser_arms"
    model = pc.read_model(source / f"{kind}.yaml")
    calibrate(machine, model, read(model, source / f"{kind}.csv", source / f"{kind}.columns.yaml"))
    table = np.genfromtxt(source / f"{kind}.csv", delimiter=",", names=True)
    n = len(ROWS[kind])
    q = np.radians(np.stack([table[f"joint_{i + 1}"] for i in range(n)], axis=1))
    r = 1e-3 * np.stack([table[f"{a}_mm"] for a in "xyz"], axis=1)
    fitting, held_out = split(len(r))
    cases: list[tuple[str, dict[str, Any]]] = [
        ("registered only", {"frames_only": True}),
        ("geometry", {}),
    ]
    if kind == "ur5":
        cases.append(("with harmonics 2, 3 and 13 of each joint", {"harmonics": (2, 3, 13)}))
    for label, options in cases:
        p = own.fit_arm(ROWS[kind], q[fitting], r[fitting], **options)
        computed = own.arm_positions(p, ROWS[kind], q[held_out], options.get("harmonics", ()))
        note_independent_fit(machine, label, computed - r[held_out])
    return machine


def hangprinter(folder: Path) -> Machine:
    """Calibrate the cable robot."""
    machine = Machine(
        "hangprinter_hp4",
        "Hangprinter HP4, cable robot with four lines",
        "mm",
    )
    source = REAL / "hangprinter_hp4"
    model = pc.read_model(ROOT / "config" / "hangprinter_hp4.yaml")
    columns = ROOT / "config" / "columns" / "hangprinter_hp4.yaml"
    calibrate(machine, model, read(model, source / "hp4_2021-12-14.csv", columns))
    table = np.genfromtxt(source / "hp4_2021-12-14.csv", delimiter=",", names=True)
    motors = np.radians(np.stack([table[f"motor{c}_deg"] for c in "ABCD"], axis=1))
    r = 1e-3 * np.stack([table[f"{a}_mm"] for a in "xyz"], axis=1)
    anchors = np.array([(0, -1.6, -0.11), (1.3, 1.25, -0.15), (-1.44, 0.74, -0.16), (0, 0, 2.345)])
    pay_out = 20 / 255 / np.array([2, 2, 2, 4])
    fitting, held_out = split(len(r))
    for label, bend in (("geometry", False), ("with spools that shrink", True)):
        p = own.fit_cable_robot(anchors, 0.075, pay_out, motors[fitting], r[fitting], bend)
        errors = own.cable_robot_errors(p, pay_out, motors[held_out], r[held_out])
        note_independent_fit(machine, label, errors)
    return machine


def d300vs(folder: Path) -> Machine:
    """Calibrate the printer by the commands of docs/delta_printer.md.

    Errors are heights at the touches by the firmware's formula; there is no other device.
    """
    machine = Machine(
        "d300vs",
        "UltiBots D300VS, delta printer and its own bed probe",
        "um",
    )
    for name in ("config.g", "config-override.g", "heightmap.csv"):
        shutil.copy(REAL / "d300vs" / name, folder)
    configuration = [folder / "config.g", folder / "config-override.g"]
    new = [word for path in configuration for word in ("--from", path)]
    into = [word for path in configuration for word in ("--into", path)]
    model, touches, fitted = (folder / n for n in ("m.yaml", "touches.json", "fitted.yaml"))

    def calibrated() -> str:
        run("new", *new, "-o", model)
        run("import", "rrf", folder / "heightmap.csv", *configuration, "-o", touches)
        run("fit", model, touches, "-o", fitted)
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            run("export", fitted, "--to", "rrf", *into, "--touches", touches, "--json")
        return printed.getvalue()

    document = json.loads(timed(machine, "new, import, fit and export", calibrated))
    heights = document["heights"]
    machine.samples = heights["touches"]
    machine.registered, machine.geometry = heights["before"], heights["held_out"]
    machine.promised = heights["after"]
    moved = 1e3 * document["movement"]["largest"]
    machine.notes.append(
        f"`export`: rms height error at all touches, also those of the fit: "
        f"{1e6 * heights['before']:.1f} -> "
        f"{1e6 * heights['after']:.1f} um; x and y change by at most {moved:.2f} mm"
    )
    given, places = own.read_d300vs(REAL / "d300vs" / "heightmap.csv")
    unseen = np.empty(len(places))
    folds = np.random.default_rng(0).permutation(len(places)) % 4
    for fold in range(4):
        p = own.fit_printer(given, range(9), places[folds != fold])
        unseen[folds == fold] = own.printer_heights(p, given, places[folds == fold])
    machine.own["geometry"] = own.rms(unseen)
    return machine


MACHINES: dict[str, Callable[[Path], Machine]] = {
    "jugglebot": jugglebot,
    "ur5": lambda folder: arm("ur5", "UR5, serial arm and laser tracker", folder),
    "wam": lambda folder: arm("wam", "Barrett WAM, serial arm and laser tracker", folder),
    "hangprinter_hp4": hangprinter,
    "d300vs": d300vs,
}


def run(*arguments: object) -> None:
    """Run a command of parallel-cal; its failure ends this program."""
    try:
        cli.main([str(a) for a in arguments])
    except SystemExit as ended:
        if ended.code:
            raise


def write_models() -> None:
    """Write the model files and column maps in `real/` as an owner makes them."""
    base, platform = jugglebot_angles()
    run(
        "new",
        "stewart42",
        *("--option", f"base={{radius: 0.41, angles: {base}}}"),
        *("--option", f"platform={{radius: 0.219075, angles: {platform}}}"),
        *("--option", "height=0.565", "--option", "limits=[0, 0.3]", "--option", "tolerance=0.02"),
        *("-o", REAL / "jugglebot" / "model.yaml"),
    )
    # The builders state the travel of each string for a turn of its motor.
    text = (REAL / "jugglebot" / "model.yaml").read_text()
    for i, turns in enumerate(TURNS_PER_MM, start=1):
        drive = f"drive: {{kind: spool, per_rev: {1e-3 / turns:.7f}, line: in}}"
        text = text.replace(f"leg{i}: {{unit: m,", f"leg{i}: {{unit: m, {drive},")
    (REAL / "jugglebot" / "model.yaml").write_text(text)
    legs = "".join(f"  leg{i}: {{column: leg_length_{i}, unit: rev}}\n" for i in range(1, 7))
    columns = (
        "# Motor revolutions since homing, and the platform by motion capture.\n"
        f"joints:\n{legs}"
        "position: {columns: [position_x, position_y, position_z], unit: mm}\n"
        "orientation: [orientation_x, orientation_y, orientation_z, orientation_w]\n"
    )
    (REAL / "jugglebot" / "columns.yaml").write_text(columns)
    for kind, rows in ROWS.items():
        links = ["- {joint: null, axes: coincident}"]
        for (a, d, alpha), axes in zip(rows, [*AXES[kind], None], strict=True):
            ends = f", axes: {axes}" if axes else ""
            links.append(f"- {{joint: R, a: {a}, d: {d}, alpha: {alpha}{ends}}}")
        run(
            "new",
            "serial",
            *("--option", "links=" + "\n".join(links)),
            *("--option", f"home={list(virtual_arm.HOME[kind])}"),
            *("-o", REAL / "laser_arms" / f"{kind}.yaml"),
        )
        joints = "".join(
            f"  joint{i + 1}: {{column: joint_{i + 1}, unit: deg}}\n" for i in range(len(rows))
        )
        (REAL / "laser_arms" / f"{kind}.columns.yaml").write_text(
            "# Joint angles, and the positions of one reflector by a laser tracker.\n"
            f"joints:\n{joints}position: {{columns: [x_mm, y_mm, z_mm], unit: mm}}\n"
        )


INTRODUCTION = """# Real machines

How well does parallel_cal calibrate machines that others built and measured? This page gives
the answer for each data set in [real/](../real/README.md) and compares it with an independent fit
(`bench/truth/independent_fits.py`), which uses scipy, its own kinematics and no code of this
package. `make real` produces this page.

Each set is divided once: three quarters of the poses are for fitting, one quarter is for judging.
Neither the tool nor the independent fit sees the poses for judging. All errors in the table are rms
position errors at the poses for judging; the sections also state their mean. The printer is an
exception: its errors are height errors at the touches of the bed, computed by the firmware's
formula. Each touch is judged once, in a four-fold cross-validation.

The sections quote the messages of `diagnose` and `add`. The "held-out poses" in these messages are
not the poses for judging: `diagnose` holds them out of the poses for fitting, in a cross-validation
of its own. Its errors therefore differ from those in the table.

- **registered**: the dimensions that the maker states; only the frames of device and target are
  estimated, if it is proven that they are not where the model says (for the Hangprinter it is not:
  other anchors explain as much). For the printer: the values in its firmware configuration.
- **geometry**: `fit`.
- **with effects**: `diagnose` and `add` until the diagnosis names no effect, or `add` refuses those
  that it names. An effect of the device (`device_field`) removes errors of the device, not of the
  machine.
- **independent geometry**: the independent fit, with the unknowns of *geometry*.
- **independent with effects**: the independent fit, with the effects in brackets. These are not
  always the effects that parallel_cal found.
"""

TARGETS_NOTE = """## Targets

The table compares the errors above with those of the independent fit: negative is better. The
target is at most 5 % worse in every row. Its last column states the other targets, which were set
for single machines before these results were known."""

MAX_EXCESS = 0.05  # of an error over that of the independent fit

HEADER = [
    "machine",
    "poses",
    "registered",
    "geometry",
    "independent geometry",
    "with effects",
    "independent with effects",
]


TARGETS_HEADER = ["machine", "geometry", "with effects", "within 5 %", "own target"]
HAND_WORK_HEADER = ["machine", "commands", "lines", "minutes", "what"]


def make_page(results: dict[str, dict[str, Any]]) -> str:
    """Make the text of docs/real_machines.md from the kept results."""
    machines = [Machine(**results[name]) for name in MACHINES if name in results]
    parts = [
        INTRODUCTION,
        _table([HEADER, *(_row(machine) for machine in machines)]),
        TARGETS_NOTE,
        _table([TARGETS_HEADER, *(_target_row(machine) for machine in machines)]),
        HAND_WORK_NOTE,
        _table([HAND_WORK_HEADER, *(_hand_work_row(machine) for machine in machines)]),
        *(_section(machine) for machine in machines),
    ]
    return "\n\n".join(part.strip() for part in parts) + "\n"


def _table(rows: Sequence[Sequence[str]]) -> str:
    lines = [rows[0], ["---"] * len(rows[0]), *rows[1:]]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def excess(machine: Machine) -> dict[str, float]:
    """By how much the errors exceed those of the independent fit, as a share; by the kind of
    model."""
    last = list(machine.own)[-1]
    found = {"geometry": machine.geometry / machine.own["geometry"] - 1}
    if machine.with_effects is not None and last != "geometry":
        found["with effects"] = machine.with_effects / machine.own[last] - 1
    return found


def own_target(machine: Machine) -> tuple[str, bool] | None:
    """The target that was set for one machine, with what was reached, and whether it is met."""
    if machine.name == "jugglebot":
        assert machine.with_effects is not None
        bends = "spool_buildup" in machine.effects or "screw_pitch_error" in machine.effects
        gain = "encoder_gain" in machine.effects
        rest = "`spool_buildup`, which bends each reading by its square" if bends else "nothing"
        return (
            f"gain {'found' if gain else 'not found'}; rms error "
            f"{_length(machine, machine.with_effects)} (at most 1.15 mm); named for what the gain "
            f"leaves: {rest}",
            gain and bends and machine.with_effects <= 1.15e-3,
        )
    if machine.name == "ur5":
        mean = machine.means["parallel_cal"]
        return f"mean error {_length(machine, mean)} (at most 62 um)", mean <= 62e-6
    if machine.name == "d300vs":
        words = (
            f"`export` promises {_length(machine, machine.promised)} at all touches (not less than "
            "43 um, the best of an independent fit)"
        )
        return words, machine.promised is not None and machine.promised >= 43e-6
    return None


def _target_row(machine: Machine) -> list[str]:
    shares = excess(machine)
    own_one = own_target(machine)
    met = max(shares.values()) <= MAX_EXCESS
    return [
        _link(machine),
        *(
            f"{round(100 * shares[kind], 1) + 0.0:+} %" if kind in shares else "-"
            for kind in ("geometry", "with effects")
        ),
        "yes" if met else "**no**",
        f"{own_one[0]}: {'met' if own_one[1] else '**not met**'}" if own_one else "-",
    ]


def _hand_work_row(machine: Machine) -> list[str]:
    work = HAND_WORK[machine.name]
    return [_link(machine), str(work.commands), str(work.lines), str(work.minutes), work.what]


def _row(machine: Machine) -> list[str]:
    cases = list(machine.own)
    geometry = machine.own.get("geometry", np.nan)
    last = machine.own[cases[-1]]
    return [
        _link(machine),
        str(machine.samples),
        *(
            _length(machine, value)
            for value in (machine.registered, machine.geometry, geometry, machine.with_effects)
        ),
        f"{_length(machine, last)} ({cases[-1]})" if cases[-1] != "geometry" else "-",
    ]


def _link(machine: Machine) -> str:
    return f"[{machine.title}](#{machine.name.replace('_', '-')})"


def _length(machine: Machine, metres: float | None) -> str:
    if metres is None:
        return "-"
    scale, digits = {"mm": (1e3, 2), "um": (1e6, 0)}[machine.unit]
    return f"{scale * metres:.{digits}f} {machine.unit}"


def _section(machine: Machine) -> str:
    effects = ", then ".join(f"`{effect}`" for effect in machine.effects) or "none"
    seconds = ", ".join(f"{name} {value:.0f} s" for name, value in machine.seconds.items())
    said = "\n".join(f"{i}. {note}" for i, note in enumerate(machine.notes, start=1))
    means = ", ".join(f"{name} {_length(machine, value)}" for name, value in machine.means.items())
    mean = f"Mean error at the poses for judging: {means}. " if means else ""
    diagnosed = (
        f"\n\nMessages of `diagnose` and `add`, in order:\n\n{said}"
        if machine.effects
        else f"\n\n{said}"
    )
    longest = " (the longest call of each)" if len(machine.seconds) > 1 else " together"
    return (
        f"## {machine.name.replace('_', '-')}\n\n"
        f"Effects added: {effects}. {mean}"
        f"Time on two cores: {seconds}{longest}.{diagnosed}"
    )


def main(names: Sequence[str]) -> None:
    results: dict[str, dict[str, Any]] = {}
    if RESULTS.exists():
        results = json.loads(RESULTS.read_text())
    with tempfile.TemporaryDirectory() as folder:
        for name in names or MACHINES:
            machine = MACHINES[name](Path(folder))
            results[name] = to_json_value(machine)
            print(json.dumps(results[name], indent=1), flush=True)
    RESULTS.write_text(json.dumps(results, indent=1) + "\n")
    PAGE.write_text(make_page(results))


if __name__ == "__main__":
    if sys.argv[1:] == ["models"]:
        write_models()
    elif sys.argv[1:] == ["page"]:
        PAGE.write_text(make_page(json.loads(RESULTS.read_text())))
    else:
        main(sys.argv[1:])
