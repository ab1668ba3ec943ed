"""What `discover` finds on real machines: the error at held-out poses before and with the laws.

Models, samples and the split into poses for fitting and held-out poses are those of
`bench/truth/real_machines.py`, which has an independent fit of each machine beside it.
Usage: `python -m bench.truth.discover_real [MACHINE ...]`.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import parallel_cal as pc
from bench.truth import real_machines as rm

LASER, CABLE = rm.REAL / "laser_arms", rm.REAL / "hangprinter_hp4"
MACHINES: dict[str, tuple[Path, Path, Path]] = {  # model, samples, column map
    "jugglebot": (
        rm.REAL / "jugglebot" / "model.yaml",
        rm.REAL / "jugglebot" / "poses_108.csv",
        rm.REAL / "jugglebot" / "columns.yaml",
    ),
    "hangprinter_hp4": (
        rm.ROOT / "config" / "hangprinter_hp4.yaml",
        CABLE / "hp4_2021-12-14.csv",
        rm.ROOT / "config" / "columns" / "hangprinter_hp4.yaml",
    ),
    "wam": (LASER / "wam.yaml", LASER / "wam.csv", LASER / "wam.columns.yaml"),
    "ur5": (LASER / "ur5.yaml", LASER / "ur5.csv", LASER / "ur5.columns.yaml"),
}


def main() -> None:
    for name in sys.argv[1:] or MACHINES:
        file, samples, columns = MACHINES[name]
        model = pc.read_model(file)
        data = rm.read(model, samples, columns)
        training, held_out = (data.select(index) for index in rm.split(len(data)))
        began = time.process_time()
        found = pc.discover(model, training)
        seconds = time.process_time() - began
        fitted = pc.fit(model, training, hold_out=0).model
        before, after = (
            1e6 * pc.compare(one, held_out).errors.summary.position_rms
            for one in (fitted, found.described)
        )
        print(f"{name}: {len(training)} poses for fitting, {len(held_out)} held out")
        print(f"    {found.verdict}: {found.summary}")
        print(f"    held-out error {before:.1f} -> {after:.1f} um; {seconds:.0f} s", flush=True)


if __name__ == "__main__":
    main()
