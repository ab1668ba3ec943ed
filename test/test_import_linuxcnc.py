"""LinuxCNC's probe logs become touches of a linear Delta; or one clear line."""

import numpy as np
import pytest

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.importing.controller_files import configured, samples
from parallel_cal.kinematics.kinematics import Kinematics

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
