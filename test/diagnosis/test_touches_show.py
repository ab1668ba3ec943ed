"""What touches of a bed cannot show: errors of a pose device, and what grows with the height."""

from dataclasses import replace

import numpy as np
import pytest
import virtual_printer as vp

from parallel_cal.diagnosis.catalogue import candidate
from parallel_cal.diagnosis.comparison import compare
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.diagnosis.field import Field
from parallel_cal.diagnosis.region import (
    AT_ONE_HEIGHT,
    TOUCH,
    TOUCH_A_BLOCK,
    is_touched_at_one_height,
)
from parallel_cal.importing.controller_files import configured, samples
from parallel_cal.model.shelf import list_plugins, load_effect, load_sensor
from parallel_cal.posterior.scene import Scene
from parallel_cal.reporting.contents import HeldOutErrors, Residuals
from parallel_cal.session import steps


@pytest.fixture(scope="module")
def touched(tmp_path_factory):
    """A printer's model and touches of its flat bed, with a probe of 5 um."""
    folder = tmp_path_factory.mktemp("printer")
    (folder / "config.g").write_text(vp.CONFIG)
    (folder / "map.csv").write_text(vp.height_map(vp.drawn(3), 0, 14e-3))
    files = [folder / "config.g"]
    model, dataset = configured(files).model, samples("rrf", [folder / "map.csv", *files])
    [probe] = model.sensors
    return model.with_sensors((load_sensor("probe", **{**probe.options, "sigma": 5e-6}),)), dataset


@pytest.fixture(scope="module")
def step(touched):
    return steps.fitted(*touched)


@pytest.fixture(scope="module")
def fitted(step):
    return step.result


@pytest.fixture(scope="module")
def diagnosed(step, touched):
    return diagnose(step.model, touched[1])


def test_residuals_of_touches_have_the_name_of_their_sensor(fitted):
    scene = Scene.of(fitted.model, fitted.dataset, fitted.observations, fitted.free)
    assert Residuals.of(scene, Field.of(scene)).components == ["probe"]


def test_effects_of_a_pose_device_are_not_tested_without_one(fitted):
    scene = Scene.of(fitted.model, fitted.dataset, fitted.observations, fitted.free)
    of_device = [name for name in list_plugins("effects") if load_effect(name).of_device]
    reasons = {name: candidate(scene, name).reason for name in of_device}
    for name in ("device_axes", "device_field", "base_compliance", "target_offset"):
        assert reasons[name] == "cannot be tested: no device measured a pose"
    for name in ("bed_shape", "probe_offset", "probe_tilt"):  # the mounting of the probe
        assert "no device" not in reasons[name]


def test_a_verdict_from_one_height_says_so_and_asks_for_a_block(diagnosed):
    assert diagnosed.verdict.word == "at_noise"
    assert f"no further effect is needed{AT_ONE_HEIGHT}" in diagnosed.verdict.text
    assert diagnosed.measure_next.advice == (TOUCH_A_BLOCK,)


def test_the_nominal_model_of_a_report_has_the_bed_where_the_fit_found_it(diagnosed, step, touched):
    shown = HeldOutErrors.of(diagnosed)
    assert shown.keeps_sensors
    assert shown.before_name == "nominal model"
    table, values = step.model.table, touched[0].values.copy()
    plate = table.matching(["probe.plate.*"])
    values[plate] = step.model.values[plate]
    there = compare(touched[0].with_values(values), touched[1]).errors.summary.reading_rms
    as_stated = compare(*touched).errors.summary.reading_rms
    assert shown.before.reading_rms == pytest.approx(there, rel=1e-4)
    assert abs(as_stated / there - 1) > 0.01
    assert not HeldOutErrors.of(diagnose(*touched)).keeps_sensors


@pytest.mark.parametrize(("height", "one"), [(5e-3, True), (30e-3, False)])
def test_touches_of_a_high_block_are_another_height(fitted, height, one):
    heights = fitted.dataset.conditions[TOUCH].copy()
    heights[::4] += height
    more = replace(fitted.dataset, conditions={**fitted.dataset.conditions, TOUCH: heights})
    assert is_touched_at_one_height(replace(fitted, dataset=more)) is one


def test_a_measured_pose_shows_heights(fitted):
    seen = replace(fitted.dataset, measured=np.ones_like(fitted.dataset.measured))
    assert not is_touched_at_one_height(replace(fitted, dataset=seen))


@pytest.mark.wide
def test_points_touched_twice_show_the_noise_that_nobody_stated(tmp_path):
    """Lead screws err by 30 um, and the probe repeats to 5 um; 25 points are touched again."""
    (tmp_path / "config.g").write_text(vp.CONFIG)
    printer, rng = vp.drawn(20, wobble=30e-6), np.random.default_rng(5)
    points = vp.places(80, 3)
    for name, xy in (("once", points), ("again", np.vstack([points, points[:25]]))):
        z = vp.heights(printer, xy) + 5e-6 * rng.standard_normal(len(xy))
        rows = [f"{x:.3f},{y:.3f},{h:.4f}" for x, y, h in 1e3 * np.column_stack([xy, z])]
        (tmp_path / f"{name}.csv").write_text("\n".join(["X,Y,Z", *rows]))
    files = [tmp_path / "config.g"]
    model = configured(files).model
    once, again = (samples("rrf", [tmp_path / f"{n}.csv", *files]) for n in ("once", "again"))
    blind = diagnose(model, once, effects=["screw_pitch_error"])
    assert blind.left == "unknown"
    assert "touch 8 points or more a second time" in blind.next_steps[-1]
    assert "`sigma` of its sensor probe" in blind.next_steps[-1]
    assert not any("discover" in step for step in blind.next_steps)
    found = diagnose(model, again, effects=["screw_pitch_error"])
    assert (found.verdict.word, found.left) == ("explained", "no")
    floor = found.best.fitted.simulated_noise
    assert floor.revisits == 25
    assert abs(floor.summary.reading_rms - 5e-6) < 3 * floor.sigmas["reading"]
