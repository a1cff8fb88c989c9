"""The random disturbance at the joints of a machine: wind, rail, cables and people push every real one.

    d' = -d / correlation_time + w,    std^2 = q^2 correlation_time / 2

is a first-order (Ornstein-Uhlenbeck) random force d beside a joint's load; w is white, of density q^2. It fades within
`correlation_time` s and has the RMS `std` in the long run. White process noise is its limit for short correlation
times, a drift that for long ones. Both numbers are estimated with the parameters, by maximum likelihood.
`disturbed` puts it into a model that is about to meet a record.

    x' = W v,    v' = -W x - 2 v / correlation_time + w,    W = 2 pi frequency,    std^2 = q^2 correlation_time / 4

is a second one, x, where evidence asks for it (diagnosis.random_parts): of a narrow band, as a mode of the body or rail
joints at constant speed make it. It swings about its frequency, within `correlation_time` s no longer in phase; its
damping ratio is 1 / (W correlation_time), and v has its RMS, too. Source: Gelb, "Applied optimal estimation" (1974),
section 3.8 (Gauss-Markov processes).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from models.expressions import names_in
from models.model import Disturbance, Joint, Model, NarrowBand, Parameter, State
from telemetry.recording import Recording

SMALL = 0.02
"""Share of a joint's typical force from which the estimation of its disturbance's RMS starts."""
SPREAD = 3.0
"""Standard deviation of the natural logarithm of that RMS: of a disturbance no more than the order of magnitude is
known before, and that to a factor of twenty."""
ROUGHLY = 10.0
"""Standard deviation of the correlation time before a record is seen, in multiples of where its estimation starts."""
LEAST_ROWS = 2.0
"""Rows of the shortest correlation time: what fades faster is white."""
LEAST_TIMES = 10.0
"""Correlation times that a record holds at least: of what fades more slowly it does not show that it is random, and
what only drifts is not."""
PREFIX = "disturbance_"
NARROW = "narrow_band_"
PERIODS = 1.0
"""For which a force of a narrow band swings on at least: what fades within one has no frequency of its own."""
MOST_DAMPED = 1.0 / (2.0 * math.pi * PERIODS)
"""Its damping ratio then."""


def state_of(joint: str) -> str:
    """Name of the state that is the disturbance at `joint`."""
    return f"{PREFIX}{joint}"


def time_of(joint: str) -> str:
    """Name of the parameter that is its correlation time, s."""
    return f"{PREFIX}{joint}_time"


def disturbed(model: Model, recordings: Sequence[Recording]) -> Model:
    """`model` with a disturbance at each joint that says so, for records as long and as fast as `recordings`; without
    any, as while a vehicle runs, for correlation times of a tenth to ten times of where their estimation starts.

    Where a joint has a random force of the model's own, a state that only noise drives, that is its disturbance.
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
    """`fitted`, which came of what `disturbed` made of `model`, without the disturbances: they are of a record."""
    own = {each.name for each in model.base_states}
    its = parameters_of([each for each in fitted.base_states if each.name not in own])
    joints = {each.name: each for each in model.joints}
    return replace(
        fitted,
        base_states=tuple(each for each in fitted.base_states if each.name in own),
        base_parameters=tuple(each for each in fitted.base_parameters if each.name not in its),
        joints=tuple(replace(each, load=joints[each.name].load) for each in fitted.joints),
    )


def undriven(model: Model) -> Model:
    """`model` with each of its disturbances held at zero, as states that nothing drives."""
    states = tuple(
        replace(each, process_noise=0.0, noise_known=True, initial_std=0.0) if each.correlation_time else each
        for each in model.base_states
    )
    its = parameters_of(model.base_states)
    parameters = tuple(replace(p, estimated=False) if p.name in its else p for p in model.base_parameters)
    return replace(model, base_states=states, base_parameters=parameters)


def _has_own(model: Model, joint: Joint) -> bool:
    """Whether a state of the model that nothing but noise drives pushes at `joint`, as a disturbance that is there."""
    parameters, pushing = {each.name for each in model.base_parameters}, _pushing(model, joint)
    return any(
        state.process_noise > 0.0 and names_in(state.derivative) <= {state.name, *parameters}
        for state in model.base_states
        if state.name in pushing
    )


def at_joints(model: Model) -> list[tuple[Joint, int]]:
    """Each joint of `model` with the place of the state that is its disturbance, those that have one."""
    return _at_joints(model, narrow=False)


def narrow_at_joints(model: Model) -> list[tuple[Joint, int]]:
    """The same of the disturbances of a narrow band."""
    return _at_joints(model, narrow=True)


def narrow_count(model: Model) -> int:
    """Numbers that tell those: RMS, frequency and correlation time of each."""
    return 3 * len(narrow_at_joints(model))


def _at_joints(model: Model, *, narrow: bool) -> list[tuple[Joint, int]]:
    shaken = [
        (place, state.name)
        for place, state in enumerate(model.base_states)
        if state.correlation_time and bool(state.frequency) is narrow
    ]
    return [(joint, place) for joint in model.joints for place, name in shaken if name in _pushing(model, joint)]


def parameters_of(states: Iterable[State]) -> frozenset[str]:
    """Names of the parameters of those of `states` that are a disturbance: times and frequencies."""
    return frozenset(name for each in states for name in (each.correlation_time, each.frequency) if name)


def power_share(state: State) -> float:
    """Variance of a disturbance in the long run, in its q^2 correlation_time."""
    return 0.25 if state.frequency else 0.5


def with_narrow_band(model: Model, at: str, known: NarrowBand, longest: float) -> Model:
    """`model` with a random force of a narrow band at the joint `at`, for a record of `longest` s, or, where that is 0,
    for one that goes on."""
    joint = next(each for each in model.joints if each.name == at)
    name, frequency = f"{NARROW}{at}", known.frequency
    lead, about, time = f"{name}_lead", f"{name}_frequency", f"{name}_time"
    shortest = PERIODS / frequency
    stated = MOST_DAMPED * shortest / known.damping_ratio if known.damping_ratio else 0.0
    most = max(longest / LEAST_TIMES if longest else stated * LEAST_TIMES, 2.0 * shortest)
    lasting, std = min(stated, most) or math.sqrt(shortest * most), known.std or SMALL * joint.force_scale
    turn = f"{2.0 * math.pi!r} * {about}"
    swinging = State(
        name=name,
        unit=joint.force_unit,
        derivative=f"{turn} * {lead}",
        initial_std=std,
        correlation_time=time,
        frequency=about,
        driven_by=lead,
        meaning=f"random force of a narrow band at {joint.name}",
    )
    leading = replace(
        swinging,
        name=lead,
        derivative=f"-{turn} * {name} - 2.0 * {lead} / {time}",
        process_noise=2.0 * std / math.sqrt(lasting),
        noise_spread=SPREAD,
        driven_by="",
        meaning="the same, a quarter of a period ahead",
    )
    parameters = (
        Parameter(about, "Hz", frequency, std=frequency, lower=0.0, meaning=f"about which {name} swings"),
        Parameter(
            time, "s", lasting, std=ROUGHLY * lasting, lower=shortest, upper=most, meaning=f"for which {name} swings on"
        ),
    )
    joints = tuple(replace(each, load=f"{each.load} + {name}") if each is joint else each for each in model.joints)
    return replace(
        model,
        base_states=(*model.base_states, swinging, leading),
        base_parameters=(*model.base_parameters, *parameters),
        joints=joints,
    )


def _pushing(model: Model, joint: Joint) -> set[str]:
    """All names that the load at `joint` is made of, those behind definitions, too."""
    names = set(names_in(joint.load))
    for name in reversed(list(model.definitions)):  # each uses those above it
        names |= names_in(model.definitions[name]) if name in names else set()
    return names


def _with(model: Model, joint: Joint, known: Disturbance, step: float, longest: float) -> Model:
    time = known.correlation_time or joint.coordinate_scale / joint.rate_scale
    shortest = max(known.shortest, LEAST_ROWS * step if step else time / LEAST_TIMES)
    most = max(min(known.longest, longest / LEAST_TIMES if longest else time * LEAST_TIMES), 2.0 * shortest)
    time = time if known.known else float(np.clip(time, shortest, most))
    std = known.std or SMALL * joint.force_scale
    state = State(
        name=state_of(joint.name),
        unit=joint.force_unit,
        derivative=f"-{state_of(joint.name)} / {time_of(joint.name)}",
        initial_std=std,
        process_noise=std * math.sqrt(2.0 / time),
        noise_known=known.known,
        noise_spread=SPREAD,
        correlation_time=time_of(joint.name),
        meaning=f"random force at {joint.name}",
    )
    parameter = Parameter(
        name=time_of(joint.name),
        unit="s",
        value=time,
        std=0.0 if known.known else ROUGHLY * time,
        lower=0.0 if known.known else shortest,
        upper=math.inf if known.known else most,
        estimated=not known.known,
        meaning=f"correlation time of the disturbance at {joint.name}",
    )
    load = f"{joint.load} + {state.name}"
    joints = tuple(replace(each, load=load) if each is joint else each for each in model.joints)
    return replace(
        model,
        base_states=(*model.base_states, state),
        base_parameters=(*model.base_parameters, parameter),
        joints=joints,
    )
