"""Every script of `examples/` runs from the repository's root and prints what it quotes."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from test_docs import like

ROOT = Path(__file__).parents[2]
# Also tested: what a camera sees (test_camera.py), simulates (test_simulate.py), plans
# (test_planning.py) and reports (test_report.py).
LONG = ("photograph_a_virtual_robot", "plan_poses", "simulate_a_robot", "write_a_report")
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
pytestmark = pytest.mark.wide


@pytest.mark.parametrize(
    "example",
    [
        pytest.param(path, id=path.stem, marks=pytest.mark.slow if path.stem in LONG else ())
        for path in EXAMPLES
    ],
)
def test_an_example_prints_what_it_quotes(example, tmp_path):
    for name in ("bags", "config", "examples", "real"):
        (tmp_path / name).symlink_to(ROOT / name)
    _, quoted = example.read_text(encoding="utf-8").split("\n# Prints:\n")
    expected = [line.removeprefix("#").strip() for line in quoted.splitlines()]
    if example.stem == "write_c_code" and not (shutil.which("make") and shutil.which("cc")):
        expected = expected[:1]  # without a compiler nothing is compared
    path = os.pathsep.join(map(str, (tmp_path, ROOT, os.environ.get("PYTHONPATH", ""))))
    done = subprocess.run(
        [sys.executable, f"examples/{example.name}"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    printed = done.stdout.splitlines()
    assert len(printed) == len(expected), done.stdout
    assert all(like(e, p) for e, p in zip(expected, printed, strict=True)), done.stdout


def test_the_page_of_examples_lists_every_example():
    page = (ROOT / "examples" / "README.md").read_text(encoding="utf-8")
    assert [path.name for path in EXAMPLES if f"({path.name})" not in page] == []
    assert len(EXAMPLES) >= 12
