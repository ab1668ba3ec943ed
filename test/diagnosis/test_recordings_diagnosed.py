"""Every recording gets its right verdict through the command line, and the error falls.

Here are two mechanisms, one with nothing hidden and one whose device errs; the others belong to the
slow tests: `test_diagnosis.py` hides the same in arrays, `test_docs.py` diagnoses three. The
truth beside a recording is read here only; `test_diagnose_node.py` does the same by the nodes.
"""

import json
from pathlib import Path

import pytest
import yaml

from parallel_cal.cli import main as cli

ROOT = Path(__file__).parents[2]
NAMES = sorted(path.stem for path in (ROOT / "bags" / "truth").glob("*.yaml"))
FIRST = ("argos_gear_ripple", "delta_clean", "delta_tilting")


def truth(name):
    return yaml.safe_load((ROOT / "bags" / "truth" / f"{name}.yaml").read_text())


@pytest.fixture
def run(capsys):
    """run(*arguments) -> the one JSON document of a command that succeeds."""

    def call(*arguments):
        with pytest.raises(SystemExit) as ended:
            cli.main([str(a) for a in (*arguments, "--json")])
        out, err = capsys.readouterr()
        assert ended.value.code == 0, err
        return json.loads(out)

    return call


def called(document):
    """Each effect found with what it is said to be confused with."""
    return [{name, *document["swaps"].get(name, [])} for name in document["effects"]]


@pytest.mark.wide
@pytest.mark.parametrize(
    "name", [n if n in FIRST else pytest.param(n, marks=pytest.mark.slow) for n in NAMES]
)
def test_the_verdict_is_right_and_adding_what_it_names_lowers_the_error(name, run, tmp_path):
    hidden = truth(name)
    model, bag = ROOT / hidden["baseline"], ROOT / "bags" / name
    data = ["--data", "mode=continuous"] if hidden["mode"] == "continuous" else []
    document = run("diagnose", model, bag, *data)
    assert document["verdict"] == hidden["verdict"], document["summary"]
    found = called(document)
    assert len(found) == len(hidden["found"])
    for group in hidden["found"]:
        assert any(set(group) & names for names in found), (group, found)
    before = run("fit", model, bag, "-o", tmp_path / "0.yaml", *data)["held_out"]["after"]
    for k, effect in enumerate(document["effects"]):
        step = run(
            "add", tmp_path / f"{k}.yaml", effect, bag, "-o", tmp_path / f"{k + 1}.yaml", *data
        )
        after = step["held_out"]["after"]
        kinds = [f"{kind}_rms" for kind in ("position", "orientation") if before[f"{kind}_rms"]]
        assert any(after[kind] < 0.99 * before[kind] for kind in kinds)
        before = after
    if document["effects"]:
        floor = step["noise_floor"]
        assert all(after[kind] < 1.3 * floor[kind] for kind in kinds)  # 60 numbers, 94 samples
