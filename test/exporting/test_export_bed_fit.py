"""An export to a printer's firmware: heights from touches, x and y from what measured them.

The firmware's formula and its least-squares fit are written here once more, by themselves.
"""

import importlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import virtual_firmware as vf
import virtual_printer as vp
from scipy.optimize import least_squares
from test_export_heights import D300VS, points_of, rms_height

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.exporting import export
from parallel_cal.exporting.bed_fit import BedFit, Movement
from parallel_cal.exporting.export import export_into
from parallel_cal.exporting.heights import BedHeights
from parallel_cal.identification.fit import fit
from parallel_cal.importing.controller_files import configured, samples
from parallel_cal.importing.touch_samples import touches_in
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.shelf import load_sensor

# Printers beside the first one, by the same lines.
OTHERS = [pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2)]
NINE = (0, 4, 5, 7, 8, 9, 10, 11)  # radius, two tower angles, end-stops and the tilt of the bed


def height_errors(v, r, trigger, old):
    """Heights (N,) in mm by the numbers v where the numbers `old` put the nozzle at r (N, 3)."""

    def motors(w, at):
        angles = np.radians(w[4:7])
        towers = w[0] * np.column_stack([np.cos(angles), np.sin(angles)])
        away = ((at[:, None, :2] - towers) ** 2).sum(axis=2)
        tall = (at[:, 2] + at[:, :2] @ w[10:12])[:, None] + np.sqrt(w[1:4] ** 2 - away)
        return tall - w[7:10] - np.sqrt(w[1:4] ** 2 - w[0] ** 2)

    wanted, at = motors(old, r), r.copy()
    for _ in range(6):
        slopes = [(motors(v, at + d) - motors(v, at - d)) / 2e-3 for d in 1e-3 * np.eye(3)]
        off = motors(v, at) - wanted
        at = at - np.linalg.solve(np.stack(slopes, axis=2), off[:, :, None])[:, :, 0]
    return at[:, 2] - trigger


def fit_factors(old, r, trigger):
    """Fit nine numbers of the firmware to the touches r (N, 3) mm."""
    scale = np.array([1, 1, 1, 1, 0.3, 0.3, 0.3, 1, 1, 1, 5e-3, 5e-3])

    def numbers(u):
        v = old.copy()
        v[list(NINE)] += u * scale[list(NINE)]
        return v

    found = least_squares(lambda u: height_errors(numbers(u), r, trigger, old), np.zeros(len(NINE)))
    return numbers(found.x)


def rms_at_held_out(old, r, trigger):
    """Rms height error (m) of the nine numbers at touches that they were not fitted to."""
    fold = np.random.default_rng(0).permutation(len(r)) % 4
    errors = np.empty(len(r))
    for k in range(4):
        v = fit_factors(old, r[fold != k], trigger)
        errors[fold == k] = height_errors(v, r[fold == k], trigger, old)
    return 1e-3 * np.sqrt(np.mean(errors**2))


def map_points(file, trigger):
    """Where the firmware believed the nozzle to be (N, 3) mm, from a height map."""
    rows = file.read_text().splitlines()
    head = dict(zip(rows[1].split(","), rows[2].split(","), strict=True))
    old = "xmin" in head  # versions of the file differ in their names
    low = [float(head[name]) for name in (("xmin", "ymin") if old else ("min0", "min1"))]
    names = ("xspacing", "yspacing") if old else ("spacing0", "spacing1")
    step = [float(head[name]) for name in names]
    cells = [[cell.strip() for cell in row.split(",")] for row in rows[3:]]
    return np.array(
        [
            (low[0] + step[0] * i, low[1] + step[1] * k, float(cell) + trigger)
            for k, row in enumerate(cells)
            for i, cell in enumerate(row)
            if cell != "0"
        ]
    )


def real_xy(printer, firmware, believed):
    """Where the printer's nozzle really is (N, 2) mm if its firmware believes it to be there."""
    first = vf.Duet(vp.CONFIG)
    carriages = 1e-3 * (firmware.motors(believed) - firmware.homed() + first.homed())
    turned, r = replace(printer, angle=printer.angle + np.radians(210.0)), 1e-3 * believed
    for _ in range(8):
        slopes = [
            (turned.readings(r + d) - turned.readings(r - d)) / 2e-7 for d in 1e-7 * np.eye(3)
        ]
        off = turned.readings(r) - carriages
        r = r - np.linalg.solve(np.stack(slopes, axis=2), off[:, :, None])[:, :, 0]
    return 1e3 * r[:, :2]


def largest_shape(moves, xy):
    """Largest of movements (N, 2) without their common shift and turn."""
    common = np.zeros((len(xy), 2, 3))
    common[:, 0, 0] = common[:, 1, 1] = 1.0
    common[:, :, 2] = np.column_stack([-xy[:, 1], xy[:, 0]]) / 100
    rows, flat = common.reshape(-1, 3), moves.ravel()
    rest = flat - rows @ np.linalg.lstsq(rows, flat, rcond=None)[0]
    return np.linalg.norm(rest.reshape(-1, 2), axis=1).max()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, OTHERS[0]])
def test_a_probe_beside_the_nozzle_leaves_no_more_than_the_noise_at_its_touches(tmp_path, seed):
    """How bed and effector tilt is for no firmware, and hardly seen in touches: 30 to 65 um."""
    beside, noise = (-2.4e-3, 21.4e-3), 20e-6
    printer = vp.drawn(seed, beside=beside)
    (tmp_path / "config.g").write_text(vp.CONFIG.replace("X0 Y0 Z0.1", "X-2.4 Y21.4 Z0.1"))
    (tmp_path / "map.csv").write_text(vp.height_map(printer, seed, 12e-3, noise, beside))
    files = [tmp_path / "config.g"]
    dataset = samples("rrf", [tmp_path / "map.csv", *files])
    model = fit(configured(files).model, dataset, hold_out=0).model
    old = vf.Duet(files[0].read_text())
    done = export_into(model, "rrf", files, touches_in(dataset, model.joints))
    new = vf.Duet(files[0].read_text())
    points = map_points(tmp_path / "map.csv", 0.1) - [*(1e3 * np.array(beside)), 0.0]
    assert rms_height(old, old, points, 0.1) > 200e-6
    assert done.heights.after == pytest.approx(rms_height(old, new, points, 0.1), abs=0.1e-6)
    assert done.heights.after < 1.1 * noise


def printer_files(folder, seed, noise):
    printer = vp.drawn(seed)
    (folder / "config.g").write_text(vp.CONFIG)
    (folder / "map.csv").write_text(vp.height_map(printer, seed, 12e-3, noise))
    return printer, [folder / "config.g"]


@pytest.mark.wide
@pytest.mark.parametrize("seed", [0, *OTHERS])
def test_the_default_path_fits_heights_and_improves_the_real_x_and_y(tmp_path, seed):
    printer, files = printer_files(tmp_path, seed, 20e-6)
    dataset = samples("rrf", [tmp_path / "map.csv", *files])
    model = fit(configured(files).model, dataset, hold_out=0).model
    done = export_into(model, "rrf", files, touches_in(dataset, model.joints))
    old, new = vf.Duet(vp.CONFIG), vf.Duet(files[0].read_text())

    # The second map was not used: it has no noise and another grid.
    (tmp_path / "check.csv").write_text(vp.height_map(printer, seed, 9e-3, 0.0))
    check = map_points(tmp_path / "check.csv", 0.1)
    assert rms_height(old, old, check, 0.1) > 400e-6
    assert rms_height(old, new, check, 0.1) < 12e-6

    bed = 0.89e3 * np.column_stack([vp.places(200, 9), np.zeros(200)])  # mm, where it was touched
    motors = old.motors(bed) - old.homed() + new.homed()
    moves = (points_of(new, motors, bed) - bed)[:, :2]
    assert done.movement.largest > 0.98e-3 * np.linalg.norm(moves, axis=1).max()
    assert done.movement.shape > 0.9e-3 * largest_shape(moves, bed)
    assert done.movement.shape < 0.5e-3
    assert not done.movement.measured
    before, after = (
        largest_shape(real_xy(printer, each, bed) - bed[:, :2], bed) for each in (old, new)
    )
    assert after < before


@pytest.mark.wide
@pytest.mark.parametrize("seed", [0, OTHERS[0]])
def test_a_printed_length_sets_the_scale_without_fixed_parameters(tmp_path, seed):
    printer, files = printer_files(tmp_path, seed, 5e-6)
    printer = replace(printer, rod=printer.rod + 1.5e-3)
    (tmp_path / "map.csv").write_text(vp.height_map(printer, seed, 12e-3, 5e-6))
    ends = np.array([[-40.0, 0, 0], [40, 0, 0]])

    def length(firmware):
        return float(np.linalg.norm(np.diff(real_xy(printer, firmware, ends), axis=0)))

    measured = length(vf.Duet(vp.CONFIG))
    assert abs(measured - 80.0) > 0.4
    dataset = samples("rrf", [tmp_path / "map.csv", *files], printed_x=[80, measured])
    model = configured(files).model
    model = model.with_sensors((*model.sensors, load_sensor("printed", along="x")))
    model = fit(model, dataset, hold_out=0).model
    done = export_into(model, "rrf", files, touches_in(dataset, model.joints))
    assert done.movement.measured
    assert done.heights.after < 8e-6
    assert length(vf.Duet(files[0].read_text())) == pytest.approx(80.0, abs=0.1)


@pytest.mark.parametrize(
    ("measured", "cure"),
    [(False, "measure one printed length"), (True, "along the other axis, too")],
)
def test_the_cure_of_an_unmeasured_move_is_the_length_that_nobody_measured(measured, cure):
    """A part along x leaves the size along y open: rods 7 mm too long made 0.85 mm of 80 mm."""
    heights = BedHeights(67, 1.3e-3, 12e-6)
    movement = Movement(2e-3, 1e-3, 0.9e-3, 1e-3, measured)
    assert cure in str(export._moves_too_far([Path("printer.cfg")], movement, heights))


@pytest.mark.wide
def test_a_point_that_the_new_numbers_do_not_reach_does_not_count(tmp_path, monkeypatch):
    """The points of the bed reach a little further than touches that are more on one side. At the
    edge of reach of a real printer that ended an export with a traceback."""
    printer, files = printer_files(tmp_path, 1, 5e-6)
    (tmp_path / "map.csv").write_text(vp.height_map(printer, 1, 12e-3, 5e-6))
    dataset = samples("rrf", [tmp_path / "map.csv", *files])
    model = fit(configured(files).model, dataset, hold_out=0).model
    touches = touches_in(dataset, model.joints)
    reach = 0.9 * np.linalg.norm(Kinematics(model).direct(touches.q).position[:, :2], axis=1).max()
    moves = BedFit.moves

    def moves_within_reach(bed, firmware, points):
        beyond = np.linalg.norm(points[:, :2], axis=1) > reach
        return np.where(beyond[:, None], np.nan, moves(bed, firmware, points))

    monkeypatch.setattr(BedFit, "moves", moves_within_reach)
    done = export_into(model, "rrf", files, touches, force=True)
    assert done.heights.after < 0.2 * done.heights.before
    assert 0 < done.movement.largest < np.inf


@pytest.mark.slow
def test_numbers_that_are_right_hardly_move_x_and_y(tmp_path):
    """40 um of noise in the touches must not become a move of x and y."""
    files = [tmp_path / "config.g"]
    files[0].write_text(vp.CONFIG)
    zero = np.zeros(3)
    printer = vp.Printer(zero, zero, zero, zero, zero)
    (tmp_path / "map.csv").write_text(vp.height_map(printer, 5, 12e-3, 40e-6))
    dataset = samples("rrf", [tmp_path / "map.csv", *files])
    model = fit(configured(files).model, dataset, hold_out=0).model
    touches = touches_in(dataset, model.joints)
    done = export_into(model, "rrf", files, touches)
    assert done.heights.after <= done.heights.before
    assert done.movement.shape < 0.15e-3
    again = export_into(model, "rrf", files, touches)  # the file has the best numbers already
    assert again.heights.after == pytest.approx(done.heights.after, abs=0.3e-6)


OF_ONES_OWN = """\
from parallel_cal.exporting.targets import rrf
from parallel_cal.exporting.targets.rrf import firmware, settings

HOLDS = ("linear_delta",)


def project(model):
    return rrf.project(model)
"""


@pytest.mark.wide
def test_an_unmeasured_move_of_x_and_y_is_refused_without_force(tmp_path, monkeypatch):
    """An exporter of one's own that does not take the touches, and a model with long rods."""
    (tmp_path / "own_mover").mkdir()
    (tmp_path / "own_mover" / "printer.py").write_text(OF_ONES_OWN)
    monkeypatch.syspath_prepend(str(tmp_path))
    importlib.invalidate_caches()
    _, files = printer_files(tmp_path, 1, 5e-6)
    dataset = samples("rrf", [tmp_path / "map.csv", *files])
    given = configured(files).model
    long = given.with_values(given.values + 8e-3 * given.table.matching(["*.Lb"]))
    fixed = replace(long, fixed=long.fixed | long.table.matching(["*.Lb"]))
    model = fit(fixed, dataset, hold_out=0).model
    touches = touches_in(dataset, model.joints)
    with pytest.raises(ParallelCalError) as refused:
        export_into(model, "own_mover.printer", files, touches)
    words = str(refused.value)
    assert "mm relative to each other in x and y with the new parameters, and no" in words
    assert "expected at most 0.5 mm. The rms height at the touches would go from" in words
    assert "nothing was written: measure one printed length" in words
    assert files[0].read_text() == vp.CONFIG
    assert not files[0].with_name("config.g.previous").exists()
    assert export_into(model, "own_mover.printer", files, touches, force=True).movement.shape > 5e-4
    files[0].write_text(vp.CONFIG)
    assert export_into(model, "rrf", files, touches).movement.shape < 0.5e-3


@pytest.mark.slow
def test_heights_are_never_given_up_for_x_and_y_that_nothing_measured(tmp_path):
    """Towers that are a millimetre and a third of a degree off: x and y must move, too."""
    zero = np.zeros(3)
    radius, angle = np.full(3, 1.2e-3), np.radians([0.35, -0.3, 0.2])
    printer = vp.Printer(np.array([0.7, -0.5, 0.3]) * 1e-3, radius, zero, angle, zero)
    (tmp_path / "config.g").write_text(vp.CONFIG)
    (tmp_path / "map.csv").write_text(vp.height_map(printer, 1, 12e-3, 6e-6))
    files = [tmp_path / "config.g"]
    dataset = samples("rrf", [tmp_path / "map.csv", *files])
    model = fit(configured(files).model, dataset, hold_out=0).model
    touches = touches_in(dataset, model.joints)
    with pytest.raises(ParallelCalError, match="The rms height at the touches would go from"):
        export_into(model, "rrf", files, touches)
    assert files[0].read_text() == vp.CONFIG
    done = export_into(model, "rrf", files, touches, force=True)
    assert done.heights.after < 8e-6
    (tmp_path / "check.csv").write_text(vp.height_map(printer, 1, 9e-3, 0.0))
    check = map_points(tmp_path / "check.csv", 0.1)
    old, new = vf.Duet(vp.CONFIG), vf.Duet(files[0].read_text())
    assert rms_height(old, new, check, 0.1) < 6e-6


@pytest.mark.wide
def test_a_real_printer_gets_what_nine_factors_reach_at_held_out_touches(tmp_path):
    """Before this fit, the export moved x and y of this printer by 2.7 mm."""
    files = [tmp_path / name for name in ("config.g", "config-override.g")]
    for file in files:
        file.write_bytes((D300VS / file.name).read_bytes())
    dataset = samples("rrf", [D300VS / "heightmap.csv", *files])
    model = fit(configured(files).model, dataset, hold_out=0).model
    done = export_into(model, "rrf", files, touches_in(dataset, model.joints))
    old = np.array([205.906, 375, 375, 375, 209.664, 329.501, 90, 0, 0, 0, 0, 0])
    old[7:10] = 439.590 + np.array([0.304, -1.064, 0.761])
    points = map_points(D300VS / "heightmap.csv", -0.461)
    assert done.heights.before == pytest.approx(54.0e-6, abs=0.1e-6)
    assert done.heights.after < 44.5e-6
    assert done.heights.held_out < 1.05 * rms_at_held_out(old, points, -0.461)
    assert done.movement.shape < 0.45e-3


def test_touches_imported_with_another_configuration_are_refused(tmp_path):
    _, files = printer_files(tmp_path, 1, 5e-6)
    model = configured(files).model
    other = tmp_path / "other.g"
    other.write_text(vp.CONFIG.replace("H300", "H301.5"))
    for text, name, one, two in (
        (vp.CONFIG.replace("H300", "H301.5"), "joint1.end_stop", "0.530629", "0.529129"),
        (vp.CONFIG.replace("L250", "L252"), "chain1.Lb", "0.252000", "0.250000"),
    ):
        other.write_text(text)
        dataset = samples("rrf", [tmp_path / "map.csv", other])
        said = f"{name} is {one}, but {two} in the model"
        with pytest.raises(ParallelCalError, match="another configuration") as refused:
            fit(model, dataset, hold_out=0)
        assert said in str(refused.value)
        with pytest.raises(ParallelCalError) as refused:
            export_into(model, "rrf", files, touches_in(dataset, model.joints))
        assert said in str(refused.value)
    assert files[0].read_text() == vp.CONFIG


def test_the_ends_of_a_short_part_are_two_poses(tmp_path):
    points = 1e3 * np.column_stack([vp.places(9, 1), np.zeros(9)])
    touched = ["Bed X: {:.4f} Y: {:.4f} Z: {:.4f}".format(*point) for point in points]
    start = "M92 X160 Y160 Z160\nM665 L250 R100 H300\nM666 X0 Y0 Z0\nM851 X0 Y0 Z0\n"
    (tmp_path / "printer.log").write_text(start + "\n".join(touched) + "\n")
    dataset = samples("marlin", [Path(tmp_path / "printer.log")], printed_x=[0.1, 0.1])
    assert len(set(dataset.pose_id.tolist())) == 11
