"""How heights change if one number is wrong, against a printer with that number."""

import numpy as np
import pytest
from printers import PRINTERS

from parallel_cal.identification.fit import fit
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import new_model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.reporting.height_changes import HeightChanges
from parallel_cal.reporting.identified import height_changes
from parallel_cal.reporting.report import report


@pytest.fixture(scope="module")
def fitted():
    kind = PRINTERS["as built"]
    return fit(kind.model(), kind.touches(60, 1))


def test_a_printer_with_another_number_has_its_tip_as_much_higher(fitted):
    found, model, data = HeightChanges.of(fitted), fitted.model, fitted.dataset
    q = data.q[[list(data.numbers).index(sample) for sample in found.samples]]
    before = Kinematics(model).direct(q).position
    np.testing.assert_allclose(before[:, :2], found.places, atol=1e-9)
    for name in ("chain1.D_x", "chain2.Lb", "chain3.beta", "chain1.dC_x"):
        more = np.array([name == each for each in model.table.names]) * 1e-5
        above, below = (
            Kinematics(model.with_values(model.values + sign * more)).direct(q).position[:, 2]
            for sign in (1, -1)
        )
        slopes = (above - below) / 2e-5
        np.testing.assert_allclose(found.parameters[name].slopes, slopes, atol=1e-6)


def test_what_all_chains_have_in_common_is_the_sum_of_the_chains(fitted):
    """Towers that are 1 mm higher raise the tip by 1 mm everywhere. With longer rods, the tip is
    lower by rod / height under the carriages: in the middle by 1 / cos of their angle."""
    found = HeightChanges.of(fitted)
    np.testing.assert_allclose(found.parameters["D_z of all chains"].slopes, 1, atol=1e-3)
    rods = found.parameters["Lb of all chains"].slopes
    rod, reach = fitted.model.value("chain1.Lb"), fitted.model.value("chain1.D_x")
    assert rods[0] == pytest.approx(-1 / np.sqrt(1 - (reach / rod) ** 2), rel=0.02)
    each = [found.parameters[f"chain{i}.Lb"].slopes for i in (1, 2, 3)]
    np.testing.assert_allclose(rods, np.sum(each, axis=0), atol=1e-12)
    assert 5 <= len(found.samples) <= 7
    assert np.linalg.norm(found.places[0]) < np.linalg.norm(found.places[1:], axis=1).min()


def test_a_report_of_touches_has_the_table_and_others_have_not(fitted):
    kind = PRINTERS["as built"]
    page = height_changes(report(fitted.model, kind.touches(60, 1), effects=["encoder_gain"]))
    assert "D_z of all chains" in page
    assert "mm per mm" in page
    assert "mm per degree" in page
    model = new_model("slider_crank")
    q = np.linspace(0.3, 0.8, 12)[:, None]
    r = Kinematics(model).direct(q).position
    r[:, 0] += 1e-5 * np.random.default_rng(0).standard_normal(len(q))
    posed = Dataset.from_arrays(model.joints, q, r)
    assert HeightChanges.of(fit(model, posed)) is None
