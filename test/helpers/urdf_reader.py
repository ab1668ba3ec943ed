"""A reader of URDF that knows the standard and nothing of ours: poses by plain 4x4 products."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation


def three(element, key, default):
    text = default if element is None else element.get(key, default)
    return np.array(text.split(), float)


class Urdf:
    """Joints by name and by the link that they move, and where links are."""

    def __init__(self, text):
        root = ElementTree.fromstring(text.read_text() if isinstance(text, Path) else text)
        self.joints = {joint.get("name"): joint for joint in root.findall("joint")}
        self.parent = {joint.find("child").get("link"): joint for joint in self.joints.values()}

    def position(self, name, q):
        """Where a joint stands: its reading, or what its mimic says."""
        mimic = self.joints[name].find("mimic")
        if mimic is None:
            return q[name]
        factor, offset = (float(mimic.get(k, v)) for k, v in (("multiplier", 1), ("offset", 0)))
        return factor * self.position(mimic.get("joint"), q) + offset

    def step(self, joint, q):
        """Pose (4, 4) of the moved link in the one before."""
        origin, moved = np.eye(4), np.eye(4)
        origin[:3, 3] = three(joint.find("origin"), "xyz", "0 0 0")
        rpy = three(joint.find("origin"), "rpy", "0 0 0")
        origin[:3, :3] = Rotation.from_euler("xyz", rpy).as_matrix()
        axis = three(joint.find("axis"), "xyz", "1 0 0")
        if joint.get("type") == "prismatic":
            moved[:3, 3] = axis / np.linalg.norm(axis) * self.position(joint.get("name"), q)
        elif joint.get("type") != "fixed":
            angle = self.position(joint.get("name"), q)
            moved[:3, :3] = Rotation.from_rotvec(axis / np.linalg.norm(axis) * angle).as_matrix()
        return origin @ moved

    def pose(self, start, end, q):
        """Pose (4, 4) of link `end` in link `start`, with readings by joint."""
        T, link = np.eye(4), end
        while link != start:
            joint = self.parent[link]
            T, link = self.step(joint, q) @ T, joint.find("parent").get("link")
        return T


def difference(model, urdf, start, end, n=20, seed=1, reach=1.0):
    """Largest difference (m, 1) between poses of a model and of a URDF at n configurations."""
    from parallel_cal.kinematics.kinematics import Kinematics

    rng, worst = np.random.default_rng(seed), 0.0
    home = np.array(model.mechanism.home.joints)
    for _ in range(n):
        q = home + rng.uniform(-reach, reach, len(home))
        expected = urdf.pose(start, end, dict(zip(model.joints, q, strict=True)))
        found = Kinematics(model).direct(q)
        away = found.position - expected[:3, 3], found.rotation - expected[:3, :3]
        worst = max(worst, *(np.abs(part).max() for part in away))
    return worst
