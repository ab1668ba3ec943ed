"""Blocks: what may cause an error of a robot, as columns of one linear Gaussian model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from parallel_cal.posterior.scene import Scene

EFFECT, LAW, FIELD, DRIFT = "effect", "law", "field", "drift"
LOG_ODDS = np.log(1 / 30)  # that a robot has a known cause, before anything is measured


@dataclass(frozen=True, eq=False)
class Block:
    """One possible cause of an error: columns B_1 ... B_m, one set for each of its settings.

    The residual that it makes is s B_i u with u ~ N(0, 1): a column is what one coefficient of its
    usual size does to the residual, in units of the noise, and s is the size of the cause in usual
    sizes. Only what the geometry cannot imitate counts: `gram` (m, k, k) are the products of the
    columns, and `onto` (m, k) those with the residual, without that part.

    Attributes
    ----------
    name : str
        The name of an effect, or of what no effect describes.
    kind : str
        EFFECT; LAW of the robot outside the catalogue; FIELD of errors of the measuring device;
        DRIFT of the noise.
    log_prior : float
        Logarithm of the odds that a robot has this cause, before anything is measured.
    settings : tuple of Mapping
        The numbers that each set of columns is for; empty for what has none.
    tried : int
        The number of settings that were scanned, which the evidence for one of them must pay for.
    """

    name: str
    kind: str
    log_prior: float
    settings: tuple[Mapping[str, float], ...]
    tried: int
    columns: np.ndarray = field(repr=False)
    gram: np.ndarray = field(repr=False)
    onto: np.ndarray = field(repr=False)

    @classmethod
    def of(
        cls,
        scene: Scene,
        name: str,
        kind: str,
        log_prior: float,
        columns: Sequence[np.ndarray],
        settings: Sequence[Mapping[str, float]] = (),
        tried: int | None = None,
    ) -> Block | None:
        """Make a block of columns (n, k) for each setting; None if the geometry imitates it.

        Sets with fewer columns than others are padded with zeros, which change no evidence.
        """
        widest = max(one.shape[1] for one in columns)
        padded = [np.pad(one, ((0, 0), (0, widest - one.shape[1]))) for one in columns]
        B = np.array([scene.project_off_geometry(one) for one in padded])
        gram = B.transpose(0, 2, 1) @ B
        if not gram.size or np.sqrt(gram.max(initial=0.0)) < 1e-9:
            return None
        given = tuple(settings) or ({},) * len(B)
        onto = scene.residual @ B
        return cls(name, kind, log_prior, given, tried or len(B), B, gram, onto)

    @cached_property
    def _products(self) -> dict[tuple[int, int], tuple[Block, np.ndarray]]:
        return {}

    def times(self, setting: int, other: Block) -> np.ndarray:
        """The products (m, k, k') of the columns of one setting with all those of another block,
        computed once."""
        key = setting, id(other)
        if key not in self._products:  # with the other block, so that its id stays its own
            self._products[key] = other, self.columns[setting].T @ other.columns
        return self._products[key][1]
