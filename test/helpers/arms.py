"""Virtual arms as a workshop describes and measures them: model files' links, Datasets."""

import numpy as np
import virtual_arm as va

from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_mechanism
from parallel_cal.recordings.dataset import Dataset

# How each axis lies to the next: shoulder, elbow and first wrist axis of a UR5 are parallel.
AXES = {
    "ur5": ("perpendicular", "parallel", "parallel", "perpendicular", "perpendicular"),
    "wam": ("perpendicular",) * 6,
}
ROWS = {"ur5": va.UR5, "wam": va.WAM}


def nominal(kind):
    """The arm of the data sheet as a model: {B} on the first axis."""
    links = [{"joint": None, "axes": "coincident"}]
    for (a, d, alpha), axes in zip(ROWS[kind], [*AXES[kind], None], strict=True):
        links.append({"joint": "R", "a": a, "d": d, "alpha": alpha})
        links[-1] |= {"axes": axes} if axes else {}
    return new_model(load_mechanism("serial", links=links, home=va.HOME[kind]))


def seen(session, pose=True, frame=""):
    """A session as a Dataset, of whole poses or of positions alone."""
    t, n = session.tracker, session.q.shape[1]
    joints = [f"joint{i + 1}" for i in range(n)]
    return Dataset.from_arrays(
        joints,
        session.q,
        session.r,
        session.R if pose else None,
        pose_cov=np.diag([t.position**2] * 3 + [t.orientation**2] * 3),
        joint_sigma=[t.joint] * n,
        conditions={f"direction.{j}": session.direction[:, i] for i, j in enumerate(joints)},
        frame=frame,
        source="virtual arm",
    )
