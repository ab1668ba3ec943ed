"""Observability: rank, unidentifiable combinations by name, covariance."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from parallel_cal.identification.prior import Knowledge, Prior, count_determined
from parallel_cal.identification.thresholds import (
    MIN_NAMED_SHARE,
    MIN_SIGMAS_PER_TOLERANCE,
    RELATIVE_RANK,
)
from parallel_cal.model.parameters import ParameterTable
from parallel_cal.model.words import direction_in_words

BLOCK = 2048  # rows of a Jacobian in one step of its QR decomposition


@dataclass(frozen=True)
class Spectrum:
    """Singular values of the whitened Jacobian with columns in tolerances.

    A motion of one tolerance along a direction with value s (a row of `directions`) moves the
    residuals by s sigmas. `held` says whether tolerances were priors along the weak directions.
    """

    singular_values: np.ndarray
    directions: np.ndarray
    rank: int
    covariance: np.ndarray
    lost: np.ndarray
    unidentifiable: tuple[dict[str, float], ...]
    weak: tuple[dict[str, float], ...]
    held: bool
    taken: float  # degrees of freedom: a direction with a prior counts by the data's share


def spectrum(
    J: np.ndarray,
    table: ParameterTable,
    free: np.ndarray,
    prior: bool | Prior | None,
    held: float = 0.0,
    variance: float = 1.0,
) -> Spectrum:
    """Rank and covariance of the free parameters from a whitened Jacobian (n, n_free).

    `lost` marks parameters in an unidentifiable direction. Their sigma is infinite; the covariance
    contains only what the data determine, which is enough to predict poses like the measured ones.
    The data determine weak directions less well than the tolerances do. `held` is the weight of the
    tolerances as a prior of these directions: the variance of the residuals (1 if the noise is
    known), or 0 without this prior. `variance`, also of the residuals in noise units, is the weight
    of a prior of all parameters.
    """
    if prior:  # holds all directions
        held = 0.0
    tolerance = (table.prior_sigma if held else table.tolerance)[free]
    names = [name for name, is_free in zip(table.names, free, strict=True) if is_free]
    # R of J tolerance = QR is a small matrix with the same singular values and directions.
    R: np.ndarray = np.zeros((0, len(tolerance)))
    for begin in range(0, len(J), BLOCK):  # a few rows at a time: no second copy of J
        rows = np.concatenate([R, J[begin : begin + BLOCK] * tolerance])
        R = np.asarray(np.linalg.qr(rows, mode="r")) if len(rows) > len(tolerance) else rows
    _, sizes, directions = np.linalg.svd(R)
    rank = int(np.sum(sizes > RELATIVE_RANK * max(sizes[0], 1e-300))) if len(sizes) else 0
    seen, unseen = directions[:rank], directions[rank:]
    little = sizes[:rank] < MIN_SIGMAS_PER_TOLERANCE * np.sqrt(held or 1.0)
    covariance = (seen.T / (sizes[:rank] ** 2 + held * little)) @ seen
    lost = np.sum(unseen**2, axis=0) > RELATIVE_RANK
    taken = count_determined(sizes[:rank] ** 2, held * little)
    if prior:
        information = (seen.T * sizes[:rank] ** 2) @ seen
        covariance = np.linalg.inv(
            information + Knowledge.of(prior, table, free, variance).information
        )
        lost = np.zeros_like(lost)
        known = Prior.from_tolerances(table) if prior is True else prior
        own = np.linalg.svd(R @ known.factor(table, free), compute_uv=False)
        taken = count_determined(own**2, variance)
    return Spectrum(
        sizes,
        directions,
        rank,
        covariance * np.outer(tolerance, tolerance),
        lost,
        tuple(combination(d, names) for d in unseen),
        tuple(combination(d, names) for d in seen[little]),
        held > 0,
        taken,
    )


def directions_in_words(
    directions: Iterable[Mapping[str, float]], table: ParameterTable
) -> list[dict[str, Any]]:
    """Directions for documents: in words, and by their parameters."""
    return [{"text": direction_in_words(d, table), "parameters": d} for d in directions]


def combination(direction: np.ndarray, names: list[str]) -> dict[str, float]:
    """The parameters of a direction, largest first, in tolerances."""
    size = np.abs(direction) / max(np.abs(direction).max(), 1e-300)
    order = np.argsort(-size, kind="stable")
    sign = np.sign(direction[order[0]]) if len(order) else 1.0
    return {names[i]: float(sign * direction[i]) for i in order if size[i] > MIN_NAMED_SHARE}


def find_independent_columns(columns: np.ndarray, floor: float) -> np.ndarray:
    """Mask of the independent columns, by a QR decomposition in the given order: the remainder of
    the column after projection onto the earlier ones is longer than `floor`."""
    kept, Q = np.zeros(columns.shape[1], dtype=bool), np.zeros((len(columns), 0))
    for j in range(columns.shape[1]):
        left = columns[:, j]
        for _ in range(2):
            left = left - Q @ (Q.T @ left)
        pivot = np.linalg.norm(left)
        if pivot > floor:
            kept[j], Q = True, np.column_stack([Q, left / pivot])
    return kept
