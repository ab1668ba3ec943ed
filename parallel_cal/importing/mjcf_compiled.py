"""A linkage from an MJCF file as MuJoCo compiles it (extra `mjcf`).

MuJoCo alone expands `<replicate>`, `<attach>` and the like. Geometries and meshes are left out, so
that the files of meshes are not needed.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.base.rotation import quaternion_to_matrix
from parallel_cal.importing.linkage import (
    FIXED,
    Linkage,
    LinkageJoint,
    LinkageLoop,
    Place,
)
from parallel_cal.importing.mjcf import KINDS

Array = np.ndarray

UNUSED = "sensors pairs excludes meshes hfields skins flexes materials textures cameras lights"
TYPES = dict(enumerate(("free", "ball", "slide", "hinge")))
DRIVES = {
    int(mujoco.mjtTrn.mjTRN_JOINT): "joint",
    int(mujoco.mjtTrn.mjTRN_JOINTINPARENT): "joint",
    int(mujoco.mjtTrn.mjTRN_TENDON): "tendon",
}


def read_compiled_mjcf(path: Path) -> Linkage:
    """Return the linkage of a file; DatasetError with MuJoCo's words if it cannot compile it."""
    try:
        model, stated = compile_bodies(path)
    except (ValueError, OSError) as error:
        raise DatasetError(f"{path}: MuJoCo cannot read it: {error}") from None
    names = [model.body(i).name or f"body{i}" for i in range(model.nbody)]
    own = [_pose(model.body_pos[i], model.body_quat[i]) for i in range(model.nbody)]
    poses, joints, floating = {"world": np.eye(4)}, list[LinkageJoint](), list[str]()
    for i in range(1, model.nbody):
        parent = names[model.body_parentid[i]]
        poses[names[i]] = poses[parent] @ own[i]
        first, n = model.body_jntadr[i], model.body_jntnum[i]
        if n and TYPES[int(model.jnt_type[first])] == "free":
            floating.append(names[i])
        elif not n:
            joints.append(LinkageJoint(names[i], FIXED, parent, names[i], own[i]))
        for k in range(first, first + n if names[i] not in floating else first):
            joints.append(
                read_joint(path, model, k, (k - first + 1, n), (parent, names[i]), own[i])
            )
            parent, own[i] = joints[-1].child, np.eye(4)
            poses.setdefault(parent, poses[joints[-1].parent] @ joints[-1].origin)
    frames = {name: Place(name, np.eye(4)) for name in names}
    sites = [
        Place(names[model.site_bodyid[i]], _pose(model.site_pos[i], model.site_quat[i]))
        for i in range(model.nsite)
    ]
    for i, site in enumerate(sites):
        frames.setdefault(model.site(i).name, site)
    frames.pop("", None)
    loops = read_equalities(path, model, names, sites)
    driven = [
        getattr(model, DRIVES[int(kind)])(model.actuator_trnid[i, 0]).name
        for i, kind in enumerate(model.actuator_trntype)
        if int(kind) in DRIVES
    ]
    known = [joint.name for joint in joints]
    return Linkage(
        path,
        (*floating, "world") if len(floating) == 1 else ("world", *floating),
        tuple(joints),
        tuple(loops),
        frames,
        poses,
        tuple(dict.fromkeys(name for name in driven if name in known)),
        model.opt.gravity.copy(),
        {names[i]: (float(model.body_mass[i]), model.body_ipos[i].copy()) for i in stated},
    )


def compile_bodies(path: Path) -> tuple[Any, list[int]]:
    """Return the model, and the numbers of the bodies whose mass the file states."""
    spec = mujoco.MjSpec.from_file(str(path))
    for geom in list(spec.geoms):
        spec.delete(geom)
    for kind in UNUSED.split():
        for one in list(getattr(spec, kind, [])):
            spec.delete(one)
    stated = [body for body in spec.bodies[1:] if body.explicitinertial]
    for body in spec.bodies[1:]:
        if not body.explicitinertial:  # what moves needs a mass
            body.explicitinertial = True
            body.mass, body.inertia, body.fullinertia = 1.0, [1.0, 1.0, 1.0], [np.nan] * 6
    spec.compiler.balanceinertia = True  # inertias do not matter
    model = spec.compile()
    return model, [body.id for body in stated]


def _pose(position: Array, quaternion: Array) -> Array:
    T, (w, x, y, z) = np.eye(4), quaternion
    T[:3, 3], T[:3, :3] = position, quaternion_to_matrix([x, y, z, w])
    return T


def read_joint(
    path: Path,
    model: Any,
    k: int,
    number: tuple[int, int],
    bodies: tuple[str, str],
    origin: Array,
) -> LinkageJoint:
    """Return a joint; `number` is its number in its body, and how many this body has."""
    i, n = number
    kind, at = KINDS[TYPES[int(model.jnt_type[k])]], model.jnt_qposadr[k]
    is_ball = kind == "spherical"
    name = model.joint(k).name or f"{bodies[1]}_joint{i if n > 1 else ''}"
    ref, spring = (float(values[at]) for values in (model.qpos0, model.qpos_spring))
    limits = model.jnt_range[k] if model.jnt_limited[k] else (-np.inf, np.inf)
    return LinkageJoint(
        name,
        kind,
        bodies[0],
        bodies[1] if i == n else f"{bodies[1].rpartition('/')[0] or bodies[1]}/{i}",
        origin,
        model.jnt_pos[k].copy(),
        () if is_ball else (model.jnt_axis[k].copy(),),
        (float(limits[0]), float(limits[1])),
        zero=0.0 if is_ball else -ref,
        rest=spring - ref if not is_ball and np.ravel(model.jnt_stiffness[k])[0] > 0 else None,
        where=f"{path}: joint '{name}'",
    )


def read_equalities(
    path: Path, model: Any, names: list[str], sites: list[Place]
) -> list[LinkageLoop]:
    loops = list[LinkageLoop]()
    for i in range(model.neq):
        if not model.eq_active0[i]:
            continue
        data, ids = model.eq_data[i], (model.eq_obj1id[i], model.eq_obj2id[i])
        kind, weld = int(model.eq_type[i]), int(mujoco.mjtEq.mjEQ_WELD)
        if kind not in (weld, int(mujoco.mjtEq.mjEQ_CONNECT)):
            raise DatasetError(
                f"{path}: equality {i + 1} is neither connect nor weld; the mechanism `chain` has "
                "no joints that follow others"
            )
        is_weld = kind == weld
        word = "weld" if is_weld else "connect"
        name = model.equality(i).name or f"{word}{i + 1}"
        if int(model.eq_objtype[i]) == int(mujoco.mjtObj.mjOBJ_SITE):
            a, b = (sites[k] for k in ids)
        else:
            turn = np.array([1.0, 0.0, 0.0, 0.0])
            one, other = _pose(data[:3], turn), _pose(data[3:6], turn)
            if is_weld:  # the anchor, in the frame of the second body, then its relative pose
                one, other = _pose(data[3:6], data[6:10]) @ one, one
            a, b = Place(names[ids[0]], one), Place(names[ids[1]], other)
        rigid = is_weld and data[10] != 0
        loops.append(LinkageLoop(name, "pose" if rigid else "point", a, b, where=f"{path}: {name}"))
    return loops
