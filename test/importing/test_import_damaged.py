"""Damaged files of controllers end in samples or in one line, never in a traceback."""

import numpy as np
import pytest
import test_import_klipper as klipper
import test_import_linuxcnc as linuxcnc
import test_import_marlin as marlin
import test_import_rrf as rrf
import test_import_table as table
import test_import_urdf as urdf

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.importing.controller_files import configured, samples
from parallel_cal.importing.urdf import arm

FILES = {
    "rrf": {"h.csv": rrf.MAP, "c.g": rrf.LINEAR},
    "rrf, rotary": {"h.csv": rrf.OLD, "c.g": rrf.ROTARY},
    "klipper": {"c.cfg": klipper.LINEAR},
    "klipper, rotary": {"c.cfg": klipper.ROTARY},
    "marlin": {"c.log": marlin.BED},
    "marlin, G33": {"c.log": marlin.G33},
    "table": {"t.txt": table.TRACKER, "j.txt": table.JOINTS},
    "linuxcnc": {"p.txt": linuxcnc.LOG, "c.hal": linuxcnc.HAL},
}
TIMES = 60
NOISE = [*"0-+.,:;=#*{}[] \n\tLRHXé", "nan", "1e999", "-1", "inf", "\x00"]


def damaged(text, rng):
    """A few places cut out, doubled or overwritten."""
    for _ in range(rng.integers(1, 4)):
        at, n = rng.integers(len(text)), rng.integers(0, 12)
        new = ["", rng.choice(NOISE), text[at : at + n] * 2][rng.integers(3)]
        text = text[:at] + new + text[at + n :]
    return text


def told(read, *arguments, **options):
    """What it refuses with; nothing where it reads."""
    try:
        read(*arguments, **options)
    except ParallelCalError as error:
        return [str(error)]
    return []


@pytest.mark.parametrize("name", FILES)
def test_damage_is_reported_in_one_line(name, tmp_path):
    rng, kind = np.random.default_rng(35), name.split(",")[0]
    options = {"unit": "mm"} if kind == "linuxcnc" else {}
    paths, refused = [tmp_path / file for file in FILES[name]], []
    for _ in range(TIMES):
        for file, text in FILES[name].items():
            (tmp_path / file).write_text(damaged(text, rng), encoding="utf-8")
        refused += told(samples, kind, paths, **options) + told(configured, paths[-1:])
    assert len(refused) > TIMES / 3
    assert not [text for text in refused if "\n" in text or str(tmp_path) not in text]


def test_damage_of_a_urdf_is_reported_in_one_line(tmp_path):
    rng, path, refused = np.random.default_rng(36), tmp_path / "robot.urdf", []
    for _ in range(TIMES):
        path.write_text(damaged(urdf.UR5, rng), encoding="utf-8")
        refused += told(arm, path, "base", "tool0")
    assert len(refused) > TIMES / 3
    assert not [text for text in refused if "\n" in text]
