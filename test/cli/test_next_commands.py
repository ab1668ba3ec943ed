"""Whoever follows the commands that the program proposes comes to an end, and loses no model."""

import re
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from marks import as_slow

from parallel_cal.model.file.modelfile import read_model
from parallel_cal.recordings.loading import load_dataset

ROOT = Path(__file__).parents[2]
DRAWING = ROOT / "config" / "delta_mockup_nominal.yaml"
MAX_COMMANDS = 5


def knocked(bag, sizes):
    """Samples of a recording; somebody knocked the device by some m at some of them."""
    data = load_dataset(ROOT / "bags" / bag, joints=read_model(DRAWING).joints)
    r, rng = data.r.copy(), np.random.default_rng(1)
    for sample, size in sizes.items():
        way = rng.standard_normal(3)
        r[sample] += size * way / np.linalg.norm(way)
    return replace(data, r=r)


@pytest.mark.wide
@pytest.mark.parametrize(
    ("bag", "sizes", "first", "verbs"),
    [
        ("delta_backlash", {17: 2e-3}, [], ["diagnose", "add", "diagnose", "report"]),
        ("delta_clean", {7: 2e-3, 20: 3e-4}, [], ["diagnose", "fit", "diagnose", "report"]),
        as_slow(("delta_backlash", {}, ["exclude=7,9"], ["diagnose", "add", "diagnose", "report"])),
    ],
)
def test_the_proposed_commands_end_and_each_continues_with_the_model_of_the_last_one(
    tmp_path, monkeypatch, run_cli, bag, sizes, first, verbs
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "robot.yaml").write_text(DRAWING.read_text())
    knocked(bag, sizes).to_json(tmp_path / "samples.json")
    command = ["diagnose", "robot.yaml", "samples.json", *(f"--data={item}" for item in first)]
    given, followed = "robot.yaml", list[str]()
    while command:
        followed.append(command[0])
        assert len(followed) <= MAX_COMMANDS, f"the commands do not end: {followed}"
        assert command[1] == given
        said = run_cli(*command).rpartition("\nnext:")[2]
        given = command[command.index("-o") + 1] if "-o" in command else given
        found = re.search(r"parallel-cal (.*)", said)
        command = shlex.split(found[1]) if found and followed[-1] != "report" else []
    assert followed == verbs


@pytest.mark.parametrize(
    ("options", "step"),
    [
        ([], "parallel-cal diagnose drawing.yaml bag"),
        (["--hold-out", "0"], "hold poses out (--hold-out)"),
    ],
)
def test_a_fit_that_would_be_refused_ends_with_the_cure_and_not_with_a_file_for_its_model(
    tmp_path, monkeypatch, run_cli, options, step
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "drawing.yaml").write_text(DRAWING.read_text())
    run_cli("simulate", "drawing.yaml", "--poses", "30", "-o", "bag")
    said = run_cli("fit", "drawing.yaml", "bag", *options)
    assert said.rpartition("\nnext:")[2].strip() == step
