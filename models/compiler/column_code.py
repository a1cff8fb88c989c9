"""Intermediate code for the columns of sensitivities: the same operations on each column, several columns at once.

A row of an array has one number per column, `width` in total, a multiple of LANES. With A, C the derivatives of slopes
and outputs with respect to the states, K the gain, S the state's sensitivities, each k x width:

    begin    k = A S + B; total = weight k; stage = S + ahead k               the first stage of Runge-Kutta
    middle   k = A stage + B; total = total + weight k; stage = S + ahead k
    finish   k = A stage + B; S = S + ahead (total + weight k)
    show     shown = D + C S
    correct  S = S - K shown
    steer    S = S + K' error, K' the gain's derivative with respect to each column

Entries of A and C that are always zero take no time. Called by models.compiler.loops.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

from upright.models.compiler.machine_code import lanes

NOTHING = 1e-150
"""Smaller sensitivities are set to 0: decaying ones would become numbers that take processors ten times as long."""
LANES = lanes()
KIND = f"<{LANES} x double>"
BITS = 64 * LANES
WIDE = f'nounwind "min-legal-vector-width"="{BITS}" "prefer-vector-width"="{BITS}"'
"""Attributes of a function: without them, LLVM halves vectors of 512 bits on the processors that have them."""
_LARGER = f"declare {KIND} @llvm.fabs.v{LANES}f64({KIND})"


@dataclass(slots=True)
class Lines:
    """Lines of intermediate code. A value is named after the number of its line."""

    code: list[str] = field(default_factory=list)

    def add(self, *lines: str) -> None:
        self.code += lines

    def new(self, instruction: str) -> str:
        name = f"%n{len(self.code)}"
        self.add(f"{name} = {instruction}")
        return name


def number(value: float) -> str:
    """`value` as intermediate code, exact to the last bit."""
    return f"0x{struct.unpack('>Q', struct.pack('>d', value))[0]:016X}"


def column_functions(
    states: int, rows: Sequence[int], outputs: int, by_state: Collection[int], shown_by_state: Collection[int]
) -> list[str]:
    """The code of all these functions. `rows` of S are processed, the others are left alone. `by_state` are the
    indices, row by row, of the entries of A that are not always zero, `shown_by_state` those of C."""
    return [
        _LARGER,
        *(_stage(name, states, rows, by_state) for name in ("begin", "middle", "finish")),
        _show(states, rows, outputs, shown_by_state),
        _correct(rows, outputs),
        _steer(rows, outputs),
    ]


class _Columns(Lines):
    """Code that loops over the columns."""

    def wide(self, value: str) -> str:
        """`value` in each of the lanes."""
        first = self.new(f"insertelement {KIND} poison, double {value}, i64 0")
        return self.new(f"shufflevector {KIND} {first}, {KIND} poison, <{LANES} x i32> zeroinitializer")

    def entry(self, array: str, place: int) -> str:
        """The number at `place` of `array`, in each of the lanes."""
        pointer = self.new(f"getelementptr double, ptr %{array}, i64 {place}")
        return self.wide(self.new(f"load double, ptr {pointer}"))

    def row(self, array: str, number: int) -> str:
        return self.new(f"load {KIND}, ptr {self._place(array, number)}, align 8")

    def store(self, value: str, array: str, number: int) -> None:
        place = self._place(array, number)
        self.add(f"store {KIND} {value}, ptr {place}, align 8")

    def plus(self, sum: str, factor: str, value: str) -> str:
        """sum + factor * value"""
        return self.new(f"fadd contract {KIND} {sum}, {self.new(f'fmul contract {KIND} {factor}, {value}')}")

    def columns(self) -> None:
        """Begins the loop over the columns; `function` ends it."""
        self.add("br label %columns", "columns:", "%column = phi i64 [0, %entry], [%next, %columns]")

    def function(self, name: str, arguments: str) -> str:
        self.add(f"%next = add i64 %column, {LANES}", "%more = icmp slt i64 %next, %width")
        self.add("br i1 %more, label %columns, label %end", "end:", "ret void", "}")
        return "\n".join([f"define void @{name}(i64 %width, {arguments}) {WIDE} {{", "entry:", *self.code])

    def _place(self, array: str, number: int) -> str:
        place = self.new(f"add i64 %column, {self.new(f'mul i64 %width, {number}')}")
        return self.new(f"getelementptr double, ptr %{array}, i64 {place}")


def _stage(name: str, states: int, rows: Sequence[int], by_state: Collection[int]) -> str:
    code = _Columns()
    entries = {divmod(place, states): code.entry("by_state", place) for place in by_state}
    ahead, weight = code.wide("%ahead"), code.wide("%weight")
    code.columns()
    start = {state: code.row("S", state) for state in rows}
    before = start if name == "begin" else {state: code.row("stage", state) for state in rows}
    for state in rows:
        slope = _combined(code, code.row("rest", state), entries, state, before)
        if name == "begin":
            total = code.new(f"fmul {KIND} {weight}, {slope}")
        else:
            total = code.plus(code.row("total", state), weight, slope)
        if name == "finish":
            moved = code.plus(start[state], ahead, total)
            size = code.new(f"call {KIND} @llvm.fabs.v{LANES}f64({KIND} {moved})")
            least = ", ".join([f"double {number(NOTHING)}"] * LANES)
            dead = code.new(f"fcmp olt {KIND} {size}, <{least}>")
            code.store(code.new(f"select <{LANES} x i1> {dead}, {KIND} zeroinitializer, {KIND} {moved}"), "S", state)
        else:
            code.store(total, "total", state)
            code.store(code.plus(start[state], ahead, slope), "stage", state)
    arguments = "ptr %by_state, ptr %rest, ptr %S, ptr %stage, ptr %total, double %ahead, double %weight"
    return code.function(name, arguments)


def _combined(
    code: _Columns, sum: str, entries: Mapping[tuple[int, int], str], row: int, values: Mapping[int, str]
) -> str:
    """sum + one row of a matrix times the rows `values`."""
    for column, value in values.items():
        if (row, column) in entries:
            sum = code.plus(sum, entries[row, column], value)
    return sum


def _show(states: int, rows: Sequence[int], outputs: int, by_state: Collection[int]) -> str:
    code = _Columns()
    entries = {divmod(place, states): code.entry("by_state", place) for place in by_state}
    code.columns()
    values = {state: code.row("S", state) for state in rows}
    for output in range(outputs):
        code.store(_combined(code, code.row("rest", output), entries, output, values), "shown", output)
    return code.function("show", "ptr %by_state, ptr %rest, ptr %S, ptr %shown")


def _correct(rows: Sequence[int], outputs: int) -> str:
    code = _Columns()
    places = [(state, output) for state in rows for output in range(outputs)]
    entries = {
        (state, output): code.new(f"fneg {KIND} {code.entry('gain', state * outputs + output)}")
        for state, output in places
    }
    code.columns()
    shown = {output: code.row("shown", output) for output in range(outputs)}
    for state in rows:
        code.store(_combined(code, code.row("S", state), entries, state, shown), "S", state)
    return code.function("correct", "ptr %gain, ptr %shown, ptr %S")


def _steer(rows: Sequence[int], outputs: int) -> str:
    code = _Columns()
    errors = [code.entry("error", output) for output in range(outputs)]
    code.columns()
    for state in rows:
        moved = code.row("S", state)
        for output, error in enumerate(errors):
            moved = code.plus(moved, error, code.row("gain_S", state * outputs + output))
        code.store(moved, "S", state)
    return code.function("steer", "ptr %gain_S, ptr %error, ptr %S")
