"""The tutorial quotes only what its commands print, the page on Python what its lines do.

Every command of a ```console block of the pages on judging is run, in one folder, after those that
write the files it reads. Each quoted line must be among those printed, numbers to 5 %
or a unit in the second decimal. A quoted `error:` is an expected refusal.
"""

import os
import re
import runpy
import shlex
import shutil
import sys
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from functools import cache
from io import StringIO
from pathlib import Path

import fleets
import numpy as np
import pytest
import test_import_maslow as maslow
import virtual_firmware
import virtual_fleet
import virtual_printer
import virtual_shelf
from marks import keep

import parallel_cal as pc
from bench.truth import age
from parallel_cal.base.rotation import quaternion_to_matrix
from parallel_cal.cli import main as cli
from parallel_cal.importing.controller_files import configured

ROOT = Path(__file__).parents[2]
JUDGING = "read_a_fit read_a_diagnosis judge_your_calibration own_effect plan_measurements".split()
TUTORIAL = "".join((ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8") for name in JUDGING)
TABLE = ROOT / "real/hangprinter_hp4/hp4_2021-12-14.csv"
VERDICTS = ("at_noise", "explained", "partly_explained", "unexplained", "cannot_know")
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


def quoted(language):
    return re.findall(rf"^```{language}\n(.*?)^```$", TUTORIAL, flags=re.M | re.S)


def steps():
    """(command, quoted lines) in the order of the page."""
    found = []
    for line in "".join(quoted("console")).splitlines():
        if line.startswith("$ "):
            found.append((line[2:], []))
        elif line != "...":
            found[-1][1].append(line)
    return found


def cases():
    """The steps; diagnoses that repeat the verdict of an earlier one belong to the slow tests."""
    shown = set()
    for command, lines in steps():
        verdicts = {line.split(":")[0] for line in lines} & set(VERDICTS)
        marks = [pytest.mark.slow] if verdicts and verdicts <= shown else []
        shown |= verdicts
        yield pytest.param(command, lines, id=command, marks=marks)


def like(seen, printed):
    """Whether a line is another one but for spaces and the last digits of its numbers."""
    if NUMBER.sub("#", seen).split() != NUMBER.sub("#", printed).split():
        return False
    pairs = zip(NUMBER.findall(seen), NUMBER.findall(printed), strict=True)
    return all(float(b) == pytest.approx(float(a), rel=0.05, abs=0.011) for a, b in pairs)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A reader's folder: the repository's data, and the files that the page shows."""
    path = tmp_path_factory.mktemp("tutorial")
    for name in ("bags", "config"):
        (path / name).symlink_to(ROOT / name)
    shutil.copy(TABLE, path)
    for text in quoted("python"):
        file = path / re.match(r"# (\S+\.py)\n", text)[1]
        file.parent.mkdir()
        file.write_text(text, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def run(folder):
    """run(command) -> (exit code, printed lines), after the commands that write what it reads."""
    writes = {words[words.index("-o") + 1]: c for c, _ in steps() if "-o" in (words := c.split())}

    @cache
    def call(command):
        words = [w for w in shlex.split(command) if w != "PYTHONPATH=."]
        for word in words:
            if writes.get(word, command) != command:
                call(writes[word])
        return execute(words, folder)

    return call


def execute(words, folder):
    """A command line, run in this process as in a shell in the folder."""
    assert words[0] == "parallel-cal"
    printed = StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(printed), redirect_stderr(printed):
        patch.chdir(folder)
        patch.syspath_prepend(str(folder))
        with pytest.raises(SystemExit) as ended:
            cli.main(words[1:])
    return ended.value.code, printed.getvalue().splitlines()


@pytest.mark.wide
@pytest.mark.parametrize(("command", "lines"), list(cases()))
def test_the_tutorial_shows_what_the_command_prints(run, command, lines):
    code, printed = run(command)
    refused = any(line.startswith("error:") for line in lines)
    assert code == (1 if refused else 0), "\n".join(printed)
    for line in lines:
        assert any(like(line, p) for p in printed), f"not printed: {line}\n" + "\n".join(printed)


@pytest.mark.slow
def test_the_printers_page_shows_what_its_commands_print(tmp_path):
    """Its virtual printer writes the maps; the commands run in order, and the heights of a bed
    never seen are right with the numbers that they put back."""
    printer = virtual_printer.drawn(3, wobble=30e-6)
    (tmp_path / "config.g").write_text(virtual_printer.CONFIG)
    for name, seed, step in (("heightmap", 0, 10e-3), ("check", 1, 13e-3)):
        file = tmp_path / f"{name}.csv"
        file.write_text(virtual_printer.height_map(printer, seed, step))
    details = tmp_path / "details"  # which come before the parameters are written
    details.mkdir()
    for name in ("config.g", "heightmap.csv"):
        shutil.copy(tmp_path / name, details)
    assert in_order("delta_printer_details.md", details) == 3
    assert in_order("delta_printer.md", tmp_path) <= 12
    before, after = (
        heights_with((tmp_path / name).read_text(), printer)
        for name in ("config.g.previous", "config.g")
    )
    assert 550e-6 < np.sqrt(np.mean(before**2)) < 650e-6
    assert np.sqrt(np.mean(after**2)) < 30e-6


@pytest.mark.wide
def test_the_page_on_export_shows_what_its_commands_print(tmp_path):
    for name in ("bags", "config"):
        (tmp_path / name).symlink_to(ROOT / name)
    write_marks_of_a_maslow(tmp_path)
    assert in_order("export.md", tmp_path) == 8


def write_marks_of_a_maslow(folder):
    """Marks that a tape measured: motors 25 mm further apart and not level, longer chains."""
    path = maslow.written(folder, maslow.INI)
    start = configured([path]).model
    wrong = {"left.A_x": -14, "right.A_x": 11, "left.A_y": 6, "right.A_y": 12}
    wrong |= {"left.L0": 4, "right.L0": 4}
    found = dict(zip(start.table.names, start.values, strict=True))
    twin = virtual_shelf.HangingSled({n: v + 1e-3 * wrong.get(n, 0) for n, v in found.items()})
    maslow.cut(folder, maslow.chains(maslow.settings([path])), twin, 40, 1)


@pytest.mark.wide
def test_the_page_on_calibrations_without_a_device_shows_what_its_commands_print(tmp_path):
    assert in_order("without_a_device.md", tmp_path) == 8


def test_the_page_on_export_converts_poses_of_the_device(tmp_path, monkeypatch):
    random = np.random.default_rng(2)
    turns = [tuple(q / np.linalg.norm(q)) for q in random.normal(size=(2, 4))]
    place = {"position": (1.0, -2.0, 0.5), "target_position": (0.01, 0.02, -0.03)}
    place |= {"quaternion": turns[0], "target_quaternion": turns[1]}
    model = pc.new_model("stewart42", sensors=[replace(pc.sensors.load("device_frame"), **place)])
    own = [name.startswith("device_frame.") for name in model.table.names]
    numbers = random.normal(size=len(own)) * model.table.tolerance
    model = model.with_values(model.values + np.where(own, numbers, 0.0))
    pc.write_model(model, tmp_path / "robot.yaml")
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs" / "export.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```$", page, flags=re.M | re.S)
    [block] = [block for block in blocks if "def to_base" in block]
    exec(block, names := {})
    at_device, turn = random.normal(size=3), random.normal(size=4)
    shown = np.append(at_device, quaternion_to_matrix(turn / np.linalg.norm(turn)))
    r, R = model.structure.to_base(shown[None], model.values)
    found = names["to_base"](at_device, turn)
    np.testing.assert_allclose(found[0], np.ravel(r), atol=1e-12)
    np.testing.assert_allclose(found[1].ravel(), np.ravel(R), atol=1e-12)


TUTORIALS = {
    "start.md": 7,
    "hexapod.md": 11,
    "argos.md": 6,
    "cable_robot.md": 11,
    "serial_arm.md": 4,
    "ankle.md": 7,
}


@pytest.mark.wide
@pytest.mark.parametrize(
    "page",
    # Robots of the others are calibrated by test_belts.py, test_chain.py, test_extra_legs.py and
    # test_registered_only.py, too.
    keep(TUTORIALS, "start.md", "hexapod.md", "argos.md"),
)
def test_a_tutorial_goes_from_raw_data_to_a_controller(page, tmp_path):
    for name in ("bags", "config", "examples", "real"):
        (tmp_path / name).symlink_to(ROOT / name)
    shutil.copy(TABLE, tmp_path)
    for file in (ROOT / "examples").glob("ankle*"):
        shutil.copy(file, tmp_path)
    assert in_order(page, tmp_path) == TUTORIALS[page]
    assert list(tmp_path.glob("*/*_vectors.csv"))  # what the last command exported


@pytest.mark.parametrize("page", [*TUTORIALS, "delta_printer.md"])
def test_a_tutorial_has_at_most_1500_words(page):
    assert len((ROOT / "docs" / page).read_text(encoding="utf-8").split()) <= 1500


@pytest.mark.wide
def test_the_page_on_belts_shows_what_its_commands_print(tmp_path):
    for name in ("config", "examples"):
        (tmp_path / name).symlink_to(ROOT / name)
    assert in_order("belts.md", tmp_path) == 5


def test_the_page_on_closed_chains_shows_what_its_commands_print(tmp_path):
    assert in_order("chains.md", tmp_path) == 3


@pytest.mark.slow
def test_the_page_on_discovery_shows_what_its_commands_print(tmp_path, monkeypatch):
    for name in ("bags", "config"):
        (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.syspath_prepend(str(tmp_path))
    assert in_order("discover.md", tmp_path) == 4
    sys.modules.pop("wires")


@pytest.mark.slow  # test_fleet.py and test_fleet_page.py study smaller ones
def test_the_page_on_fleets_shows_what_its_commands_print(tmp_path):
    pytest.importorskip("distributed")
    members = virtual_fleet.drawn(8)
    fleets.written(tmp_path / "workshop", members, 3, n_poses=24, n_replicates=4)
    (tmp_path / "workshop" / "robot004" / "2.json").write_text("{cut")
    assert in_order("fleet.md", tmp_path) == 2
    for name in ("fleet.html", "rows.parquet", "seconds.parquet", "fleet.json", "reports"):
        assert (tmp_path / "fleet" / name).exists()
    assert len(list((tmp_path / "fleet" / "reports").glob("robot*.html"))) == 7


@pytest.mark.wide
def test_the_page_on_watching_shows_what_its_commands_print(tmp_path):
    script = ROOT / "examples" / "watch_a_robot.py"
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(StringIO()):
        patch.chdir(tmp_path)
        runpy.run_path(str(script))  # it writes the model and the recordings
    assert in_order("watch.md", tmp_path) == 2
    for name in ("watch.html", "poses.csv", "belts.watch.json"):
        assert (tmp_path / name).exists()


@pytest.mark.wide
def test_the_page_on_updates_shows_what_its_commands_print(tmp_path):
    assert in_order("recheck.md", tmp_path) == 8


@pytest.mark.wide
def test_the_page_on_age_shows_what_its_commands_print(tmp_path):
    age.write_sessions(tmp_path)
    assert in_order("age.md", tmp_path) == 2


@pytest.mark.slow
def test_the_page_on_studies_shows_what_its_commands_print(tmp_path):
    (tmp_path / "config").symlink_to(ROOT / "config")
    pytest.importorskip("distributed")
    assert in_order("study.md", tmp_path) == 3


def in_order(name, folder):
    """How many commands a page has, which were run one after the other and printed what it says."""
    page = (ROOT / "docs" / name).read_text(encoding="utf-8")
    shown = "".join(re.findall(r"^```console\n(.*?)^```$", page, flags=re.M | re.S)).splitlines()
    printed = []
    for line in shown:
        if line.startswith("$ "):
            words = [w for w in shlex.split(line[2:]) if w != "PYTHONPATH=."]
            code, printed = execute(words, folder)
            assert code == 0, "\n".join(printed)
        elif line != "...":
            assert any(like(line, p) for p in printed), f"not printed: {line}\n{printed}"
    return sum(line.startswith("$ ") for line in shown)


def heights_with(config, printer):
    """How high the nozzle, homed as before, believes an unseen bed at 400 places (m)."""
    firmware, first = virtual_firmware.Duet(config), virtual_firmware.Duet(virtual_printer.CONFIG)

    def believed(r):
        return 1e-3 * (firmware.motors(1e3 * r) - firmware.homed() + first.homed())

    return virtual_printer.heights(printer, virtual_printer.places(400, 99), believed)


@pytest.mark.wide
def test_the_python_page_shows_what_its_lines_print(tmp_path, monkeypatch):
    for name in ("bags", "config"):
        (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    names, printed = {}, []
    for language, block in re.findall(r"^```(python|text)\n(.*?)^```$", page, flags=re.M | re.S):
        if language == "python":
            out = StringIO()
            with redirect_stdout(out):
                exec(block, names)
            printed = out.getvalue().splitlines()
        for line in block.splitlines() if language == "text" else ():
            assert any(like(line, p) for p in printed), f"not printed: {line}\n{printed}"
    assert len(names["arrows"].data) > 0
    assert len(names["falling"].data) > 0
    assert "backlash" in (tmp_path / "report.html").read_text(encoding="utf-8")
    assert names["pc"].read_model("better.yaml").value("backlash.joint1.width") > 0


def test_every_verdict_has_an_example():
    shown = {line.split(":")[0] for _, lines in steps() for line in lines}
    assert set(VERDICTS) <= shown


def test_links_of_the_documents_lead_somewhere():
    for page in (*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), ROOT / "bags" / "README.md"):
        text = page.read_text(encoding="utf-8")
        links = re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text)
        for link in (*links, *re.findall(r'<(?:img|source)[^>]* src(?:set)?="(.*?)"', text)):
            if link.startswith("made/"):  # by `make docs`; test_site.py follows these links
                continue
            assert os.path.exists(page.parent / link), f"{page.name}: {link}"


def test_the_readme_quotes_what_its_first_fit_prints(tmp_path):
    """The five lines are the last ones of the command that the page shows."""
    page = (ROOT / "README.md").read_text(encoding="utf-8")
    [command] = re.findall(r"^    (parallel-cal fit .* -o robot.yaml)$", page, flags=re.M)
    quoted = re.findall(r"^    ((?:before|after|noise|missing|next):.*)$", page, flags=re.M)
    for name in ("bags", "config"):
        (tmp_path / name).symlink_to(ROOT / name)
    code, printed = execute(shlex.split(command), tmp_path)
    assert code == 0
    assert len(quoted) == 5
    assert all(map(like, quoted, printed[-5:])), printed[-5:]


def test_the_picture_of_the_front_page_has_colours_for_the_dark_mode_and_no_ground():
    name = "docs/falling_error.svg"
    assert f"]({name})" in (ROOT / "README.md").read_text(encoding="utf-8")
    picture = (ROOT / name).read_text(encoding="utf-8")
    assert "prefers-color-scheme: dark" in picture
    assert "#ffffff" not in picture
