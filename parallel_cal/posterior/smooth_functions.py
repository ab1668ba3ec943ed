"""Smooth random functions of places, as columns of a linear model."""

from __future__ import annotations

import numpy as np


def smooth_functions(
    places: np.ndarray, length: float, centres: int, rough: bool = False
) -> np.ndarray:
    """Columns (N, m) of a random function of variance one that changes over a length of the places
    (N, d): a Gaussian process with squared exponential covariance, by its values at `centres` of
    the places, the furthest from each other (Quinonero-Candela and Rasmussen, JMLR 6, 2005).

    With `rough`, the covariance is exponential, as that of noise whose neighbours are similar.
    """
    # Begin with the place nearest to the mean; each further one is the furthest from those chosen.
    chosen = [int(np.argmin(np.sum((places - places.mean(axis=0)) ** 2, axis=1)))]
    away = np.sum((places - places[chosen[0]]) ** 2, axis=1)
    while len(chosen) < centres and away.max() > 0:
        chosen.append(int(np.argmax(away)))
        away = np.minimum(away, np.sum((places - places[chosen[-1]]) ** 2, axis=1))
    c = places[chosen]

    def covariance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        squares = np.sum((a[:, None] - b[None]) ** 2, axis=2)
        return np.exp(-np.sqrt(squares) / length if rough else -squares / (2 * length**2))

    factor = np.linalg.cholesky(covariance(c, c) + 1e-6 * np.eye(len(c)))
    return np.asarray(np.linalg.solve(factor, covariance(c, places)).T)
