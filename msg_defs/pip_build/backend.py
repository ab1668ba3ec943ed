# Copyright 2026 parallel_cal maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

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
