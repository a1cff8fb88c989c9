"""Machine code checks no sizes: a pass must not write beyond any array that it is given, whatever the model."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from upright.models import library
from upright.models.compiler.kernel import compile_model
from upright.models.effects.catalogue import CATALOGUE
from upright.models.model import Model
from upright.models.parts import ModelError
from upright.models.segment import Segment

GUARD = 64
"""Number of elements behind every array that must not change."""
UNTOUCHED = 77.0


class Guarded:
    """Replaces numpy in models.compiler.kernel: every array that it allocates has a guard behind it."""

    def __init__(self) -> None:
        self.guards: list[np.ndarray] = []

    def __getattr__(self, name: str) -> object:
        return getattr(np, name)

    def zeros(self, shape: int | tuple[int, ...], dtype: type = float) -> np.ndarray:
        size = int(np.prod(shape))
        whole = np.zeros(size + GUARD, dtype=dtype)
        whole[size:] = UNTOUCHED
        self.guards.append(whole[size:])
        return whole[:size].reshape(shape)

    def intact(self) -> bool:
        return all((guard == UNTOUCHED).all() for guard in self.guards)


def models() -> Iterator[Model]:
    for model in library.MODELS.values():
        yield model
        whole = model
        for name in CATALOGUE:
            try:
                whole = whole.add(name)
            except ModelError:  # the model has no place for it
                continue
        yield whole


@pytest.mark.timeout(600)  # each structure is compiled once per computer
@pytest.mark.parametrize("model", list(models()), ids=lambda model: f"{model.name}+{len(model.effects)}")
def test_no_pass_writes_beyond_its_arrays(model: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    kernel = compile_model(model)
    states, outputs, parameters = len(kernel.states), len(kernel.outputs), len(kernel.parameters)
    columns = parameters + states * (1 + outputs)
    random = np.random.default_rng(6)
    for rows in (2, 3, 40):
        time = 0.004 * np.arange(rows)
        segment = Segment(
            time,
            np.ascontiguousarray(time[:, None] - 0.004 * random.random(len(kernel.inputs))),
            0.01 * random.standard_normal((rows, len(kernel.inputs))),
            1e-3 * random.standard_normal((rows, outputs)),
        )
        gain = 1e-2 * random.standard_normal((states, outputs))
        for count in (0, 1, 3, 4, 5, columns):
            numpy = Guarded()
            monkeypatch.setattr("upright.models.compiler.kernel.np", numpy)
            active = random.permutation(columns)[:count].tolist()
            memory = kernel.memory(numpy.zeros((states,)), active)
            predicted, sensitivity = numpy.zeros((rows, outputs)), numpy.zeros((rows, outputs, len(active)))
            for substeps in (1, 3):
                kernel.proceed(
                    segment, kernel.vector(), memory, gain, active, predicted, sensitivity, substeps=substeps
                )
            assert numpy.guards
            assert numpy.intact()
