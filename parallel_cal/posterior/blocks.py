"""Blocks: what may cause an error of a robot, as columns of one linear Gaussian model."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from parallel_cal.posterior.scene import Scene

EFFECT, LAW, FIELD, DRIFT, KNOCK = "effect", "law", "field", "drift", "knock"
NO_COLUMN = 1e-9  # root of the sum of squares of a column that the geometry imitates
NEGLIGIBLE = 1e-7  # sum of squares of a column that changes no logarithm of evidence by 1e-4
LOG_ODDS = np.log(1 / 30)  # that a robot has a known cause, before anything is measured


@dataclass(frozen=True)
class OwnNumbers:
    """A number that joints may have of their own: its `name`, and for each joint its `columns`
    among those of a setting."""

    name: str
    columns: Mapping[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class Cause:
    """What may cause an error, before anything is measured.

    Attributes
    ----------
    name : str
        The name of an effect, or of what no effect describes.
    kind : str
        EFFECT; LAW of the robot outside the catalogue; FIELD of errors of the measuring device;
        DRIFT of the noise; KNOCK that disturbed a single sample.
    log_prior : float
        Logarithm of the odds that a robot has this cause.
    settings : tuple of Mapping
        Its numbers, which are scanned; empty for what has none.
    tried : int
        The number of settings that were scanned, which the evidence for one of them must pay for.
    in_one : int
        How many settings, the last, are of one joint alone. That it is alone is as improbable as
        one more cause.
    """

    name: str
    kind: str
    log_prior: float
    settings: tuple[Mapping[str, float], ...]
    tried: int
    in_one: int = field(default=0, kw_only=True)

    @cached_property
    def log_priors(self) -> np.ndarray:
        """Logarithm of the odds (m,) that a robot has this cause with each of its settings."""
        each = np.full(len(self.settings), self.log_prior - np.log(self.tried))
        if self.in_one:
            each[-self.in_one :] = self.log_prior + LOG_ODDS - np.log(self.in_one)
        return each


@dataclass(frozen=True, eq=False)
class Block(Cause):
    """One possible cause of an error: columns B_1 ... B_m, one set for each of its settings.

    The residual that it makes is s B_i u with u ~ N(0, 1): a column is what one coefficient of its
    usual size does to the residual, in units of the noise, and s is the size of the cause in usual
    sizes. Only what the geometry cannot imitate counts. The coefficients u are turned by T_i (a
    `turn` each) so that the columns B_i T_i of a setting are orthogonal: `squares` (m, k) are their
    sums of squares, and `onto` (m, k) their products with the `residual` (n,).

    Attributes
    ----------
    usual : tuple of array
        For each setting of an effect, a root L (p, k) of the covariance L L' that its p parameters
        usually have, in tolerances; a row is zero where a setting is without that parameter.
    own : OwnNumbers or None
        The number of its settings that joints may have of their own.
    whole : tuple of Block and array, or None
        Of a cause in one joint alone: the cause in all, and the columns of this joint.
    scanned : Block or None
        Where joints have numbers of their own, the block in which all have the same.
    """

    columns: tuple[np.ndarray, ...] = field(repr=False)
    turns: np.ndarray = field(repr=False)
    squares: np.ndarray = field(repr=False)
    onto: np.ndarray = field(repr=False)
    usual: tuple[np.ndarray, ...] = field(repr=False)
    residual: np.ndarray = field(repr=False)
    own: OwnNumbers | None = None
    whole: tuple[Block, np.ndarray] | None = field(default=None, repr=False)
    scanned: Block | None = field(default=None, repr=False)

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
        own: OwnNumbers | None = None,
        in_one: int = 0,
    ) -> Block | None:
        """Make a block of columns (n, p) for each setting; None if the geometry imitates it.

        Where there are more roots (p, k) of `usual` covariances than sets of columns, the sets are
        taken again in turn. Turns of sets with fewer columns than others are padded with zeros,
        which change no evidence.
        """
        # In turn: together they are large.
        left = [scene.project_off_geometry(one).astype(np.float32) for one in columns]
        made = cls.of_projected(scene.residual, left, usual, name, kind, log_prior, settings, tried)
        return made and replace(made, own=own, in_one=in_one)

    @classmethod
    def of_projected(
        cls,
        residual: np.ndarray,
        columns: Sequence[np.ndarray],
        usual: Sequence[np.ndarray],
        name: str,
        kind: str,
        log_prior: float,
        settings: Sequence[Mapping[str, float]],
        tried: int | None,
    ) -> Block | None:
        """Make a block of columns without what the geometry imitates."""
        products = list[tuple[np.ndarray, np.ndarray]]()
        for one in columns:
            rounded = one.astype(float, copy=False)
            products.append((rounded.T @ rounded, residual @ rounded))
        roots = tuple(usual) or tuple(np.eye(one.shape[1]) for one in columns)
        each = [k % len(columns) for k in range(len(roots))]
        tall, wide = (max(one.shape[axis] for one in roots) for axis in (0, 1))
        squares, onto = np.zeros((2, len(roots), wide))
        turns = np.zeros((len(roots), tall, wide))
        for i, (root, k) in enumerate(zip(roots, each, strict=True)):
            gram, with_residual = products[k]
            p, n = root.shape
            # Roots are identities where no `usual` is given: no products with large ones.
            squares[i, :n], rotation = np.linalg.eigh(root.T @ gram @ root if usual else gram)
            turns[i, :p, :n] = root @ rotation if usual else rotation
            onto[i] = with_residual @ turns[i, :p]
        largest = squares.max(axis=0, initial=0.0)
        if not (largest > NO_COLUMN**2).any():
            return None
        counts = largest > min(NEGLIGIBLE, largest.max() / 2)
        given = tuple(settings) or ({},) * len(roots)
        squares = np.maximum(squares[:, counts], 0.0)
        tried, turns, onto = tried or len(roots), turns[:, :, counts], onto[:, counts]
        shared = tuple(columns[k] for k in each)
        numbers = given, tried, shared, turns, squares, onto, roots
        return cls(name, kind, log_prior, *numbers, residual)

    @cached_property
    def parts(self) -> list[Stack]:
        """The cause in each joint alone, under the joint's name, if joints may have numbers of
        their own."""
        found = list[Block]()
        for joint, own in self.own.columns.items() if self.own else ():
            roots = [root[own][:, root[own].any(axis=0)] for root in self.usual]
            sliced = [B[:, own] for B in self.columns]
            given = joint, self.kind, 0.0, self.settings, self.tried
            part = self.of_projected(self.residual, sliced, roots, *given)
            if part is not None:
                # In place of copies: the columns of all joints may be large.
                found.append(replace(part, columns=self.columns, whole=(self, own)))
        return Stack.of_alike(found)

    def combine(self, common: int, apart: Mapping[str, int]) -> Block | None:
        """The cause with the number of one setting in all joints except those `apart`, which have
        that of other settings; None if the geometry imitates it."""
        assert self.own is not None
        B, setting = self.columns[common].copy(), dict(self.settings[common])
        for joint, other in apart.items():
            own = self.own.columns[joint]
            B[:, own] = self.columns[other][:, own]
            setting[f"{joint}.{self.own.name}"] = self.settings[other][self.own.name]
        log_prior, tried = self.price(len(apart))
        given = self.name, self.kind, log_prior, [setting], tried
        made = self.of_projected(self.residual, [B], [self.usual[common]], *given)
        return made and replace(made, scanned=self)

    def only(self, setting: int) -> Block:
        """This cause with one of its settings."""
        here = slice(setting, setting + 1)
        return replace(
            self,
            settings=self.settings[here],
            in_one=0,
            columns=self.columns[here],
            turns=self.turns[here],
            squares=self.squares[here],
            onto=self.onto[here],
            usual=self.usual[here],
            own=None,
        )

    def price(self, apart: int) -> tuple[float, int]:
        """The log odds of this cause, and the number of settings to choose from, if some joints
        have a number of their own: each is as improbable as one more cause."""
        return self.log_prior + LOG_ODDS * apart, self.tried ** (1 + apart)

    @cached_property
    def _turned(self) -> dict[int, np.ndarray]:
        return {}

    def at(self, setting: int) -> np.ndarray:
        """The orthogonal columns (n, k) of one setting, made once."""
        if setting not in self._turned:
            B = self.columns[setting]
            B = (B if self.whole is None else B[:, self.whole[1]]).astype(float)
            self._turned[setting] = B @ self.turns[setting, : B.shape[1]]
        return self._turned[setting]

    def times(self, columns: np.ndarray) -> np.ndarray:
        """The products (c, m, k) of other columns (n, c) with those of all settings."""
        if self.whole is not None:
            block, own = self.whole
            products = block._unturned(columns)[:, :, own]
        else:
            products = self._unturned(columns)
        return np.ascontiguousarray((products @ self.turns).transpose(1, 0, 2))

    def _unturned(self, columns: np.ndarray) -> np.ndarray:
        """The products (m, c, p) of other columns (n, c) with those of all settings, not turned;
        they are kept for the parts of a cause."""
        if id(columns) in self._known:
            return self._known[id(columns)][1]
        each, (tall, c) = {id(B): B for B in self.columns}, (self.turns.shape[1], columns.shape[1])
        known = dict[int, np.ndarray]()
        for key, B in each.items():
            known[key] = np.zeros((c, tall))
            known[key][:, : B.shape[1]] = columns.T @ B.astype(float)
        products = np.array([known[id(B)] for B in self.columns])
        if self.own is not None:
            self._known[id(columns)] = columns, products
        return products

    @cached_property
    def _known(self) -> dict[int, tuple[np.ndarray, np.ndarray]]:
        return {}

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
        return np.concatenate([block.log_priors for block in self.blocks])

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
