"""A table of single touches of the bed, X, Y and Z by the firmware, of any Delta whose
configuration `new --from` reads.

Many firmwares print touches, or the nozzle is lowered by hand onto a sheet of paper, and none of
it is stored. The table and the configuration that was active then give the joints: X, Y and Z are
where the firmware believes the tip of the probe to be, and its own formula says where its motors
were.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.importing.controller_files import configured
from parallel_cal.importing.deltas import Delta
from parallel_cal.importing.touch_samples import (
    make_printed_ends,
    make_touch_samples,
    read_touch_table,
)
from parallel_cal.recordings.dataset import Dataset

PROBE = "probe"
EXPECTED = (
    "expected tables (.csv) with the columns X, Y and Z of touches in mm, and the configuration "
    "that was active then"
)
NO_DELTA = "its touches cannot be imported: expected the configuration of a Delta"
NO_PROBE = (
    "a model made from {} has no probe: state it as `new --from ... --sensor "
    "'probe: {{height: {:.4f}, sigma: null}}'`, with the height of the bed in m"
)


def samples(
    paths: Sequence[Path], printed_x: Sequence[float] = (), printed_y: Sequence[float] = ()
) -> Dataset:
    """Read tables of touches, with the configuration by which the firmware computed them."""
    tables = [path for path in paths if path.suffix.lower() == ".csv"]
    files = [path for path in paths if path not in tables]
    if not tables or not files:
        raise DatasetError(f"{', '.join(map(str, paths))}: {EXPECTED}")
    robot = configured(files)
    delta: Delta | None = robot.formula
    model = robot.model
    if delta is None:
        raise DatasetError(f"{files[0]}: a {model.mechanism.name}: {NO_DELTA}")
    found = [read_touch_table(path, plane_mm=None) for path in tables]
    if missing := [path for path, each in zip(tables, found, strict=True) if each is None]:
        raise DatasetError(f"{missing[0]}: no columns X, Y and Z; {EXPECTED}")
    read = [each for each in found if each is not None]
    points = np.concatenate([each[0] for each in read])
    probes = [sensor for sensor in model.sensors if sensor.name == PROBE]
    tip = probes[0].options.get("tip", (0.0, 0.0, 0.0)) if probes else (0.0, 0.0, 0.0)
    remarks = [] if probes else [NO_PROBE.format(files[0].name, np.median(points[:, 2]))]
    return make_touch_samples(
        delta,
        points - np.array(tip),
        [place for each in read for place in each[1]],
        paths,
        delta.step,
        warnings=remarks,
        printed=make_printed_ends(delta, printed_x, printed_y),
    )
