"""Distances of a printed part that Klipper stored determine x and y; the bed does not.

The printer that makes the part and touches the bed has other numbers than its file; both are those
of an independent firmware.
"""

import numpy as np
import pytest
import virtual_firmware as vf

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.cli.main import main
from parallel_cal.identification.observations import observe
from parallel_cal.identification.prediction_errors import errors
from parallel_cal.importing.controller_files import configured, samples

MM = 1e-3
STEP = 40 / (200 * 16)  # mm of a carriage
NUMBERS = {"radius": 140.0, "arms": (300.0,) * 3, "angles": (210.0, 330.0, 90.0)}
NUMBERS["stops"] = (400.0,) * 3
REAL = {"radius": 140.4, "arms": (300.5, 300.9, 300.2), "angles": (210.2, 329.9, 90.0)}
REAL["stops"] = (400.3, 399.8, 400.1)
PRINTER = "[printer]\nkinematics: delta\ndelta_radius: {radius}\n"
STEPPER = """\
[stepper_{name}]
rotation_distance: 40
microsteps: 16
arm_length: {arm}
angle: {angle}
position_endstop: {stop}
"""
FIT = (
    "new --from printer.cfg -o m.yaml",
    "import klipper printer.cfg -o t.json",
    "fit m.yaml t.json --prior -o o.yaml",
)
MIDDLE = "distances.middle7"
HEXAGON = 70 * np.array([[np.cos(a), np.sin(a), 0] for a in np.radians(30 + 60 * np.arange(6))])


def config(numbers):
    rows = zip("abc", numbers["arms"], numbers["angles"], numbers["stops"], strict=True)
    return PRINTER.format(**numbers) + "".join(
        STEPPER.format(name=n, arm=r, angle=a, stop=s) for n, r, a, s in rows
    )


def counted(firmware, points):
    """Steps (N, 3) from the end-stops with which a firmware goes to points (N, 3) in mm."""
    return (firmware.homed() - firmware.motors(points)) / STEP


def reached(firmware, steps):
    """Points (N, 3) in mm at which a firmware believes the nozzle."""
    return firmware.forward(firmware.homed() - STEP * steps)


def stored(real, nominal, seed=0, noise=0.02):
    """What DELTA_CALIBRATE and DELTA_ANALYZE store: 7 touches, 12 distances in mm."""
    rng = np.random.default_rng(seed)
    bed = np.vstack([np.zeros(3), 0.9 * HEXAGON[:, :] * 100 / 70])
    rows = [(f"height{k}", 0.0, [s]) for k, s in enumerate(counted(real, bed))]
    spokes = [(np.zeros(3), end) for end in HEXAGON]
    rims = list(zip(HEXAGON, np.roll(HEXAGON, -1, axis=0), strict=True))
    for k, ends in enumerate([*spokes, *rims]):
        steps = counted(nominal, np.array(ends))
        first, second = reached(real, steps)
        length = np.linalg.norm(second - first) + noise * rng.standard_normal()
        rows.append((f"distance{k}", length, list(steps)))
    text = "[delta_calibrate]\n"
    for name, value, places in rows:
        text += f"{name} = {value:.4f}\n"
        for i, steps in enumerate(places, start=1):
            end = f"_pos{i}" if len(places) > 1 else "_pos"
            text += f"{name}{end} = {','.join(f'{s:.3f}' for s in steps)}\n"
    return text


def shape_error(firmware, real):
    """Largest error (mm) of x and y over the bed, after a common shift and turn."""
    around, out = np.meshgrid(np.radians(np.arange(0, 360, 15)), [30, 60, 90])
    points = np.column_stack(
        [(out * np.cos(around)).ravel(), (out * np.sin(around)).ravel(), np.zeros(out.size)]
    )
    at = reached(firmware, counted(real, points))[:, :2]
    one, other = at - at.mean(axis=0), points[:, :2] - points[:, :2].mean(axis=0)
    left, _, right = np.linalg.svd(one.T @ other)
    return np.linalg.norm(one @ left @ right - other, axis=1).max()


def run(commands):
    for command in commands:
        with pytest.raises(SystemExit) as end:
            main(command.split())
        assert end.value.code == 0


@pytest.fixture
def printer(tmp_path):
    real, nominal = vf.Klipper(config(REAL)), vf.Klipper(config(NUMBERS))
    file = tmp_path / "printer.cfg"
    file.write_text(config(NUMBERS) + stored(real, nominal))
    return file, real, nominal


def test_distances_are_readings_at_their_ends(printer):
    file, real, nominal = printer
    data, model = samples("klipper", [file]), configured([file]).model
    assert len(data) == 7 + 2 * 12
    assert not data.warnings
    one = data.conditions["reading.distance7"]
    assert np.isfinite(one).sum() == 2
    ends = one[np.isfinite(one)]
    first, second = reached(real, counted(nominal, HEXAGON[[1, 2]]))
    assert np.ptp(ends) / MM == pytest.approx(np.linalg.norm(second - first), abs=0.08)
    [sensor] = [sensor for sensor in model.sensors if sensor.name == "distances"]
    assert sensor.directions[:2] == pytest.approx([np.radians(30), np.radians(90)], abs=1e-6)
    assert ends.mean() / MM == pytest.approx(0.0, abs=1e-4)  # the middle of a side, along it


@pytest.mark.wide
def test_a_fit_of_distances_corrects_the_shape_of_printed_parts(printer, capsys, monkeypatch):
    file, real, nominal = printer
    monkeypatch.chdir(file.parent)
    run([*FIT, "export o.yaml --to klipper --into printer.cfg"])
    out = capsys.readouterr().out
    assert "The measurements of x and y show all of this motion but" in out
    assert "No measurement shows" not in out
    before, after = (shape_error(f, real) for f in (nominal, vf.Klipper(file.read_text())))
    assert before > 0.15
    assert after < 0.3 * before


@pytest.mark.wide
def test_without_distances_nothing_shows_x_and_y(printer, capsys, monkeypatch):
    file, *_ = printer
    file.write_text(file.read_text().partition("distance0 =")[0])
    monkeypatch.chdir(file.parent)
    assert "cannot determine the print scale" in samples("klipper", [file]).warnings[0]
    run([*FIT, "export o.yaml --to klipper --into printer.cfg --force"])
    assert "No measurement shows whether this is right" in capsys.readouterr().out


def test_distances_behind_a_gap_are_counted(printer):
    file, *_ = printer
    file.write_text(file.read_text().replace("distance3", "distance30"))
    data = samples("klipper", [file])
    assert len(data) == 7 + 2 * 3
    assert "distance3 is missing" in data.warnings[0]
    assert data.warnings[0].endswith("omits 9 distances behind it")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("distance3 = ", "distance3 = -", "[delta_calibrate] distance3 is '-"),
        ("distance3_pos1 = ", "distance3_pos1 = 1,", "distance3_pos1 is '1,"),
        ("distance3_pos2 = ", "distance3_at = ", "no [delta_calibrate] distance3_pos2, expected"),
        ("distance3_pos2 = ", "distance3_pos2 = 99999,0,0\n# ", "steps at which the con"),
    ],
)
def test_a_wrong_distance_is_named_with_line_and_field(printer, old, new, message):
    file, *_ = printer
    file.write_text(file.read_text().replace(old, new))
    for read in (lambda: samples("klipper", [file]), lambda: configured([file])):
        with pytest.raises(ParallelCalError) as error:
            read()
        assert message in str(error.value)
        assert "\n" not in str(error.value)


def mesh(real, nominal, z_offset, radius=None):
    """What BED_MESH_CALIBRATE stores: the bed's heights by the nominal numbers, 5 x 5 points.

    The probe is 20 mm to the right of the nozzle and z_offset below it. The bed is z = 0 of the
    real printer, whose nozzle is at z_offset then.
    """
    x, y = np.meshgrid(np.linspace(-60, 60, 5), np.linspace(-60, 60, 5))
    # The nozzle's height by the nominal numbers, by bisection at all points at once.
    low, high = np.full(25, -5.0), np.full(25, 5.0)
    for _ in range(60):
        middle = (low + high) / 2
        nozzle = np.column_stack([x.ravel() - 20, y.ravel(), middle])
        below = reached(real, counted(nominal, nozzle))[:, 2] < z_offset
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    heights = low - z_offset
    grid = heights.reshape(5, 5)
    if radius is not None:  # Klipper repeats the outermost probed height of a row
        out = np.hypot(x, y) > radius
        grid = np.array([np.where(o, g[~o][0], g) for o, g in zip(out, grid, strict=True)])
    rows = "".join("\n  " + ", ".join(f"{z:.6f}" for z in row) for row in grid)
    text = f"[probe]\nz_offset: {z_offset}\nx_offset: 20\n[bed_mesh default]\nversion = 1\n"
    text += f"points = {rows}\nx_count = 5\ny_count = 5\n"
    text += "min_x = -60.0\nmax_x = 60.0\nmin_y = -60.0\nmax_y = 60.0\n"
    return text + (f"[bed_mesh]\nmesh_radius: {radius}\n" if radius else "")


@pytest.mark.parametrize(("radius", "n"), [(None, 25), (61, 13)])
def test_a_bed_mesh_is_touches_where_the_probe_was(tmp_path, radius, n):
    real, nominal = vf.Klipper(config(REAL)), vf.Klipper(config(NUMBERS))
    file = tmp_path / "printer.cfg"
    file.write_text(config(NUMBERS) + mesh(real, nominal, 2.5, radius))
    data = samples("klipper", [file])
    assert len(data) == n
    assert data.conditions["reading.probe"] == pytest.approx(2.5e-3)
    q0 = np.array(configured([file]).model.mechanism.joint_limits)[:, 1]
    heights = reached(real, (q0 - data.q) / MM / STEP)[:, 2]
    assert heights == pytest.approx(2.5, abs=2e-5)  # where the real printer touches
    assert any("holds only for the geometry" in words for words in data.warnings)
    assert data.configuration["chain1.D_x"] == pytest.approx(0.14)


def test_a_mesh_is_used_beside_stored_heights_unless_it_is_left_out(printer):
    file, real, nominal = printer
    text = file.read_text() + mesh(real, nominal, 2.5)
    file.write_text(text + "[bed_mesh cold]\npoints = 0\n")
    data = samples("klipper", [file])
    assert len(data) == 7 + 25 + 24
    assert any("not used: [bed_mesh cold]; --option mesh" in words for words in data.warnings)
    assert len(samples("klipper", [file], mesh="none")) == 7 + 24
    with pytest.raises(ParallelCalError, match="no mesh 'warm', expected default or cold or none"):
        samples("klipper", [file], mesh="warm")
    file.write_text(text + "[bed_mesh]\nzero_reference_position: 0, 0\n")
    data = samples("klipper", [file])
    assert len(data) == 7 + 24
    assert any("count from the point of zero_reference_pos" in words for words in data.warnings)


def test_both_ends_of_a_distance_are_held_out_together(printer):
    file, *_ = printer
    data = samples("klipper", [file])
    pairs = [
        np.flatnonzero(np.isfinite(data.conditions[f"reading.distance{k}"])) for k in range(12)
    ]
    folds = data.folds()
    assert [np.isin(pair, test).all() for pair in pairs for _, test in folds].count(True) == 12
    assert not any(np.isin(pair, test).sum() == 1 for pair in pairs for _, test in folds)


def test_the_error_of_a_distance_does_not_depend_on_its_middle(printer):
    """Each end is off by half of measured minus configured distance, with opposite signs."""
    file, *_ = printer
    data, model = samples("klipper", [file]), configured([file]).model
    moved = model.with_values(model.values + 1e-3 * (np.array(model.table.names) == MIDDLE))
    one, other = (errors(m, observe(m, data)).reading for m in (model, moved))
    np.testing.assert_allclose(one, other, atol=1e-12)
    read = data.conditions["reading.distance7"]
    expected = (np.ptp(read[np.isfinite(read)]) - 70 * MM) / 2
    off = one[np.isfinite(read), 1 + 7]
    np.testing.assert_allclose(off, [-expected, expected], atol=1e-7)


@pytest.mark.wide
def test_a_mesh_beside_distances_leaves_micrometres(tmp_path, capsys, monkeypatch):
    real, nominal = vf.Klipper(config(REAL)), vf.Klipper(config(NUMBERS))
    file = tmp_path / "printer.cfg"
    file.write_text(config(NUMBERS) + stored(real, nominal) + mesh(real, nominal, 2.5, 61))
    monkeypatch.chdir(tmp_path)
    run([*FIT, "export o.yaml --to klipper --into printer.cfg"])
    assert "at 20 touches" in capsys.readouterr().out
    assert shape_error(nominal, real) > 0.15
    assert shape_error(vf.Klipper(file.read_text()), real) < 0.03


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("x_count = 5", "x_count = 6", "[bed_mesh default] points is '25 heights', expected 30"),
        ("points = \n  ", "points = \n  x", "[bed_mesh default] points is 'x"),
        ("min_x = -60.0\n", "", "no [bed_mesh default] min_x, expected mm"),
        ("max_x = 60.0", "max_x = 900.0", "expected points within reach of the rods"),
    ],
)
def test_a_wrong_mesh_is_named(tmp_path, old, new, message):
    real, nominal = vf.Klipper(config(REAL)), vf.Klipper(config(NUMBERS))
    file = tmp_path / "printer.cfg"
    text = config(NUMBERS) + mesh(real, nominal, 2.5)
    assert old in text
    file.write_text(text.replace(old, new))
    with pytest.raises(ParallelCalError) as error:
        samples("klipper", [file])
    assert message in str(error.value)
    assert len(str(error.value)) < 600
