"""The two-wheeled balancing robot from its energies: derivation of the equations of vehicles.twsbr.model.

Coordinates (rad): angles theta of the left and the right wheel relative to the floor, and of the body from upright, all
positive forward. x forward, y left, z up; the body's centre of mass is `com_height` above the axle. The wheels roll
without slip, so with the mean wheel rate s' / wheel_radius the axle's middle moves by

    x' = s' cos(heading),  y' = s' sin(heading),  heading' = wheel_radius (right' - left') / wheel_distance.

The heading can be integrated, x and y cannot. Putting x' and y' into the energies before Lagrange's derivatives are
taken, as the paper does, omits the effect of a turn on a centre of mass beside the axle (the centrifugal force
body_mass com_height sin(tilt) heading'^2, and its counterpart about the vertical; neither does work). Lagrange's
equations are therefore set up with x and y and then projected on the motions that rolling allows (Maggi):

    q' = B rates,  B^T (d/dt dL/dq' - dL/dq) = forces,  that is  M rates' + V = forces.

Source: Hassan, Moustafa, Moness, equations (1) to (20), with z_b = z_m + l cos(theta_3), the dots that were lost in
(11) and (20), and the projection; Maggi: Papastavridis, Analytical Mechanics (2002), section 3.5.
"""

from __future__ import annotations

from dataclasses import dataclass

import sympy

GRAVITY = sympy.Symbol("gravity", positive=True)


@dataclass(frozen=True, slots=True)
class Derivation:
    """mass rates' + bias = forces, for the wheels' and the body's rates; `energy` is kinetic and potential, J.

    Symbols have the names of the model's parameters, and `angles`, `rates` (rad, rad/s), `voltages` (V) are (left,
    right, tilt) and (left, right). `forces` are those of motors and friction, N m; gravity is in `bias`.
    """

    angles: tuple[sympy.Symbol, ...]
    rates: tuple[sympy.Symbol, ...]
    voltages: tuple[sympy.Symbol, ...]
    lagrangian: sympy.Expr
    energy: sympy.Expr
    mass: sympy.Matrix
    bias: sympy.Matrix
    forces: sympy.Matrix


def symbol(name: str) -> sympy.Symbol:
    """A parameter of the robot."""
    return sympy.Symbol(name, positive=True)


def derive() -> Derivation:
    """The equations of motion, from the energies. Takes a second or two."""
    r, d, height = map(symbol, ("wheel_radius", "wheel_distance", "com_height"))
    wheel_mass, body_mass = map(symbol, ("wheel_mass", "body_mass"))
    yaw_inertia, tilt_inertia = map(symbol, ("yaw_inertia", "tilt_inertia"))
    rotor = symbol("gear_ratio") ** 2 * symbol("rotor_inertia")

    x, y, left, right, tilt = q = sympy.symbols("x y left right tilt", real=True)
    x_dot, y_dot, left_dot, right_dot, tilt_dot = q_dot = sympy.symbols("x' y' left' right' tilt'", real=True)
    heading = r * (right - left) / d

    def rate(expression: sympy.Expr) -> sympy.Expr:
        return sympy.Add(*(expression.diff(each) * dot for each, dot in zip(q, q_dot, strict=True)))

    def speed_squared(*position: sympy.Expr) -> sympy.Expr:
        return sympy.Add(*(rate(each) ** 2 for each in position))

    # Equations (5) to (9) of the paper: positions of wheels and body, with the axle at the height r.
    side = sympy.Matrix([-sympy.sin(heading), sympy.cos(heading)]) * d / 2
    left_wheel, right_wheel = (x + side[0], y + side[1]), (x - side[0], y - side[1])
    lean = height * sympy.sin(tilt)
    body = (x + lean * sympy.cos(heading), y + lean * sympy.sin(heading), r + height * sympy.cos(tilt))

    # (11) to (13); a wheel is a solid disc.
    disc = wheel_mass * r**2 / 2
    kinetic = (
        wheel_mass * (speed_squared(*left_wheel) + speed_squared(*right_wheel))
        + disc * (left_dot**2 + right_dot**2)
        + rotor * ((left_dot - tilt_dot) ** 2 + (right_dot - tilt_dot) ** 2)
        + body_mass * speed_squared(*body)
        + tilt_inertia * tilt_dot**2
        + yaw_inertia * rate(heading) ** 2
    ) / 2
    potential = GRAVITY * (2 * wheel_mass * r + body_mass * body[2])
    lagrangian = kinetic - potential

    # (3) and (4): motions that rolling allows.
    forward = r * (left_dot + right_dot) / 2
    rates = sympy.Matrix([left_dot, right_dot, tilt_dot])
    allowed = sympy.Matrix([forward * sympy.cos(heading), forward * sympy.sin(heading), *rates])
    directions = allowed.jacobian(rates)
    rolling = dict(zip((x_dot, y_dot), allowed[:2], strict=True))

    momentum = sympy.Matrix([lagrangian.diff(dot) for dot in q_dot])
    full_mass = momentum.jacobian(q_dot)
    full_bias = momentum.jacobian(q) * sympy.Matrix(q_dot) - sympy.Matrix([lagrangian.diff(each) for each in q])
    turning = directions.applyfunc(rate) * rates
    mass = directions.T * full_mass * directions
    bias = directions.T * (full_mass * turning + full_bias)

    # (12) to (14) with the current in steady state: R I = u - K n (theta' - tilt').
    gear, constant, resistance = map(symbol, ("gear_ratio", "motor_constant", "armature_resistance"))
    voltages = sympy.symbols("left_voltage right_voltage", real=True)
    slip = [left_dot - tilt_dot, right_dot - tilt_dot]
    currents = [(u - constant * gear * each) / resistance for u, each in zip(voltages, slip, strict=True)]
    gears = [
        gear * constant * current - symbol("motor_friction") * each
        for current, each in zip(currents, slip, strict=True)
    ]
    floor = symbol("wheel_friction")
    forces = [gears[0] - floor * left_dot, gears[1] - floor * right_dot, -gears[0] - gears[1]]

    def tidy(expression: sympy.Expr) -> sympy.Expr:
        """Take the heading along x: all directions on a level floor are equivalent."""
        expanded = sympy.expand(expression.subs(rolling).subs(right, left))
        return sympy.expand(expanded.subs(sympy.cos(tilt) ** 2, 1 - sympy.sin(tilt) ** 2))

    return Derivation(
        angles=(left, right, tilt),
        rates=(left_dot, right_dot, tilt_dot),
        voltages=voltages,
        lagrangian=lagrangian,
        energy=tidy(kinetic + potential),
        mass=mass.applyfunc(tidy),
        bias=bias.applyfunc(tidy),
        forces=sympy.Matrix(forces),
    )
