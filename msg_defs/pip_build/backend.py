"""PEP 517 backend: scikit-build-core, told where pip put ROS (CMakeLists.txt stays plain ament)."""

import os
from pathlib import Path

import ament_package
from scikit_build_core.build import *  # noqa: F403

# prefix/lib/python3.x/site-packages/ament_package/__init__.py; in an isolated build the prefix is
# pip's temporary one. A ROS that happens to be sourced must not be mixed with it.
_prefix = str(Path(ament_package.__file__).resolve().parents[4])
_include = Path(__file__).with_name("ros_wheels.cmake").as_posix()
os.environ["AMENT_PREFIX_PATH"] = os.environ["CMAKE_PREFIX_PATH"] = _prefix
os.environ["SKBUILD_CMAKE_DEFINE"] = f"CMAKE_PROJECT_INCLUDE={_include};BUILD_TESTING=OFF"
