"""Derivatives by SymPy's rules, with intermediate results kept.

SymPy searches every subexpression for free symbols at every step of every derivative, which took most of a first
compilation. Here these are found once, and so is the derivative of each subexpression.
"""

from __future__ import annotations

import sympy


class Derivatives:
    """Derivatives of any expressions; results are kept."""

    def __init__(self) -> None:
        self._free: dict[sympy.Basic, frozenset[sympy.Basic]] = {}
        self._known: dict[tuple[sympy.Basic, sympy.Symbol], sympy.Expr] = {}

    def by(self, expression: sympy.Expr, symbol: sympy.Symbol) -> sympy.Expr:
        """expression.diff(symbol)"""
        if symbol not in self._symbols(expression):
            return sympy.S.Zero
        if (expression, symbol) not in self._known:
            self._known[expression, symbol] = self._found(expression, symbol)
        return self._known[expression, symbol]

    def _found(self, expression: sympy.Expr, symbol: sympy.Symbol) -> sympy.Expr:
        match expression:
            case sympy.Symbol():
                return sympy.S.One
            case sympy.Add(args=terms):
                return sympy.Add(*(self.by(term, symbol) for term in terms))
            case sympy.Mul(args=factors):
                inner = [(place, self.by(factor, symbol)) for place, factor in enumerate(factors)]
                terms = (sympy.Mul(*factors[:k], each, *factors[k + 1 :]) for k, each in inner if each != 0)
                return sympy.Add(*terms)
            case sympy.Pow(base=base, exp=exponent) if exponent.is_number:
                return exponent * base ** (exponent - 1) * self.by(base, symbol)
            case sympy.Function(args=(argument,)):
                return expression.fdiff(1) * self.by(argument, symbol)
            case sympy.Max(args=arguments) | sympy.Min(args=arguments):
                inner = [(place, self.by(argument, symbol)) for place, argument in enumerate(arguments, 1)]
                return sympy.Add(*(expression.fdiff(place) * each for place, each in inner if each != 0))
        return expression.diff(symbol)

    def _symbols(self, expression: sympy.Basic) -> frozenset[sympy.Basic]:
        if expression not in self._free:
            itself = (expression,) if expression.is_Symbol else ()
            self._free[expression] = frozenset(itself).union(*map(self._symbols, expression.args))
        return self._free[expression]
