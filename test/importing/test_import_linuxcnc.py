"""LinuxCNC's probe logs become touches of a linear Delta; or one clear line."""

import numpy as np
import pytest
import virtual_firmware as vf
from scipy.optimize import fsolve

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.exporting.export import export, export_into
from parallel_cal.identification.fit import fit
from parallel_cal.importing.controller_files import configured, samples
from parallel_cal.importing.importers import linuxcnc
from parallel_cal.importing.touch_samples import touches_in
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.mechanism import poses_in_workspace
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_mechanism

HAL = """\
loadrt lineardeltakins
setp lineardeltakins.R 150  # mm
setp lineardeltakins.L 250
setp lineardeltakins.J1off 0.5
"""
LOG = """\
0.000000 80.000000 -1.000000 0.000000 0.000000 0.000000 0.000000 0.000000 0.000000
-30.5 20 0.25 0 0 0 0 0 0

"""


@pytest.fixture
def files(tmp_path):
    """files(log, hal): their paths."""

    def write(log=LOG, hal=HAL):
        (tmp_path / "probe.txt").write_text(log)
        (tmp_path / "machine.hal").write_text(hal)
        return [tmp_path / "probe.txt", tmp_path / "machine.hal"]

    return write


def test_lines_of_the_log_are_touches(files):
    data = samples("linuxcnc", files(), unit="mm")
    # 70 mm from tower 0, which stands along y: 250^2 = 70^2 + 240^2
    assert data.q[0, 0] == pytest.approx(0.239, abs=1e-12)
    assert data.q[0, 1] - data.q[0, 2] == pytest.approx(0.0005, abs=1e-12)
    at = Kinematics(configured(files()[1:]).model).direct(data.q).position
    np.testing.assert_allclose(at, [[0, 0.08, -0.001], [-0.0305, 0.02, 0.00025]], atol=1e-9)


def test_inches_are_inches(files):
    inches = LOG.replace("80.000000", "3.0").replace("-30.5 20", "1 1")
    hal = HAL.replace("150", "6").replace("250", "10").replace("0.5", "0")
    data = samples("linuxcnc", files(inches, hal), unit="in")
    expected = 0.0254 * (np.sqrt(10**2 - 3**2) - 1)
    assert data.q[0, 0] == pytest.approx(expected, abs=1e-12)


def test_a_signal_may_lead_to_the_pins(files):
    """As LinuxCNC's own examples have it."""
    led = HAL.replace(
        "setp lineardeltakins.R 150", "net R lineardeltakins.R => delta.R\nsets R 150"
    )
    plain, model = (configured(files(hal=text)[1:]).model for text in (HAL, led))
    assert plain.values.tolist() == model.values.tolist()
    with pytest.raises(ParallelCalError, match=r"hal:3: lineardeltakins.R is '15O', expected setp"):
        configured(files(hal=led.replace("sets R 150", "sets R 15O"))[1:])


BROKEN = {
    "short line": (LOG.replace(" 0 0 0\n", "\n"), HAL, "probe.txt:2: the line is '-30.5 20 0.25 0"),
    "word": (LOG.replace("0.25", "O.25"), HAL, "probe.txt:2: Z is 'O.25', expected a number"),
    "nan": (LOG.replace("80.000000", "nan"), HAL, "probe.txt:1: Y is 'nan', expected a number"),
    "far": (LOG.replace("80.0", "880.0"), HAL, "probe.txt:1: position is 'x 0.000 y 880.000"),
    "empty": ("", HAL, "the files contain no touches"),
    "no R": (LOG, HAL.replace(".R", ".Q"), "machine.hal: no lineardeltakins.R, expected setp"),
    "R": (LOG, HAL.replace("150", "[KINS]R"), "hal:2: lineardeltakins.R is '[KINS]R', expected"),
    "L": (LOG, HAL.replace("250", "140"), "hal:3: lineardeltakins.L is '140', expected setp, the"),
    "offset": (LOG, HAL.replace("0.5", "x"), "hal:4: lineardeltakins.J1off is 'x', expected mm"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_file_is_named_with_line_and_field(files, name):
    log, hal, message = BROKEN[name]
    with pytest.raises(ParallelCalError) as error:
        samples("linuxcnc", files(log, hal), unit="mm")
    assert message in str(error.value)


def test_the_unit_must_be_stated(files):
    with pytest.raises(ParallelCalError, match=r"missing a required argument: 'unit'.*unit, step"):
        samples("linuxcnc", files())
    with pytest.raises(ParallelCalError, match="unit=furlong: expected mm, in or m"):
        samples("linuxcnc", files(), unit="furlong")


# ------------------------------------------------------------------ its own kinematics, any unit

INCH = 25.4  # mm
ROTARY = """\
net pfr rotarydeltakins.platformradius => view.pfr
net tl rotarydeltakins.thighlength => view.tl
net sl rotarydeltakins.shinlength => view.sl
net fr rotarydeltakins.footradius => view.fr
sets pfr 10
sets tl 10
sets sl 18
sets fr 5 # of the foot
"""
HOMED = "[JOINT_{}]\nHOME_OFFSET = {}\n"


def machine(folder, hal, unit, homed, limit="MAX_LIMIT = 90.0\n"):
    """Both files of a machine whose joints are homed at these positions."""
    joints = "".join(HOMED.format(i, at) + limit for i, at in enumerate(homed))
    (folder / "machine.hal").write_text(hal)
    (folder / "machine.ini").write_text(f"[TRAJ]\nLINEAR_UNITS = {unit}\n{joints}")
    return [folder / "machine.hal", folder / "machine.ini"]


def hexapod_pins():
    """Pins of a hexapod in inches: two flat triangles of pairs, the platform 20 inches up."""
    base, platform = ([[-23, 13], [23, 13], [23, 13], [0, -26], [0, -26], [-23, 13]],) + (
        [[-1, 11], [1, 11], [10, -5], [9, -6], [-9, -6], [-10, -5]],
    )
    lines = [
        f"setp genhexkins.{name}.{k}.{axis} {value}"
        for name, points in (("base", base), ("platform", platform))
        for k, point in enumerate(points)
        for axis, value in zip("xyz", [*point, 0.0], strict=True)
    ]
    spans = np.linalg.norm(np.subtract(platform, base), axis=1)
    return "\n".join(lines) + "\n", np.hypot(spans, 20.0)


def test_a_rotary_delta_in_inches_is_read_where_its_shins_reach(tmp_path):
    model = configured(machine(tmp_path, ROTARY, "inch", [0, 5, -5])).model
    text = ROTARY.replace("net ", "#").replace("sets pfr", "setp rotarydeltakins.platformradius")
    for short, pin in (("tl", "thighlength"), ("sl", "shinlength"), ("fr", "footradius")):
        text = text.replace(f"sets {short}", f"setp rotarydeltakins.{pin}")
    lines = [line.split(" #")[0] for line in text.splitlines() if not line.startswith("#")]
    firmware = vf.LinuxCnc("\n".join(lines), (tmp_path / "machine.ini").read_text())
    r, _ = poses_in_workspace(model.mechanism, 200, np.random.default_rng(1))
    found = Kinematics(model).inverse(r)
    assert found.solved.all()
    np.testing.assert_allclose(
        np.degrees(found.joints), -firmware.motors(r / (INCH * 1e-3)), atol=1e-9
    )
    tops = np.degrees([high for _, high in model.mechanism.joint_limits])
    assert tops == pytest.approx([0, -5, 5])


def test_a_hexapod_in_inches_has_readings_that_are_the_lengths_of_its_struts(tmp_path):
    pins, lengths = hexapod_pins()
    model = configured(machine(tmp_path, pins, "inch", lengths)).model
    home = model.mechanism.home
    np.testing.assert_allclose(home.joints, lengths * INCH * 1e-3, atol=1e-12)
    assert home.position == pytest.approx((0, 0, 20 * INCH * 1e-3))
    assert model.value("leg1.C_x") == pytest.approx(-23 * INCH * 1e-3)


def short_struts(folder):
    """Files of a hexapod in inches that is homed 3 inches shorter than at HOME, and has a SCALE."""
    pins, lengths = hexapod_pins()
    files = machine(folder, pins, "inch", lengths - 3)
    text = files[1].read_text().replace("MAX_LIMIT = 90.0\n", "")
    for i, length in enumerate(lengths):
        stated = f"HOME = {length}\nMIN_LIMIT = {length - 3.1}\nMAX_LIMIT = {length + 4}\n"
        text = text.replace(f"[JOINT_{i}]\n", f"[JOINT_{i}]\nSCALE = -4000\n{stated}")
    files[1].write_text(text)
    return files, lengths


def test_a_hexapod_has_the_limits_and_the_switches_of_its_ini_file(tmp_path):
    files, lengths = short_struts(tmp_path)
    found = configured(files)
    assert found.remarks == ()
    mechanism = found.model.mechanism
    limits = np.column_stack([lengths - 3.1, lengths + 4]) * INCH * 1e-3
    np.testing.assert_allclose(mechanism.joint_limits, limits)
    np.testing.assert_allclose(mechanism.switches, (lengths - 3) * INCH * 1e-3)
    np.testing.assert_allclose(mechanism.scale, -4000 / (INCH * 1e-3))
    np.testing.assert_allclose(mechanism.home.joints, lengths * INCH * 1e-3)
    r, R = poses_in_workspace(mechanism, 500, np.random.default_rng(3))
    q = Kinematics(found.model).inverse(r, R).joints
    assert ((q > limits[:, 0]) & (q < limits[:, 1])).all()


def test_a_wrong_pitch_goes_into_scale_and_a_zero_into_home_offset(tmp_path):
    """Counts of true screws, by hand: a strut is zero + (1 + gain) * (counts / old SCALE)."""
    files, lengths = short_struts(tmp_path)
    drawing = configured(files).model
    model = drawing.with_effect("encoder_gain")
    gains, zeros = 1e-4 * np.arange(1, 7), 1e-4 * np.arange(-3, 3)
    values = model.values.copy()
    for i in range(6):
        values[model.table.index_of(f"encoder_gain.leg{i + 1}.gain")] = gains[i]
        values[model.table.index_of(f"leg{i + 1}.L0")] = zeros[i]
    model = model.with_values(values)
    for _ in range(2):  # a second export changes nothing
        done = export_into(model, "linuxcnc", files)
        ini = files[1].read_text()
        scale, homed = (
            np.array([float(line.split()[-1]) for line in ini.splitlines() if line.startswith(key)])
            for key in ("SCALE", "HOME_OFFSET")
        )
        switch = (lengths - 3) * INCH * 1e-3
        np.testing.assert_allclose(scale, -4000 / (1 + gains), rtol=1e-7)
        travel = np.linspace(0, 3, 5)[:, None]  # inches from the switch, as LinuxCNC counts
        counts = travel * scale
        true = zeros + (1 + gains) * (switch + counts / -4000 * INCH * 1e-3)
        np.testing.assert_allclose((homed + travel) * INCH * 1e-3, true, atol=2e-7)
    assert done.loss["position_max"] < 0.3e-6
    assert done.before["position_max"] < 0.3e-6


def test_a_hexapod_with_switches_elsewhere_is_not_written(tmp_path):
    """A model whose upper limits were taken for switches: HOME_OFFSET would move by 7 inches."""
    files, _ = short_struts(tmp_path)
    model = configured(files).model
    model.mechanism.switches = model.mechanism.scale = None
    before = [file.read_text() for file in files]
    with pytest.raises(ParallelCalError, match=r"leg1 would read 177.8 mm differently .* Nothing"):
        export_into(model, "linuxcnc", files)
    assert [file.read_text() for file in files] == before


def test_a_twist_correction_of_the_hal_file_is_not_left_active(tmp_path):
    files, _ = short_struts(tmp_path)
    model = configured(files).model
    files[0].write_text(files[0].read_text() + "setp genhexkins.screw-lead 0.2\n")
    with pytest.raises(ParallelCalError, match=r"screw-lead is '0.2', expected 0: the export"):
        export_into(model, "linuxcnc", files)


def test_component_and_parameters_are_in_separate_folders(tmp_path):
    files, _ = short_struts(tmp_path)
    export(configured(files).model, "linuxcnc", tmp_path / "out")
    out = tmp_path / "out"
    assert {path.name for path in out.iterdir()} == {"component", "genhexkins"}
    assert {path.name for path in (out / "genhexkins").iterdir()} == {"machine.hal", "machine.ini"}
    assert "HOME_OFFSET and SCALE must be" in (out / "component/stewart42_kins.c").read_text()
    assert "Do not use" in (out / "genhexkins/machine.ini").read_text().splitlines()[0]


@pytest.mark.parametrize("kind", ["rotary", "hexapod"])
def test_numbers_go_back_into_a_file_in_inches_in_inches(kind, tmp_path):
    pins, homed = (ROTARY, [0, 5, -5]) if kind == "rotary" else hexapod_pins()
    files = machine(tmp_path, pins, "inch", homed)
    before = files[0].read_text()
    model = configured(files).model
    done = export_into(model, "linuxcnc", files)
    assert done.before["position_max"] < 5e-9
    assert done.loss["position_max"] < 5e-9
    kept = {*files[0].read_text().splitlines()} & {*before.splitlines()}
    changed = {*before.splitlines()} - kept
    assert {line.split()[1] for line in changed} <= ({"pfr", "fr"} if kind == "rotary" else set())
    longer = "chain1.Lb" if kind == "rotary" else "leg1.C_x"
    values = model.values.copy()
    values[model.table.index_of(longer)] += 0.0254e-2  # a hundredth of an inch
    export_into(model.with_values(values), "linuxcnc", files)
    if kind == "hexapod":
        assert "genhexkins.base.0.x -22.99" in files[0].read_text()
    else:
        assert "sets sl 18.00" in files[0].read_text()


@pytest.mark.parametrize("joint", ["JOINT", "AXIS"])
def test_pins_may_lead_to_keys_of_the_ini_file_and_joints_may_be_axes(joint, tmp_path):
    """As machines in use have it; before version 2.8, [AXIS_0] was the section of joint 0."""
    hal, ini = tmp_path / "machine.hal", tmp_path / "machine.ini"
    hal.write_text(
        "setp lineardeltakins.R [MACHINE]TOWERS\nsetp lineardeltakins.L [MACHINE](ROD)\n"
    )
    switches = "".join(f"[{joint}_{i}]\nHOME_OFFSET = {300 + i}\n" for i in range(3))
    ini.write_text(
        f"[MACHINE]\nTOWERS = 150.5  # mm\nROD = 250\n[TRAJ]\nLINEAR_UNITS = mm\n{switches}"
    )
    model = configured([hal, ini]).model
    towers = linuxcnc.kinematics(linuxcnc.settings([hal, ini]))
    np.testing.assert_allclose(towers.radius, 0.1505)
    np.testing.assert_allclose(towers.rods, 0.25)
    np.testing.assert_allclose(towers.homed, [0.3, 0.301, 0.302])
    before = hal.read_text(), ini.read_text()
    assert export_into(model, "linuxcnc", [hal, ini]).loss["position_max"] < 5e-9
    assert (hal.read_text(), ini.read_text()) == before
    longer = model.values.copy()
    for i in range(3):
        longer[model.table.index_of(f"chain{i + 1}.Lb")] += 1e-3
    export_into(model.with_values(longer), "linuxcnc", [hal, ini])
    assert hal.read_text() == before[0]
    assert "ROD = 251.00000\n" in ini.read_text()
    assert "TOWERS = 150.5  # mm\n" in ini.read_text()
    with pytest.raises(ParallelCalError, match=r"hal:1: lineardeltakins.R is '\[MACHINE\]TOWERS'"):
        configured([hal])


@pytest.mark.wide
@pytest.mark.parametrize("name", ["stewart42", "delta24", "linear_delta"])
def test_what_was_exported_for_its_own_kinematics_is_read_again(name, tmp_path):
    model = new_model(name)
    export(model, "linuxcnc", tmp_path)
    (folder,) = (path for path in tmp_path.iterdir() if path.name != "component")
    files = [folder / "machine.hal", folder / "machine.ini"]
    again = configured(files)
    assert any("lengths are assumed to be in mm" in remark for remark in again.remarks)
    done = export(again.model, "linuxcnc", tmp_path / "again")
    assert done.loss["position_max"] < 0.1e-6
    for file in files:
        assert (tmp_path / "again" / folder.name / file.name).read_text() == file.read_text()


def towers_with(folder, joints, axes="", homed=None):
    """Files of a linear Delta in mm, R 150 and L 250: carriages are 200 above a central tool."""
    (folder / "machine.hal").write_text("setp lineardeltakins.R 150\nsetp lineardeltakins.L 250\n")
    stops = f"HOME_OFFSET = {homed}\n" if homed is not None else ""
    sections = "".join(f"[JOINT_{i}]\n{stops}{joints}" for i in range(3))
    (folder / "machine.ini").write_text(f"[TRAJ]\nLINEAR_UNITS = mm\n{sections}{axes}")
    return [folder / "machine.hal", folder / "machine.ini"]


def span(low, high):
    return f"MIN_LIMIT = {low}\nMAX_LIMIT = {high}\n"


# limits of the joints and of z, HOME_OFFSET -> joint limits, heights of the workspace, the bed (mm)
BED, FAR = "[AXIS_Z]\n" + span(450, 640), "[AXIS_Z]\n" + span(900, 990)
RAILS = {
    "its own example": (span(0, 375), "[AXIS_Z]\n" + span(-5, 35), 375, (0, 375), (0, 35), 0),
    "zero at the top": (span(-700, 1), "", 0, (-700, 1), (-900, -800), -900),
    "a bed above zero": (span(600, 950), BED, 950, (600, 950), (450, 640), 450),
    "no limits": ("", "", 0, (-100, 0), (-300, -200), -300),
    "limits of nothing": (span(-1e99, 1e6), "", 500, (-100, 500), (0, 100), 0),
    "z beyond the joints": (span(0, 400), FAR, 400, (0, 400), (0, 100), 0),
}  # fmt: skip


@pytest.mark.parametrize("name", RAILS)
def test_a_linear_delta_works_between_the_limits_of_its_ini_file(tmp_path, name):
    joints, axes, homed, limits, heights, bed = RAILS[name]
    found = configured(towers_with(tmp_path, joints, axes, homed))
    model, mechanism = found.model, found.model.mechanism
    if name == "no limits":  # the lower ones are those of the assumed workspace
        np.testing.assert_allclose(np.array(mechanism.joint_limits)[:, 1], 0, atol=1e-12)
    else:
        np.testing.assert_allclose(mechanism.joint_limits, [np.array(limits) * 1e-3] * 3)
    low, high = np.array(mechanism.joint_limits).T
    home, box = mechanism.home, mechanism.workspace
    height = home.position[2]
    assert height == pytest.approx(np.mean(heights) * 1e-3)
    np.testing.assert_allclose(home.joints, height + 0.2)  # 250^2 = 150^2 + 200^2
    assert ((home.joints > low) & (home.joints < high)).all()
    assert heights[0] * 1e-3 - 1e-9 <= box.low[2] < height < box.high[2] <= heights[1] * 1e-3 + 1e-9
    r, _ = poses_in_workspace(mechanism, 200, np.random.default_rng(1))
    q = Kinematics(model).inverse(r).joints
    assert ((q >= low - 1e-9) & (q <= high + 1e-9)).all()
    assert model.value("probe.plate.z") == pytest.approx(bed * 1e-3)
    said = "\n".join(found.remarks)
    assert ("--sensor 'probe: {height: " in said) == (bed != 0)
    assert ("joint limits are assumed" in said) == (name in ("no limits", "limits of nothing"))
    assert ("[AXIS_Z] MIN_LIMIT and MAX_LIMIT are heights" in said) == (
        name == "z beyond the joints"
    )


def test_the_bed_of_a_machine_with_zero_at_the_top_calibrates_where_it_is(tmp_path):
    """By hand: 250^2 = 150^2 + 200^2, so the carriages are at -700 when the tool is at -900."""
    files = towers_with(tmp_path, span(-720, 1))  # LinuxCNC's HOME_OFFSET is then 0
    (tmp_path / "probe.txt").write_text("0 0 -900 0 0 0 0 0 0\n0 80 -900.5 0 0 0 0 0 0\n")
    data = samples("linuxcnc", [tmp_path / "probe.txt", *files], unit="mm")
    np.testing.assert_allclose(data.q[0], -0.7, atol=1e-12)
    model = configured(files).model
    assert model.mechanism.switches == (0.0, 0.0, 0.0)
    assert touches_in(data, model.joints).explain_other_model(model) == ""


@pytest.mark.wide
def test_a_fit_finds_an_unstated_bed_and_the_export_leaves_it_there(tmp_path):
    """True: R 150.4, switches 0.3, -0.2 and 0.1 mm off, the bed at -900 where -920 is assumed."""
    files = towers_with(tmp_path, span(-720, 1))
    angles = np.radians([90, 210, 330])

    def carriages(r, radius, off):
        towers = radius * np.column_stack([np.cos(angles), np.sin(angles)])
        away = ((r[:, None, :2] - towers) ** 2).sum(axis=2)
        return r[:, 2:] + np.sqrt(250**2 - away) - np.array(off)

    grid = np.array([(x, y) for x in range(-80, 81, 20) for y in range(-80, 81, 20)], float)
    bed = np.column_stack([grid, np.full(len(grid), -900.0)])[np.hypot(*grid.T) < 85]
    counted = carriages(bed, 150.4, [0.3, -0.2, 0.1])
    by_firmware = [
        fsolve(lambda r, q: carriages(r[None], 150, [0, 0, 0])[0] - q, r, args=(q,))
        for r, q in zip(bed, counted, strict=True)
    ]
    lines = [" ".join(f"{v:.6f}" for v in (*r, *[0] * 6)) for r in by_firmware]
    (tmp_path / "probe.txt").write_text("\n".join(lines))
    touches = samples("linuxcnc", [tmp_path / "probe.txt", *files], unit="mm")
    found = fit(configured(files).model, touches, hold_out=0, prior=True).model
    assert found.value("probe.plate.z") == pytest.approx(-0.9, abs=1e-3)
    done = export_into(found, "linuxcnc", files, touches_in(touches, found.joints))
    assert done.heights.after < 1e-6 < 100e-6 < done.heights.before
    # LinuxCNC's z moves by less than 1 mm.
    stops = [float(t.split()[-1]) for t in files[1].read_text().splitlines() if "HOME_O" in t]
    np.testing.assert_allclose(stops, 0, atol=1.0)


def test_switches_inside_the_limits_stay_where_they_are(tmp_path):
    """The export writes HOME_OFFSET again, not the upper limit."""
    files = towers_with(tmp_path, span(-700, 5), homed=-1.5)
    model = configured(files).model
    assert model.mechanism.switches == pytest.approx((-0.0015,) * 3)
    before = files[1].read_text()
    assert export_into(model, "linuxcnc", files).loss["position_max"] < 5e-9
    assert files[1].read_text() == before


def test_a_rotary_delta_has_the_limits_of_its_ini_file_with_its_own_signs(tmp_path):
    """LinuxCNC counts downwards, the model upwards: -45..80 is -80..45. z is -18..-10 inches."""
    files = machine(tmp_path, ROTARY, "inch", [0, 5, -5])
    joints = files[1].read_text().replace("MAX_LIMIT = 90.0", "MIN_LIMIT = -45\nMAX_LIMIT = 80")
    files[1].write_text(joints + "[AXIS_Z]\nMIN_LIMIT = -18\nMAX_LIMIT = -10\n")
    found = configured(files)
    mechanism = found.model.mechanism
    np.testing.assert_allclose(np.degrees(mechanism.joint_limits), [[-80, 45]] * 3)
    np.testing.assert_allclose(np.degrees(mechanism.switches), [0, -5, 5], atol=1e-12)
    assert mechanism.home.position == pytest.approx((0, 0, -14 * INCH * 1e-3))
    t = mechanism.home.joints[0]  # in inches: 18^2 = (5 + 10 cos t)^2 + (14 + 10 sin t)^2
    assert np.hypot(5 + 10 * np.cos(t), 14 + 10 * np.sin(t)) == pytest.approx(18)
    low, high = mechanism.workspace.low[2], mechanism.workspace.high[2]
    assert -18 * INCH * 1e-3 - 1e-9 <= low < high <= -10 * INCH * 1e-3 + 1e-9
    assert any("minus" in r or "-1 times" in r for r in found.remarks)
    before = files[1].read_text()
    export_into(found.model, "linuxcnc", files)
    assert files[1].read_text() == before


def test_arms_that_cannot_be_at_their_switches_have_home_inside_their_limits(tmp_path):
    files = machine(tmp_path, ROTARY, "inch", [0, 0, 0])
    limits = "MIN_LIMIT = 30\nMAX_LIMIT = 80"
    files[1].write_text(files[1].read_text().replace("MAX_LIMIT = 90.0", limits))
    mechanism = configured(files).model.mechanism
    np.testing.assert_allclose(np.degrees(mechanism.home.joints), -55, atol=1e-9)


@pytest.mark.parametrize("limits", [(-1000, 1000), (0, 1e6), (-1e99, 1e99), (0, 25)])
def test_limits_that_no_strut_can_reach_are_none(tmp_path, limits):
    """LinuxCNC's example of a hexapod has -1000 and 1000 inches."""
    pins, lengths = hexapod_pins()
    files = machine(tmp_path, pins, "inch", lengths)
    low, high = limits
    high = high if high > 25 else float(lengths.max()) + 4
    text = files[1].read_text().replace("MAX_LIMIT = 90.0\n", span(low, high))
    files[1].write_text(text)
    found = configured(files)
    assert any("joint limits are assumed" in remark for remark in found.remarks)
    bounds = np.array(found.model.mechanism.joint_limits) / (INCH * 1e-3)
    assert (bounds[:, 0] > 0).all()
    assert (bounds[:, 0] < lengths).all()
    expected = [high] * 6 if high < 100 else 1.5 * lengths
    np.testing.assert_allclose(bounds[:, 1], expected)


# Pins of LinuxCNC's example configs/sim/axis/pentapod (5c41560ebb), mm: x y z of the base, r and z
# of the effector.
PENTAPOD = (
    (-418, 500, -140, 80.3, 87),
    (418, 500, -140, 80.3, 114.5),
    (0, 500, -310, 80.3, 140.5),
    (418, 500, 510, 80.3, 232.5),
    (-418, 500, 510, 80.3, 258.5),
)
# X Y Z A B in mm and degrees, and the struts in mm that its pentakins.c computed for them.
BY_PENTAKINS = (
    ((0, 0, 0, 0, 0), (614.846892386, 625.522142755, 615.709623118, 635.227479787, 624.307577302)),
    (
        (20, -30, 40, 8, -5),
        (668.912761846, 675.557057987, 685.776818500, 661.849477251, 656.523630804),
    ),
    (
        (-55.5, 61.25, -18, -12, 10),
        (525.063237974, 577.584027674, 527.046854824, 601.824831029, 554.828415713),
    ),
)
# Likewise Bx, Cx, Cy in inches of lib/hallib/tripodsim.hal; X Y Z and the struts by tripodkins.c.
TRIPOD = "setp tripodkins.Bx 10\nsetp tripodkins.Cx 5\nsetp tripodkins.Cy 7.071\n"
BY_TRIPODKINS = (
    ((1, 2, 3), (3.741657387, 9.695359715, 7.121449361)),
    ((4, 2.5, 3.5), (5.873670062, 7.382411530, 5.843290255)),
)


def pentapod_pins():
    names = ("base.{}.x", "base.{}.y", "base.{}.z", "effector.{}.r", "effector.{}.z")
    return "".join(
        f"setp pentakins.{name.format(k)} {value}\n"
        for k, row in enumerate(PENTAPOD)
        for name, value in zip(names, row, strict=True)
    )


def about(axis, degrees):
    w = np.zeros(3)
    w["xy".index(axis)] = np.radians(degrees)
    return rotation_matrix(w[None])[0]


@pytest.mark.parametrize("home", [0, 1])
def test_a_pentapod_moves_as_pentakins_computes(tmp_path, home):
    """From any home; its rotation is Ry(B) Rx(A)."""
    hal = pentapod_pins()
    found = configured(machine(tmp_path, hal, "mm", BY_PENTAKINS[home][1], ""))
    assert found.model.mechanism.name == "pentapod"
    at = [pose for pose, _ in BY_PENTAKINS]
    r = np.array([pose[:3] for pose in at]) * 1e-3
    R = np.array([about("y", pose[4]) @ about("x", pose[3]) for pose in at])
    joints = np.array([struts for _, struts in BY_PENTAKINS]) * 1e-3
    solved = Kinematics(found.model)
    np.testing.assert_allclose(solved.inverse(r, R).joints, joints, atol=1e-12)
    poses = solved.direct(joints)
    np.testing.assert_allclose(poses.position, r, atol=1e-11)
    np.testing.assert_allclose(poses.rotation, R, atol=1e-10)
    np.testing.assert_allclose(found.model.mechanism.home.position, r[home], atol=1e-9)


def test_a_tripod_moves_as_tripodkins_computes(tmp_path):
    found = configured(machine(tmp_path, TRIPOD, "inch", BY_TRIPODKINS[1][1]))
    assert found.model.mechanism.name == "tripod_struts"
    r, joints = (np.array([row[k] for row in BY_TRIPODKINS]) * INCH * 1e-3 for k in (0, 1))
    solved = Kinematics(found.model)
    np.testing.assert_allclose(solved.inverse(r).joints, joints, atol=1e-11)
    np.testing.assert_allclose(solved.direct(joints).position, r, atol=1e-10)
    np.testing.assert_allclose(found.model.mechanism.home.position, r[1], atol=1e-10)


def test_lengths_of_a_pentapod_that_do_not_meet_leave_home_at_zero(tmp_path):
    """Those of LinuxCNC's own example: they miss each other by 22 mm."""
    homed = [598.5792, 697.1982, 682.785, 787.9175, 806.0397]
    found = configured(machine(tmp_path, pentapod_pins(), "mm", homed, ""))
    assert any(
        r"where they are 614.8469, 625.5221, 615.7096, 635.2275, 624.3076 long" in remark
        for remark in found.remarks
    )
    assert found.model.mechanism.home.position == (0, 0, 0)


@pytest.mark.parametrize("kind", ["pentapod", "tripod"])
def test_struts_that_are_longer_and_elsewhere_go_back_into_the_files(kind, tmp_path):
    """The numbers in the files are those of the changed robot, and a second export changes none."""
    hal, homed, unit = (
        (pentapod_pins(), BY_PENTAKINS[0][1], "mm")
        if kind == "pentapod"
        else (TRIPOD, BY_TRIPODKINS[1][1], "inch")
    )
    files = machine(tmp_path, hal, unit, homed, "")
    model = configured(files).model
    rng = np.random.default_rng(4)
    moved = model.with_values(model.values + 1e-3 * rng.standard_normal(len(model.values)))
    done = export_into(moved, "linuxcnc", files)
    assert done.before["position_max"] > 1e-3
    assert done.loss["position_max"] < 0.1e-6
    again = export_into(moved, "linuxcnc", files)
    assert again.before["position_max"] < 0.1e-6
    text = files[0].read_text()
    if kind == "pentapod":
        value = moved.value("leg3.B_r") * 1e3
        assert f"setp pentakins.effector.2.r {value:.5f}" in text
    else:
        A, B = ([moved.value(f"leg{i}.C_{axis}") for axis in "xyz"] for i in (1, 2))
        side = np.linalg.norm(np.subtract(B, A)) / (INCH * 1e-3)
        assert f"setp tripodkins.Bx {side:.7f}" in text


def test_a_tripod_may_hang_and_lean(tmp_path):
    """Its base leans in the model's frame; LinuxCNC's frame lies on the base, the tool above it."""
    base = [[0.1, 0.2, 1.0], [0.15, -0.3, 1.1], [-0.4, 0.1, 0.9]]
    mechanism = load_mechanism("tripod_struts", base=base, home=[0, 0, 0.4], retracted=0)
    done = export(new_model(mechanism), "linuxcnc", tmp_path)
    assert done.loss["position_max"] < 0.1e-6
    pins = dict(
        line.split()[1:3]
        for line in (tmp_path / "tripodkins/machine.hal").read_text().splitlines()
        if line.startswith("setp")
    )
    side = np.linalg.norm(np.subtract(base[1], base[0])) * 1e3
    assert float(pins["tripodkins.Bx"]) == pytest.approx(side, abs=1e-5)


def test_what_is_wrong_in_files_of_its_own_kinematics_is_said(tmp_path):
    pins, lengths = hexapod_pins()
    for hal, unit, homed, message in (
        (ROTARY, "furlong", [0, 0, 0], "LINEAR_UNITS is 'furlong', expected one of mm, metric, i"),
        (ROTARY.replace("sl 18", "sl 9"), "mm", [0, 0, 0], "shinlength is '9', expected a length"),
        (pins, "inch", [0.0] * 6, "HOME_OFFSET is '0.0', expected"),
        (pins, "inch", [10.0] * 6, "struts of 254 mm do not reach"),
        (pins.replace("base.3.y", "base.3.q"), "mm", lengths, "no genhexkins.base.3.y, expected"),
        ("loadrt trivkins\n", "mm", [0], "no genhexkins.base.0.x, expected pins of genhexkins, p"),
        (
            pentapod_pins().replace("effector.2.r", "q"),
            "mm",
            [600] * 5,
            "no pentakins.effector.2.r",
        ),
        (TRIPOD.replace("Bx 10", "Bx 0"), "mm", [9] * 3, "tripodkins.Bx is '0', expected a length"),
        (TRIPOD.replace("Cy", "Cz"), "mm", [9] * 3, "no tripodkins.Cy, expected setp, a length"),
        (TRIPOD, "mm", [1, 9, 9], "HOME_OFFSET is '1', expected lengths at which the struts meet"),
    ):
        with pytest.raises(ParallelCalError) as error:
            configured(machine(tmp_path, hal, unit, homed))
        assert message in str(error.value)
        assert "machine." in str(error.value)
