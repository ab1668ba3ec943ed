"""The pose of a flat board in a camera's frame from the rays of its corners, in closed form."""

from __future__ import annotations

import numpy as np

MIN_CORNERS = 6  # of an image that starts a camera; four determine a pose, and errors with it
MIN_FLATNESS = 1e-3  # second over first singular value of the corners seen: not on one line


def compute_board_poses(
    corners: np.ndarray, rays: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the homographies of the images, and the poses of the board that they contain.

    Parameters
    ----------
    corners : array (n, 3)
        Corners in the board's frame, m, with z = 0.
    rays : array (N, n, 2)
        x / z and y / z of each corner in the camera's frame; NaN where it is not seen.

    Returns
    -------
    seen : array of bool (N,)
        Images with enough corners.
    r, R : array (N, 3), (N, 3, 3)
        Pose of the board in the camera's frame; 0 and the identity where it is not seen.
    """
    known = np.isfinite(rays).all(axis=2)
    seen = np.array([_spans_a_plane(corners[own]) for own in known], dtype=bool)
    r, R = np.zeros((len(rays), 3)), np.tile(np.eye(3), (len(rays), 1, 1))
    if not seen.any():
        return seen, r, R
    H = _find_homographies(corners, rays[seen], known[seen])
    H = H / np.linalg.norm(H[:, :, :2], axis=1).mean(axis=1)[:, None, None]
    depth = H[:, 2] @ [*corners.mean(axis=0)[:2], 1.0]
    H = np.where(depth[:, None, None] > 0, H, -H)  # in front of the camera
    left, _, right = np.linalg.svd(H[:, :, :2], full_matrices=False)
    turned = left @ right
    third = np.cross(turned[:, :, 0], turned[:, :, 1])
    r[seen], R[seen] = H[:, :, 2], np.concatenate([turned, third[:, :, None]], axis=2)
    return seen, r, R


def _spans_a_plane(corners: np.ndarray) -> bool:
    if len(corners) < MIN_CORNERS:
        return False
    sizes = np.linalg.svd(corners[:, :2] - corners[:, :2].mean(axis=0), compute_uv=False)
    return bool(sizes[1] > MIN_FLATNESS * sizes[0])


def _find_homographies(corners: np.ndarray, rays: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Find H (N, 3, 3) with (ray, 1) ~ H (x, y, 1), by the direct linear transformation."""
    middle, size = corners.mean(axis=0)[:2], np.ptp(corners, axis=0).max() / 2
    points = np.column_stack([(corners[:, :2] - middle) / size, np.ones(len(corners))])
    into = np.array([[1, 0, -middle[0]], [0, 1, -middle[1]], [0, 0, size]]) / size
    count = known.sum(axis=1)[:, None]
    rays = np.where(known[:, :, None], rays, 0.0)
    centre = rays.sum(axis=1) / count
    away = np.where(known[:, :, None], rays - centre[:, None], 0.0)
    spread = np.abs(away).max(axis=(1, 2))
    p = points * known[:, :, None]
    none = np.zeros_like(p)
    u, v = np.moveaxis(away / spread[:, None, None], 2, 0)
    rows = np.concatenate(
        [
            np.concatenate([p, none, -u[:, :, None] * p], axis=2),
            np.concatenate([none, p, -v[:, :, None] * p], axis=2),
        ],
        axis=1,
    )
    H = np.linalg.svd(np.linalg.qr(rows, mode="r"))[2][:, -1].reshape(-1, 3, 3)
    back = np.zeros_like(H)
    back[:, 0, 0] = back[:, 1, 1] = spread
    back[:, :2, 2], back[:, 2, 2] = centre, 1.0
    return np.asarray(back @ H @ into)
