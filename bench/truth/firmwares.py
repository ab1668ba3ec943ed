"""Exports beside the firmwares' own kinematics: inverse problem, forward problem and homed pose.

Each export is read by an independent firmware (test/helpers/virtual_firmware.py). It computes the
motors of 2000 points, and the points from the motors, with its own type of numbers. The full model
then says where the robot is. `--write` puts the table into docs/export.md. `--files FOLDER` sends
every configuration in a folder through new --from, export --into and back.
"""

from __future__ import annotations

import argparse
import difflib
import re
import shutil
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]

from test_export_firmware import MM, off, simulated, told_frame  # noqa: E402
from virtual_firmware import Marlin  # noqa: E402

from parallel_cal.base.errors import ParallelCalError  # noqa: E402
from parallel_cal.base.files import write_atomically  # noqa: E402
from parallel_cal.exporting.export import SHELF, export, export_into  # noqa: E402
from parallel_cal.importing.controller_files import configured  # noqa: E402
from parallel_cal.kinematics.kinematics import Kinematics  # noqa: E402
from parallel_cal.model.mechanism import poses_in_workspace  # noqa: E402
from parallel_cal.model.model import Model, new_model  # noqa: E402
from parallel_cal.model.shelf import load_module  # noqa: E402
from parallel_cal.virtual import robot as vr  # noqa: E402

PAGE = ROOT / "docs" / "export.md"
BEGIN, END = "<!-- from bench/truth/firmwares.py -->", "<!-- until here -->"
N_POSES = 2000
ROTARY = ("klipper", "rrf", "grblhal", "fluidnc", "linuxcnc", "smoothieware")
LINEAR = ("klipper", "rrf", "marlin", "marlin_equal_rods", "linuxcnc")
LINEAR += ("smoothieware", "mk4duo", "richcattell")
UPWARDS = ("klipper", "rrf")  # count the angles of arms upwards
HEAD = (
    "| robot | target | stated error, mean / max | by the firmware's inverse | "
    "forward minus inverse | homed pose |"
)
TARGET_OF = {".cfg": "klipper", ".hal": "linuxcnc", ".g": "rrf", ".h": "marlin", ".txt": "grblhal"}


def robots() -> dict[str, tuple[Model, tuple[str, ...]]]:
    """Robots with usual errors, and the targets that can represent them."""
    return {
        "Delta 54 of the thesis": (new_model("delta54", vr.TABLE_5_18), ROTARY),
        "Delta 24": (off("delta24", 0.3), ROTARY),
        "linear Delta": (off("linear_delta", 0.1), LINEAR),
        "five-bar": (off("five_bar", 1.0), ("rrf",)),
        "Stewart 42": (off("stewart42"), ("linuxcnc",)),
    }


@dataclass(frozen=True)
class Row:
    """Errors in um: stated and reached (mean, max), of the forward problem, and when homed."""

    stated: tuple[float, float]
    reached: tuple[float, float]
    forward: float
    homed: float | None


def measure(model: Model, target: str) -> Row:
    """Export, read with the independent firmware, and compare."""
    with tempfile.TemporaryDirectory() as folder:
        done = export(model, target, folder)
        firmware = simulated(target, Path(folder))
    assert done.loss is not None
    origin, axes, order = told_frame(done.remarks)
    kinematics, m = Kinematics(model), model.mechanism
    r, R = poses_in_workspace(m, N_POSES, np.random.default_rng(1))
    points = (r - origin) @ axes / MM
    turned = len(m.controlled) == 6
    motors = firmware.motors(points, R) if turned else firmware.motors(points)
    ends = np.array(m.joint_limits)
    stops = ends[:, 0] if axes[2, 2] < 0 else ends[:, 1]
    order = order if len(order) == len(m.joints) else [*range(len(m.joints))]
    if m.name == "five_bar":
        stops = np.array(m.switches)
    unit = MM if m.joint_units[0] == "m" else np.pi / 180
    up = -1.0 if axes[2, 2] < 0 else 1.0
    if m.joint_units[0] == "rad" and m.name != "five_bar" and target not in UPWARDS:
        up = -up
    q = np.tile(stops, (len(r), 1))
    q[:, order] += up * unit * (motors - firmware.homed())
    wanted = kinematics.inverse(r, R)
    found = kinematics.direct(q, start=wanted)
    reached = 1e6 * np.linalg.norm(found.position - r, axis=1)
    homed = None
    if turned:
        back, _ = firmware.forward_pose(motors, points + 1.0, R)
        near = kinematics.direct(stops[None])
        pose = firmware.forward_pose(firmware.homed()[None], near.position / MM, near.rotation)[0]
        homed = 1e6 * float(np.linalg.norm(pose[0] * MM - near.position[0]))
    elif m.name == "five_bar":
        back = firmware.forward(motors)
    else:
        back = firmware.forward(firmware.computed_motors(points), firmware.number)
        if isinstance(firmware, Marlin):
            stops = stops.copy()
            stops[order] -= firmware.retracts() * MM
        at = (kinematics.direct(stops[None]).position[0] - origin) @ axes
        homed = 1e6 * float(np.linalg.norm(firmware.home_position(firmware.number) * MM - at))
    return Row(
        (1e6 * done.loss["position_mean"], 1e6 * done.loss["position_max"]),
        (float(np.mean(reached)), float(np.max(reached))),
        1e3 * float(np.linalg.norm(back - points, axis=1).max()),
        homed,
    )


def table() -> list[str]:
    """Return the lines of the table in um."""
    lines = [HEAD, "|---|---|---|---|---|---|"]
    for name, (model, targets) in robots().items():
        for target in targets:
            row = measure(model, target)
            stated, reached = (f"{a:.2f} / {b:.2f}" for a, b in (row.stated, row.reached))
            homed = "-" if row.homed is None else f"{row.homed:.1f}"
            cells = (name, f"`{target}`", stated, reached, f"{row.forward:.2g}", homed)
            lines.append(f"| {' | '.join(cells)} |")
            print(lines[-1], flush=True)
    return lines


def write(lines: list[str]) -> None:
    """Put the table between the two marks of the page."""
    text = PAGE.read_text(encoding="utf-8")
    before, rest = text.split(BEGIN)
    _, after = rest.split(END)
    write_atomically(PAGE, "\n".join([before + BEGIN, *lines, END + after]))


# ------------------------------------------------------------------ configuration files


def configurations(folder: Path) -> list[list[Path]]:
    """Return the files of each machine: those of a .hal file and an .ini file belong together."""
    found = []
    for path in sorted(path for path in folder.rglob("*") if path.suffix in TARGET_OF):
        inis = sorted(path.parent.glob("*.ini")) if path.suffix == ".hal" else []
        found.append([path, *inis])
    return found


def send_round(paths: list[Path]) -> tuple[float, int]:
    """Return what is lost (um) on the way there and back, and how many lines changed.

    ParallelCalError if the files cannot be read; AssertionError if a line changed in which
    nothing stands that the export writes.
    """
    target = TARGET_OF[paths[0].suffix]
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(shutil.copy(path, folder)) for path in paths]
        old = [path.read_bytes().decode(errors="replace").splitlines() for path in files]
        stated = load_module(SHELF, target).settings(files).texts
        keys = {  # to which the pins of a .hal file lead
            old[files.index(place.path)][place.line - 1].split("=")[0]
            for field, (_, place) in stated.items()
            if "kins." in field
        }
        first = export_into(configured(files).model, target, files)
        second = export_into(configured(files).model, target, files)
        changed = []
        for path, lines in zip(files, old, strict=True):
            now = path.read_bytes().decode(errors="replace").splitlines()
            changed += [line for line in difflib.ndiff(lines, now) if line[0] in "+-"]
    other = [
        line
        for line in changed
        if not re.search(WRITTEN, line) and line[2:].split("=")[0] not in keys
    ]
    assert not other, f"{paths[0]}: other lines changed: {other}"
    assert first.loss is not None
    assert second.loss is not None
    worst = max(first.loss["position_max"], second.loss["position_max"])
    return 1e6 * worst, sum(line[0] == "+" for line in changed)


WRITTEN = (
    r"M66[569]|\$64[1-6]|DELTA_|HOME_OFFSET|kins\.|sets |global |"
    r"delta_radius|shoulder|arm_length|angle|position_endstop"
)


def files(folder: Path) -> None:
    """Print a line for each machine, and how many came back."""
    good, every = 0, configurations(folder)
    for paths in every:
        name = paths[0].relative_to(folder)
        try:
            lost, lines = send_round(paths)
        except ParallelCalError as error:
            print(f"refused  {name}: {str(error)[-150:]}", flush=True)
            continue
        good += lost < 5e-4
        print(f"{lost:.3f} um  {lines:2} lines  {name}", flush=True)
    print(f"{good} of {len(every)} machines came back with 0.000 um lost and no other line changed")


def main(words: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help=f"put the table into {PAGE.name}")
    parser.add_argument("--files", type=Path, help="folder of configuration files")
    asked = parser.parse_args([] if words is None else words)
    if asked.files:
        return files(asked.files)
    lines = table()
    if asked.write:
        write(lines)


if __name__ == "__main__":
    main(sys.argv[1:])
