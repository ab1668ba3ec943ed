"""Heights of the bed before and after an export, by firmwares that share nothing with the package.

A touch leaves the motors a number of steps from their end-stops. What the firmware believes the
nozzle's height to be there, with the numbers of its file, decides how the first layer is printed.
"""

import itertools
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import virtual_firmware as vf
import virtual_printer as vp

from parallel_cal.base.errors import ModelError, ParallelCalError
from parallel_cal.cli.main import main
from parallel_cal.exporting.export import export, export_into
from parallel_cal.exporting.heights import BedHeights
from parallel_cal.identification.fit import fit
from parallel_cal.importing.controller_files import configured, samples
from parallel_cal.importing.touch_samples import Touches, touches_in
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_sensor

D300VS = Path(__file__).parents[2] / "real/d300vs"
TRIGGER = 0.1  # mm, G31 Z of the virtual printer
KLIPPER = "[printer]\nkinematics: delta\ndelta_radius: 100\n" + "".join(
    f"[stepper_{tower}]\nposition_endstop: 300\narm_length: 250\nangle: {angle}\n"
    "rotation_distance: 40\nmicrosteps: 16\n"
    for tower, angle in zip("abc", (210, 330, 90), strict=True)
)
MICROSTEP = 40 / 3200  # mm of KLIPPER
MARLIN = "M92 X160 Y160 Z160\nM665 L250 R100 H300\nM666 X0 Y0 Z0\nM851 X0 Y0 Z0\n"
UNKNOWN = ["*.alpha", "*.beta", "*.dC_*", "*.dLb"]  # what no firmware has a number for


def points_of(firmware, motors, start):
    """Where a firmware believes the nozzle (N, 3) mm with its motors there, near `start`."""
    r = np.array(start, float)
    for _ in range(8):
        slopes = np.stack(
            [(firmware.motors(r + d) - firmware.motors(r - d)) / 2e-4 for d in 1e-4 * np.eye(3)],
            axis=2,
        )
        off = firmware.motors(r) - motors
        r = r - np.linalg.solve(slopes, off[:, :, None])[:, :, 0]
    return r


def rms_height(old, new, points, trigger):
    """Rms height (m) by the new firmware's formula where the old one believed the nozzle to be at
    points (N, 3) mm."""
    motors = old.motors(points) - old.homed() + new.homed()
    return 1e-3 * np.sqrt(np.mean((points_of(new, motors, points)[:, 2] - trigger) ** 2))


def printer(seed):
    """Half a millimetre here and there, a bed that bows by 0.1 mm at its rim."""
    return vp.drawn(seed, bowl=0.03)


def rrf(folder, seed, noise):
    """The config.g and samples of a virtual printer, and where its nozzle was believed (mm)."""
    (folder / "config.g").write_text(vp.CONFIG)
    (folder / "map.csv").write_text(vp.height_map(printer(seed), seed, 12e-3, noise))
    files = [folder / "config.g"]
    dataset = samples("rrf", [folder / "map.csv", *files])
    n = round(np.sqrt(len(rows := grid(folder / "map.csv"))))
    x, y = (each.ravel() for each in np.meshgrid(*2 * [12 * (np.arange(n) - (n - 1) / 2)]))
    on = np.isfinite(rows)
    return files, dataset, np.column_stack([x, y, rows + TRIGGER])[on], TRIGGER


def grid(file):
    """Heights (mm) of a map's cells row by row, NaN where none was probed."""
    cells = [c.strip() for line in file.read_text().splitlines()[3:] for c in line.split(",")]
    return np.array([np.nan if cell == "0" else float(cell) for cell in cells])


def touched(seed, noise, n=60):
    """Believed points (n, 3) mm where a nozzle touched the bed."""
    xy = vp.places(n, seed)
    z = vp.heights(printer(seed), xy) + noise * np.random.default_rng(seed).standard_normal(n)
    return 1e3 * np.column_stack([xy, z])


def klipper(folder, seed, noise):
    first, points = vf.Klipper(KLIPPER), touched(seed, noise)
    steps = (first.homed() - first.motors(points)) / MICROSTEP
    stored = [
        f"height{k} = 0.0\nheight{k}_pos = {','.join(map('{:.3f}'.format, row))}"
        for k, row in enumerate(steps)
    ]
    file = folder / "printer.cfg"
    file.write_text("\n".join([KLIPPER, "[delta_calibrate]", *stored]) + "\n")
    return [file], samples("klipper", [file]), points, 0.0


def marlin(folder, seed, noise):
    points = touched(seed, noise)
    touches = ["Bed X: {:.4f} Y: {:.4f} Z: {:.4f}".format(*point) for point in points]
    (folder / "printer.log").write_text(MARLIN + "\n".join(touches) + "\n")
    return [folder / "printer.log"], samples("marlin", [folder / "printer.log"]), points, 0.0


def test_a_camera_takes_the_place_of_a_configurations_probe(tmp_path, capsys):
    (tmp_path / "config.g").write_text(vp.CONFIG)
    camera = "camera: {columns: 8, rows: 6, square: 0.03, image_size: [1280, 1024]}"
    command = ["new", "--from", str(tmp_path / "config.g"), "--sensor", camera]
    for more, names in (([], ["camera"]), (["--sensor", "probe"], ["probe", "camera"])):
        model = tmp_path / f"{len(names)}.yaml"
        with pytest.raises(SystemExit) as ended:
            main([*command, *more, "-o", str(model)])
        said = capsys.readouterr()
        assert ended.value.code == 0, said.err
        assert [sensor.name for sensor in read_model(model).sensors] == names
        assert ("the probe's noise is not stated" in said.out) == ("probe" in names)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "seed", "noise"),
    [
        pytest.param(
            *case,
            id=f"{case[0].__name__}-{case[1]}-{1e6 * case[2]:.0f}",
            # One with much noise; the others go by the same lines.
            marks=[] if case == (klipper, 1, 60e-6) else pytest.mark.slow,
        )
        for case in itertools.product((rrf, klipper), range(2), (20e-6, 40e-6, 60e-6))
    ],
)
def test_the_default_path_makes_the_bed_better_and_says_by_how_much(tmp_path, kind, seed, noise):
    """Nobody states the probe's noise, and nothing is held."""
    files, dataset, points, trigger = kind(tmp_path, seed, noise)
    firmware = vf.Duet if kind is rrf else vf.Klipper
    old = firmware(files[0].read_text())
    model = fit(configured(files).model, dataset, hold_out=0).model
    done = export_into(model, kind.__name__, files, touches_in(dataset, model.joints))
    new = firmware(files[0].read_text())
    before, after = (rms_height(old, each, points, trigger) for each in (old, new))
    assert before > 0.2e-3
    assert after < 1.15 * noise
    assert done.heights.touches == len(points)
    assert done.heights.before == pytest.approx(before, abs=0.1e-6)
    assert done.heights.after == pytest.approx(after, abs=0.1e-6)


@pytest.mark.wide
@pytest.mark.parametrize("seed", range(2))
def test_a_marlin_log_gives_numbers_that_make_the_bed_better(tmp_path, seed):
    files, dataset, points, trigger = marlin(tmp_path, seed, 40e-6)
    model = fit(configured(files).model, dataset, hold_out=0).model
    done = export(model, "rrf", tmp_path / "out", touches_in(dataset, model.joints))
    first, new = vf.Duet(MARLIN), vf.Duet((tmp_path / "out" / "config.g").read_text())
    after = rms_height(first, new, points, trigger)
    assert after < 45e-6 < rms_height(first, first, points, trigger)
    assert done.heights.before is None
    assert done.heights.after == pytest.approx(after, abs=0.1e-6)


@pytest.mark.wide
def test_an_unstated_probe_noise_gives_the_estimates_of_the_stated_one(tmp_path):
    """40 um, which a guess of 5 um turns into towers that lean by degrees."""
    files, dataset, *_ = rrf(tmp_path, 2, 40e-6)
    model = configured(files).model

    def values(sigma):
        [probe] = model.sensors
        stated = model.with_sensors((replace(probe, sigma=sigma),))
        return fit(stated, dataset, hold_out=0).model.values / model.table.tolerance

    unstated, true, wrong = (values(sigma) for sigma in (None, 40e-6, 5e-6))
    assert np.abs(unstated - true).max() < 0.2
    assert np.abs(wrong - true).max() > 1.0


def test_readings_of_unstated_noise_prove_nothing(tmp_path):
    files, dataset, *_ = rrf(tmp_path, 0, 40e-6)
    model = configured(files).model
    assert model.sensors[0].sigma is None
    held = replace(model, fixed=model.fixed | model.table.matching(UNKNOWN))
    found = fit(held, dataset, hold_out=0)
    document = found.document()
    assert document["noise_from"]["reading"] == "estimated from the residuals"
    assert document["chi2_band"] == [None, None]
    assert not [words for words in found.warnings if "chi2/dof" in words]
    [probe] = [one for one in document["noise"] if one["name"] == "probe"]
    assert probe["value"] == pytest.approx(40e-6, rel=0.2)
    assert document["chi2_per_dof"] == pytest.approx(1, abs=0.03)


@pytest.mark.wide
@pytest.mark.parametrize("sigma", [40e-6, None])
@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_a_robust_loss_ignores_bad_touches(tmp_path, sigma, loss):
    """Every 15th touch is 2 mm off: the others fit as without them."""
    files, dataset, *_ = rrf(tmp_path, 2, 40e-6)
    model = configured(files).model
    model = model.with_sensors((replace(model.sensors[0], sigma=sigma),))
    bad = np.arange(0, len(dataset), 15)
    read = dataset.conditions["reading.probe"].copy()
    read[bad] += 2e-3
    spoilt = replace(dataset, conditions={**dataset.conditions, "reading.probe": read})
    found = fit(model, spoilt, hold_out=0, loss=loss)
    assert {one.sample for one in found.down_weighted} == set(bad.tolist())
    others = np.delete(found.after.reading, bad)
    assert np.sqrt(np.mean(others**2)) < 42e-6


@pytest.mark.wide
def test_the_guess_of_an_unstated_probe_noise_decides_nothing(tmp_path):
    """From 50 nm to 5 mm: the same parameters, errors at held-out touches and weak directions."""
    files, dataset, *_ = rrf(tmp_path, 2, 40e-6)
    model = configured(files).model

    def fitted(guess):
        [probe] = model.sensors
        own = type("Own", (type(probe),), {"guessed_sigma": guess, "name": "probe"})
        guessed = own(height=0.0, sigma=None, tip=probe.tip)
        return fit(model.with_sensors((guessed,)), dataset)

    first, *others = (fitted(guess) for guess in (20e-6, 50e-9, 5e-3))
    for other in others:
        away = (other.model.values - first.model.values) / model.table.tolerance
        assert np.abs(away).max() < 0.02
        assert len(other.estimate.spectrum.weak) == len(first.estimate.spectrum.weak)
        errors = [one.held_out.summary.reading_rms for one in (first, other)]
        assert errors[1] == pytest.approx(errors[0], rel=1e-3)


def test_tolerances_throughout_weigh_by_the_noise_that_is_found(tmp_path):
    """Ten times another guess of what nobody stated: the same estimates."""
    files, dataset, *_ = rrf(tmp_path, 0, 40e-6)
    model = configured(files).model

    def values(guess):
        [probe] = model.sensors
        own = type("Own", (type(probe),), {"guessed_sigma": guess, "name": "probe"})
        guessed = own(height=0.0, sigma=None, tip=probe.tip)
        given = replace(model, fixed=model.fixed | model.table.matching(UNKNOWN))
        found = fit(given.with_sensors((guessed,)), dataset, hold_out=0, prior=True)
        return found.model.values / model.table.tolerance

    assert np.abs(values(10e-6) - values(100e-6)).max() < 0.02


def worse(folder):
    """A printer whose numbers are right, touches that say so, and a model that is off."""
    file = folder / "config.g"
    file.write_text(vp.CONFIG)
    model = configured([file]).model
    x, y = (each.ravel() for each in np.meshgrid(*2 * [np.linspace(-40, 40, 5)]))
    cells = "\n".join([",".join(["  0.010"] * 5)] * 5)
    (folder / "map.csv").write_text(
        "RepRapFirmware height map file v2 generated at 2026-11-22 10:00\n"
        "axis0,axis1,min0,max0,min1,max1,radius,spacing0,spacing1,num0,num1\n"
        f"X,Y,-40,40,-40,40,60,20,20,5,5\n{cells}\n"
    )
    dataset = samples("rrf", [folder / "map.csv", file])
    radius = model.table.matching(["*.D_x"])
    model = model.with_values(model.values + 0.5e-3 * radius)
    return model, file, dataset, np.column_stack([x, y, np.full(25, 0.01 + TRIGGER)])


def test_a_bed_is_worse_if_its_heights_rise_by_more_than_the_digits_of_a_file_round():
    assert BedHeights(25, before=10e-6, after=10.2e-6).worse
    assert not BedHeights(25, before=10e-6, after=10.05e-6).worse
    assert not BedHeights(25, before=None, after=1e-3).worse


@pytest.mark.wide
def test_an_export_that_makes_the_bed_worse_is_refused_without_force(tmp_path):
    model, file, dataset, points = worse(tmp_path)
    touches = touches_in(dataset, model.joints)
    with pytest.raises(ParallelCalError) as refused:
        export_into(model, "rrf", [file], touches)
    words = str(refused.value)
    assert words.startswith(
        f"{file}: the height error at the touches rises with the new parameters: rms at 25 touches"
    )
    assert "nothing was written" in words
    assert words.endswith("--force")
    assert file.read_text() == vp.CONFIG
    assert not file.with_name("config.g.previous").exists()
    done = export_into(model, "rrf", [file], touches, force=True)
    old, new = vf.Duet(vp.CONFIG), vf.Duet(file.read_text())
    after = rms_height(old, new, points, TRIGGER)
    assert f"formula: 10.0 -> {1e6 * after:.1f} um" in words
    assert done.heights.after == pytest.approx(after, abs=0.1e-6)
    assert after > 100e-6


@pytest.mark.wide
def test_the_command_prints_both_heights_and_refuses_a_worse_bed(tmp_path, monkeypatch, capsys):
    from parallel_cal.model.file.modelfile import write_model

    monkeypatch.chdir(tmp_path)
    model, file, dataset, _ = worse(tmp_path)
    dataset.to_json("touches.json")
    write_model(model, "model.yaml")
    command = ["export", "model.yaml", "--to", "rrf", "--into", "config.g"]
    command += ["--touches", "touches.json"]

    def run(*words):
        with pytest.raises(SystemExit) as ended:
            main(words)
        return ended.value.code, *capsys.readouterr()

    code, out, err = run(*command)
    assert (code, out) == (1, "")
    assert err.startswith("error: config.g: the height error at the touches rises")
    assert file.read_text() == vp.CONFIG
    code, out, _ = run(*command, "--force", "--json")
    heights = json.loads(out)["heights"]
    assert (code, heights["touches"]) == (0, 25)
    assert heights["before"] == pytest.approx(10e-6, abs=0.1e-6)
    assert heights["after"] > 100e-6
    file.write_text(vp.CONFIG)
    code, out, _ = run(*command, "--force")
    assert f"formula: 10.0 -> {1e6 * heights['after']:.1f} um" in out


@pytest.mark.wide
def test_the_export_finds_the_touches_that_the_model_was_fitted_on(tmp_path, monkeypatch, capsys):
    """Where they lay, or beside the model; where they are gone it says how to give them."""
    folder = tmp_path / "here"
    folder.mkdir()
    rrf(folder, 1, 20e-6)
    monkeypatch.chdir(folder)

    def run(*words):
        with pytest.raises(SystemExit) as ended:
            main(words)
        assert ended.value.code in (0, None)
        return capsys.readouterr()

    hold = [word for pattern in UNKNOWN for word in ("--fix", pattern)]
    run("new", "--from", "config.g", "-o", "printer.yaml")
    run("import", "rrf", "map.csv", "config.g", "-o", "touches.json")
    run(
        "fit",
        "printer.yaml",
        "touches.json",
        "-o",
        "fitted.yaml",
        "--hold-out",
        "0",
        "--force",
        *hold,
    )
    assert read_model("fitted.yaml").history[-1]["dataset"]["files"] == ["touches.json"]
    said = "touches by the firmware's formula: "
    for place, model in ((folder, "fitted.yaml"), (tmp_path, "here/fitted.yaml")):
        monkeypatch.chdir(place)
        (folder / "config.g").write_text(vp.CONFIG)
        out, err = run("export", model, "--to", "rrf", "--into", str(folder / "config.g"))
        assert said in out
        assert "warning" not in err
    other = (folder / "touches.json").read_text().replace('"sha256": "', '"sha256": "0')
    for text in (other, "{}", None):
        if text is None:
            (folder / "touches.json").unlink()
        else:
            (folder / "touches.json").write_text(text)
        out, err = run("export", model, "--to", "rrf", "--into", str(folder / "config.g"))
        assert said not in out
        assert "(map.csv, config.g) were not found; give their samples: --touches" in err


@pytest.mark.slow
def test_a_touch_that_the_fit_excluded_is_not_used_for_the_export(tmp_path, monkeypatch, capsys):
    """Touch 3 hit a blob of 0.3 mm. The export must not fit the numbers to it again."""
    rrf(tmp_path, 1, 10e-6)
    monkeypatch.chdir(tmp_path)

    def run(*words):
        with pytest.raises(SystemExit) as ended:
            main(words)
        assert ended.value.code in (0, None)
        return capsys.readouterr()[0]

    run("new", "--from", "config.g", "-o", "printer.yaml")
    run("import", "rrf", "map.csv", "config.g", "-o", "touches.json")
    document = json.loads(Path("touches.json").read_text())
    [column] = [name for name in document["conditions"] if name.endswith("probe")]
    document["conditions"][column][3] -= 3e-4
    Path("touches.json").write_text(json.dumps(document))
    fixed = [word for pattern in UNKNOWN for word in ("--fix", pattern)]
    fit = ["fit", "printer.yaml", "touches.json", "--hold-out", "0.5", *fixed]
    run(*fit, "--data", "exclude=3", "-o", "without.yaml")
    run(*fit, "-o", "all.yaml")

    def export(model, *more):
        Path("config.g").write_text(vp.CONFIG)
        out = run("export", model, "--to", "rrf", "--into", "config.g", "--json", *more)
        return json.loads(out)["heights"]

    n, found, every = len(document["q"]), export("without.yaml"), export("all.yaml")
    assert (found["touches"], found["excluded"]) == (n - 1, [3])
    assert (every["touches"], every["excluded"]) == (n, [])
    assert found["after"] < 25e-6 < every["after"]
    assert export("without.yaml", "--touches", "touches.json") == found
    Path("config.g").write_text(vp.CONFIG)
    out = run("export", "without.yaml", "--to", "rrf", "--into", "config.g")
    assert f"at {n - 1} touches" in out
    assert "without sample 3 (excluded from the fit)" in out


@pytest.mark.wide
def test_numbers_that_an_override_had_are_those_that_the_bed_was_touched_with(tmp_path):
    """RepRapFirmware reads config-override.g at M501: its numbers won, and will again."""
    model, file, dataset, _ = worse(tmp_path)
    file.write_text(vp.CONFIG.replace("R100", "R102") + "M501\n")
    override = tmp_path / "config-override.g"
    override.write_text("M665 L250 R100 H300\n")
    touches = touches_in(dataset, model.joints)
    with pytest.raises(ModelError) as error:
        export_into(model, "rrf", [file], touches, force=True)
    assert f"{override}:1: M665 L is '250': the firmware also reads this file" in str(error.value)
    assert f"--into {file} --into {override} changes it there" in str(error.value)
    done = export_into(model, "rrf", [file, override], touches, force=True)
    assert done.heights.before == pytest.approx(10e-6, abs=0.1e-6)
    assert vf.words(file.read_text())["M665 R"] == 102
    assert vf.words(override.read_text())["M665 R"] != 100


@pytest.mark.wide
def test_heights_of_a_robot_that_hangs_upside_down_are_counted_upwards(tmp_path):
    """A Delta whose {B} looks down has its plate at z 0.26 m; the probe's tip is 2 mm below."""
    sensor = load_sensor("probe", height=0.26, tip=(0.0, 0.0, 2e-3), sigma=1e-6)
    model = new_model("delta24", sensors=[sensor])
    heights = np.array([0.0, 0.5e-3, -1e-3])
    r = np.column_stack([[0, 0.05, -0.03], [0, 0.02, -0.04], 0.26 - 2e-3 + heights])
    q = Kinematics(model).inverse(r, np.broadcast_to(np.eye(3), (3, 3, 3))).joints
    for read, expected in ((heights, 0.0), (heights + 0.1e-3, 0.1e-3)):
        done = export(model, "klipper", tmp_path / "out", Touches(q, read, "by hand", ""))
        assert done.heights.after == pytest.approx(expected, abs=0.5e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"q": 9.0}, "2 of 2 touches are beyond the firmware's reach with the file's numbers"),
        ({"sensors": ()}, "the model's sensors are none: expected a 'probe'"),
    ],
)
def test_touches_that_cannot_be_judged_are_refused_in_one_line(tmp_path, change, message):
    (tmp_path / "config.g").write_text(vp.CONFIG)
    model = configured([tmp_path / "config.g"]).model
    q = np.full((2, 3), 0.2)
    q[:, 0] = change.get("q", 0.2)
    if "sensors" in change:
        model = model.with_sensors(())
    with pytest.raises(ParallelCalError) as error:
        export_into(model, "rrf", [tmp_path / "config.g"], Touches(q, np.zeros(2), "here", ""))
    assert message in str(error.value)
    assert (tmp_path / "config.g").read_text() == vp.CONFIG


def test_a_setups_probe_takes_the_noise_that_somebody_states(tmp_path, capsys):
    (tmp_path / "config.g").write_text(vp.CONFIG)
    command = ["new", "--from", str(tmp_path / "config.g"), "-o", str(tmp_path / "m.yaml")]
    with pytest.raises(SystemExit) as ended:
        main([*command, "--sensor", "probe: {sigma: 4.0e-5}"])
    assert ended.value.code == 0, capsys.readouterr().err
    [probe] = read_model(tmp_path / "m.yaml").sensors
    assert (probe.sigma, probe.tip) == (4e-5, (0.0, 0.0, -1e-4))


@pytest.mark.slow
def test_a_real_printers_bed_gets_as_good_as_its_firmware_can(tmp_path):
    """54.0 um as it was; nine factors of the firmware, fitted by somebody else, reach 43.7 um."""
    names = ("config.g", "config-override.g")
    for name in names:
        (tmp_path / name).write_text((D300VS / name).read_text())
    files = [tmp_path / name for name in names]
    dataset = samples("rrf", [D300VS / "heightmap.csv", *files])
    model = fit(configured(files).model, dataset, hold_out=0).model
    done = export_into(model, "rrf", files, touches_in(dataset, model.joints))
    assert done.heights.touches == 137
    assert done.heights.before == pytest.approx(54.0e-6, abs=0.1e-6)
    assert done.heights.after < 44.5e-6


def test_a_model_that_was_never_fitted_warns_that_no_heights_were_compared(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    Path("config.g").write_text(vp.CONFIG)

    def run(*words):
        with pytest.raises(SystemExit) as ended:
            main(words)
        assert ended.value.code in (0, None)
        return capsys.readouterr()

    probe = "probe: {sigma: 4.0e-5}"
    assert "the probe's noise is not stated" in run("new", "--from", "config.g", "-o", "a.yaml").out
    stated = run("new", "--from", "config.g", "--sensor", probe, "-o", "printer.yaml")
    assert "the probe's noise is not stated" not in stated.out
    err = run("export", "printer.yaml", "--to", "rrf", "--into", "config.g").err
    assert "the heights of the bed were not compared: printer.yaml was not fitted to touches" in err
