"""Robot or device? Find effects of one side that an error of the other side could imitate.

Residuals show what is missing, but not on which side of the measurement. The plausible size of each
side decides: a tolerance bounds an effect of the robot, and the device's certificate (the
tolerances of its effects) bounds an error of the device. A device that is worse than its
certificate shows by the form of its error: a smooth field over the workspace makes the data as
likely as the robot's effects do. A robot with a flaw that no effect of the catalogue describes
shows in the same way: a smooth error of one joint makes the data as likely as the device's effects.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from parallel_cal.causes.effects import find_new_parameters
from parallel_cal.diagnosis.catalogue import Candidate
from parallel_cal.diagnosis.thresholds import (
    CENTRES,
    EFFECT_SIZES,
    FIELD_LENGTHS,
    FIELD_SIZES,
    JOINT_FIELD_LENGTHS,
    MIN_LOG_EVIDENCE_GAIN,
    MIN_SEPARATION_SIGMAS,
)
from parallel_cal.identification.thresholds import LSTSQ_RANK_TOLERANCE
from parallel_cal.model.model import Model
from parallel_cal.posterior.scene import Scene, columns
from parallel_cal.posterior.smooth_functions import smooth_functions


def find_doubtful_effects(
    scene: Scene, chosen: Sequence[Candidate], ranked: Sequence[Candidate], fitted: Model
) -> list[str]:
    """Names of the effects among `chosen` that the other side may cause, by size or by form.

    `fitted` is the model with the chosen effects. Its tolerances allow the sizes that the data
    show, also of effects that are larger than usual.
    """
    return list(
        dict.fromkeys(
            [
                *find_device_lookalikes(scene, chosen, ranked, fitted),
                *find_position_only_effects(scene, chosen, fitted),
                *find_joint_lookalikes(scene, chosen, fitted),
                *find_effects_of_load(scene, chosen, fitted),
            ]
        )
    )


def find_device_lookalikes(
    scene: Scene, chosen: Sequence[Candidate], ranked: Sequence[Candidate], fitted: Model
) -> list[str]:
    """Names of the robot's effects among `chosen` that the device could cause as well.

    Next to the device's effects, the robot's effect, with its substitutes (see `_add_substitutes`),
    lowers misfit and price (see `cost`) by less than five sigmas. The device's effects are on both
    sides of this comparison, because a further error of the device says nothing against the robot's
    effect. Errors of the device that change with time are tested elsewhere: shuffled conditions,
    exchange of lookalikes.
    """
    names = {c.name for c in chosen}
    there = [c for c in ranked if c.effect.of_device and c.testable and c.name not in names]
    device = _list_lasting([*chosen, *there], scene, of_device=True)
    if not device:
        return []
    among = [*chosen, *device]
    return [
        one.name
        for one in _list_lasting(chosen, scene, of_device=False)
        if not is_needed([one], among, scene, fitted)
        and not is_needed(_add_substitutes(one, chosen, scene, fitted), among, scene, fitted)
    ]


def _list_lasting(some: Sequence[Candidate], scene: Scene, of_device: bool) -> list[Candidate]:
    """The effects of one side on the rows of the scene, without errors of the device that change
    with time."""
    return [
        c
        for c in some
        if c.effect.of_device is of_device
        and c.scene is scene
        and not (of_device and c.effect.needs)
    ]


def _add_substitutes(
    one: Candidate, chosen: Sequence[Candidate], scene: Scene, fitted: Model
) -> list[Candidate]:
    """An effect with the chosen ones of its side that could replace it: without one of them it
    would be needed.

    What two effects of the robot take from each other says nothing about the device.
    """
    if is_needed([one], chosen, scene, fitted):
        return [one]
    side = one.effect.of_device
    own = [c for c in chosen if c.effect.of_device is side and c.scene is scene and c is not one]
    return [
        one,
        *(c for c in own if is_needed([one], [d for d in chosen if d is not c], scene, fitted)),
    ]


def is_needed(
    some: Sequence[Candidate], among: Sequence[Candidate], scene: Scene, fitted: Model
) -> bool:
    """Whether some effects lower misfit and price of the others by more than five sigmas."""
    shared = _shared_scene(scene, [*some, *among])
    known = {c.name: _columns(scene, shared, c, fitted) for c in (*some, *among)}
    own = [known.pop(c.name) for c in some]
    without = np.hstack([np.zeros((len(shared.residual), 0)), *known.values()])
    both = np.hstack([without, *own])
    off_geometry = shared.project_off_geometry(both)
    numbers, _, rank, _ = np.linalg.lstsq(off_geometry, shared.residual)
    left = shared.residual - off_geometry @ numbers
    chi2_per_dof = float(left @ left) / max(shared.dof - int(rank), 1)
    if shared.observations.noise_assumed:
        # The noise was estimated from the residuals of the base: it contains what is missing.
        scale = max(chi2_per_dof, 1e-300)
        gain = cost(shared, without, scale) - cost(shared, both, scale)
        return gain > MIN_SEPARATION_SIGMAS**2
    noise = max(chi2_per_dof, 1.0)
    return cost(shared, without) - cost(shared, both) > MIN_SEPARATION_SIGMAS**2 * noise


def cost(scene: Scene, B: np.ndarray, scale: float = 1.0) -> float:
    """min over e of |r - B e|^2 / scale + |e|^2: misfit of the residual r (n,) by columns B (n, k)
    in tolerances, without the part that the geometry absorbs, plus the price of large coefficients
    e. `scale` is the variance of the noise in units of the scene's."""
    B = scene.project_off_geometry(B) / np.sqrt(scale)
    residual = scene.residual / np.sqrt(scale)
    along = B.T @ residual
    return float(residual @ residual - along @ np.linalg.solve(np.eye(B.shape[1]) + B.T @ B, along))


def _shared_scene(scene: Scene, chosen: Sequence[Candidate]) -> Scene:
    """The scene whose rows every chosen effect has: that of the larger model where one was chosen,
    since its closure has more rows a sample, else `scene`."""
    wider = (c.scene for c in chosen if c.effect.widens and c.scene is not None)
    return next(wider, scene)


def _columns(scene: Scene, shared: Scene, one: Candidate, fitted: Model) -> np.ndarray:
    """Columns of a candidate on the rows of `shared`; those of the larger model itself are its
    parameters that the model of `scene` has not."""
    if one.effect.widens:
        return columns(shared.model, shared, find_new_parameters(scene.model, shared.model))
    extended = shared.model.with_effect(one.name, one.settings)
    raised = {n: t for n, t in fitted.tolerances.items() if n in extended.table.names}
    extended = replace(extended, tolerances={**extended.tolerances, **raised})
    return columns(extended, shared, find_new_parameters(shared.model, extended))


def find_position_only_effects(
    scene: Scene, chosen: Sequence[Candidate], fitted: Model
) -> list[str]:
    """Names of the robot's effects among `chosen` that describe only a field of position.

    The data are likelier with a smooth field of position than with the effects, and hardly likelier
    with both. An error that effects describe with fewer parameters stays with the robot.
    """
    own = _list_lasting(chosen, scene, of_device=False)
    fields = list(_smooth_fields(_shared_scene(scene, chosen))) if own else []
    return _find_replaced(own, scene, chosen, fitted, fields)


def find_joint_lookalikes(scene: Scene, chosen: Sequence[Candidate], fitted: Model) -> list[str]:
    """Names of the device's effects among `chosen` that flaws of the joints could cause.

    Next to a smooth error of one joint or of all joints, the effect makes the data hardly likelier.
    Errors of the device that change with time are tested elsewhere.
    """
    own = _list_lasting(chosen, scene, of_device=True)
    fields = list(_joint_fields(_shared_scene(scene, chosen))) if own else []
    return _find_replaced(own, scene, chosen, fitted, fields)


def find_effects_of_load(scene: Scene, chosen: Sequence[Candidate], fitted: Model) -> list[str]:
    """Names of the device's effects among `chosen` that go with the payload, which no device knows:
    the robot deflects.

    The data are clearly likelier if the same error is proportional to the payload, and the error
    that is the same under every payload is then no longer needed. A payload that never changed
    decides nothing.
    """
    payload = scene.dataset.conditions.get("payload")
    own = _list_lasting(chosen, scene, of_device=True)
    if not own or payload is None or np.ptp(payload) == 0:
        return []
    shared = _shared_scene(scene, chosen)
    known = {c.name: _columns(scene, shared, c, fitted) for c in chosen}
    share = np.repeat(payload / np.sqrt(np.mean(payload**2)), shared.rows)[:, None]
    nothing = np.zeros((len(shared.residual), 0))

    def likely(*some: np.ndarray) -> float:
        return log_evidence(
            shared, shared.project_off_geometry(np.hstack([nothing, *some])), nothing
        )

    plain, found = likely(*known.values()), []
    for one in own:
        others = [columns for name, columns in known.items() if name != one.name]
        loaded = likely(*others, share * known[one.name])
        both = likely(*known.values(), share * known[one.name])
        if loaded > max(plain + MIN_LOG_EVIDENCE_GAIN, both - MIN_LOG_EVIDENCE_GAIN):
            found.append(one.name)
    return found


def _find_replaced(
    own: Sequence[Candidate],
    scene: Scene,
    chosen: Sequence[Candidate],
    fitted: Model,
    fields: Sequence[np.ndarray],
) -> list[str]:
    """Names of the effects `own` that a field of the other side could replace, alone and together
    with their substitutes: the data are hardly likelier with both.

    An effect of the robot keeps its name if the data are likelier with the effects alone. An effect
    of the device must be needed next to the field, because a robot that learns an error of its
    device is worse than before.
    """
    if not fields:
        return []
    shared = _shared_scene(scene, chosen)
    known = {
        c.name: shared.project_off_geometry(_columns(scene, shared, c, fitted)) for c in chosen
    }
    nothing = np.zeros((len(shared.residual), 0))

    def likely(names: Iterable[str], fields: Sequence[np.ndarray]) -> float:
        B = np.hstack([nothing, *(known[name] for name in names)])
        return max(log_evidence(shared, B, field) for field in fields)

    both, plain = likely(known, fields), likely(known, [nothing])

    def is_replaced(some: Sequence[Candidate]) -> bool:
        replaced = {c.name for c in some}
        limit = both - MIN_LOG_EVIDENCE_GAIN
        if not some[0].effect.of_device:
            limit = max(plain, limit)
        return likely([name for name in known if name not in replaced], fields) > limit

    return [
        one.name
        for one in own
        if is_replaced([one]) and is_replaced(_add_substitutes(one, chosen, scene, fitted))
    ]


def log_evidence(scene: Scene, B: np.ndarray, F: np.ndarray) -> float:
    """Log of how likely the residual r (n,) is, up to a constant, where numbers of B (n, k), in
    tolerances, and of F (n, m), in sigmas, are drawn about zero: -dof/2 log Q - 1/2 log|1 + C^T C|
    with Q = r^T (1 + C C^T)^-1 r and C their columns off the geometry times their sizes, the
    likeliest of a few. The noise's scale is whatever fits best.
    """
    r, best = scene.residual, -np.inf
    # F alone is factorised once for all sizes; what it leaves of B, once for each size of F.
    squares_F, turn_F = np.linalg.eigh(F.T @ F)
    along_F, across = turn_F.T @ (F.T @ r), B.T @ F @ turn_F
    for field in FIELD_SIZES if F.shape[1] else (1.0,):
        shrink = field**2 / (1 + field**2 * np.maximum(squares_F, 0.0))
        squares_B, turn_B = np.linalg.eigh(B.T @ B - across * shrink @ across.T)
        along_B = turn_B.T @ (B.T @ r - across @ (shrink * along_F))
        left = float(r @ r - shrink @ along_F**2)
        spread_F = float(np.log(field**2 / shrink).sum())
        for effect in EFFECT_SIZES if B.shape[1] else (1.0,):
            grown = 1 + effect**2 * np.maximum(squares_B, 0.0)
            Q = max(left - float(effect**2 / grown @ along_B**2), 1e-300)
            likely = -scene.dof / 2 * np.log(Q) - (spread_F + float(np.log(grown).sum())) / 2
            best = max(best, likely)
    return best


def _smooth_fields(scene: Scene) -> Iterator[np.ndarray]:
    """Columns (n, 3 m), off the geometry, of fields of position that change over one length each;
    none where no position was measured, or the robot moves none.

    Values at m of the places, the furthest from each other, and what is likeliest in between: a
    Gaussian process with exp(-d^2 / 2 l^2), d in standard deviations of place. A coefficient of
    one moves the residuals by about one sigma.
    """
    n = len(scene.model.joints)
    moved = [n + i for i in scene.model.mechanism.moved if i < 3]
    if not scene.observations.measured[:, moved].any():
        return
    by_place = scene.measured_jacobian[:, :, n : n + 3]
    by_place = by_place / np.sqrt(np.sum(by_place**2) / (3 * len(by_place)))
    places = scene.x[:, n : n + 3]
    places = places / np.maximum(places.std(axis=0), 1e-12)
    for length in FIELD_LENGTHS:
        smooth = smooth_functions(places, length, CENTRES)
        F = np.einsum("nri,nm->nrim", by_place, smooth)
        yield scene.project_off_geometry(F.reshape(len(scene.residual), -1))


def _joint_fields(scene: Scene) -> Iterator[np.ndarray]:
    """Columns (n, m), off the geometry, of errors of one joint, or (n, nq m) of all, that change
    smoothly with the robot's configuration, and of errors of all joints, each with its own reading.

    A flaw of a joint, such as a leg that is softer on one side, moves the platform everywhere. A
    flaw that all drives have, such as a spool on which the line piles up, depends on the reading.
    """
    n = len(scene.model.joints)
    q = scene.x[:, :n] - scene.x[:, :n].mean(axis=0)
    left, sizes, _ = np.linalg.svd(q, full_matrices=False)
    places = left[:, sizes > LSTSQ_RANK_TOLERANCE * sizes[0]] * len(left) ** 0.5
    wider = (places.shape[1] / 3) ** 0.5  # distances grow with the number of coordinates
    by_joint = scene.measured_jacobian[:, :, :n]
    by_joint = by_joint / np.sqrt(np.mean(np.sum(by_joint**2, axis=1), axis=0))
    for length in JOINT_FIELD_LENGTHS:
        smooth = smooth_functions(places, wider * length, CENTRES)
        F = np.einsum("nrj,nm->nrjm", by_joint, smooth)
        F = scene.project_off_geometry(F.reshape(len(scene.residual), -1)).reshape(
            len(scene.residual), n, -1
        )
        yield F.reshape(len(F), -1)
        yield from (F[:, joint] for joint in range(n))
        readings = q / np.maximum(q.std(axis=0), 1e-12)
        own = [smooth_functions(readings[:, [j]], length, CENTRES) for j in range(n)]
        F = np.dstack([by_joint[:, :, [j]] * own[j][:, None] for j in range(n)])
        yield scene.project_off_geometry(F.reshape(len(scene.residual), -1))
