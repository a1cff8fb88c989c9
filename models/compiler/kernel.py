"""A compiled model: one pass over a segment of data gives predictions and all sensitivities.

Without a gain it is a simulation; with a Kalman gain the state is corrected at each sample and the errors are
innovations. A model's equations become machine code in a fraction of a second, the loops around them in seconds, once
per computer. Both are kept on disk (models.compiler.machine_code), named by the model's structure and all the code that
generates them: a later start compiles nothing and imports neither numba nor SymPy. Parameter values are not part of the
structure.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from upright.models.compiler import machine_code
from upright.models.compiler.fingerprint import SOURCES, digest, fingerprint
from upright.models.model import Model
from upright.models.parts import ModelError
from upright.models.segment import Segment

Array = NDArray[np.float64]
Progress = Callable[[str], None]

FUNCTIONS = ("prepare", "slopes", "observe", "begin", "middle", "finish", "show", "correct", "steer")
"""The functions in the code of a model (models.compiler.codegen, models.compiler.column_code)."""
LOOPS = "upright_run"
LARGEST = 1e30
"""Root of the sum of squares of all predictions, or of all their derivatives, of which a model has diverged."""
LINE = 64
"""Bytes of a cache line."""
ELSEWHERE = -1
"""Number of a column that is not a parameter, initial state or gain."""

_loaded: dict[str, machine_code.Loaded] = {}


@dataclass(frozen=True, slots=True)
class Run:
    """The result of a pass over n samples.

    `predicted` (n, ny) before the correction at each sample; `sensitivity` (n, ny, na) its derivatives with respect to
    the active columns; `final` (nx,) the state after the last sample.
    """

    predicted: Array
    sensitivity: Array
    final: Array

    @property
    def diverges(self) -> bool:
        """Whether a number is not finite, or too large for any vehicle."""
        squares = (float(np.vdot(part, part)) for part in (self.predicted, self.sensitivity))
        return not all(each < LARGEST**2 for each in squares)  # NaN is not less


@dataclass(slots=True)
class Memory:
    """The point that a pass has reached: state x (nx,), sensitivities S (nx, na), lags and positions in the inputs."""

    x: Array
    S: Array
    lag: Array
    lag_S: Array
    pointer: NDArray[np.int64]

    def copy(self) -> Memory:
        """A copy of this point, to return to."""
        return Memory(*(each.copy() for each in self._arrays))

    def views(self) -> list[memoryview]:
        """Views of what is in its arrays: `view[:] = view` goes on from another point, in a tenth of a microsecond."""
        return [each.data.cast("B") for each in self._arrays if each.size]

    @property
    def _arrays(self) -> tuple[NDArray[Any], ...]:
        return self.x, self.S, self.lag, self.lag_S, self.pointer


@dataclass(frozen=True, slots=True)
class Kernel:
    """A model's compiled equations. Names are in the order of the arrays' elements.

    `neutral` parameters have to be zero, and a pass differentiates with respect to no others. If none is neutral, there
    are no such restrictions.
    """

    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    parameters: tuple[str, ...]
    defaults: Array
    code: machine_code.Loaded
    neutral: frozenset[int] = frozenset()

    def vector(self, values: Mapping[str, float] | None = None) -> Array:
        """Parameter values (np,), those in `values` instead of the model's. Raises ModelError for an unknown name."""
        vector = self.defaults.copy()
        for name, value in (values or {}).items():
            vector[self.index(name)] = value
        return vector

    def index(self, name: str) -> int:
        """The index of parameter `name`. Raises ModelError."""
        if name not in self.parameters:
            there = ", ".join(self.parameters)
            raise ModelError(f"parameter {name}", "the model has no such parameter", remedy=f"use one of: {there}.")
        return self.parameters.index(name)

    def memory(self, initial: Array, active: Sequence[int] = ()) -> Memory:
        """The start of a pass from state `initial` (nx,); the columns of `active` initial states are unit vectors."""
        size = len(active)
        sensitivity = np.zeros((len(self.states), size))
        for column, number in enumerate(active):
            if len(self.parameters) <= number < len(self.parameters) + len(self.states):
                sensitivity[number - len(self.parameters), column] = 1.0
        inputs = len(self.inputs)
        places = np.zeros(inputs, dtype=np.int64)
        return Memory(
            np.array(initial, dtype=np.float64), sensitivity, np.zeros(inputs), np.zeros((inputs, size)), places
        )

    def run(
        self,
        segment: Segment,
        values: Array,
        initial: Array,
        *,
        gain: Array | None = None,
        gain_slopes: Array | None = None,
        active: Sequence[int] = (),
        substeps: int = 1,
    ) -> Run:
        """One pass over `segment` from the state `initial` (nx,) with parameters `values` (np,).

        `gain` (nx, ny) corrects the state by gain * (measured - predicted); None simulates. `active` numbers the
        columns to differentiate by: parameter i, np + j for the initial state j, np + nx + j * ny + k for gain (j, k),
        or ELSEWHERE for a column that acts through the gain alone. `gain_slopes` (nx * ny, na) are the gain's
        derivatives with respect to each column. A state that grows beyond all bounds gives values that are not finite,
        not an error.
        """
        memory = self.memory(initial, active)
        predicted = np.empty((len(segment), len(self.outputs)))
        sensitivity = np.empty((len(segment), len(self.outputs), len(active)))
        move = self.ready(
            segment, values, memory, gain, active, predicted, sensitivity, gain_slopes=gain_slopes, substeps=substeps
        )
        move(0, len(segment) - 1, False)
        return Run(predicted, sensitivity, memory.x)

    def proceed(
        self,
        segment: Segment,
        values: Array,
        memory: Memory,
        gain: Array | None,
        active: Sequence[int],
        predicted: Array,
        sensitivity: Array,
        *,
        first: int = 0,
        last: int | None = None,
        substeps: int = 1,
        skip: bool = False,
    ) -> None:
        """Samples `first` to `last`, continuing from `memory`, which is updated; results go into the given arrays.

        `skip`: sample `first` was predicted and corrected before. Raises ModelError for an array of the wrong shape.
        """
        last = len(segment) - 1 if last is None else last
        move = self.ready(segment, values, memory, gain, active, predicted, sensitivity, substeps=substeps)
        move(first, last, skip)

    def ready(
        self,
        segment: Segment,
        values: Array,
        memory: Memory,
        gain: Array | None,
        active: Sequence[int],
        predicted: Array,
        sensitivity: Array,
        *,
        gain_slopes: Array | None = None,
        substeps: int = 1,
    ) -> Callable[[int, int, bool], None]:
        """`proceed` for many short parts, as a function of `first`, `last` and `skip`.

        Arrays are read and written in place, so they must not be replaced between calls.
        """
        rows, samples, columns = len(segment), len(segment.inputs), len(active)
        states, inputs, outputs, parameters = map(len, (self.states, self.inputs, self.outputs, self.parameters))
        chosen = _columns(tuple(active), parameters, states, outputs)
        limit = parameters + states * (1 + outputs)
        if not (substeps >= 1 and chosen.least >= ELSEWHERE and chosen.most < limit):
            what = f"{substeps} substeps with columns {tuple(active)} of {limit} are not possible"
            raise ModelError("pass", what, remedy="use at least one substep, and columns that exist.")
        if self.neutral and (not self.neutral.issuperset(active) or values[list(self.neutral)].any()):
            what = "this kernel is for neutral parameters alone, at zero"
            raise ModelError("pass", what, remedy="differentiate by these, or compile the model without neutral ones.")
        gain = np.zeros((states, outputs)) if gain is None else gain
        by_gain = chosen.by_gain
        if gain_slopes is not None:
            by_gain = gain_slopes if by_gain is None else by_gain + gain_slopes
        structure, functions = self.code.facts["structure"], self.code.facts["functions"]
        delays, constants = int(structure[4]), int(structure[5])
        lanes = machine_code.lanes()
        width = -(-columns // lanes) * lanes
        space = constants + states * (states + 2 * inputs + outputs + 4) + outputs * (states + 2 * inputs + 1)
        space += inputs * 14
        space += width * (4 * states + 3 * inputs + outputs * (2 + states) + 4)
        work, places = _aligned(space), np.empty(parameters + 3 * delays + inputs, dtype=np.int64)
        table = (
            _address(functions),
            _address(structure),
            samples,
            _pointer("time", segment.time, rows),
            _pointer("knots", segment.knots, samples, inputs),
            _pointer("inputs", segment.inputs, samples, inputs),
            _pointer("measured", segment.measured, rows, outputs),
            _pointer("values", values, parameters),
            columns,
            _address(chosen.numbers),
            _pointer("gain", gain, states, outputs),
            0 if by_gain is None else _pointer("derivatives of the gain", by_gain, states * outputs, columns),
            _pointer("state", memory.x, states),
            _pointer("sensitivities of the state", memory.S, states, columns),
            _pointer("lags", memory.lag, inputs),
            _pointer("sensitivities of the lags", memory.lag_S, inputs, columns),
            _address(memory.pointer),
            *(0, 0, substeps, 0),  # of each call: `first`, `last` and `skip`
            by_gain is not None,
            _pointer("predicted", predicted, rows, outputs),
            _pointer("sensitivity", sensitivity, rows, outputs, columns),
            _address(work),
            _address(places),
            work.nbytes,
            places.nbytes,
        )
        arguments = np.array(table, dtype=np.int64)
        address = ctypes.c_void_p(_address(arguments))
        held = (memory.x, memory.S, memory.lag, memory.lag_S, memory.pointer)
        used = (segment, values, *held, chosen, gain, by_gain, arguments, work, places)
        loops = _loops()

        def proceed(first: int, last: int, skip: bool, used: object = used) -> None:
            if not 0 <= first <= last < rows:
                raise ModelError(
                    "pass", f"there are no samples {first} to {last} of {rows}", remedy="choose samples that exist."
                )
            loops(address, first, last, skip)

        return proceed


@dataclass(frozen=True, slots=True)
class _Columns:
    """The columns of a pass: their `numbers` (na,), the smallest and the largest, and the gain's derivatives with
    respect to them, (nx * ny, na), None if none of them is an entry of the gain."""

    numbers: NDArray[np.int64]
    least: int
    most: int
    by_gain: Array | None


@functools.lru_cache(maxsize=256)
def _columns(active: tuple[int, ...], parameters: int, states: int, outputs: int) -> _Columns:
    numbers = np.array(active, dtype=np.int64)
    entries = numbers - parameters - states
    by_gain = None
    if (entries >= 0).any():
        by_gain = np.equal.outer(np.arange(states * outputs), entries).astype(np.float64)
    return _Columns(numbers, min(active, default=0), max(active, default=-1), by_gain)


def _aligned(size: int) -> Array:
    """An array (size,) aligned to a cache line: vectors that cross a border of lines take twice as long."""
    space = np.empty(size + LINE // 8)
    first = -_address(space) % LINE // 8
    return space[first : first + size]


def _pointer(name: str, array: Array, *shape: int) -> int:
    """The address of `array`. Machine code does not check sizes, so an array that does not fit is rejected here."""
    if array.shape != shape or array.dtype != np.float64 or not array.flags.c_contiguous:
        what = f"is {array.dtype} {array.shape}, but should be float64 {shape}, C-contiguous"
        raise ModelError(name, what, remedy="use np.ascontiguousarray, and the kernel's own sizes.")
    return _address(array)


def _address(array: NDArray[Any]) -> int:
    try:
        return ctypes.addressof(ctypes.c_char.from_buffer(array))  # type: ignore[arg-type]  # twice as fast
    except (TypeError, ValueError):  # read-only, or empty
        return int(array.ctypes.data)


def compile_model(model: Model, *, neutral: Sequence[str] = (), progress: Progress | None = None) -> Kernel:
    """The kernel of `model`, from memory, from the cache on disk, or compiled now (`progress` gets a message).

    Parameters that are `neutral` are zero in all its passes, which then take a fraction of the time: see Kernel.
    Raises ModelError if its equations are wrong.
    """
    progress = progress or (lambda text: None)
    name = f"{model.name}-{fingerprint(model)}"
    if neutral:
        name = f"{name}-{digest(*sorted(neutral))}"
    if name not in _loaded:
        _loops(progress)
        found = machine_code.recall(name)
        if found is None:
            from upright.models.compiler.codegen import generate

            progress(f"model {model.name}: compiling")
            made = generate(model, neutral)
            found = machine_code.assemble(made.text, {"structure": made.structure})
            machine_code.keep(name, found)
        code = machine_code.load(found, FUNCTIONS)
        facts = {
            "structure": np.array(code.facts["structure"], dtype=np.int64),
            "functions": np.array([code.addresses[each] for each in FUNCTIONS], dtype=np.int64),
        }
        _loaded[name] = machine_code.Loaded(code.addresses, facts, code.engine)
    names = tuple(parameter.name for parameter in model.parameters)
    return Kernel(
        states=tuple(state.name for state in model.states),
        inputs=tuple(each.name for each in model.inputs),
        outputs=tuple(each.name for each in model.outputs),
        parameters=names,
        defaults=np.array([parameter.value for parameter in model.parameters]),
        code=_loaded[name],
        neutral=frozenset(map(names.index, neutral)),
    )


def _loops(progress: Progress | None = None) -> Any:
    """upright.models.compiler.loops.run, compiled."""
    if LOOPS not in _loaded:
        name = f"loops-{digest(SOURCES, machine_code.processor())}"
        found = machine_code.recall(name)
        if found is None:
            if progress is not None:
                progress("compiling the integrator, once on this computer")
            from upright.models.compiler.loops import intermediate_code

            found = machine_code.assemble(intermediate_code(LOOPS), {}, optimise=True)
            machine_code.keep(name, found)
        code = machine_code.load(found, (LOOPS,))
        integer = ctypes.c_int64
        function = ctypes.CFUNCTYPE(None, ctypes.c_void_p, integer, integer, integer)(code.addresses[LOOPS])
        _loaded[LOOPS] = machine_code.Loaded(code.addresses, {"function": function}, code.engine)
    return _loaded[LOOPS].facts["function"]
