"""Expand a closure into sums of (function of parameters) x (function of coordinates).

CasADi's instructions for a row are carried out on polynomials whose variables ("atoms") are
x, y, z, R_ij, q_i, cos q_i and sin q_i, and whose coefficients are expressions of the parameters.
Squaring removes a root: sqrt(A) + B = 0 becomes A - B^2 = 0. Nothing is specific to a mechanism.
"""

from __future__ import annotations

from typing import Any

import casadi as ca

from parallel_cal.base.errors import FitError
from parallel_cal.model.structure import Structure

Monomial = tuple[str, ...]  # atoms, sorted, repeated for powers; () is 1
Polynomial = dict[Monomial, Any]

PLAIN = {
    ca.OP_SIN: ca.sin,
    ca.OP_COS: ca.cos,
    ca.OP_TAN: ca.tan,
    ca.OP_SQRT: ca.sqrt,
    ca.OP_ACOS: ca.acos,
    ca.OP_ASIN: ca.asin,
    ca.OP_ATAN: ca.atan,
    ca.OP_EXP: ca.exp,
    ca.OP_LOG: ca.log,
    ca.OP_FABS: ca.fabs,
}
# Operations whose last argument may depend on coordinates.
EXPANDED = {
    ca.OP_ASSIGN,
    ca.OP_ADD,
    ca.OP_SUB,
    ca.OP_NEG,
    ca.OP_TWICE,
    ca.OP_MUL,
    ca.OP_SQ,
    ca.OP_SQRT,
    ca.OP_SIN,
    ca.OP_COS,
}


class Separation:
    """Every row of a closure as a polynomial in atoms; `value` gives an atom's expression."""

    def __init__(self, structure: Structure):
        self._roots: dict[str, Polynomial] = {}
        if structure.a.numel():
            raise _inseparable("an effect needs conditions")
        n = structure.q.numel()
        atoms = [f"q{i}" for i in range(n)] + list("xyz") + [f"R{i}" for i in range(9)]
        expressions = ca.vertsplit(structure.configuration)
        self.value: dict[str, Any] = dict(zip(atoms, expressions, strict=True))
        for i, q in enumerate(ca.vertsplit(structure.q)):
            self.value |= {f"cos q{i}": ca.cos(q), f"sin q{i}": ca.sin(q)}
        coordinates = [{(atom,): ca.SX(1)} for atom in atoms]
        self._inputs = [coordinates, structure.v]
        names = (structure.configuration, structure.v)
        self._function = ca.Function("rows", list(names), [structure.phi])
        self._refuse_what_never_separates()
        self.rows = [self._without_roots(row) for row in self._run()]

    def monomial(self, m: Monomial) -> Any:
        """A monomial as an expression of the configuration."""
        product = ca.SX(1)
        for atom in m:
            product *= self.value[atom]
        return product

    def _refuse_what_never_separates(self) -> None:
        """Refuse a function of coordinates that no polynomial is, before anything is expanded:
        long rows take minutes."""
        f, varies = self._function, dict[int, bool]()
        for k in range(f.n_instructions()):
            op, into, of = f.instruction_id(k), f.instruction_output(k), f.instruction_input(k)
            if op in (ca.OP_INPUT, ca.OP_CONST):
                varies[into[0]] = op == ca.OP_INPUT and of[0] == 0
            elif op != ca.OP_OUTPUT:
                if varies[of[-1]] and op not in EXPANDED:
                    raise _mixes(op)
                varies[into[0]] = any(varies[i] for i in of)

    def _run(self) -> list[Polynomial]:
        f = self._function
        work: dict[int, Polynomial] = {}
        rows: list[Polynomial] = [{} for _ in range(f.numel_out(0))]
        for k in range(f.n_instructions()):
            op, into, of = f.instruction_id(k), f.instruction_output(k), f.instruction_input(k)
            if op == ca.OP_OUTPUT:
                rows[into[1]] = work[of[0]]
            elif op == ca.OP_INPUT:
                which, entry = of
                source = self._inputs[which][entry]
                work[into[0]] = {(): source} if which else source
            elif op == ca.OP_CONST:
                work[into[0]] = _tidy({(): ca.SX(f.instruction_constant(k))})
            else:
                work[into[0]] = self._apply(op, [work[i] for i in of])
        return rows

    def _apply(self, op: int, args: list[Polynomial]) -> Polynomial:
        a, b = args[0], args[-1]
        linear = {ca.OP_ADD: (1, 1), ca.OP_SUB: (1, -1), ca.OP_NEG: (-1, 0), ca.OP_TWICE: (2, 0)}
        if op in linear or op == ca.OP_ASSIGN:
            k, l = linear.get(op, (1, 0))
            return _sum(_times(a, k), _times(b, l))
        if op in (ca.OP_MUL, ca.OP_SQ):
            return self._product(a, b)
        if op in (ca.OP_DIV, ca.OP_INV) and set(b) <= {()}:
            return _times(a if op == ca.OP_DIV else {(): ca.SX(1)}, 1 / b[()])
        if op in (ca.OP_CONSTPOW, ca.OP_POW) and float(b[()]) == 2:
            return self._product(a, a)
        if op == ca.OP_SQRT and set(a) - {()}:
            if any(atom in self._roots for m in a for atom in m):
                raise _inseparable("a root is within another one")
            name = f"root{len(self._roots)}"
            self._roots[name] = a
            return {(name,): ca.SX(1)}
        if op in (ca.OP_SIN, ca.OP_COS) and set(a) - {()}:
            return self._expand_sin_or_cos(op, a)
        if op in PLAIN and set(a) <= {()}:
            return {(): PLAIN[op](a.get((), 0))}
        raise _mixes(op)

    def _expand_sin_or_cos(self, op: int, a: Polynomial) -> Polynomial:
        """sin or cos of +-q_i + (parameters), by the addition theorem."""
        (m, k), *more = [(m, k) for m, k in a.items() if m]
        if more or len(m) != 1 or not m[0].startswith("q") or not k.is_constant():
            raise _inseparable(f"an angle is made of {', '.join(' '.join(m) or '1' for m in a)}")
        if abs(float(k)) != 1:
            raise _inseparable(f"the sine of {float(k)} {m[0]}")
        c, s, phase = f"cos {m[0]}", f"sin {m[0]}", a.get((), ca.SX(0))
        if op == ca.OP_SIN:
            return _tidy({(s,): k * ca.cos(phase), (c,): ca.sin(phase)})
        return _tidy({(c,): ca.cos(phase), (s,): -k * ca.sin(phase)})

    def _product(self, a: Polynomial, b: Polynomial) -> Polynomial:
        total: Polynomial = {}
        for m, k in a.items():
            for n, l in b.items():
                for one, c in self._reduced(tuple(sorted(m + n)), k * l).items():
                    total[one] = total[one] + c if one in total else c
        return _tidy(total)

    def _reduced(self, m: Monomial, k: Any) -> Polynomial:
        """Replace a root times itself by the expression under the root."""
        for name, inside in self._roots.items():
            if m.count(name) > 1:
                rest = list(m)
                rest.remove(name)
                rest.remove(name)
                return self._product({tuple(rest): k}, inside)
        return _tidy({m: k})

    def _without_roots(self, row: Polynomial) -> Polynomial:
        for name, inside in self._roots.items():
            with_root = {tuple(x for x in m if x != name): k for m, k in row.items() if name in m}
            if not with_root:
                continue
            rest = {m: k for m, k in row.items() if name not in m}
            squared = self._product(self._product(with_root, with_root), inside)
            row = _sum(squared, _times(self._product(rest, rest), -1))
        return row


def _mixes(op: int) -> FitError:
    return _inseparable(f"CasADi's operation {op} mixes parameters and coordinates for good")


def _inseparable(why: str) -> FitError:
    return FitError(f"the closure cannot be separated: {why}; use the implicit method")


def _times(a: Polynomial, k: Any) -> Polynomial:
    return _tidy({m: k * c for m, c in a.items()})


def _sum(a: Polynomial, b: Polynomial) -> Polynomial:
    total = dict(a)
    for m, k in b.items():
        total[m] = total[m] + k if m in total else k
    return _tidy(total)


def _tidy(a: Polynomial) -> Polynomial:
    return {m: k for m, k in a.items() if not ca.SX(k).is_zero()}
