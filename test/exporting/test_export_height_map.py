"""The height map that an export to RepRapFirmware writes beside its numbers."""

import numpy as np
import pytest
import virtual_firmware as vf
import virtual_printer as vp

from parallel_cal.exporting.export import export
from parallel_cal.importing.controller_files import configured, samples
from parallel_cal.importing.importers.rrf import read_map
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import new_model

MM = 1e-3


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A printer whose towers lean and whose rods are pairs that differ, and what was written."""
    folder = tmp_path_factory.mktemp("printer")
    (folder / "config.g").write_text(vp.CONFIG)
    model = configured([folder / "config.g"]).model
    values = model.values.copy()
    for name, by in (("chain1.alpha", 12e-3), ("chain2.beta", -15e-3), ("chain3.dLb", 3 * MM)):
        values[model.table.index_of(name)] += by
    model = model.with_values(values)
    return model, export(model, "rrf", folder / "new"), folder / "new"


def test_the_nozzle_is_on_the_bed_where_the_map_is_added_to_z(exported):
    """By another formula of the firmware, with the numbers as they are written."""
    model, _, folder = exported
    points, _, gaps = read_map(folder / "heightmap.csv")
    assert len(points) > 60
    assert len(points) + len(gaps) == 121
    firmware = vf.Duet((folder / "config.g").read_text())
    homed = np.array(model.mechanism.joint_limits)[:, 1]

    def heights(r):
        q = homed + (firmware.motors(r / MM) - firmware.homed()) * MM
        return Kinematics(model).direct(q).position[:, 2]

    plain = heights(points * [1, 1, 0])
    left = heights(points)
    assert np.std(plain) > 10e-6
    assert np.abs(left - left.mean()).max() < 1.5e-6  # digits of the map and of the numbers


def test_the_map_is_read_as_touches_of_this_printer(exported):
    model, _, folder = exported
    data = samples("rrf", [folder / "heightmap.csv", folder / "config.g"])
    off = (
        np.array(model.mechanism.joint_limits)[:, 1]
        - np.array(configured([folder / "config.g"]).model.mechanism.joint_limits)[:, 1]
    )
    z = Kinematics(model).direct(data.q + off).position[:, 2]
    assert np.abs(z - z.mean()).max() < 3e-6


def test_a_printer_without_a_probe_gets_no_map(tmp_path):
    done = export(new_model("linear_delta"), "rrf", tmp_path)
    assert [path.name for path in done.paths] == ["config.g"]
