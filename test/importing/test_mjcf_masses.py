"""Masses of an MJCF: those that it states, and those of geometries, worked by hand."""

import numpy as np
import pytest

from parallel_cal.base.errors import DatasetError
from parallel_cal.importing.mjcf_elements import read_document
from parallel_cal.importing.mjcf_masses import read_masses

LINKS = """<mujoco><compiler angle="radian"/>
<default><default class="heavy"><geom density="2000"/></default>
<default class="shown"><geom type="mesh" mass="0"/></default></default>
<worldbody><geom type="plane" size="1 1 1"/>
<body name="stated"><inertial mass="1.5" pos="0 0 0.1" diaginertia="1 1 1"/><geom size="9"/></body>
<body name="ball"><geom size="0.1" pos="0.1 0 0"/><geom class="shown" mesh="a"/></body>
<body name="rod"><geom type="capsule" size="0.02" fromto="0 0 0 0 0.3 0" class="heavy"/></body>
<body name="drum" childclass="heavy"><frame pos="0 0 1"><geom type="cylinder" size="0.1 0.05"/>
</frame></body>
<body name="plates"><geom type="box" size="0.1 0.2 0.3" mass="3" pos="1 0 0"/>
  <geom type="ellipsoid" size="0.1 0.2 0.3" mass="1" pos="0 1 0" quat="0 1 0 0"/>
  <geom size="5" group="7"/></body>
<body name="cast"><geom type="mesh" mesh="a" mass="2"/></body>
</worldbody></mujoco>"""


def masses(tmp_path, text=LINKS):
    (tmp_path / "links.xml").write_text(text)
    return read_masses(read_document(tmp_path / "links.xml"))


@pytest.mark.parametrize(
    ("body", "mass", "centre"),
    [
        ("stated", 1.5, [0, 0, 0.1]),
        ("ball", 1000 * 4 / 3 * np.pi * 0.1**3, [0.1, 0, 0]),
        ("rod", 2000 * np.pi * 0.02**2 * (0.3 + 4 / 3 * 0.02), [0, 0.15, 0]),
        ("drum", 2000 * np.pi * 0.1**2 * 0.1, [0, 0, 1]),
        ("plates", 4.0, [0.75, 0.25, 0]),
    ],
)
def test_a_body_weighs_what_its_file_says(tmp_path, body, mass, centre):
    found, _ = masses(tmp_path)
    assert found[body][0] == pytest.approx(mass, rel=1e-12)
    assert found[body][1] == pytest.approx(centre)


def test_a_mass_that_follows_from_a_mesh_is_not_read_and_said(tmp_path):
    found, [remark] = masses(tmp_path)
    assert set(found) == {"stated", "ball", "rod", "drum", "plates"}
    assert remark.startswith("the masses of cast follow from meshes")


def test_the_compiler_may_take_geometries_alone_or_none_and_state_the_sum(tmp_path):
    alone, _ = masses(tmp_path, LINKS.replace("<compiler", '<compiler inertiafromgeom="true"'))
    assert alone["stated"][0] == pytest.approx(1000 * 4 / 3 * np.pi * 9**3)
    none, _ = masses(tmp_path, LINKS.replace("<compiler", '<compiler inertiafromgeom="false"'))
    assert set(none) == {"stated"}
    scaled, _ = masses(tmp_path, LINKS.replace("<compiler", '<compiler settotalmass="50"'))
    assert sum(mass for mass, _ in scaled.values()) == pytest.approx(50)


def test_a_geometry_without_its_size_names_its_line(tmp_path):
    with pytest.raises(DatasetError, match=r"links.xml:\d+.*size is '0.1', expected 3 numbers"):
        masses(tmp_path, LINKS.replace('"0.1 0.2 0.3" mass="3"', '"0.1"'))
