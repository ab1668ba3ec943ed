"""LinuxCNC's component: compiled against stand-ins of its headers and called as LinuxCNC does."""

import ctypes
import shutil
import subprocess

import numpy as np
import pytest
import virtual_day as vd

from parallel_cal.exporting.export import export
from parallel_cal.model.mechanism import poses_in_workspace
from parallel_cal.model.model import new_model
from parallel_cal.virtual import robot as vr
from parallel_cal.virtual import stewart

pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="no C compiler")

# What kinematics.h, hal.h and rtapi*.h declare of what a component uses (LinuxCNC 2.9).
HEADERS = {
    "kinematics.h": """
typedef struct { double x, y, z; } PmCartesian;
typedef struct EmcPose { PmCartesian tran; double a, b, c, u, v, w; } EmcPose;
typedef enum { KINEMATICS_IDENTITY = 1, KINEMATICS_FORWARD_ONLY, KINEMATICS_INVERSE_ONLY,
    KINEMATICS_BOTH } KINEMATICS_TYPE;
typedef unsigned long int KINEMATICS_FORWARD_FLAGS, KINEMATICS_INVERSE_FLAGS;
extern int kinematicsForward(const double *, struct EmcPose *, const KINEMATICS_FORWARD_FLAGS *,
    KINEMATICS_INVERSE_FLAGS *);
extern int kinematicsInverse(const struct EmcPose *, double *, const KINEMATICS_INVERSE_FLAGS *,
    KINEMATICS_FORWARD_FLAGS *);
extern KINEMATICS_TYPE kinematicsType(void);
#define KINS_NOT_SWITCHABLE
""",
    "hal.h": "int hal_init(const char *); int hal_ready(int); int hal_exit(int);\n",
    "rtapi.h": """
#define EXPORT_SYMBOL(x) struct nothing
#define MODULE_LICENSE(x) struct nothing
""",
    "rtapi_app.h": "int rtapi_app_main(void); void rtapi_app_exit(void);\n",
}
HAL = """#include "hal.h"
int hal_init(const char *name) { return name[0]; }
int hal_ready(int id) { return id; }
int hal_exit(int id) { return id; }
"""


class Pose(ctypes.Structure):
    _fields_ = [(name, ctypes.c_double) for name in "xyzabcuvw"]


class Component:
    """A machine of nine joints that runs an exported component."""

    def __init__(self, model, folder):
        export(model, "linuxcnc:name=robot", folder)
        folder = folder / "component"
        for name, text in HEADERS.items():
            (folder / name).write_text(text)
        (folder / "hal.c").write_text(HAL)
        strict = "gcc -std=c99 -Wall -Wextra -Werror -O1 -fPIC -shared -I.".split()
        words = [*strict, "robot_kins.c", "hal.c", "-o", "kins.so", "-lm"]
        done = subprocess.run(words, cwd=folder, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        self.library = ctypes.CDLL(str(folder / "kins.so"))

    def inverse(self, pose):
        joints, zero = (ctypes.c_double * 9)(), ctypes.c_ulong()
        given = Pose(*pose)
        zero = ctypes.byref(zero)
        status = self.library.kinematicsInverse(ctypes.byref(given), joints, zero, zero)
        return status, np.array(joints)

    def forward(self, joints):
        pose, zero = Pose(), ctypes.byref(ctypes.c_ulong())
        given = (ctypes.c_double * 9)(*joints)
        status = self.library.kinematicsForward(given, ctypes.byref(pose), zero, zero)
        return status, np.array([getattr(pose, name) for name in "xyzabcuvw"])


def test_a_delta_moves_where_rods_and_points_say_and_passes_other_letters_on(tmp_path):
    component = Component(new_model("delta54", vr.TABLE_5_18), tmp_path)
    assert component.library.kinematicsType() == 4
    assert component.library.rtapi_app_main() == 0
    for r in vd.targets(20, seed=3):
        status, joints = component.inverse([*r * 1e3, 11, 12, 13, 14, 15, 16])
        assert status == 0
        reached = vr.MOCK_UP.forward(np.radians(joints[:3]))[0]
        assert np.linalg.norm(reached - r) < 1e-9
        assert joints[3:].tolist() == [11, 12, 13, 14, 15, 16]
        status, pose = component.forward(joints)
        assert status == 0
        np.testing.assert_allclose(pose, [*r * 1e3, 11, 12, 13, 14, 15, 16], atol=1e-6)
    assert component.inverse([900, 0, 200, *[0] * 6])[0] == -1


@pytest.mark.wide
def test_a_hexapod_turns_about_x_then_y_then_z(tmp_path):
    model = new_model("stewart42")
    component = Component(model, tmp_path)
    robot = stewart.Stewart(model.table.mapping(model.values))
    r, _ = poses_in_workspace(model.mechanism, 10, np.random.default_rng(2))
    for k, (a, b, c) in enumerate(np.random.default_rng(3).uniform(-9, 9, (10, 3))):
        turned = [
            vr.axis_rotation(axis, np.radians(t)) for axis, t in zip("zyx", (c, b, a), strict=True)
        ]
        status, joints = component.inverse([*r[k] * 1e3, a, b, c, 1, 2, 3])
        assert status == 0
        q = robot.inverse(r[k], turned[0] @ turned[1] @ turned[2])[0]
        np.testing.assert_allclose(joints[:6], q * 1e3, atol=1e-6)
        assert joints[6:].tolist() == [1, 2, 3]
        status, pose = component.forward(joints)
        np.testing.assert_allclose(pose, [*r[k] * 1e3, a, b, c, 1, 2, 3], atol=1e-6)


@pytest.mark.parametrize(
    ("widths", "proposed"),
    [
        (
            [-0.7, 10.0, 1.9, 2.1, 0.0, 30.0],
            "mm: JOINT_0 0.0000, JOINT_1 0.0100, JOINT_2 0.0000, JOINT_3 0.0021, JOINT_4 0.0000, "
            "JOINT_5 0.0300 (0: less than 2 sigma, or negative). ",
        ),
        ([-0.7, 0.7, 1.9, -5.0, 0.0, 0.1], "leave BACKLASH at 0 in your .ini file"),
    ],
)
def test_a_width_of_backlash_that_is_not_significant_is_proposed_as_0(widths, proposed, tmp_path):
    model = new_model("stewart42").with_effect("backlash")
    which = [model.table.index_of(f"backlash.leg{k}.width") for k in range(1, 7)]
    values, covariance = model.values.copy(), np.zeros((len(model.values),) * 2)
    values[which], covariance[which, which] = 1e-6 * np.array(widths), 1e-6**2
    done = export(model.with_values(values, covariance), "linuxcnc", tmp_path)
    (remark,) = [remark for remark in done.remarks if "BACKLASH" in remark]
    assert proposed in remark
    assert remark.endswith("The stated error of the kinematics does not include backlash")
    assert not any("cannot represent of" in remark for remark in done.remarks)
    assert done.loss["position_max"] < 1e-7


REALTIME = {  # how LinuxCNC's headers mark what a module exports (rtapi.h, 2.9 and 5c41560ebb)
    "EXPORT_SYMBOL(x)": 'char rtapi_exported_##x[] __attribute__((section(".rtapi_export"))) = #x;',
    "MODULE_LICENSE(x)": "struct nothing",
}
OPTIONS = {  # of Makefile.modinc: Debian's 2.9.0, and 5c41560ebb
    "2.9.0": "-Os -g",
    "5c41560ebb": "-O2 -Wall -Wextra -g",
}
MODULE = (
    "-I. -DUSPACE -fno-fast-math -mieee-fp -fno-unsafe-math-optimizations -DRTAPI -D_GNU_SOURCE "
    "-Drealtime -D__MODULE__ -fno-builtin-sin -fno-builtin-cos -fno-builtin-sincos "
    "-Wframe-larger-than=2560 -DSIM -fPIC"
)


@pytest.mark.wide
@pytest.mark.skipif(shutil.which("objdump") is None, reason="no binutils")
@pytest.mark.parametrize("version", OPTIONS)
def test_halcompile_links_the_three_functions_of_a_component_and_no_other(version, tmp_path):
    """The steps of halcompile, which hides all symbols but the exported ones. halcompile itself was
    run on components of a Delta, a hexapod and a cable robot: these functions gave the same poses.
    """
    export(new_model("delta54", vr.TABLE_5_18), "linuxcnc:name=robot", tmp_path)
    folder = tmp_path / "component"
    marks = "".join(f"#define {name} {text}\n" for name, text in REALTIME.items())
    for name, text in (HEADERS | {"rtapi.h": marks}).items():
        (folder / name).write_text(text)
    (folder / "hal.c").write_text(HAL)

    def run(words):
        done = subprocess.run(words, cwd=folder, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout

    run(["gcc", *OPTIONS[version].split(), *MODULE.split(), "-c", "robot_kins.c"])
    run(["ld", "-d", "-r", "-o", "robot.tmp", "robot_kins.o"])
    marked = run(["objdump", "-w", "-j", ".rtapi_export", "-t", "robot.tmp"])
    names = sorted(word[15:] for word in marked.split() if word.startswith("rtapi_exported_"))
    assert names == ["kinematicsForward", "kinematicsInverse", "kinematicsType"]
    (folder / "robot.ver").write_text(
        "{ global : " + "".join(f"{name}; " for name in names) + "local : * ; };\n"
    )
    link = "gcc -shared -Bsymbolic -Wl,--version-script,robot.ver -o kins.so robot_kins.o -lm"
    run([*link.split(), "hal.c", "-I."])
    component = object.__new__(Component)
    component.library = ctypes.CDLL(str(folder / "kins.so"))
    for r in vd.targets(5, seed=3):
        status, joints = component.inverse([*r * 1e3, 11, 12, 13, 14, 15, 16])
        assert status == 0
        reached = vr.MOCK_UP.forward(np.radians(joints[:3]))[0]
        assert np.linalg.norm(reached - r) < 1e-9
