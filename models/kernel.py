"""A compiled model: one pass over a stretch of data gives predictions and all sensitivities.

With no gain it is a simulation; with a Kalman gain the state is corrected row by row and the errors are innovations.
A model's equations become machine code in a fraction of a second, the loops around them in seconds, once on a computer.
Both are kept on disk (models.machine_code), named by the model's structure and all the code that makes them: a later
start compiles nothing and imports neither numba nor SymPy. Parameter values are no part of the structure.
"""

from __future__ import annotations

import ctypes
import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models import machine_code
from models.model import Model, ModelError
from models.segment import Segment

Array = NDArray[np.float64]
Progress = Callable[[str], None]

FUNCTIONS = ("prepare", "slopes", "observe", "propagate")
"""What the code of a model consists of (models.codegen)."""
LOOPS = "upright_run"

_loaded: dict[str, machine_code.Loaded] = {}


@dataclass(frozen=True, slots=True)
class Run:
    """What a pass over n rows gives.

    `predicted` (n, ny) before each row's own correction; `sensitivity` (n, ny, na) its derivatives by what was active;
    `final` (nx,) the state after the last row.
    """

    predicted: Array
    sensitivity: Array
    final: Array


@dataclass(slots=True)
class Memory:
    """Where a pass stands, to be continued: state x (nx,), sensitivities S (nx, na), lags and places in the input."""

    x: Array
    S: Array
    lag: Array
    lag_S: Array
    pointer: NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Kernel:
    """A model's compiled equations. Names are in the order of the arrays' places."""

    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    parameters: tuple[str, ...]
    defaults: Array
    code: machine_code.Loaded

    def vector(self, values: Mapping[str, float] | None = None) -> Array:
        """Parameter values (np,), those in `values` instead of the model's. Raises ModelError for an unknown name."""
        vector = self.defaults.copy()
        for name, value in (values or {}).items():
            vector[self.index(name)] = value
        return vector

    def index(self, name: str) -> int:
        """The place of parameter `name`. Raises ModelError."""
        if name not in self.parameters:
            there = ", ".join(self.parameters)
            raise ModelError(f"parameter {name}", "the model has none", remedy=f"use one of: {there}.")
        return self.parameters.index(name)

    def memory(self, initial: Array, active: Sequence[int] = ()) -> Memory:
        """The start of a pass from state `initial` (nx,); the columns of `active` initial states start as units."""
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
        active: Sequence[int] = (),
        substeps: int = 1,
    ) -> Run:
        """One pass over `segment` from the state `initial` (nx,) with parameters `values` (np,).

        `gain` (nx, ny) corrects the state by gain * (measured - predicted); None simulates. `active` numbers what to
        differentiate by: parameter i, np + j for the initial state j, np + nx + j * ny + k for gain (j, k). A state
        that grows beyond all bounds gives values that are not finite, no error.
        """
        memory = self.memory(initial, active)
        predicted = np.empty((len(segment), len(self.outputs)))
        sensitivity = np.empty((len(segment), len(self.outputs), len(active)))
        self.proceed(segment, values, memory, gain, active, predicted, sensitivity, substeps=substeps)
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
        """Rows `first` to `last` from where `memory` stands, which is moved on; results go into the arrays given.

        `skip`: row `first` was predicted and corrected before. Raises ModelError for an array that does not fit.
        """
        rows, columns = len(segment), len(active)
        states, inputs, outputs, parameters = map(len, (self.states, self.inputs, self.outputs, self.parameters))
        last = rows - 1 if last is None else last
        numbers = np.array(active, dtype=np.int64).reshape(columns)
        limit = parameters + states * (1 + outputs)
        if not (0 <= first <= last < rows and substeps >= 1 and all(0 <= number < limit for number in active)):
            what = (
                f"there is no row {first} to {last} of {rows}, {substeps} substeps, columns {tuple(active)} of {limit}"
            )
            raise ModelError("pass", what, remedy="ask for what there is.")
        structure: Array = self.code.facts["structure"]
        delays, constants = int(structure[4]), int(structure[5])
        width = -(-columns // machine_code.LANES) * machine_code.LANES
        space = constants + states * (states + inputs + 4) + outputs * (states + inputs + 1) + inputs * 9
        space += width * (4 * states + 2 * inputs + outputs + 4)
        work, places = np.zeros(space), np.zeros(parameters + 3 * delays + inputs, dtype=np.int64)
        _loops()(
            *(self.code.addresses[name] for name in FUNCTIONS),
            structure.ctypes.data,
            rows,
            _pointer("time", segment.time, rows),
            _pointer("knots", segment.knots, rows, inputs),
            _pointer("inputs", segment.inputs, rows, inputs),
            _pointer("measured", segment.measured, rows, outputs),
            _pointer("values", values, parameters),
            columns,
            numbers.ctypes.data,
            _pointer("gain", np.zeros((states, outputs)) if gain is None else gain, states, outputs),
            _pointer("state", memory.x, states),
            _pointer("sensitivities of the state", memory.S, states, columns),
            _pointer("lags", memory.lag, inputs),
            _pointer("sensitivities of the lags", memory.lag_S, inputs, columns),
            memory.pointer.ctypes.data,
            first,
            last,
            substeps,
            skip,
            _pointer("predicted", predicted, rows, outputs),
            _pointer("sensitivity", sensitivity, rows, outputs, columns),
            work.ctypes.data,
            places.ctypes.data,
        )


def _pointer(name: str, array: Array, *shape: int) -> int:
    """Where `array` begins: machine code looks at no sizes, so what does not fit is refused here."""
    if array.shape != shape or array.dtype != np.float64 or not array.flags.c_contiguous:
        what = f"is {array.dtype} {array.shape}, and should be float64 {shape}, C-contiguous"
        raise ModelError(name, what, remedy="use np.ascontiguousarray, and the kernel's own sizes.")
    return int(array.ctypes.data)


def compile_model(model: Model, *, progress: Progress | None = None) -> Kernel:
    """The kernel of `model`, from memory, from the cache on disk, or made now (`progress` is told in words).

    Raises ModelError where its equations are wrong.
    """
    progress = progress or (lambda text: None)
    name = f"{model.name}-{fingerprint(model)}"
    if name not in _loaded:
        _loops(progress)
        found = machine_code.recall(name)
        if found is None:
            from models.codegen import generate

            progress(f"model {model.name}: compiling")
            made = generate(model)
            found = machine_code.assemble(made.text, {"structure": made.structure})
            machine_code.keep(name, found)
        code = machine_code.load(found, FUNCTIONS)
        structure = np.array(code.facts["structure"], dtype=np.int64)
        _loaded[name] = machine_code.Loaded(code.addresses, {"structure": structure}, code.engine)
    return Kernel(
        states=tuple(state.name for state in model.states),
        inputs=tuple(each.name for each in model.inputs),
        outputs=tuple(each.name for each in model.outputs),
        parameters=tuple(parameter.name for parameter in model.parameters),
        defaults=np.array([parameter.value for parameter in model.parameters]),
        code=_loaded[name],
    )


def _loops(progress: Progress | None = None) -> Any:
    """models.kernel_loops.run, compiled."""
    if LOOPS not in _loaded:
        name = f"loops-{_digest(SOURCES, machine_code.processor())}"
        found = machine_code.recall(name)
        if found is None:
            if progress is not None:
                progress("compiling the integrator, once on this computer")
            from models.kernel_loops import intermediate_code

            found = machine_code.assemble(intermediate_code(LOOPS), {})
            machine_code.keep(name, found)
        code = machine_code.load(found, (LOOPS,))
        integer, pointer = ctypes.c_int64, ctypes.c_void_p
        kinds = (*[integer] * 4, pointer, integer, *[pointer] * 5, integer, *[pointer] * 7)
        prototype = ctypes.CFUNCTYPE(None, *kinds, *[integer] * 4, *[pointer] * 4)
        function = prototype(code.addresses[LOOPS])
        _loaded[LOOPS] = machine_code.Loaded(code.addresses, {"function": function}, code.engine)
    return _loaded[LOOPS].facts["function"]


def fingerprint(model: Model) -> str:
    """What tells apart models that need code of their own: names, equations, holds, delays, and what makes the code."""
    parts: list[Any] = [SOURCES, machine_code.processor(), model.name]
    parts += [(state.name, state.derivative) for state in model.base_states]
    parts += [(each.name, each.hold.value, each.delays, each.lag) for each in model.inputs]
    parts += [(each.name, each.expression) for each in model.outputs]
    parts += [parameter.name for parameter in model.base_parameters]
    parts += [sorted(model.definitions.items())]
    parts += [(j.name, j.coordinate, j.rate, j.inertia, j.load, j.smooth_rate) for j in model.joints]
    parts += [(a.name, a.command, a.joint, a.rate, a.angle, a.gain) for a in model.actuators]
    parts += [(sensor.name, sensor.angle, sensor.rate) for sensor in model.sensors]
    for attached in model.effects:
        effect = attached.effect
        expressions = (effect.force, effect.command, effect.angle_reading, effect.rate_reading)
        states = [(state.name, state.derivative) for state in effect.states]
        names = [parameter.name for parameter in effect.parameters]
        shifts = (effect.delay, effect.lag)
        parts += [(attached.name, attached.at, effect.place.value, expressions, shifts, states, names)]
    return _digest(*parts)


def _digest(*parts: Any) -> str:
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:20]


def _sources() -> str:
    """Changes with any change of the code that makes machine code."""
    here = Path(__file__).parent
    names = ("codegen", "equations", "expressions", "expression_syntax", "kernel_loops", "machine_code")
    return hashlib.sha256(b"".join((here / f"{name}.py").read_bytes() for name in names)).hexdigest()


SOURCES = _sources()
"""Of the code that is loaded: taken at import, since an upgrade may change the files while this process runs."""
