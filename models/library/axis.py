"""One axis that a known force or torque drives: the minimal model, to which effects are added.

    inertia * rate' = force

Rename its channels with `axis(...)`: a carriage has `position` in m and a force in N, a pendulum an angle in rad and a
motor voltage in V, with `force_gain` in N m/V.
"""

from __future__ import annotations

from upright.models.model import Model
from upright.models.parts import Actuator, Disturbance, Hold, Input, Joint, Output, Parameter, Sensor, State


def axis(
    *,
    name: str = "axis",
    position: str = "position",
    position_unit: str = "m",
    rate: str = "rate",
    rate_unit: str = "m/s",
    force: str = "force",
    force_unit: str = "N",
    inertia_unit: str = "kg",
    inertia: float = 1.0,
    force_gain: float = 1.0,
    force_gain_unit: str = "1",
    hold: Hold = Hold.ZERO_ORDER,
    rate_measured: bool = False,
    load: str = "",
    more_parameters: tuple[Parameter, ...] = (),
    position_noise: float = 1e-4,
    rate_noise: float = 1e-3,
    process_noise: float = 0.0,
    force_scale: float = 10.0,
    position_scale: float = 0.1,
    rate_scale: float = 0.1,
    smooth_rate: float = 1e-3,
    disturbance: Disturbance | None = Disturbance(),  # noqa: B008  # frozen
) -> Model:
    """An axis with its own channel names, units and scales. `load` is a further known force, an expression.

    `process_noise` is in rate units/sqrt(s); `disturbance` is that of a joint. The position is measured, the rate only
    if `rate_measured`.
    """
    outputs: tuple[Output, ...] = (Output(position, position_unit, position, position_noise),)
    if rate_measured:
        outputs += (Output(rate, rate_unit, rate, rate_noise),)
    pushed = f"force_gain * {force}"
    return Model(
        name=name,
        title="one axis: inertia and a known force",
        base_states=(
            State(position, position_unit, rate, initial=position, initial_std=10.0 * position_noise),
            State(
                rate,
                rate_unit,
                "axis_force / inertia",
                initial=rate if rate_measured else "0",
                initial_std=10.0 * rate_noise if rate_measured else rate_scale,
                process_noise=process_noise,
            ),
        ),
        inputs=(Input(force, "1" if force_gain_unit != "1" else force_unit, hold),),
        outputs=outputs,
        base_parameters=(
            Parameter("inertia", inertia_unit, inertia, lower=0.0, scale=inertia, meaning="resistance to acceleration"),
            Parameter(
                "force_gain", force_gain_unit, force_gain, estimated=False, meaning="force per unit of the input"
            ),
            *more_parameters,
        ),
        joints=(
            Joint(
                name="axis",
                coordinate=position,
                rate=rate,
                inertia="inertia",
                load=f"{pushed} + ({load})" if load else pushed,
                force_unit=force_unit,
                coordinate_unit=position_unit,
                force_scale=force_scale,
                coordinate_scale=position_scale,
                rate_scale=rate_scale,
                smooth_rate=smooth_rate,
                disturbance=disturbance,
            ),
        ),
        actuators=(
            Actuator(
                name="drive",
                command=force,
                joint="axis",
                rate_unit=force_unit,
                angle_unit=position_unit,
                command_scale=force_scale / force_gain,
            ),
        ),
        sensors=(
            Sensor(
                name="encoder",
                angle=position,
                rate=rate if rate_measured else "",
                angle_unit=position_unit,
                rate_unit=rate_unit,
                angle_scale=position_scale,
                rate_scale=rate_scale,
            ),
        ),
    )


AXIS = axis()
