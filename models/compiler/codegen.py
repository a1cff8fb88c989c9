"""From a model's equations to LLVM's intermediate code: slopes, outputs and their exact derivatives, each just once.

SymPy differentiates and finds common subexpressions. The remaining products, sums and functions are written down
directly, in a hundredth of the time of numba's front end. The resulting functions, called by models.compiler.loops, are
those of models.compiler.column_code and:

    prepare    the expressions of parameters alone, once per pass
    slopes     the states' derivatives; on request, their derivatives with respect to states, parameters, inputs, then
               the inputs' slopes, and time
    observe    the outputs, likewise; not with respect to time, since the sample instants do not move

A derivative with respect to a parameter is computed only if that parameter has a column, together with the
subexpressions that nothing else needs.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import sympy

from upright.models.compiler.column_code import Lines, column_functions, number
from upright.models.compiler.derivatives import Derivatives
from upright.models.compiler.equations import Equations, Magnitude, Signum, compose
from upright.models.model import Model
from upright.models.parts import Hold, ModelError

FUNCTIONS = {
    **{getattr(sympy, name): name for name in ("sin", "cos", "tan", "asin", "acos", "atan")},
    **{getattr(sympy, name): name for name in ("sinh", "cosh", "tanh", "exp", "log")},
    Magnitude: "llvm.fabs.f64",
}
"""SymPy's functions and the names of their implementations, in the C library or LLVM's own."""
ROOT = "llvm.sqrt.f64"
POWER = "pow"
_DECLARATIONS = [
    *(f"declare double @{name}(double)" for name in (*FUNCTIONS.values(), ROOT)),
    f"declare double @{POWER}(double, double)",
]
_ARGUMENTS = (
    "double %t, ptr %state, ptr %input, ptr %slope, ptr %parameter, ptr %constant, ptr %column, i64 %width, "
    "i64 %derive, ptr %result, ptr %by_state, ptr %by_parameter, ptr %by_input, ptr %by_time"
)


@dataclass(frozen=True, slots=True)
class Code:
    """Intermediate code, and the model's sizes and indices in the form of `structure` of models.compiler.loops.run."""

    text: str
    structure: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class _Target:
    """Where a value is stored: an index into an array or, for a derivative with respect to a parameter, the row."""

    function: str
    array: str
    place: int
    parameter: int = -1


def generate(model: Model, neutral: Collection[str] = ()) -> Code:
    """The same model gives the same code. Raises ModelError.

    If parameters are `neutral`, the code assumes that each of them is zero: it differentiates with respect to no other
    parameter, and omits the sensitivities of states on which no output then depends.
    """
    equations = compose(model)
    zero = {symbol: sympy.Integer(0) for symbol in equations.parameters if symbol.name in neutral}
    targets: dict[_Target, sympy.Expr] = {}
    _derive(targets, "slopes", equations.derivatives, equations, zero)
    _derive(targets, "observe", equations.outputs, equations, zero)
    rows = _observable(targets, len(model.states)) if neutral else list(range(len(model.states)))
    sizes = {"by_state": len(model.states), "by_input": 2 * len(model.inputs), "by_time": 1, "by_parameter": 1}
    targets = {
        target: expression
        for target, expression in targets.items()
        if target.function == "observe" or target.array == "result" or target.place // sizes[target.array] in rows
    }
    symbols = sympy.numbered_symbols("q_")
    # Unsorted: the arguments of sums and products have an order of their own, and sorting finds nothing more to share.
    shared, reduced = sympy.cse(list(targets.values()), symbols=symbols, order="none", list=False)
    writer = _Writer(places=_places(equations), definitions=dict(shared))
    constants = writer.constants(equations.parameters)
    targets = dict(zip(targets, reduced, strict=True))
    names = [parameter.name for parameter in model.parameters]
    shifts = [(place, names.index(name)) for place, delays in enumerate(equations.delays) for name in delays]
    places = [target.place for target in targets if (target.function, target.array) == ("slopes", "by_input")]
    driven = sorted({place // sizes["by_input"] for place in places})
    structure = (
        *(len(model.states), len(model.inputs), len(model.outputs), len(names), len(shifts), len(constants)),
        *(int(each.hold is Hold.CUBIC) for each in model.inputs),
        *(names.index(lag) if lag else -1 for lag in equations.lags),
        *(place for place, _ in shifts),
        *(parameter for _, parameter in shifts),
        len(driven),
        *driven,
    )
    lines = [
        *_DECLARATIONS,
        *_prepare(writer, constants),
        *_function("slopes", targets, writer),
        *_function("observe", targets, writer),
        *column_functions(
            len(model.states),
            rows,
            len(model.outputs),
            *(
                [target.place for target in targets if (target.function, target.array) == (function, "by_state")]
                for function in ("slopes", "observe")
            ),
        ),
    ]
    return Code("\n".join([*lines, ""]), structure)


def _derive(
    targets: dict[_Target, sympy.Expr],
    function: str,
    expressions: Sequence[sympy.Expr],
    equations: Equations,
    zero: Mapping[sympy.Symbol, sympy.Expr],
) -> None:
    """Add `expressions` and their nonzero derivatives to `targets`, with `zero` substituted in all of them."""
    arrays = {"by_state": equations.states, "by_input": (*equations.inputs, *equations.slopes)}
    if function == "slopes":
        arrays["by_time"] = (equations.time,)
    derivatives = Derivatives()
    for row, whole in enumerate(expressions):
        expression = whole.xreplace(zero)
        targets[_Target(function, "result", row)] = expression
        for array, symbols in arrays.items():
            for place, symbol in enumerate(symbols):
                if (derivative := derivatives.by(expression, symbol)) != 0:
                    targets[_Target(function, array, row * len(symbols) + place)] = derivative
        for place, symbol in enumerate(equations.parameters):
            if (symbol in zero or not zero) and (derivative := derivatives.by(whole, symbol).xreplace(zero)) != 0:
                targets[_Target(function, "by_parameter", row, place)] = derivative


def _observable(targets: Iterable[_Target], states: int) -> list[int]:
    """The states that an output depends on, directly or through other states."""
    targets = list(targets)
    links = [divmod(each.place, states) for each in targets if (each.function, each.array) == ("slopes", "by_state")]
    found = {each.place % states for each in targets if (each.function, each.array) == ("observe", "by_state")}
    while further := {column for row, column in links if row in found} - found:
        found |= further
    return sorted(found)


def _places(equations: Equations) -> dict[sympy.Symbol, str]:
    """The name of a symbol, or the array element with its value."""
    places = {equations.time: "%t"}
    for array, symbols in (
        ("state", equations.states),
        ("input", equations.inputs),
        ("slope", equations.slopes),
        ("parameter", equations.parameters),
    ):
        places |= {symbol: f"{array} {place}" for place, symbol in enumerate(symbols)}
    return places


@dataclass(slots=True, kw_only=True)
class _Writer(Lines):
    """Writes expressions as code. `places` are the known values, `definitions` the shared subexpressions, in order.

    `values` are the names of the expressions in the lines written so far.
    """

    places: dict[sympy.Symbol, str]
    definitions: Mapping[sympy.Symbol, sympy.Expr]
    values: dict[sympy.Expr, str] = field(default_factory=dict)

    def inner(self) -> _Writer:
        """A writer for a block of this code: values computed in the block are not known after it."""
        return _Writer(code=self.code, places=self.places, definitions=self.definitions, values=dict(self.values))

    def constants(self, parameters: Sequence[sympy.Symbol]) -> list[sympy.Symbol]:
        """The shared subexpressions of parameters alone."""
        fixed = set(parameters)
        constants = []
        for symbol, definition in self.definitions.items():
            if definition.free_symbols <= fixed:
                fixed.add(symbol)
                constants.append(symbol)
        return constants

    def needed(self, expressions: Iterable[sympy.Expr]) -> set[sympy.Symbol]:
        """The shared subexpressions that have to be computed for `expressions`."""
        found: set[sympy.Symbol] = set()
        waiting = list(expressions)
        while waiting:
            for symbol in waiting.pop().free_symbols:
                if symbol in self.definitions and symbol not in found and symbol not in self.places:
                    found.add(symbol)
                    waiting.append(self.definitions[symbol])
        return found

    def work_out(self, symbols: set[sympy.Symbol]) -> None:
        for symbol, definition in self.definitions.items():
            if symbol in symbols and symbol not in self.values:
                self.values[symbol] = self.value(definition)

    def store(self, expression: sympy.Expr, array: str, place: int | str) -> None:
        value = self.value(expression)
        pointer = self.new(f"getelementptr double, ptr %{array}, i64 {place}")
        self.add(f"store double {value}, ptr {pointer}")

    def value(self, expression: sympy.Expr) -> str:
        """The name of the value of `expression`, or its number."""
        if expression.is_number:
            return number(float(expression))
        if expression not in self.values:
            self.values[expression] = self._write(expression)
        return self.values[expression]

    def _write(self, expression: sympy.Expr) -> str:
        match expression:
            case sympy.Symbol():
                place = self.places[expression]
                if place.startswith("%"):
                    return place
                array, index = place.split()
                return self.new(f"load double, ptr {self.new(f'getelementptr double, ptr %{array}, i64 {index}')}")
            case sympy.Add(args=(first, *rest)):
                total = self.value(first)
                for term in rest:
                    negative = term.as_coeff_Mul()[0].is_negative
                    operation, term = ("fsub", -term) if negative else ("fadd", term)
                    total = self.new(f"{operation} contract double {total}, {self.value(term)}")
                return total
            case sympy.Mul(args=(first, *rest)) if first == -1:
                return self.new(f"fneg double {self.value(sympy.Mul(*rest))}")
            case sympy.Mul(args=factors):
                # Divisors come last, so that each takes one division.
                product = ""
                for factor in sorted(factors, key=_is_divisor):
                    if product and _is_divisor(factor):
                        product = self.new(f"fdiv contract double {product}, {self.value(1 / factor)}")
                    else:
                        value = self.value(factor)
                        product = self.new(f"fmul contract double {product}, {value}") if product else value
                return product
            case sympy.Pow(args=(base, exponent)):
                return self._power(base, exponent)
            case sympy.Max(args=(first, *rest)) | sympy.Min(args=(first, *rest)):
                test = "ogt" if isinstance(expression, sympy.Max) else "olt"
                best = self.value(first)
                for other in map(self.value, rest):
                    better = self.new(f"fcmp {test} double {other}, {best}")
                    best = self.new(f"select i1 {better}, double {other}, double {best}")
                return best
            case sympy.Heaviside():
                return self._switch(expression.args[0], "0.0", "0.5")
            case Signum():
                return self._switch(expression.args[0], "-1.0", "0.0")
            case sympy.DiracDelta():
                return "0.0"
            case _ if type(expression) in FUNCTIONS:
                return self.new(f"call double @{FUNCTIONS[type(expression)]}(double {self.value(expression.args[0])})")
        raise ModelError("equations", f"{expression} cannot be compiled", remedy="write it in another way.")

    def _power(self, base: sympy.Expr, exponent: sympy.Expr) -> str:
        """An integer exponent becomes products, an exponent of one half a square root."""
        if exponent.is_number and exponent.is_negative:
            return self.new(f"fdiv double 1.0, {self.value(base**-exponent)}")
        value = self.value(base)
        if exponent == sympy.Rational(1, 2):
            return self.new(f"call double @{ROOT}(double {value})")
        if not (exponent.is_Integer and exponent <= 16):
            return self.new(f"call double @{POWER}(double {value}, double {self.value(exponent)})")
        power, rest = "", int(exponent)
        while rest:
            if rest & 1:
                power = self.new(f"fmul contract double {power}, {value}") if power else value
            rest >>= 1
            value = self.new(f"fmul contract double {value}, {value}") if rest else value
        return power

    def _switch(self, argument: sympy.Expr, below: str, between: str) -> str:
        """1 above zero, `below` below it, `between` at zero."""
        value = self.value(argument)
        negative = self.new(f"fcmp olt double {value}, 0.0")
        otherwise = self.new(f"select i1 {negative}, double {below}, double {between}")
        positive = self.new(f"fcmp ogt double {value}, 0.0")
        return self.new(f"select i1 {positive}, double 1.0, double {otherwise}")


def _is_divisor(factor: sympy.Expr) -> bool:
    return bool(factor.is_Pow and factor.exp.is_number and factor.exp.is_negative)


def _prepare(writer: _Writer, constants: Sequence[sympy.Symbol]) -> list[str]:
    """The code that computes the constants, which are known from then on."""
    inner = writer.inner()
    inner.code = []
    inner.work_out(set(constants))
    for place, symbol in enumerate(constants):
        inner.store(symbol, "constant", place)
        writer.places[symbol] = f"constant {place}"
    return ["define void @prepare(ptr %parameter, ptr %constant) nounwind {", *inner.code, "ret void", "}"]


def _function(name: str, targets: Mapping[_Target, sympy.Expr], writer: _Writer) -> list[str]:
    """The code of `slopes` or `observe`."""
    block = _Writer(places=writer.places, definitions=writer.definitions)
    values: dict[_Target, sympy.Expr] = {}
    common: dict[_Target, sympy.Expr] = {}
    parameters: dict[int, dict[_Target, sympy.Expr]] = {}
    for target, expression in targets.items():
        if target.function == name:
            group = common if target.parameter < 0 else parameters.setdefault(target.parameter, {})
            (values if target.array == "result" else group)[target] = expression
    block.work_out(block.needed(values.values()))
    for target, expression in values.items():
        block.store(expression, target.array, target.place)
    derive = block.new("icmp ne i64 %derive, 0")
    block.add(f"br i1 {derive}, label %derivatives, label %end", "derivatives:")
    needed = [block.needed(rows.values()) for rows in parameters.values()]
    shared = {symbol for symbols in needed for symbol in symbols if sum(symbol in other for other in needed) > 1}
    block.work_out(shared | block.needed(common.values()))
    for target, expression in common.items():
        block.store(expression, target.array, target.place)
    for parameter, rows in sorted(parameters.items()):
        column = block.new(f"load i64, ptr {block.new(f'getelementptr i64, ptr %column, i64 {parameter}')}")
        active = block.new(f"icmp sge i64 {column}, 0")
        block.add(f"br i1 {active}, label %by{parameter}, label %after{parameter}", f"by{parameter}:")
        inner = block.inner()
        inner.work_out(inner.needed(rows.values()))
        for target, expression in rows.items():
            row = inner.new(f"mul i64 %width, {target.place}")
            inner.store(expression, target.array, inner.new(f"add i64 {row}, {column}"))
        block.add(f"br label %after{parameter}", f"after{parameter}:")
    head = f"define void @{name}({_ARGUMENTS}) nounwind {{"
    return [head, "entry:", *block.code, "br label %end", "end:", "ret void", "}"]
