"""A compiled model: one pass over a stretch of data gives predictions and all sensitivities.

With no gain it is a simulation; with a Kalman gain the state is corrected row by row and the errors are innovations.
The generated module is kept in the user's cache directory, named by the model's structure, with numba's machine code
beside it: a second start generates and compiles nothing, and does not import SymPy. Parameter values are no part of
the structure.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.model import Model, ModelError
from models.segment import Segment

Array = NDArray[np.float64]
Progress = Callable[[str], None]

_loaded: dict[str, Kernel] = {}


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
    module: ModuleType

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
        differentiate by: parameter i, np + j for the initial state j, np + nx + j * ny + k for gain (j, k). A state that grows beyond all bounds gives
        values that are not finite, no error.
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

        `skip`: row `first` was predicted and corrected before.
        """
        if gain is None:
            gain = np.zeros((len(self.states), len(self.outputs)))
        self.module.run(
            segment.time,
            segment.knots,
            segment.inputs,
            segment.measured,
            values,
            np.asarray(active, dtype=np.int64),
            gain,
            memory.x,
            memory.S,
            memory.lag,
            memory.lag_S,
            memory.pointer,
            first,
            len(segment) - 1 if last is None else last,
            substeps,
            skip,
            predicted,
            sensitivity,
        )


def compile_model(model: Model, *, progress: Progress | None = None) -> Kernel:
    """The kernel of `model`, from memory, from the cache on disk, or made now (seconds; `progress` is told in words).

    Raises ModelError where its equations are wrong.
    """
    name = f"{model.name.replace('-', '_').replace('.', '_')}_{fingerprint(model)}"
    module = _loaded[name].module if name in _loaded else _module(name, model, progress or (lambda text: None))
    kernel = Kernel(
        states=tuple(state.name for state in model.states),
        inputs=tuple(each.name for each in model.inputs),
        outputs=tuple(each.name for each in model.outputs),
        parameters=tuple(parameter.name for parameter in model.parameters),
        defaults=np.array([parameter.value for parameter in model.parameters]),
        module=module,
    )
    _loaded[name] = kernel
    return kernel


def fingerprint(model: Model) -> str:
    """What tells apart models that need code of their own: names, equations, holds, delays, and the code generator."""
    parts: list[Any] = [_generator(), model.name]
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
        parts += [
            (attached.name, attached.at, effect.place.value, expressions, effect.delay, effect.lag, states, names)
        ]
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:20]


def cache_directory() -> Path:
    """Where generated modules are kept: UPRIGHT_CACHE, systemd's CACHE_DIRECTORY, or the user's cache."""
    for variable in ("UPRIGHT_CACHE", "CACHE_DIRECTORY"):
        if os.environ.get(variable):
            return Path(os.environ[variable].split(":")[0]) / "kernels"
    base = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return Path(base) / "upright" / "kernels"


def _generator() -> str:
    """Changes with any change of the code that generates."""
    here = Path(__file__).parent
    sources = [here / name for name in ("codegen.py", "equations.py", "expressions.py", "kernel_loops.py")]
    return hashlib.sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()


def _module(name: str, model: Model, progress: Progress) -> ModuleType:
    path = cache_directory() / f"{name}.py"
    if not path.exists():
        progress(f"model {model.name}: deriving its equations")
        from models.codegen import generate

        path = _keep(path, generate(model))
        progress(f"model {model.name}: compiling")
    spec = importlib.util.spec_from_file_location(f"upright_kernels.{name}", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def _keep(path: Path, source: str) -> Path:
    """Write `source` whole or not at all; where the cache cannot be written, into a directory for this process."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile("w", dir=path.parent, suffix=".tmp", delete=False) as file:
            file.write(source)
        os.replace(file.name, path)
    except OSError:
        path = Path(tempfile.mkdtemp(prefix="upright-kernels-")) / path.name
        path.write_text(source)
    return path
