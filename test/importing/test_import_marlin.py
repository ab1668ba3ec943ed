"""A log of Marlin becomes touches and a model; or one clear line."""

import numpy as np
import pytest

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.importing.controller_files import configured, samples
from parallel_cal.kinematics.kinematics import Kinematics

MM, DEGREE = 1e-3, np.pi / 180
SETTINGS = """\
Send: M503
Recv: echo:; Steps per unit:
Recv: echo:  M92 X100.00 Y100.00 Z200.00 E95.00
Recv: echo:  M665 L250.00 R150.00 H300.00 S200.00 X0.00 Y0.00 Z0.00 A0.00 B0.00 C0.00
Recv: echo:  M666 X0.00 Y-0.50 Z-1.00
Recv: echo:  M851 X10.00 Y-5.00 Z-2.00 ; (mm)
"""
BED = (
    SETTINGS
    + """\
Send: N12 G29 V4*33
Recv: Bed X: -40.000 Y: 10.000 Z: 0.125
Recv: Bed X: 40.000 Y: 10.000 Z: -0.250
"""
)
G33 = (
    SETTINGS
    + """\
>>> G33 P3 V3
G33 Auto Calibrate
Checking... AC at radius:80.00
.Height:300.00    Ex:+0.00  Ey:-0.50  Ez:-1.00  Radius:150.00
.                 Tx:+0.00  Ty:+0.00  Tz:+0.00
.      c:+0.10   x:+0.20   y:+0.00   z:-0.10
.               yz:+0.00  zx:+0.05  xy:+0.00
Iteration : 01                                std dev:0.090
.Height:299.90    Ex:+0.00  Ey:-0.40  Ez:-1.20  Radius:149.50
.                 Tx:+0.10  Ty:+0.00  Tz:-0.10
.      c:+0.00   x:+0.00   y:+0.00   z:+0.00
.               yz:+0.00  zx:+0.00  xy:+0.00
Calibration OK                                std dev:0.001
"""
)


@pytest.fixture
def log(tmp_path):
    """log(text): its path."""

    def write(text):
        (tmp_path / "printer.log").write_text(text)
        return [tmp_path / "printer.log"]

    return write


def test_points_of_the_bed_are_touches_with_the_nozzle_beside_the_probe(log):
    data = samples("marlin", log(BED))
    model = configured(log(BED)).model
    at = Kinematics(model).direct(data.q).position
    np.testing.assert_allclose(at, np.array([[-50, 15, 2.125], [30, 15, 1.75]]) * MM, atol=1e-9)
    assert model.sensors[0].tip == (0.01, -0.005, -0.002)
    np.testing.assert_allclose(data.joint_sigma * 12**0.5, np.array([10, 10, 5]) * 1e-6)
    # the switches, by M666 above where the nozzle is 300 mm high: 250^2 = 150^2 + 200^2
    tops = [high for _, high in model.mechanism.joint_limits]
    np.testing.assert_allclose(tops, [0.5, 0.5005, 0.501], atol=1e-12)


def test_touches_before_and_after_new_settings_count_from_the_same_end_stops(log):
    """In the centre carriages are 200 mm + z up, 300.0 - 0.5 ... below their switches."""
    data = samples("marlin", log(G33.replace("M851", "M852")))
    assert len(data) == 14
    model = configured(log(G33)).model
    assert model.value("chain1.D_x") == pytest.approx(0.1495 * np.cos(0.1 * DEGREE))
    tops = np.array([high for _, high in model.mechanism.joint_limits])
    up = np.sqrt(0.25**2 - 0.1495**2)
    np.testing.assert_allclose(tops, up + np.array([299.9, 300.3, 301.1]) * MM, atol=1e-12)
    below = np.array([300.0, 300.5, 301.0]) * MM + 0.2 - (0.2 + 0.1 * MM)
    np.testing.assert_allclose(tops - data.q[0], below, atol=1e-12)
    after = Kinematics(model).direct(data.q[7:]).position
    around = np.radians([210, 330, 90, 30, 150, 270])
    circle = 0.08 * np.column_stack([np.cos(around), np.sin(around), 0 * around])
    np.testing.assert_allclose(after, [[0, 0, 0], *circle], atol=1e-9)


@pytest.mark.parametrize(("command", "beside"), [("G33 P3 V3", 0.0), ("G33 P3 V3 O", 1.0)])
def test_g33_has_the_nozzle_over_its_points_or_with_o_the_probe(log, command, beside):
    paths = log(G33.replace("G33 P3 V3", command))
    at = Kinematics(configured(paths).model).direct(samples("marlin", paths).q[7:]).position
    np.testing.assert_allclose(at[0], np.array([-10 * beside, 5 * beside, 2]) * MM, atol=1e-9)


def test_means_of_g33_are_no_touches(log):
    with pytest.raises(ParallelCalError, match=r"no touches.*means of several touches"):
        samples("marlin", log(G33.replace("P3", "P4")))
    data = samples("marlin", log(G33.replace("P3 ", "") + BED))
    assert len(data) == 2
    assert data.warnings[1].startswith("G33's numbers are means")


def test_b_is_the_circle_of_older_versions(log):
    old = G33.replace(" A0.00 B0.00 C0.00", " B75.0").replace(" at radius:80.00", "")
    old = old.replace("M851", "M852")
    after = Kinematics(configured(log(old)).model).direct(samples("marlin", log(old)).q[8:9])
    assert np.hypot(*after.position[0, :2]) == pytest.approx(0.075, abs=1e-9)


HOSTS = {
    "OctoPrint's serial.log": "2024-05-01 08:55:33,358 - {way}: {line}",
    "Pronterface": "{line}",
    "Repetier-Host": "08:55:33.358 : {line}",
    "Repetier-Server": "{way}:08:55:33.358: {line}",
    "Simplify3D": "{read}: {line}",
    "MatterControl": "{arrow}{line}",
    "Arduino": "08:55:33.358 -> {line}",
    "minicom": "[2024-05-01 08:55:33] {line}",
}


@pytest.mark.parametrize("host", HOSTS)
def test_a_log_has_what_its_host_writes_before_a_line(log, host):
    """The same machine and touches, whoever recorded the conversation."""
    lines = []
    for line in (G33 + BED.removeprefix(SETTINGS)).splitlines():
        sent = line.startswith(("Send", ">>>"))
        plain = line.removeprefix("Send: ").removeprefix("Recv: ").removeprefix(">>> ")
        way, read, arrow = ("Send", "SENT", "->") if sent else ("Recv", "READ", "<-")
        lines.append(HOSTS[host].format(way=way, read=read, arrow=arrow, line=plain))
    expected = samples("marlin", log(G33 + BED.removeprefix(SETTINGS)))
    stated = configured(log(G33)).model
    found = samples("marlin", log("\n".join(lines)))
    assert found.q.tolist() == expected.q.tolist()
    assert configured(log("\n".join(lines))).model.values.tolist() == stated.values.tolist()


def test_what_a_log_only_mentions_is_no_setting(log):
    mentioned = "echo:; M665 L1.00\n; Recv: M665 L2.00\nError:Resend: 12\n"
    assert (
        samples("marlin", log(BED + mentioned)).q.tolist() == samples("marlin", log(BED)).q.tolist()
    )


@pytest.mark.parametrize(
    "command",
    [
        "M665L250.00R150.00H300.00A0.00B0.00C0.00",
        "N7 M665 L250.00 R150.00 H300.00 A0.00 B0.00 C0.00*83",
        "M665 L 250.00 R 150.00 H 300.00 A 0.00 B 0.00 C 0.00",
    ],
)
def test_words_may_be_written_as_marlin_reads_them(log, command):
    text = BED.replace(
        "  M665 L250.00 R150.00 H300.00 S200.00 X0.00 Y0.00 Z0.00 A0.00 B0.00 C0.00", command
    )
    assert command in text
    assert samples("marlin", log(text)).q.tolist() == samples("marlin", log(BED)).q.tolist()


BROKEN = {
    "rod": (BED, "L250.00", "L25O.0", "log:4: M665 L is '25O.0', expected the rods"),
    "short": (BED, "L250.00", "L100", "log:4: M665 L is '100', expected"),
    "no rod": (BED, "L250.00", "", "no M665 L, expected the rods' length in mm"),
    "no settings": (BED, "M665", "M605", "no M665 R, expected the delta radius in mm"),
    "no height": (BED, "H300.00", "", "no M665 H, expected the homed height in mm, which M665 wit"),
    "height": (BED, "H300.00", "H-1", "log:4: M665 H is '-1', expected the homed height"),
    "end-stop": (BED, "Z-1.00", "Z1.00", "log:5: M666 Z is '1.00', expected mm, 0 or less"),
    "probe": (BED, "Z-2.00", "Z--2", "log:6: M851 Z is '--2', expected mm"),
    "inches": (BED, "Send: M503", "echo: G20", "log:1: unit is 'G20', expected millimetres"),
    "bed": (BED, "0.125", "0.1.25", "log:8: Bed Z is '0.1.25', expected mm"),
    "nan": (BED, "-0.250", "nan", "log:9: Bed Z is 'nan', expected mm"),
    "far": (BED, "X: 40.000", "X: 940.00", "log:4: M665 L is '250.00', expected rods that rea"),
    "no touches": (SETTINGS, "S200", "S100", "no touches, expected 'Bed X: Y: Z:' lines"),
    "radius": (G33, "radius:80.00", "radius:?", "log:9: at radius is '?', expected mm above 0"),
    "no radius": (G33.replace("B0.00", ""), " at radius:80.00", "", "no M665 B, expected 'at rad"),
    "report": (G33, "z:-0.10", "z:-0.1O", "log:12: G33 z is '-0.1O', expected mm within 20"),
    "setting": (G33, "Ez:-1.20", "Ez:oops", "log:15: M666 Z is 'oops', expected mm, 0 or less"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_log_is_named_with_line_and_field(log, name):
    text, old, new, message = BROKEN[name]
    assert old in text
    with pytest.raises(ParallelCalError) as error:
        samples("marlin", log(text.replace(old, new, 1)))
    assert message in str(error.value)
    assert "printer.log" in str(error.value)
    assert "\n" not in str(error.value)


def test_touches_at_one_place_by_one_setting_are_replicates_however_far_apart(log):
    """Joint readings that differ by as much as noise of 1 mm were no replicates, unless by chance
    they were near: the noise that diagnose stated was then that of the near ones."""
    again = "\nRecv: Bed X: 10.00 Y: 20.00 Z: {}\n"
    text = BED + again.format(0.5) + again.format(-0.5)
    data = samples("marlin", log(text + "Send: M665 R151\n" + again.format(0.1)))
    first, second, other = data.pose_id[-3:]
    assert first == second != other
