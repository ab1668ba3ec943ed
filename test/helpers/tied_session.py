"""A session on a virtual plate as a recording: joint states and the constraint, no pose."""

import bag_writing as bw
import numpy as np
import virtual_setups as vs

PLATE = vs.Plate()
SENSOR = (
    f"plane_spheres: {{height: {PLATE.height}, holes: {[list(h) for h in PLATE.holes]}, "
    f"bars: {[PLATE.bar] * len(PLATE.holes)}}}"
)
SIGMA = str(PLATE.joint)


def session(readings, **options):
    """Standstills at encoder readings, short ones: 0.6 s, and 0.4 s from one to the next."""
    return bw.Session(readings, dwell=0.6, move=0.4, rate=50.0, jitter=1e-6, **options)


def ties_of(moves, ties):
    """What holds the tip is said while the robot moves to the first pose that it holds."""
    step = moves.dwell + moves.move
    first = [i for i, name in enumerate(ties) if i == 0 or name != ties[i - 1]]
    return [bw.tie(i * step - 0.5 * moves.move, ties[i]) for i in first]


def messages(robot, n=40, seed=0):
    """n poses on the plate and on each sphere, and the tip free at the end."""
    readings, ties = PLATE.session(robot, n, seed)
    moves = session(np.vstack([readings, readings[0]]))
    return bw.joint_states(moves) + ties_of(moves, [*ties, ""])
