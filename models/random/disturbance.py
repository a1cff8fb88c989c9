"""The random disturbance at the joints of a machine: wind, rail, cables and people act on every real one.

A first-order random force (models.random.part) is added to a joint's load; white process noise is its limit for short
correlation times, a drift that for long ones. Its RMS and correlation time are estimated with the parameters, by
maximum likelihood. `disturbed` adds it to a model before this is fitted to a record.

A second, narrow-band force is added if the evidence requires it (diagnosis.fits.random_parts) or the model states it.
It is caused by a mode of the body, or by rail joints at constant speed.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from upright.models.model import Model
from upright.models.parts import Disturbance, Joint, NarrowBand, State
from upright.models.random.part import LEAST_ROWS, LEAST_TIMES, RandomPart, first_order, narrow_band
from upright.models.text.expressions import names_in
from upright.telemetry.recording import Recording

SMALL = 0.02
"""Share of a joint's typical force from which the estimation of its disturbance's RMS starts."""
PREFIX = "disturbance_"
NARROW = "narrow_band_"


def state_of(joint: str) -> str:
    """Name of the state that is the disturbance at `joint`."""
    return f"{PREFIX}{joint}"


def time_of(joint: str) -> str:
    """Name of the parameter that is its correlation time, s."""
    return f"{PREFIX}{joint}_time"


def disturbed(model: Model, recordings: Sequence[Recording]) -> Model:
    """`model` with a disturbance at each joint that states one, for records as long and as fast as `recordings`.

    Without any recordings, as while a vehicle runs, the correlation times are bounded to a tenth to ten times the start
    of their estimation. If the model has a random force of its own at a joint, a state that only noise drives, that is
    the disturbance of the joint.
    """
    times = [each.timestamp_ns for each in recordings if len(each.timestamp_ns) > 1]
    steps = [float(np.median(np.diff(each))) * 1e-9 for each in times]
    longest = max((float(each[-1] - each[0]) * 1e-9 for each in times), default=0.0)
    for joint in model.joints:
        if joint.disturbance is not None and not _has_own(model, joint):
            model = _with(model, joint, joint.disturbance, max(steps, default=0.0), longest)
            if joint.disturbance.narrow_band:
                model = with_narrow_band(model, joint.name, joint.disturbance.narrow_band, longest)
    return model


def undisturbed(model: Model, fitted: Model) -> Model:
    """`fitted`, a fit of `disturbed(model)`, without the disturbances and without the random errors of sensors: these
    belong to a record."""
    own = {each.name: each for each in model.base_states}
    its = parameters_of([each for each in fitted.base_states if each.name not in own])
    joints = {each.name: each for each in model.joints}
    outputs = {each.name: each for each in model.outputs}
    return replace(
        fitted,
        # An error of a sensor occurs only in the states that integrate its noise.
        base_states=tuple(
            replace(each, derivative=own[each.name].derivative) if each.noise_of else each
            for each in fitted.base_states
            if each.name in own
        ),
        outputs=tuple(replace(each, expression=outputs[each.name].expression) for each in fitted.outputs),
        base_parameters=tuple(each for each in fitted.base_parameters if each.name not in its),
        joints=tuple(replace(each, load=joints[each.name].load) for each in fitted.joints),
    )


def with_zero_disturbances(model: Model) -> Model:
    """`model` with each of its disturbances held at zero, as states that nothing drives."""
    places = {place for _, place in (*at_joints(model), *narrow_at_joints(model))}
    names = {name for place in places for name in (model.base_states[place].name, model.base_states[place].driven_by)}
    states = tuple(
        replace(each, process_noise=0.0, noise_known=True, initial_std=0.0) if each.name in names else each
        for each in model.base_states
    )
    its = parameters_of([each for each in model.base_states if each.name in names])
    parameters = tuple(replace(p, estimated=False) if p.name in its else p for p in model.base_parameters)
    return replace(model, base_states=states, base_parameters=parameters)


def _has_own(model: Model, joint: Joint) -> bool:
    """Whether a state that only noise drives acts at `joint`: a disturbance that the model has already."""
    parameters, in_load = {each.name for each in model.base_parameters}, _names_in_load(model, joint)
    return any(
        state.process_noise > 0.0 and names_in(state.derivative) <= {state.name, *parameters}
        for state in model.base_states
        if state.name in in_load
    )


def at_joints(model: Model) -> list[tuple[Joint, int]]:
    """Each joint of `model` that has a disturbance, with the index of the state that is the disturbance."""
    return _at_joints(model, narrow=False)


def narrow_at_joints(model: Model) -> list[tuple[Joint, int]]:
    """The same for the narrow-band disturbances."""
    return _at_joints(model, narrow=True)


def _at_joints(model: Model, *, narrow: bool) -> list[tuple[Joint, int]]:
    disturbances = [
        (place, state.name)
        for place, state in enumerate(model.base_states)
        if state.correlation_time and bool(state.frequency) is narrow
    ]
    return [
        (joint, place) for joint in model.joints for place, name in disturbances if name in _names_in_load(model, joint)
    ]


def parameters_of(states: Iterable[State]) -> frozenset[str]:
    """Names of the parameters of the disturbances among `states`: correlation times and frequencies."""
    return frozenset(name for each in states for name in (each.correlation_time, each.frequency) if name)


def power_share(state: State) -> float:
    """Stationary variance of a disturbance, over its q^2 correlation_time."""
    return 0.25 if state.frequency else 0.5


def with_narrow_band(model: Model, at: str, known: NarrowBand, longest: float) -> Model:
    """`model` with a narrow-band random force at the joint `at`, for a record of `longest` s, or for one that goes on
    if that is 0."""
    joint = next(each for each in model.joints if each.name == at)
    known = known if known.std else replace(known, std=SMALL * joint.force_scale)
    meaning = f"narrow-band random force at {at}"
    return _with_part(model, joint, narrow_band(f"{NARROW}{at}", joint.force_unit, meaning, known, longest))


def _names_in_load(model: Model, joint: Joint) -> set[str]:
    """All names that the load at `joint` uses, directly or through definitions."""
    names = set(names_in(joint.load))
    for name in reversed(list(model.definitions)):  # each uses those above it
        names |= names_in(model.definitions[name]) if name in names else set()
    return names


def _with(model: Model, joint: Joint, known: Disturbance, step: float, longest: float) -> Model:
    time = known.correlation_time or joint.coordinate_scale / joint.rate_scale
    shortest = max(known.shortest, LEAST_ROWS * step if step else time / LEAST_TIMES)
    most = max(min(known.longest, longest / LEAST_TIMES if longest else time * LEAST_TIMES), 2.0 * shortest)
    time = time if known.known else float(np.clip(time, shortest, most))
    bounds = None if known.known else (shortest, most)
    name, meaning = state_of(joint.name), f"random force at {joint.name}"
    std = known.std or SMALL * joint.force_scale
    return _with_part(model, joint, first_order(name, joint.force_unit, meaning, std, time, bounds))


def _with_part(model: Model, joint: Joint, part: RandomPart) -> Model:
    load = f"{joint.load} + {part.shown}"
    joints = tuple(replace(each, load=load) if each is joint else each for each in model.joints)
    return replace(
        model,
        base_states=(*model.base_states, *part.states),
        base_parameters=(*model.base_parameters, *part.parameters),
        joints=joints,
    )
