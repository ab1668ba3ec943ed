"""Named parameters with unit, nominal value and tolerance, and the vector of their values."""

from __future__ import annotations

import fnmatch
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from parallel_cal.base.errors import ModelError

MAX_TOLERANCES = 10.0  # tolerances from nominal: further away a number is not of such a robot
RANGE_MARGIN_SIGMAS = 3.0  # sigmas by which an estimate may exceed its range by chance


@dataclass(frozen=True)
class Parameter:
    """One parameter of a model.

    Parameters
    ----------
    name : str
        Full name, such as `chain1.Lb`.
    unit : str
        SI unit, such as `m`, `rad` or `1/K`.
    nominal : float
        Value in the drawing.
    tolerance : float
        Standard deviation of real robots around the nominal value, above 0.
    group : str
        `geometry`, `effect` or `sensor`. Default `geometry`.
    low, high : float
        Lowest and highest possible value (a backlash is never negative). Default: unbounded.
    label : str
        The last part of the name in plain words, such as `rod length`. Default empty.
    title : str
        The whole name in plain words, if the parts of the name mean nothing to a user. Default
        empty.
    """

    name: str
    unit: str
    nominal: float
    tolerance: float
    group: str = "geometry"
    low: float = -np.inf
    high: float = np.inf
    label: str = ""
    title: str = ""

    @property
    def shown_name(self) -> str:
        """The name that messages and tables show."""
        return self.title or self.name

    def with_tolerance(self, tolerance: float) -> Parameter:
        """Return the parameter with another tolerance.

        The distances of `low` and `high` from the nominal value change by the same factor, because
        both are stated for robots with the present tolerance.
        """
        times = tolerance / self.tolerance
        low, high = (self.nominal + times * (v - self.nominal) for v in (self.low, self.high))
        return replace(self, tolerance=tolerance, low=low, high=high)

    @property
    def prior_sigma(self) -> float:
        """Standard deviation around the nominal value before any data; see `ParameterTable`."""
        is_effect = self.group == "effect"
        return MAX_TOLERANCES / 3**0.5 * self.tolerance if is_effect else self.tolerance

    def plausible_range(self, sigma: float = 0.0) -> tuple[float, float]:
        """Return the lowest and the highest plausible value.

        The range is the nominal value +- 10 tolerances, cut at the physical bounds. It is then
        extended by 3 `sigma` on both sides, because noise can make the estimate of a zero backlash
        slightly negative.

        Parameters
        ----------
        sigma : float, optional
            Standard deviation of the estimate, in the unit of the parameter. Default 0.

        Returns
        -------
        low, high : float
        """
        reach = MAX_TOLERANCES * self.tolerance
        slack = RANGE_MARGIN_SIGMAS * sigma if sigma > 0 else 0.0
        low, high = max(self.low, self.nominal - reach), min(self.high, self.nominal + reach)
        return low - slack, high + slack


class ParameterTable(Sequence[Parameter]):
    """An ordered table of parameters; its order is the order of the parameter vector.

    Parameters
    ----------
    parameters : iterable of Parameter
        The parameters (n); each name may occur once.

    Raises
    ------
    ModelError
        If a name occurs twice.

    Examples
    --------
    >>> import parallel_cal as pc
    >>> table = pc.ParameterTable([pc.Parameter("arm.L", "m", 0.2, 1e-4)])
    >>> table["arm.L"].nominal
    0.2
    >>> table.vector({"arm.L": 0.201})
    array([0.201])
    """

    def __init__(self, parameters: Iterable[Parameter]):
        self._parameters = tuple(parameters)
        self._index = {p.name: i for i, p in enumerate(self._parameters)}
        if len(self._index) != len(self._parameters):
            raise ModelError(f"a parameter name occurs twice in {[p.name for p in self]}")

    def __getitem__(self, key: Any) -> Any:
        return self._parameters[self.index_of(key) if isinstance(key, str) else key]

    def __len__(self) -> int:
        return len(self._parameters)

    def __add__(self, other: Iterable[Parameter]) -> ParameterTable:
        return ParameterTable((*self._parameters, *other))

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names (n) of the parameters."""
        return tuple(p.name for p in self._parameters)

    @cached_property
    def nominal(self) -> np.ndarray:
        """Nominal values (n,), each in its unit."""
        return np.array([p.nominal for p in self._parameters], dtype=float)

    @cached_property
    def tolerance(self) -> np.ndarray:
        """Tolerances (n,), each in its unit."""
        return np.array([p.tolerance for p in self._parameters], dtype=float)

    @cached_property
    def prior_sigma(self) -> np.ndarray:
        """Standard deviation (n,) of each parameter around its nominal value before any data.

        For geometry this is the tolerance. For an effect it is the standard deviation of a uniform
        distribution over the plausible range.
        """
        return np.array([p.prior_sigma for p in self])

    def index_of(self, name: str) -> int:
        """Return the position of a parameter in the vector; ModelError for an unknown name."""
        if name not in self._index:
            raise ModelError(f"no parameter '{name}'; the model has {', '.join(self.names)}")
        return self._index[name]

    def matching(self, patterns: Iterable[str]) -> np.ndarray:
        """Return the mask (n,) of parameters whose name matches a shell pattern.

        Raises ModelError if a pattern matches no parameter.
        """
        mask = np.zeros(len(self), dtype=bool)
        for pattern in patterns:
            hits = np.array([fnmatch.fnmatchcase(name, pattern) for name in self.names], dtype=bool)
            if not hits.any():
                raise ModelError(
                    f"no parameter matches '{pattern}'; the model has {', '.join(self.names)}"
                )
            mask |= hits
        return mask

    def vector(self, values: Mapping[str, float]) -> np.ndarray:
        """Return the parameter vector: nominal values, replaced by the given values."""
        vector = self.nominal.copy()
        for name, value in values.items():
            vector[self.index_of(name)] = value
        return vector

    def with_tolerances(self, tolerances: Mapping[str, float]) -> ParameterTable:
        """Return the table with other tolerances and ranges, given by name or shell pattern.

        If several patterns match a name, the last one counts.
        """
        if not tolerances:
            return self
        own = dict[str, float]()
        for key, tolerance in tolerances.items():
            hits = [key] if key in self._index else fnmatch.filter(self.names, key)
            own |= dict.fromkeys(hits, tolerance)
        return ParameterTable(p.with_tolerance(own[p.name]) if p.name in own else p for p in self)

    def with_nominal(self, nominal: Mapping[str, float]) -> ParameterTable:
        """Return the table with other nominal values where they are given."""
        return ParameterTable(replace(p, nominal=nominal.get(p.name, p.nominal)) for p in self)

    def mapping(self, vector: Sequence[float] | np.ndarray) -> dict[str, float]:
        """Return the values of a parameter vector (n,) by name."""
        return dict(zip(self.names, (float(v) for v in vector), strict=True))


class Named:
    """A vector read by name: `p["chain1"].Lb` and `p["chain1.Lb"]` are the same entry."""

    def __init__(self, names: Sequence[str], vector: Any, prefix: str = ""):
        self._names, self._vector, self._prefix = tuple(names), vector, prefix

    def __getitem__(self, key: str) -> Any:
        full = self._prefix + key
        if full in self._names:
            return self._vector[self._names.index(full)]
        if any(name.startswith(full + ".") for name in self._names):
            return Named(self._names, self._vector, full + ".")
        raise ModelError(f"no entry '{full}'; there are {', '.join(self._names)}")

    def __getattr__(self, key: str) -> Any:
        if key.startswith("_"):
            raise AttributeError(key)
        return self[key]

    def get(self, key: str, default: Any) -> Any:
        """Return the entry, or `default` if there is none."""
        return self[key] if self._prefix + key in self._names else default

    def vector(self, *keys: str) -> Any:
        """Stack several entries as a column: `chain.vector("D_x", "D_y", "D_z")`."""
        import casadi as ca

        return ca.vertcat(*[self[key] for key in keys])

    @property
    def column(self) -> Any:
        """All entries, in order."""
        return self._vector

    def replaced(self, changes: Mapping[str, Any]) -> Named:
        """Return the vector with some entries changed, as an effect that acts on geometry does."""
        import casadi as ca

        entries = [changes.get(name, self._vector[i]) for i, name in enumerate(self._names)]
        return Named(self._names, ca.vertcat(*entries), self._prefix)
