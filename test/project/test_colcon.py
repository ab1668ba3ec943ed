"""Both packages build with colcon, unchanged, on the pip-installed ROS."""

import configparser
import os
import re
import shutil
import signal
import subprocess
import venv
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]


def run(*command, **kwargs):
    done = subprocess.run(
        [str(word) for word in command], capture_output=True, text=True, timeout=900, **kwargs
    )
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]
    return done.stdout


def clean_environment(**extra):
    """Ours without what a sourced ROS or the wheels' start-up hook left in it."""
    dropped = re.compile(
        r"AMENT_|CMAKE_|COLCON_|ROS_|RMW_|_ROS_WHEELS|LD_LIBRARY_PATH|PYTHONPATH|VIRTUAL_ENV"
    )
    kept = {name: value for name, value in os.environ.items() if not dropped.match(name)}
    return kept | extra


def build_requirements():
    """The list that pip's isolated build of msg_defs uses, so that there is one list only."""
    text = (ROOT / "msg_defs" / "pyproject.toml").read_text()
    names = re.search(r"^requires = \[(.*?)^\]", text, re.DOTALL | re.MULTILINE)[1]
    return re.findall(r'^\s*"([^"]+)"', names, re.MULTILINE)


@pytest.fixture(scope="module")
def workspace(tmp_path_factory):
    """(python, install space); an environment of its own, .venv needs neither colcon nor empy 3."""
    if not (shutil.which("cmake") and shutil.which("c++") and shutil.which("make")):
        pytest.skip("needs cmake, make and a C++ compiler")
    folder = tmp_path_factory.mktemp("colcon")
    source, prefix = folder / "src", folder / "venv"
    shutil.copytree(
        ROOT,
        source,
        ignore=shutil.ignore_patterns(".git", ".venv", "build", "install", "log", "*.egg-info"),
    )
    venv.create(prefix, with_pip=True)
    python = prefix / "bin" / "python"
    environment = clean_environment()
    libraries = ["numpy", "colcon-common-extensions", *build_requirements()]
    run(python, "-m", "pip", "install", "-qq", *libraries, env=environment)
    path = f"{prefix / 'bin'}{os.pathsep}{os.environ['PATH']}"
    run(
        *(python, prefix / "bin" / "colcon", "build", "--cmake-args"),
        f"-DCMAKE_PROJECT_INCLUDE={source / 'msg_defs' / 'pip_build' / 'ros_wheels.cmake'}",
        *("-DBUILD_TESTING=OFF", f"-DPython3_EXECUTABLE={python}"),
        cwd=source,
        env=environment
        | {
            "PATH": path,
            "AMENT_PREFIX_PATH": str(prefix),
            "CMAKE_PREFIX_PATH": str(prefix),
            "COLCON_DEFAULTS_FILE": str(source / "colcon_defaults.yaml"),
        },
    )
    return python, source / "install"


def test_the_messages_of_the_install_space_work(workspace):
    python, install = workspace
    site = next((install / "parallel_cal_msgs").glob("lib/python3*/site-packages"))
    script = (
        "import parallel_cal_msgs.msg as m, parallel_cal_msgs.action, parallel_cal_msgs.srv\n"
        "from rclpy.serialization import deserialize_message, serialize_message\n"
        "sent = m.SolutionSet(solutions=[m.Solution(joints=[1.0])], count_complex=40)\n"
        "assert deserialize_message(serialize_message(sent), m.SolutionSet) == sent\n"
        "print(m.__file__)\n"
    )
    environment = clean_environment(
        PYTHONPATH=str(site), LD_LIBRARY_PATH=str(install / "parallel_cal_msgs" / "lib")
    )
    assert str(install) in run(python, "-c", script, env=environment)


@pytest.mark.parametrize("node", ["kinematics_node", "calibration_node", "replay_node"])
def test_ros2_run_finds_the_nodes(workspace, node):
    executable = workspace[1] / "parallel_cal" / "lib" / "parallel_cal" / node
    assert executable.is_file()
    assert os.access(executable, os.X_OK)


def test_the_nodes_run_with_the_workspace_sourced(workspace):
    """What `ros2 run` and `ros2 launch` come to in a shell that has sourced the install space."""
    python, install = workspace
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg")
    libraries = setup["options"]["install_requires"], setup["options.extras_require"]["ros"]
    named = [line for text in libraries for line in text.split()]
    run(python, "-m", "pip", "install", "-qq", *named, env=clean_environment())
    share = install / "parallel_cal" / "share" / "parallel_cal"
    preset = share / "config" / "delta_mockup_nominal.yaml"
    served = start(workspace, "kinematics_node", f"model_file:={preset}")
    assert f"{preset.name}: " in served.stdout.readline()
    served.send_signal(signal.SIGINT)
    assert served.wait(60) == 0
    refused = start(workspace, "calibration_node", "mode:=walk")
    assert refused.stdout.readline().startswith("error: parameter mode")
    assert refused.wait(60) == 1


def start(workspace, node, parameter):
    python, install = workspace
    executable = install / "parallel_cal" / "lib" / "parallel_cal" / node
    command = f'source {install / "setup.bash"} && exec {executable} --ros-args -p "{parameter}"'
    environment = clean_environment(
        AMENT_PREFIX_PATH=str(python.parents[1]), ROS_AUTOMATIC_DISCOVERY_RANGE="OFF"
    )
    return subprocess.Popen(
        ["bash", "-c", command],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


@pytest.mark.parametrize(
    "path",
    [
        "ament_index/resource_index/packages/parallel_cal",
        "parallel_cal/package.xml",
        "parallel_cal/launch/calibration.launch.py",
    ],
)
def test_the_package_is_indexed_with_its_launch_file(workspace, path):
    assert (workspace[1] / "parallel_cal" / "share" / path).is_file()


def test_the_presets_are_installed(workspace):
    presets = {path.name for path in (ROOT / "config").glob("*.yaml")}
    installed = workspace[1] / "parallel_cal" / "share" / "parallel_cal" / "config"
    assert {path.name for path in installed.glob("*.yaml")} == presets
