"""Blocks: what may cause an error of a robot, as columns of one linear Gaussian model."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from parallel_cal.posterior.scene import Scene

EFFECT, LAW, FIELD, DRIFT, KNOCK = "effect", "law", "field", "drift", "knock"
NO_COLUMN = 1e-9  # root of the sum of squares of a column that the geometry imitates
NEGLIGIBLE = 1e-7  # sum of squares of a column that changes no logarithm of evidence by 1e-4
LOG_ODDS = np.log(1 / 30)  # that a robot has a known cause, before anything is measured


@dataclass(frozen=True, eq=False)
class Block:
    """One possible cause of an error: columns B_1 ... B_m, one set for each of its settings.

    The residual that it makes is s B_i u with u ~ N(0, 1): a column is what one coefficient of its
    usual size does to the residual, in units of the noise, and s is the size of the cause in usual
    sizes. Only what the geometry cannot imitate counts. The coefficients u are turned by T_i (a
    `turn` each) so that the columns B_i T_i of a setting are orthogonal: `squares` (m, k) are their
    sums of squares, and `onto` (m, k) their products with the residual.

    Attributes
    ----------
    name : str
        The name of an effect, or of what no effect describes.
    kind : str
        EFFECT; LAW of the robot outside the catalogue; FIELD of errors of the measuring device;
        DRIFT of the noise; KNOCK that disturbed a single sample.
    log_prior : float
        Logarithm of the odds that a robot has this cause, before anything is measured.
    settings : tuple of Mapping
        The numbers that each set of columns is for; empty for what has none.
    tried : int
        The number of settings that were scanned, which the evidence for one of them must pay for.
    usual : tuple of array
        For each setting of an effect, a root L (p, k) of the covariance L L' that its p parameters
        usually have, in tolerances; a row is zero where a setting is without that parameter.
    """

    name: str
    kind: str
    log_prior: float
    settings: tuple[Mapping[str, float], ...]
    tried: int
    columns: tuple[np.ndarray, ...] = field(repr=False)
    turns: np.ndarray = field(repr=False)
    squares: np.ndarray = field(repr=False)
    onto: np.ndarray = field(repr=False)
    usual: tuple[np.ndarray, ...] = field(repr=False)

    @classmethod
    def of(
        cls,
        scene: Scene,
        name: str,
        kind: str,
        log_prior: float,
        columns: Iterable[np.ndarray],
        settings: Sequence[Mapping[str, float]] = (),
        tried: int | None = None,
        usual: Sequence[np.ndarray] = (),
    ) -> Block | None:
        """Make a block of columns (n, p) for each setting; None if the geometry imitates it.

        Where there are more roots (p, k) of `usual` covariances than sets of columns, the sets are
        taken again in turn. Turns of sets with fewer columns than others are padded with zeros,
        which change no evidence.
        """
        own, products = list[np.ndarray](), list[tuple[np.ndarray, np.ndarray]]()
        for one in columns:  # in turn: together they are large
            own.append(scene.project_off_geometry(one).astype(np.float32))
            rounded = own[-1].astype(float)
            products.append((rounded.T @ rounded, scene.residual @ rounded))
        roots = tuple(usual) or tuple(np.eye(one.shape[1]) for one in own)
        each = [k % len(own) for k in range(len(roots))]
        tall, wide = (max(one.shape[axis] for one in roots) for axis in (0, 1))
        squares, onto = np.zeros((2, len(roots), wide))
        turns = np.zeros((len(roots), tall, wide))
        for i, (root, k) in enumerate(zip(roots, each, strict=True)):
            gram, with_residual = products[k]
            p, n = root.shape
            squares[i, :n], rotation = np.linalg.eigh(root.T @ gram @ root)
            turns[i, :p, :n] = root @ rotation
            onto[i] = with_residual @ turns[i, :p]
        largest = squares.max(axis=0, initial=0.0)
        if not (largest > NO_COLUMN**2).any():
            return None
        counts = largest > min(NEGLIGIBLE, largest.max() / 2)
        given = tuple(settings) or ({},) * len(roots)
        squares = np.maximum(squares[:, counts], 0.0)
        tried, turns, onto = tried or len(roots), turns[:, :, counts], onto[:, counts]
        shared = tuple(own[k] for k in each)
        return cls(name, kind, log_prior, given, tried, shared, turns, squares, onto, roots)

    @cached_property
    def _turned(self) -> dict[int, np.ndarray]:
        return {}

    def at(self, setting: int) -> np.ndarray:
        """The orthogonal columns (n, k) of one setting, made once."""
        if setting not in self._turned:
            B = self.columns[setting].astype(float)
            self._turned[setting] = B @ self.turns[setting, : B.shape[1]]
        return self._turned[setting]

    def times(self, columns: np.ndarray) -> np.ndarray:
        """The products (c, m, k) of other columns (n, c) with those of all settings."""
        known, products = dict[int, np.ndarray](), list[np.ndarray]()
        for B, turn in zip(self.columns, self.turns, strict=True):
            if id(B) not in known:
                known[id(B)] = columns.T @ B.astype(float)
            products.append(known[id(B)] @ turn[: B.shape[1]])
        return np.stack(products, axis=1)

    @cached_property
    def alone(self) -> Stack:
        return Stack((self,))


@dataclass(frozen=True, eq=False)
class Stack:
    """Blocks with equally many columns: what concerns each of their settings is computed at once.

    `first` (blocks,) is the row of the first setting of each block.
    """

    blocks: tuple[Block, ...]

    @classmethod
    def of_alike(cls, blocks: Sequence[Block]) -> list[Stack]:
        """Stack the blocks of one kind that have equally many columns."""
        alike = defaultdict[tuple[int, str], list[Block]](list)
        for block in blocks:
            alike[block.squares.shape[1], block.kind].append(block)
        return [cls(tuple(alike[key])) for key in sorted(alike)]

    @cached_property
    def first(self) -> np.ndarray:
        return np.cumsum([0, *(len(block.columns) for block in self.blocks[:-1])])

    @cached_property
    def squares(self) -> np.ndarray:
        return np.concatenate([block.squares for block in self.blocks])

    @cached_property
    def onto(self) -> np.ndarray:
        return np.concatenate([block.onto for block in self.blocks])

    @cached_property
    def log_prior(self) -> np.ndarray:
        """Of each setting."""
        priors = [block.log_prior - np.log(block.tried) for block in self.blocks]
        return np.repeat(priors, [len(block.columns) for block in self.blocks])

    @cached_property
    def known(self) -> dict[Hashable, Any]:
        """Rankings of these blocks beside chosen causes, for all searches that share them."""
        return {}

    @cached_property
    def _products(self) -> dict[tuple[int, int], tuple[Block, np.ndarray]]:
        return {}

    def times(self, other: Block, setting: int) -> np.ndarray:
        """The products (c, m, k) of the columns of one setting of another block with those of all
        settings, computed once."""
        key = setting, id(other)
        if key not in self._products:  # with the other block, so that its id stays its own
            columns = other.at(setting)
            products = np.concatenate([block.times(columns) for block in self.blocks], axis=1)
            self._products[key] = other, products
        return self._products[key][1]
