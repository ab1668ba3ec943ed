"""Delta printers known by touches alone: heights to the noise, what hides named, size unknown."""

import pytest
from printers import PRINTERS, TOUCH

from parallel_cal.diagnosis.comparison import compare
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.identification.fit import fit


@pytest.mark.wide
@pytest.mark.parametrize("name", list(PRINTERS))
def test_the_diagnosis_names_the_hidden_effect_and_lowers_the_height_error_to_the_noise(name):
    kind = PRINTERS[name]
    found = diagnose(kind.model(), kind.touches(200, 1))
    assert found.effects == kind.names
    assert found.verdict.word == ("explained" if kind.names else "at_noise")
    assert not found.robot_or_device
    fresh = kind.touches(300, 1, draw=1, noise=0.0)
    before, after = (
        compare(model, fresh).errors.summary.reading_rms
        for model in (kind.model(), found.best.fitted.model)
    )
    assert before > 0.2e-3
    assert after < TOUCH


def test_parameters_that_touches_do_not_determine_are_held_by_priors_and_listed():
    """A printer that is too large by 1 % gives the same touches of its flat bed."""
    kind = PRINTERS["as built"]
    result = fit(kind.model(), kind.touches(120, 1), hold_out=0)
    document = result.document()
    assert document["priors"] == "weak"
    assert len(document["unidentifiable"]) + len(document["weak"]) > 20
    assert result.estimate.sigma[result.model.table.index_of("chain1.Lb")] > 0.1e-3


@pytest.mark.parametrize("seed", range(3))
def test_a_parameter_held_by_its_tolerance_uses_no_degree_of_freedom(seed):
    """chi2/dof of printers as built: 1.2 to 1.5 where each weak direction counted as a whole."""
    kind = PRINTERS["as built"]
    result = fit(kind.model(), kind.touches(120, seed), hold_out=0)
    low, high = result.document()["chi2_band"]
    assert low < result.estimate.chi2_per_dof < high
    assert result.estimate.dof > 120 - result.estimate.spectrum.rank + 3
