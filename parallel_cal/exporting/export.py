"""Export a model as files for a controller or a program, by the name of a target."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from inspect import signature
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import Any

import numpy as np

from parallel_cal.base.arguments import check_arguments
from parallel_cal.base.errors import ModelError, ParallelCalError
from parallel_cal.base.files import write_atomically
from parallel_cal.base.options import convert_options, split_options
from parallel_cal.base.threads import single_threaded
from parallel_cal.base.units import DEGREE, MM
from parallel_cal.exporting.bed_fit import MAX_UNMEASURED_MOVE, BedFit, Movement, Present
from parallel_cal.exporting.deltas import with_scale_of
from parallel_cal.exporting.editing import (
    are_same_numbers,
    edit_files,
    format_settings,
    read_verbatim,
    sets_stored_value,
)
from parallel_cal.exporting.heights import BedHeights, nozzle_heights, rms_height, why_not
from parallel_cal.exporting.output import place_files, replace_files
from parallel_cal.exporting.projection import (
    Firmware,
    Machine,
    Projection,
    TargetPoses,
    are_equal,
    loss,
)
from parallel_cal.importing.settings import Settings
from parallel_cal.importing.touch_samples import Touches
from parallel_cal.model.model import Model
from parallel_cal.model.region import describe_untested_conditions, describe_workspace_excess
from parallel_cal.model.shelf import list_plugins, load_module, wrap_plugin_function

SHELF = "exporting.targets"
N_FOLDS, FOLD_SEED = 4, 3
N_COMPARED_POSES = 100
MAX_MOVED_TRAVEL = 0.5  # of a joint's travel, between the previous and the new numbers
MIN_FOLDED_TOUCHES = 24  # twice the numbers of a linear Delta in RepRapFirmware


@dataclass(frozen=True)
class ExportResult:
    """The written files, and what a firmware's numbers lose.

    Attributes
    ----------
    paths : list of Path
        The written files.
    loss : dict or None
        The loss of accuracy by a firmware's numbers: errors by kind (m, rad).
    before : dict or None
        The loss with the firmware's previous numbers.
    remarks : list of str
        Further notes.
    heights : BedHeights or None
        Height errors (m) at the touches of a firmware's bed, before and after.
    movement : Movement or None
        How far x and y move over this bed, m.
    """

    paths: list[Path]
    loss: Mapping[str, Any] | None = None
    before: Mapping[str, Any] | None = None
    remarks: list[str] = field(default_factory=list)
    heights: BedHeights | None = None
    movement: Movement | None = None


@check_arguments(ModelError)
@single_threaded()
def export(
    model: Model, target: str, folder: str | Path, touches: Touches | None = None
) -> ExportResult:
    """Write a calibrated model for a controller or another program.

    Errors of the measuring device are not exported. A firmware whose kinematics has fewer
    parameters gets the values that fit the model best, and the loss is computed.

    Parameters
    ----------
    model : Model
    target : str
        `"NAME"` or `"NAME:option=value,..."`, such as `"c"`, `"urdf"`, `"klipper"`; or the Python
        path of your own target, a module with a function
        `files(model, option=default, ...) -> {name: text}`.
    folder : str or Path
        The folder to write the files to. It is created if it does not exist. If the target writes
        a single file, it may be the name of that file, such as `robot.urdf`; one that is there
        remains as `NAME.previous`.
    touches : Touches, optional
        Points of the bed that a probe touched. The result then states the bed heights at these
        points, computed by the model and by the formula of the firmware.

    Returns
    -------
    ExportResult
        `paths` are the written files, `loss` is the loss of accuracy (m, rad), `remarks` are
        notes on the target's limits.

    Raises
    ------
    ModelError
        If the target is unknown or cannot represent this model, or if `folder` is the name of a
        file and the target writes several.

    Examples
    --------
    >>> import parallel_cal as pc
    >>> from tempfile import mkdtemp
    >>> done = pc.export(pc.new_model("delta24"), "c", mkdtemp())
    >>> sorted(path.suffix for path in done.paths)
    ['', '.c', '.c', '.c', '.csv', '.h', '.txt']
    """
    name, given = split_options(target, "target", ModelError)
    module, robot = load_module(SHELF, name), model.robot()
    made: dict[str, str] = {}
    if hasattr(module, "files"):
        options = convert_options(given, module.files, name, ModelError)
        made = wrap_plugin_function(name, module.files)(robot, **options)
    elif given or not _holds(module, model):
        raise _refusal(name, module, model, given)
    result = ExportResult([])
    if touches is not None and not _holds(module, model):
        raise ModelError(
            f"{name} is not a firmware with parameters of its own: export without touches"
        )
    if _holds(module, model):
        projection, found = _project(name, module, robot)
        made |= {
            file: projection.head + format_settings(numbers)
            for file, numbers in projection.settings.items()
        }
        if hasattr(module, "beside"):
            made |= module.beside(robot, found)
        heights = None
        if touches is not None:
            _check_touches_apply(robot, touches)
            after = rms_height(robot, found, touches, "the new")
            heights = BedHeights(len(touches.q), None, after, excluded=touches.excluded)
        result = ExportResult([], loss(robot, found), None, _remarks(robot, projection), heights)
    for path, text in place_files(name, made, Path(folder)).items():
        path.parent.mkdir(parents=True, exist_ok=True)
        if path == Path(folder) and path.exists():
            replace_files({path: text})  # it may be the user's own
        else:
            write_atomically(path, text)
        result.paths.append(path)
    if hasattr(module, "remarks"):
        result.remarks.extend(module.remarks(robot))
    result.remarks.extend(_describe_limits(model))
    return result


@single_threaded()
def export_into(
    model: Model,
    target: str,
    files: Sequence[Path],
    touches: Touches | None = None,
    force: bool = False,
) -> ExportResult:
    """Write a firmware's numbers into its own configuration files, and keep comments and order.

    The old files remain as `NAME.previous`. With `touches` of the bed, the numbers fit their
    heights, and x and y stay where nothing measured them. If the heights at the touches get worse,
    or if x and y move by more than MAX_UNMEASURED_MOVE without a measurement, no file is changed
    and the result is a ModelError, unless `force` is set.
    """
    module, robot = load_module(SHELF, target), model.robot()
    if hasattr(module, "edit"):
        if touches is not None:
            raise ModelError(f"{target} is no firmware that probes a bed: export without touches")
        texts, remarks = module.edit(robot, files)
        replace_files(texts)
        return ExportResult(list(texts), remarks=[*remarks, *_describe_limits(model)])
    if not _holds(module, model):
        raise _refusal(target, module, model)
    stated: Settings = module.settings(files)
    now = _firmware(module, stated, robot)
    projection, found = _project(target, module, robot, stated)
    if type(now) is not type(found.firmware):
        raise ModelError(f"{files[0]}: it is configured for another kind of machine")
    old_height = 0.0
    if touches is not None:
        _check_touches_apply(robot, touches)
        old_height = rms_height(robot, replace(found, firmware=now), touches, "the file's")
        steps = found.frame.motors(touches.q - found.stops)
        present = Present(with_scale_of(found.firmware, now, steps.mean(axis=0)), touches)
        if _takes(module, "present"):
            projection, found = _project(target, module, robot, stated, present)
    groups = _distribute_numbers(target, module, files, stated, projection)
    texts, firmware = _edit(module, replace(stated, paths=files), groups, robot)
    if are_equal(now, firmware):  # the files may state these numbers in other words
        texts = {path: read_verbatim(path) for path in files}
    old, new = (replace(found, firmware=each) for each in (now, firmware))
    _check_previous_numbers(files, robot, old, new)
    heights = movement = None
    if touches is not None:
        new_height = rms_height(robot, new, touches, "the new")
        heights = BedHeights(len(touches.q), old_height, new_height, excluded=touches.excluded)
        movement = BedFit(robot, old, touches).movement(new.firmware)
        if heights.worse and not force:
            raise _worse_bed(files, heights)
        if movement.unsupported > MAX_UNMEASURED_MOVE and not force:
            raise _moves_too_far(files, movement, heights)
        held_out = _held_out_height(target, module, robot, stated, present)
        heights = replace(heights, held_out=held_out)
    before, after = loss(robot, old), loss(robot, new)
    replace_files(texts)
    remarks = [*_remarks(robot, projection), *_describe_limits(model), *stated.describe_unused()]
    return ExportResult(list(texts), after, before, remarks, heights, movement)


def _distribute_numbers(
    target: str,
    module: ModuleType,
    files: Sequence[Path],
    stated: Settings,
    projection: Projection,
) -> list[tuple[dict[str, str], list[Path]]]:
    """Return the new numbers, each with the files that may state it.

    ModelError if a file is missing among those that were given: one in which numbers belong, or one
    that overrides a number.
    """
    groups = list[tuple[dict[str, str], list[Path]]]()
    cleared = [field for field in getattr(module, "CLEARED", ()) if field in stated]
    for file, numbers in projection.settings.items():
        its = [path for path in files if path.suffix == Path(file).suffix]
        if len(projection.settings) == 1:
            its = list(files)
        if not its:
            raise ModelError(
                f"{target}: some numbers belong in {Path(file).name}: pass that file with "
                "--into as well"
            )
        if hasattr(module, "adapt"):
            numbers = module.adapt(stated, numbers)
        groups.append(({**numbers, **dict.fromkeys(cleared, "0")}, its))
        cleared = []
    for name, value in (pair for numbers, _ in groups for pair in numbers.items()):
        text, place = stated.texts.get(name, (value, None))
        if place is None or place.path in files or are_same_numbers(text, value):
            continue
        given = " ".join(f"--into {path}" for path in [*files, place.path])
        raise ModelError(
            f"{place.path}:{place.line}: {name} is '{text}': the firmware also reads this file "
            f"with {files[0]}, and this value is the one that counts. Nothing was written: {given} "
            "changes it there"
        )
    return groups


def _edit(
    module: ModuleType,
    stated: Settings,
    groups: Sequence[tuple[dict[str, str], Sequence[Path]]],
    robot: Model,
) -> tuple[dict[Path, str], Firmware]:
    """Return the texts of files with new numbers, and the firmware that reads them.

    A number that the firmware also has without it is not added to a file. Words of commands and
    settings of grblHAL are: without them, a controller keeps the numbers that it has stored.
    """
    texts = edit_files(stated, groups)
    firmware = _read(module, stated.paths, texts, robot)
    for numbers, _ in groups:
        added = [key for key in numbers if key not in stated and not sets_stored_value(key)]
        for key in added:
            text = numbers.pop(key)
            try:
                shorter = edit_files(stated, groups)
                same = are_equal(_read(module, stated.paths, shorter, robot), firmware)
            except ParallelCalError:  # the firmware needs this number
                same = False
            if same:
                texts = shorter
            else:
                numbers[key] = text
    return texts, firmware


def _worse_bed(files: Sequence[Path], heights: BedHeights) -> ModelError:
    """Return the error for new parameters that increase the height error, with the cure."""
    before, after = 1e6 * (heights.before or 0.0), 1e6 * heights.after
    words = (
        f"the height error at the touches rises with the new parameters: rms at {heights.touches} "
        f"touches by the firmware's formula: {before:.1f} -> {after:.1f} um"
    )
    cure = (
        "probe more points, exclude wrong touches (fit --data exclude=N), fix the "
        "parameters that the firmware does not have (fit --fix), keep what the touches determine "
        "poorly near the drawing (fit --prior), or pass --force"
    )
    return ModelError(f"{', '.join(map(str, files))}: {words}; nothing was written: {cure}")


def _moves_too_far(files: Sequence[Path], movement: Movement, heights: BedHeights) -> ModelError:
    """Return the error for new parameters that move x and y without a measurement of them."""
    before, after = 1e6 * (heights.before or 0.0), 1e6 * heights.after
    known = "" if movement.sigma is None else f" (the data leave {1e3 * movement.sigma:.2g} mm)"
    words = (
        f"points on the bed move by up to {1e3 * movement.unsupported:.2f} mm relative to each "
        f"other in x and y with the new parameters, and no measurement shows this{known}: expected "
        f"at most {1e3 * MAX_UNMEASURED_MOVE:g} mm. The rms height at the touches would go from "
        f"{before:.1f} to {after:.1f} um"
    )
    measure = (
        "measure a printed length along the other axis, too (sensor printed with along: xy, import "
        "--option printed_x=[sent, measured] and printed_y)"
        if movement.measured
        else "measure one printed length (new --sensor 'printed: {along: x, sigma: 2.0e-5}', "
        "import --option printed_x=[sent, measured])"
    )
    cure = (
        f"{measure} and fit again, keep what the touches determine poorly near the drawing (fit "
        "--prior), or, if the present parameters are only those of the drawing, pass --force"
    )
    return ModelError(f"{', '.join(map(str, files))}: {words}; nothing was written: {cure}")


def _check_touches_apply(robot: Model, touches: Touches) -> None:
    if reason := why_not(robot) or touches.explain_other_model(robot):
        raise ModelError(reason)


def _takes(module: ModuleType, parameter: str) -> bool:
    return parameter in signature(module.project).parameters


def _held_out_height(
    name: str, module: ModuleType, robot: Model, stated: Settings, present: Present
) -> float | None:
    """Return the rms height (m) at touches that the firmware's numbers were not fitted to.

    None if there are too few touches for N_FOLDS folds.
    """
    touches = present.touches
    if len(touches.q) < MIN_FOLDED_TOUCHES or not _takes(module, "present"):
        return None
    fold = np.random.default_rng(FOLD_SEED).permutation(len(touches.q)) % N_FOLDS
    heights = np.empty(len(touches.q))
    for k in range(N_FOLDS):
        train = replace(present, touches=touches.select(fold != k), by_touch=True)
        _, machine = _project(name, module, robot, stated, train)
        heights[fold == k] = nozzle_heights(robot, machine, touches.select(fold == k))
    return float(np.sqrt(np.mean(heights**2)))


def _holds(module: ModuleType, model: Model) -> bool:
    return model.mechanism.name in getattr(module, "HOLDS", ())


def _refusal(
    name: str, module: ModuleType, model: Model, given: Mapping[str, str] | None = None
) -> ModelError:
    """Return the error for a target that cannot represent a model; it names targets that can."""
    if hasattr(module, "edit"):
        return ModelError(f"{name} changes the numbers of a file that exists: give it with --into")
    if not hasattr(module, "HOLDS"):
        return ModelError(f"{name} is not an export target: it has no function files(model)")
    if given and _holds(module, model):
        key, value = next(iter(given.items()))
        return ModelError(f"option '{key}={value}': {name} has none")
    others = [other for other in list_plugins(SHELF) if other not in (name, "urdf")]
    modules = {other: load_module(SHELF, other) for other in others}
    can = [other for other, m in modules.items() if hasattr(m, "files") or _holds(m, model)]
    return ModelError(
        f"{name} has no numbers for {model.mechanism.name}, only for "
        f"{', '.join(module.HOLDS)}; {', '.join(can)} can represent it"
    )


def _project(
    name: str,
    module: ModuleType,
    robot: Model,
    stated: Settings | None = None,
    present: Present | None = None,
) -> tuple[Projection, Machine]:
    """Return a firmware's numbers, and the machine that has them as they are written.

    `stated` are the settings that they replace.
    """
    given: dict[str, Any] = {} if present is None else {"present": present}
    if stated is not None and _takes(module, "stated"):
        given["stated"] = stated
    projection: Projection = wrap_plugin_function(name, module.project)(robot, **given)
    texts = {Path(file): format_settings(numbers) for file, numbers in projection.settings.items()}
    firmware = _read(module, [*texts], texts, robot)
    return projection, Machine(firmware, projection.frame, projection.stops)


def _firmware(module: ModuleType, stated: Settings, robot: Model) -> Firmware:
    """Return the firmware that has these settings, with motors in the unit of the model's."""
    read: Firmware = module.firmware(stated)
    return module.complete(read, robot) if hasattr(module, "complete") else read


def _check_previous_numbers(
    files: Sequence[Path], robot: Model, old: Machine, new: Machine
) -> None:
    """Refuse new numbers if they move a joint by much of its travel at the same pose.

    No calibration corrects so much: the model then has other switches, limits or units than the
    machine.
    """
    wanted = TargetPoses.over_workspace(robot, N_COMPARED_POSES, seed=1).at
    before, after = (m.readings(wanted.position, wanted.rotation) for m in (old, new))
    known = np.isfinite(before - after).all(axis=1)
    if not known.any():
        return
    moved = np.abs(np.median((after - before)[known], axis=0))
    travel = np.ptp(np.array(robot.mechanism.joint_limits, dtype=float), axis=1)
    worst = int((moved / travel).argmax())
    if moved[worst] <= MAX_MOVED_TRAVEL * travel[worst]:
        return
    length = robot.mechanism.joint_units[worst] == "m"
    unit, factor = ("mm", 1 / MM) if length else ("deg", 1 / DEGREE)
    raise ModelError(
        f"{', '.join(map(str, files))}: at the same poses, {robot.joints[worst]} would read "
        f"{factor * moved[worst]:.4g} {unit} differently with the new numbers; expected at most "
        f"{factor * MAX_MOVED_TRAVEL * travel[worst]:.4g} {unit}, half of its travel. Nothing was "
        "written. Either the model file has other switches than the machine (its option switches, "
        "or else the joint limits, state where they are), or another frame or unit: write the "
        "model file with new --from from these files and fit again"
    )


def _read(
    module: ModuleType, files: Sequence[Path], texts: Mapping[Path, str], robot: Model
) -> Firmware:
    """Return the firmware that reads these texts in place of the files' present texts."""
    if "texts" in signature(module.settings).parameters:  # it reads further files beside these
        return _firmware(module, module.settings(files, texts), robot)
    with TemporaryDirectory() as kept:
        copies = [Path(kept) / str(k) / path.name for k, path in enumerate(files)]
        for copy, path in zip(copies, files, strict=True):
            copy.parent.mkdir()
            write_atomically(copy, texts[path] if path in texts else read_verbatim(path))
        return _firmware(module, module.settings(copies), robot)


def _describe_limits(model: Model) -> list[str]:
    """Where the exported numbers, which hold under neutral conditions and lack the effects of the
    device, may be wrong."""
    neutral = describe_untested_conditions(model, model.condition_rows(None, 1))
    device = [effect.name for effect in model.effects if effect.of_device]
    lacking = (
        f"not exported: {', '.join(device)}. This is ascribed to the device or its stand, and the "
        "error at held-out poses is that of the model with it. If the robot causes it, the "
        "exported model may be worse than one that was identified without it"
    )
    limits = [describe_workspace_excess(model), neutral, lacking if device else ""]
    return list(filter(None, limits))


def _remarks(robot: Model, projection: Projection) -> list[str]:
    """List where the firmware's frame is, and what its numbers cannot represent."""
    frame, remarks = projection.frame, [*projection.remarks]
    if np.any(frame.origin) or not np.array_equal(frame.axes, np.eye(3)):
        origin, axes = np.round(1e3 * frame.origin, 3) + 0.0, np.round(frame.axes, 6) + 0.0
        at = " ".join(f"{axis} {value:g}" for axis, value in zip("xyz", origin, strict=True))
        square = np.allclose(frame.axes.T @ frame.axes, np.eye(3), atol=1e-9)
        shown = {
            axis: " ".join(f"{value:g}" for value in axes[:, k])
            for k, axis in enumerate("xyz")
            if axis != "y" or not square  # z and x determine it
        }
        shear = ". The axes are not orthogonal: the firmware corrects a tilted bed by a shear"
        remarks.append(
            f"frame of the firmware in {{B}}: origin {at} mm, "
            f"{', '.join(f'{axis}-axis {words}' for axis, words in shown.items())}"
            f"{'' if square else shear}"
        )
    if frame.order != tuple(range(len(frame.order))):
        joints = ", ".join(robot.joints[k] for k in frame.order)
        remarks.append(f"the firmware's motors are {joints}, in this order")
    lost = [effect.name for effect in robot.effects if effect.name not in projection.expressed]
    if lost:
        remarks.append(f"the loss includes what its numbers cannot represent of {', '.join(lost)}")
    if robot.conditions:
        remarks.append(f"neutral conditions: {', '.join(robot.conditions)}")
    return remarks
