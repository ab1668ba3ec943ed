"""Evidence of one recording about parameters, without the tolerances that served as priors."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from parallel_cal.identification.fit import FitResult
from parallel_cal.identification.thresholds import RELATIVE_RANK


@dataclass(frozen=True)
class Evidence:
    """A likelihood of parameters p (n,), SI: log L = g.d - d.A.d / 2 with d = p - `centre`.

    `information` is A (n, n), `pull` g (n,). A direction that the data do not determine has no
    information, which a covariance could not express.
    """

    names: tuple[str, ...]
    centre: np.ndarray
    information: np.ndarray
    pull: np.ndarray

    @classmethod
    def of(cls, result: FitResult) -> Evidence:
        """Evidence of a fit; residuals larger than the noise reduce it (Birge's ratio)."""
        model, found, free = result.model, result.estimate.spectrum, result.free
        table, chi2 = model.table, result.estimate.chi2_per_dof
        scale = (table.prior_sigma if found.held else table.tolerance)[free]
        seen = found.directions[: found.rank]
        A = (seen.T * found.singular_values[: found.rank] ** 2) @ seen
        # Where the tolerances stood in, the data pull against them.
        held = found.directions[found.rank - len(found.weak) : found.rank] if found.held else None
        known = np.zeros_like(A) if held is None else held.T @ held
        assumed = result.observations.noise_assumed
        known = np.eye(len(A)) if result.options.prior else known
        known = known * (chi2 if assumed else 1.0)
        pull = known @ ((model.values - table.nominal)[free] / scale)
        birge = chi2 if assumed else np.fmax(chi2, 1.0)
        return cls(
            tuple(np.array(table.names)[free].tolist()),
            np.asarray(model.values[free]),
            A / np.outer(scale, scale) / birge,
            pull / scale / birge,
        )

    def __add__(self, other: Evidence) -> Evidence:
        """Combine two likelihoods of the same parameters about the same centre."""
        information = self.information + other.information
        return replace(self, information=information, pull=self.pull + other.pull)

    @classmethod
    def uninformative(cls, names: Sequence[str]) -> Evidence:
        """Evidence before any measurement."""
        n = len(names)
        return cls(tuple(names), np.zeros(n), np.zeros((n, n)), np.zeros(n))

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> Evidence:
        """Evidence from a document that `documents.plain` made."""
        numbers = (np.array(document[key]) for key in ("centre", "information", "pull"))
        return cls(tuple(document["names"]), *numbers)

    def marginalise(self, names: Iterable[str]) -> Evidence:
        """Evidence of some of its parameters; the others are unknown."""
        wanted = set(names)
        asked = np.array([name in wanted for name in self.names], dtype=bool)
        A, g, others = self.information, self.pull, ~asked
        size = np.sqrt(np.maximum(np.diag(A)[others], 1e-300))
        inner = A[np.ix_(others, others)] / np.outer(size, size)
        gain = (
            A[np.ix_(asked, others)]
            / size
            @ np.linalg.pinv(inner, RELATIVE_RANK**2, hermitian=True)
        )
        return Evidence(
            tuple(name for name in self.names if name in wanted),
            self.centre[asked],
            A[np.ix_(asked, asked)] - gain @ (A[np.ix_(others, asked)] / size[:, None]),
            g[asked] - gain @ (g[others] / size),
        )

    def recentre(self, names: Sequence[str], centre: np.ndarray, scale: np.ndarray) -> Evidence:
        """Evidence of the parameters `names` (n,) about `centre` (n,) in units of `scale` (n,);
        without information about parameters that it does not contain."""
        own, n = self.marginalise(names), len(names)
        at = [names.index(name) for name in own.names]
        information, pull = np.zeros((n, n)), np.zeros(n)
        information[np.ix_(at, at)] = own.information * np.outer(scale[at], scale[at])
        pull[at] = (own.pull + own.information @ (own.centre - centre[at])) * scale[at]
        return Evidence(tuple(names), np.zeros(n), information, pull)
