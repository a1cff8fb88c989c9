"""A measured input with white noise that does not act on the plant: the current of a motor that is passive.

    u_acting = u - share (u - usual),    usual' = (u - usual) / time

`usual` is the filtered reading. With `share` 1 it acts, with 0 the reading itself acts. diagnosis.fits.input_noise
decides whether a record requires such noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from upright.models.model import Model
from upright.models.parts import Parameter, State
from upright.models.text.expressions import names_in, renamed

SHARE = "noise_share_"
USUAL = "usual_"
BEGIN = 0.5
"""Start of the estimation of the share."""


@dataclass(frozen=True, slots=True)
class InputNoise:
    """White noise of the input `name`: `std` of a reading, and the filter that separates it from the signal: its time
    constant `time`, s, its initial value `level`, and the standard deviation of that, `spread`."""

    name: str
    std: float
    time: float
    level: float
    spread: float


def with_input_noise(model: Model, noise: InputNoise) -> Model:
    """`model` in which a share of the `noise` of an input does not act, to be estimated."""
    shown = next(each for each in model.inputs if each.name == noise.name)
    name, share, usual = shown.name, f"{SHARE}{shown.name}", f"{USUAL}{shown.name}"
    acting = {name: f"{name} - {share} * ({name} - {usual})"}
    state = State(
        name=usual,
        unit=shown.unit,
        derivative=f"({name} - {usual}) / {noise.time!r}",
        initial=repr(noise.level),
        initial_std=noise.spread,
        meaning=f"{name} without the white noise of its readings",
    )
    parameter = Parameter(
        share, "1", BEGIN, lower=0.0, upper=1.0, meaning=f"share of the noise of {name} that does not act"
    )
    states = (replace(each, derivative=renamed(each.derivative, acting)) for each in model.base_states)
    return replace(
        model,
        base_states=(*states, state),
        base_parameters=(*model.base_parameters, parameter),
        definitions={each: renamed(text, acting) for each, text in model.definitions.items()},
        joints=tuple(replace(each, load=renamed(each.load, acting)) for each in model.joints),
    )


def noisy_inputs(model: Model) -> tuple[str, ...]:
    """The names of the inputs of `model` with a share of noise that does not act."""
    shares = {each.name for each in model.base_parameters}
    return tuple(each.name for each in model.inputs if f"{SHARE}{each.name}" in shares)


def without_input_noise(model: Model, fitted: Model) -> Model:
    """`fitted`, a fit of `model`, with inputs that act as measured: their noise belongs to a record."""
    noisy = noisy_inputs(fitted)
    if not noisy:
        return fitted
    shares, usual = {f"{SHARE}{each}" for each in noisy}, {f"{USUAL}{each}" for each in noisy}
    own = {each.name: each for each in model.base_states}
    joints = {each.name: each for each in model.joints}
    return replace(
        fitted,
        base_states=tuple(
            replace(each, derivative=own[each.name].derivative) if names_in(each.derivative) & shares else each
            for each in fitted.base_states
            if each.name not in usual
        ),
        base_parameters=tuple(each for each in fitted.base_parameters if each.name not in shares),
        definitions=dict(model.definitions),
        joints=tuple(replace(each, load=joints[each.name].load) for each in fitted.joints),
    )
