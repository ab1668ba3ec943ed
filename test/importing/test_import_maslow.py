"""The Maslow on two chains: its settings in both forms, its own lengths of chain, and a sled that
hangs by another computation, before and after the new numbers are in its file."""

import numpy as np
import pytest
import virtual_shelf as vf

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.cli import main as cli
from parallel_cal.exporting.export import export, export_into
from parallel_cal.identification.fit import fit
from parallel_cal.importing.controller_files import configured, samples
from parallel_cal.importing.importers.maslow import chains, settings
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.drive import Drive
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_mechanism

MM = 1e-3
INI = """\
[Maslow Settings]
comport = /dev/ttyACM0
motorspacingx = 2978.4
bedwidth = 2438.4
bedheight = 1219.2
motoroffsety = 463
sledwidth = 310
sledheight = 139
sledcg = 79
; mine

[Advanced Settings]
gearteeth = 10
chainpitch = 6.35
kinematicstype = Triangular
rotationradius = 139.1
chainoversprocket = Top
"""
QUADRILATERAL = INI.replace("Triangular", "Quadrilateral")
BELOW = INI.replace("= Top", "= Bottom\nchainsagcorrection = 31.5\nleftchaintolerance = 0.3")
LIST = """\
$0=2438.40 (machine width, mm)
$1=1219.19995117 (machine height, mm)
$2=2978.40 (motor distance, mm)
$3=463.00000000 (motor height, mm)
$4=310.00000000 (sled width, mm)
$5=139.00000000 (sled height, mm)
$6=79.00000000 (sled cg, mm)
$7=2 (Kinematics Type 1=Quadrilateral, 2=Triangular)
$8=139.10000000 (rotation radius, mm)
$13=63.50000000 (distance / rotation, mm)
$37=0.00000000 (chain sag correction value)
$38=1 (chain over sprocket)
"""
# Where the bit is (mm), and what the firmware fad6ad31 computed for it, compiled with numbers of
# double precision: the left and the right chain.
AT = np.array([(0, 0), (-1100, -560), (900, 500), (-300, 250)])
BY_FIRMWARE = {
    QUADRILATERAL: [
        (1634.63877, 1634.63092),
        (1489.36271, 2865.03836),
        (2261.23737, 624.10365),
        (1247.99383, 1771.63007),
    ],
    INI: [
        (1702.49432, 1702.49432),
        (1552.78199, 2927.53634),
        (2320.15375, 690.350813),
        (1313.03049, 1834.5187),
    ],
    BELOW: [
        (1716.29985, 1721.78961),
        (1552.49989, 2958.25474),
        (2340.3695, 706.511214),
        (1328.26867, 1857.75694),
    ],
}


def written(folder, text, name="groundcontrol.ini"):
    (folder / name).write_text(text)
    return folder / name


def places(points):
    return np.column_stack([points, np.zeros(len(points))]) * MM


@pytest.mark.parametrize("text", BY_FIRMWARE, ids=["mounts", "ring", "below"])
def test_chains_are_as_long_as_the_firmware_computes(text, tmp_path):
    """It stops its search for the tilt, and rounds sines, at some hundredths of a mm."""
    machine = chains(settings([written(tmp_path, text)]))
    far = 0.02 if text is QUADRILATERAL else 0.001  # its sprockets have 10.1 mm, these 10.106 mm
    found = machine.joints(places(AT)) / MM
    first = np.array(BY_FIRMWARE[text])
    arc = (10.10634 - 10.1) * np.pi
    assert np.abs(found - first).max() < far + arc


def test_a_sled_on_two_mounts_is_moved_to_other_places_than_the_firmware_believes(tmp_path):
    """It takes the sine twice. Its own correct chains would move the sled to the stated places."""
    machine = chains(settings([written(tmp_path, QUADRILATERAL)]))
    found = configured([tmp_path / "groundcontrol.ini"])
    assert any("takes the sine twice" in remark for remark in found.remarks)
    corners = places(np.array([(-1219, -609), (1219, -609), (1000, 400), (0, 0)]))
    reached = Kinematics(found.model).direct(machine.joints(corners)).position
    off = np.linalg.norm(reached - corners, axis=1) / MM
    assert off[:2] == pytest.approx(1.5, abs=0.1)
    assert off[3] < 0.1
    # The exported numbers make up for most of it.
    done = export_into(found.model, "maslow", [tmp_path / "groundcontrol.ini"])
    assert done.before["position_mean"] == pytest.approx(0.23 * MM, abs=0.02 * MM)
    assert done.loss["position_mean"] < 0.08 * MM


def test_groundcontrols_file_and_the_firmwares_list_are_the_same_machine(tmp_path):
    ini, listed = written(tmp_path, INI), written(tmp_path, LIST, "settings.txt")
    one, other = (chains(settings([path])) for path in (ini, listed))
    assert vars(one) == pytest.approx(vars(other), abs=1e-7)
    for path in (ini, listed):
        found = configured([path]).model
        assert found.mechanism.name == "hanging_sled"
        assert found.machine_class == "hobby"
        np.testing.assert_allclose(found.mechanism.home.joints, [1.70249432] * 2, atol=2e-5)


def test_what_groundcontrol_computed_counts_before_the_words(tmp_path):
    more = "\n[Computed Settings]\nkinematicstypecomputed = 1\ndistperrot = 60\n"
    machine = chains(settings([written(tmp_path, INI + more)]))
    assert machine.radius == pytest.approx(60 * MM / 2 / np.pi)
    assert type(machine).__name__ == "Quadrilateral"
    drives = configured([written(tmp_path, INI + more)]).model.mechanism.drives
    assert drives == (Drive("belt", per_rev=60 * MM),) * 2  # per turn of the sprockets
    remarks = configured([tmp_path / "groundcontrol.ini"]).remarks
    assert any("a radius of 9.549 mm, but a controller that was sw" in each for each in remarks)


def test_a_correction_of_sag_is_the_effect_and_goes_back_as_a_correction(tmp_path):
    """The firmware's parabola and the catenary differ where a chain is nearly slack."""
    path = written(tmp_path, INI.replace("= Top", "= Top\nchainsagcorrection = 31.5"))
    machine, model = chains(settings([path])), configured([path]).model
    assert [effect.name for effect in model.effects] == ["line_sag"]
    r = places(np.random.default_rng(0).uniform((-1100, -520), (1100, 520), (200, 2)))
    off = np.abs(Kinematics(model).inverse(r).joints - machine.joints(r)) / MM
    plain = np.abs(
        chains(settings([written(tmp_path, INI, "plain.ini")])).joints(r) - machine.joints(r)
    )
    assert np.median(off) < 0.01
    assert np.median(plain) / MM > 0.1
    export(model, "maslow", tmp_path / "new")
    again = chains(settings([tmp_path / "new" / "groundcontrol.ini"]))
    assert again.sag == pytest.approx(31.5e-6, rel=0.1)


def cut(folder, machine, twin, n, seed, noise=0.3 * MM):
    """Send a twin to n places by the chains of a firmware; write what a tape reads there."""
    rng = np.random.default_rng(seed)
    sent = np.round(rng.uniform((-1100, -520), (1100, 520), (n, 2)))
    reached = twin.forward(machine.joints(places(sent)), (places(sent), np.eye(3)))[0][:, :2]
    read = reached + noise * rng.standard_normal((n, 2))
    rows = "".join(
        f"{x:.0f},{y:.0f},{a:.2f},{b:.2f}\n" for (x, y), (a, b) in zip(sent, read / MM, strict=True)
    )
    (folder / "cuts.csv").write_text(f"x,y,measured_x,measured_y\n{rows}")
    # Where the sheet lies is stated by nobody: compare the shapes.
    wanted, got = sent - sent.mean(axis=0), reached / MM - (reached / MM).mean(axis=0)
    turn = np.angle(np.sum((got @ [1, 1j]) * (wanted @ [1, -1j])))
    return np.abs(got @ [1, 1j] - np.exp(1j * turn) * (wanted @ [1, 1j]))


@pytest.mark.parametrize("text", [INI, QUADRILATERAL], ids=["ring", "mounts"])
def test_a_sled_is_where_it_was_sent_with_the_numbers_of_its_cuts(text, tmp_path):
    """Motors 25 mm further apart and not level, a rotation radius 4 mm longer or another sled."""
    path = written(tmp_path, text)
    start = configured([path]).model
    found = dict(zip(start.table.names, start.values, strict=True))
    wrong = {"left.A_x": -14, "right.A_x": 11, "left.A_y": 6, "right.A_y": 12}
    if text is INI:
        wrong |= {"left.L0": 4, "right.L0": 4}
    else:
        wrong |= {"left.B_y": 5, "right.B_y": 5, "left.B_x": -2, "right.B_x": 2, "sled.G_y": -12}
    twin = vf.HangingSled({name: v + wrong.get(name, 0) * MM for name, v in found.items()})
    before = cut(tmp_path, chains(settings([path])), twin, 40, 1)
    data = samples("maslow", [tmp_path / "cuts.csv", path])
    held = () if text is INI else ("*.L0",)
    model = fit(start, data, fix=held).model
    done = export_into(model, "maslow", [path])
    assert "; mine" in path.read_text()
    after = cut(tmp_path, chains(settings([path])), twin, 200, 2)
    assert before.mean() > 3
    assert after.mean() < 0.3  # the noise of the tape
    assert done.before["position_mean"] > 5 * done.loss["position_mean"]


@pytest.mark.parametrize("text", [INI, LIST], ids=["ini", "list"])
def test_a_machine_that_is_as_its_file_states_leaves_the_file_as_it_is(text, tmp_path):
    path = written(tmp_path, text, "settings.txt" if text is LIST else "groundcontrol.ini")
    export_into(configured([path]).model, "maslow", [path])
    assert {*text.splitlines()} <= {*path.read_text().splitlines()}
    new = export(configured([path]).model, "maslow", tmp_path / "new").paths[0]
    assert new.name == "groundcontrol.ini"
    again = chains(settings([new]))
    assert vars(again) == pytest.approx(vars(chains(settings([path]))), abs=1e-7)


def test_a_sled_that_the_firmware_does_not_know_is_refused(tmp_path):
    for options, words in (
        ({"wheels": "sled"}, "the wheels of this sled are on it"),
        ({"over": False}, "computes only chains over the top"),
    ):
        with pytest.raises(ParallelCalError, match=words):
            export(new_model(load_mechanism("hanging_sled", **options)), "maslow", tmp_path)


@pytest.mark.wide
def test_what_the_firmware_has_no_number_for_is_named(tmp_path):
    model = new_model(load_mechanism("hanging_sled", retracted=0))
    values = model.values.copy()
    values[model.table.index_of("left.B_x")] += 3 * MM
    remarks = export(model.with_values(values), "maslow", tmp_path).remarks
    assert any("the mounts of the sled are not symmetrical" in each for each in remarks)
    lines = export(new_model("hanging_sled"), "maslow", tmp_path).remarks
    assert any("no number for the length of a chain at reading zero" in each for each in lines)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("motorspacingx = 2978.4", "motorspacingx = 2978,4", r":3: .* motorspacingx is '2978,4'"),
        ("sledcg = 79", "sledcg = 79\nsledcg = 80", r":10: .* sledcg is '80', expected one value"),
        ("= Triangular", "= Ring", r":15: .*type is 'Ring', expected Quadrilateral or Triangular"),
        ("[Maslow Settings]", "[Settings]", r"expected pins of genhexkins"),
    ],
)
def test_settings_that_cannot_be_are_named(old, new, message, tmp_path):
    with pytest.raises(ParallelCalError, match=message):
        configured([written(tmp_path, INI.replace(old, new))])


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("x,y\n1,2\n", r"cuts.csv:1: the columns are x, y: expected tables .*measured_x"),
        (
            "x,y,measured_x,measured_y\n1300,0,1301,2\n",
            r"cuts.csv:2: x is '1300 mm', expected a pl",
        ),
        (
            "x [deg],y,measured_x,measured_y\n1,0,1,2\n",
            r"cuts.csv:1: column x \[deg\] is no length",
        ),
    ],
)
def test_tables_that_cannot_be_are_named(table, message, tmp_path):
    path = written(tmp_path, INI)
    with pytest.raises(ParallelCalError, match=message):
        samples("maslow", [written(tmp_path, table, "cuts.csv"), path])
    with pytest.raises(ParallelCalError, match="expected tables"):
        samples("maslow", [path])


def test_a_size_that_the_file_does_not_state_is_said(tmp_path):
    text = "\n".join(line for line in INI.splitlines() if "motoroffsety" not in line.lower())
    remarks = configured([written(tmp_path, text)]).remarks
    said = "not stated, so that the default counts: [Maslow Settings] motoroffsety 463 mm"
    assert [words for words in remarks if "default" in words] == [said]
    assert not any("default" in words for words in configured([written(tmp_path, INI)]).remarks)


def test_an_export_says_by_how_much_each_chain_is_longer(tmp_path):
    path = written(tmp_path, INI)
    model = configured([path]).model
    wrong = {"left.L0": 3 * MM, "right.L0": -1 * MM}
    values = [
        value + wrong.get(name, 0.0)
        for name, value in zip(model.table.names, model.values, strict=True)
    ]
    done = export_into(model.with_values(np.array(values)), "maslow", [path])
    assert any("+2.00 (left) and -2.00 mm (right)" in words for words in done.remarks)


def marks(folder, sent=1.0, measured=1.0, ini=INI):
    """Return a table of marks in mm times a factor, and a configuration."""
    (folder / "groundcontrol.ini").write_text(ini)
    places = 0.9 * np.array([(1219, 609), (-1219, 609), (0, 0), (-1219, -609), (1219, -609)])
    rows = np.hstack([places * sent, (places + [1.0, 0.5]) * measured])
    head = "x,y,measured_x,measured_y"
    np.savetxt(folder / "marks.csv", rows, delimiter=",", header=head, comments="")
    return [folder / "marks.csv", folder / "groundcontrol.ini"]


@pytest.mark.parametrize(
    ("sent", "measured", "named"),
    [
        (1.0, 1.0, []),
        (1.0, 0.3, []),  # a part of the sheet
        (1 / 25.4, 1 / 25.4, ["sent places", "measured places"]),
        (1.0, 1 / 25.4, ["measured places"]),
        (1e-3, 1e-3, ["sent places", "measured places"]),
    ],
)
def test_places_in_another_unit_than_the_sheet_are_named(sent, measured, named, tmp_path):
    warnings = samples("maslow", marks(tmp_path, sent, measured)).warnings
    unit = "m" if sent == 1e-3 else "inches"
    assert [w for w in warnings if f"they fit if they are in {unit}, not mm" in w] == [*warnings]
    assert [w.split(" are")[0] for w in warnings] == [f"the {name}" for name in named]


def test_the_noise_of_a_chain_is_that_of_a_step_and_that_of_a_mark_is_stated(tmp_path):
    """8113.73 steps on 63.5 mm are 7.8 um; a uniform error in them has 2.26 um."""
    found = samples("maslow", marks(tmp_path), sigma=3e-4)
    np.testing.assert_allclose(found.joint_sigma, 2.2593e-6, rtol=1e-4)
    np.testing.assert_allclose(found.pose_cov[:, [0, 1], [0, 1]], 9e-8)
    coarse = INI.replace("gearteeth = 10", "gearteeth = 10\nencodersteps = 811.373")
    np.testing.assert_allclose(
        samples("maslow", marks(tmp_path, ini=coarse)).joint_sigma, 2.2593e-5, rtol=1e-4
    )


def test_a_machine_in_inches_is_named(tmp_path):
    inches = INI.replace("2978.4", "117.26").replace("2438.4", "96").replace("1219.2", "48")
    files = marks(tmp_path, ini=inches.replace("463", "18.2"))
    found = configured(files[1:]).remarks
    assert any(
        "motors, are 3.9 % of the usual sizes: they fit if they are in inches" in r for r in found
    )
    message = (
        "48 mm: .*; the sent places are 22.9 times the sizes of the sheet: they fit if the sizes of"
    )
    with pytest.raises(ParallelCalError, match=message):
        samples("maslow", files)


@pytest.mark.wide
def test_a_diagnosis_proposes_to_export_only_a_model_that_was_fitted(tmp_path, monkeypatch, capsys):
    """It fits the model itself and writes nothing: the model that it was given has the numbers of
    the file still. A sample that is far off is decided first."""
    monkeypatch.chdir(tmp_path)
    path = written(tmp_path, INI)
    start = configured([path]).model
    off = {"left.A_x": -9 * MM, "right.A_x": 7 * MM}
    found = dict(zip(start.table.names, start.values, strict=True))
    twin = vf.HangingSled({name: v + off.get(name, 0.0) for name, v in found.items()})
    cut(tmp_path, chains(settings([path])), twin, 30, 1)

    def run(*words):
        with pytest.raises(SystemExit) as ended:
            cli.main([*words])
        assert ended.value.code == 0
        return [line.strip() for line in capsys.readouterr().out.splitlines()]

    fitting = "parallel-cal fit maslow.yaml cuts.json -o better.yaml"
    run("new", "--from", path.name, "-o", "maslow.yaml")
    run("import", "maslow", "cuts.csv", path.name, "-o", "cuts.json")
    assert run("diagnose", "maslow.yaml", "cuts.json")[-1] == fitting
    run(*fitting.split()[1:])
    export = "parallel-cal export better.yaml --to maslow --into groundcontrol.ini"
    assert run("diagnose", "better.yaml", "cuts.json")[-1].endswith(export)
    rows = (tmp_path / "cuts.csv").read_text().splitlines()
    x, y, at_x, at_y = rows[5].split(",")
    rows[5] = f"{x},{y},{float(at_x) + 60},{at_y}"
    (tmp_path / "cuts.csv").write_text("\n".join(rows))
    run("import", "maslow", "cuts.csv", path.name, "-o", "cuts.json")
    shown = run("diagnose", "better.yaml", "cuts.json")
    assert "parallel-cal fit better.yaml cuts.json --data exclude=4 -o refitted.yaml" in shown
    assert not any("parallel-cal export" in line for line in shown)
