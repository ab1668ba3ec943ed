"""Virtual delta printers known by config.g and heightmap.csv alone: heights, names, size."""

from dataclasses import replace

import numpy as np
import pytest
import virtual_printer as vp

from parallel_cal.diagnosis.comparison import compare
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.identification.fit import fit
from parallel_cal.importing.door import configured, samples


def touched(folder, printer, seed, config=vp.CONFIG):
    """The model as configured, touches of a grid, and of another one without noise."""
    (folder / "config.g").write_text(config)
    maps = {"seen.csv": (seed, 10e-3), "unseen.csv": (seed + 1000, 13e-3, 0.0)}
    for name, grid in maps.items():
        (folder / name).write_text(vp.height_map(printer, *grid))
    seen, unseen = (samples("rrf", [folder / name, folder / "config.g"]) for name in maps)
    return configured([folder / "config.g"]).model, seen, unseen


def height(model, dataset):
    return compare(model, dataset).errors.summary.reading_rms


@pytest.mark.parametrize("seed", range(2))
def test_heights_over_an_unseen_grid_fall_to_the_noise(tmp_path, seed):
    model, seen, unseen = touched(tmp_path, vp.drawn(seed), seed)
    assert height(model, unseen) > 0.2e-3
    assert height(fit(model, seen, hold_out=0).model, unseen) < 4e-6  # of 5 um in each touch


def test_a_printer_too_large_by_a_fiftieth_touches_alike(tmp_path):
    misfits = []
    for size in (0.98, 1.0, 1.02):
        config = vp.CONFIG.replace("L250", f"L{250 * size}").replace("R100", f"R{100 * size}")
        model, seen, _ = touched(tmp_path, vp.drawn(1), 1, config)
        held = replace(model, fixed=model.fixed | model.table.matching(["*.Lb"]))
        misfits.append(fit(held, seen, hold_out=0).estimate.chi2_per_dof)
    assert np.ptp(misfits) < 0.05
    assert "cannot tell the size" in seen.warnings[0]


BENT = {"bowl": 0.03, "lean": 3e-3}  # 1/m: 0.1 mm at the rim; 0.2 degrees
SCREWS = {"wobble": 30e-6}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hidden", "names", "seeds"),
    [
        ({}, (), 20),
        (SCREWS, ("screw_pitch_error",), 20),
        (BENT, (), 40),
        (BENT | SCREWS, ("screw_pitch_error",), 40),
    ],
)
def test_what_hides_is_named_in_nine_of_ten_printers(tmp_path, hidden, names, seeds):
    """Beds that are domed and tilted, towers that lean: heights are right, and no more is named;
    the size is not known, which is said."""
    named = 0
    for seed in range(seeds):
        model, seen, unseen = touched(tmp_path, vp.drawn(seed, **hidden), seed)
        found = diagnose(model, seen)
        named += found.effects == names
        assert height(found.best.fitted.model, unseen) < 5e-6
        assert found.dataset.warnings[0].startswith("size: cannot_know: touches of a plate cannot")
    assert named >= 0.9 * seeds


def test_what_a_bed_cannot_tell_is_one_line(tmp_path):
    model, seen, _ = touched(tmp_path, vp.drawn(3), 3)
    result = fit(model, seen, hold_out=0)
    said = [w for w in result.warnings if "the data cannot tell" in w]
    assert len(said) == 1
    unseen = result.document()["unidentifiable"]
    assert f"the data cannot tell {len(unseen)} combinations of D_x, D_y, D_z, " in said[0]
    assert " of chain 1, 2, 3 and " in said[0]
    assert "of plate of probe: along them the model keeps what it had" in said[0]
