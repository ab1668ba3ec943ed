"""How does the controller get the calibrated kinematics?

The exported C99 needs no library and no memory allocation; `make check` there compares it with
the numbers that Python computed.
"""

import shutil
import subprocess

import parallel_cal as pc

model = pc.read_model("config/delta_mockup_nominal.yaml")
exported = pc.export(model, "c", "controller")
print(*sorted(path.name for path in exported.paths))

if shutil.which("make") and shutil.which("cc"):
    done = subprocess.run(["make", "-C", "controller", "check"], capture_output=True, text=True)
    print("agrees with Python" if done.returncode == 0 else done.stderr)

# Prints:
# CMakeLists.txt Makefile delta54.c delta54.h delta54_check.c delta54_loop.c delta54_vectors.csv
# agrees with Python
