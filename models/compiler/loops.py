"""The loops of every compiled model: one pass over a segment of data, with all sensitivities.

Classical Runge-Kutta of order four on states and variational equations: discretise, then differentiate, so the
sensitivities are those of the returned numbers. A step is cut where a held input changes; a delay shifts that instant
and thereby the ends of two pieces, which is how a delay gets its derivative. A measured input is read as a curve
through its samples: with three evaluations per step, straight lines would lose a corner within the step if an input is
sampled a fraction of a sampling interval before. Behind a first-order lag it is the straight line that has the mean and
the first moment of the exact response to a straight line over each piece, and is exactly neutral at lag 0. A lag of a
held input remembers the value held before the first sample.

numba translates this file once per computer, not once per model: sizes are arguments and a model's equations
(models.compiler.codegen) are called by address. Arrays are bare pointers, row by row; nothing is allocated and nothing
can raise. models.compiler.kernel, the only caller, checks the sizes.
"""

# mypy: ignore-errors

from __future__ import annotations

import math

from llvmlite import ir
from numba import cfunc, config, njit, types
from numba.extending import intrinsic

from upright.models.compiler.machine_code import lanes

NUMBER, INTEGER = types.float64, types.int64
NUMBERS, INTEGERS = types.CPointer(NUMBER), types.CPointer(INTEGER)
OPTIONS = {"error_model": "numpy", "fastmath": {"contract"}}
INLINE = {**OPTIONS, "forceinline": True}
LANES = lanes()


def _call(builder, context, values):
    """Call the function whose address is values[0] with the others."""
    kind = ir.FunctionType(ir.VoidType(), [value.type for value in values[1:]])
    builder.call(builder.inttoptr(values[0], kind.as_pointer()), values[1:])
    return context.get_dummy_value()


@intrinsic
def _prepare(typing, address, p, constants):
    """constants = the expressions of parameters alone."""
    return types.void(INTEGER, NUMBERS, NUMBERS), lambda context, builder, _, values: _call(builder, context, values)


@intrinsic
def _equations(typing, address, t, x, u, slope, p, constants, column, width, derive, result, A, B, G, T):
    """result, and if `derive` its derivatives by state, active parameter (its `column`), input and time."""
    kinds = (INTEGER, NUMBER, *[NUMBERS] * 5, INTEGERS, INTEGER, INTEGER, *[NUMBERS] * 5)
    return types.void(*kinds), lambda context, builder, _, values: _call(builder, context, values)


@intrinsic
def _stage(typing, address, width, A, B, S, stage_S, total_S, ahead, weight):
    """The sensitivities' part of a stage: begin, middle or finish of models.compiler.column_code."""
    kinds = (INTEGER, INTEGER, *[NUMBERS] * 5, NUMBER, NUMBER)
    return types.void(*kinds), lambda context, builder, _, values: _call(builder, context, values)


@intrinsic
def _show(typing, address, width, C, D, S, shown):
    """shown = D + C S"""
    return types.void(INTEGER, INTEGER, *[NUMBERS] * 4), lambda context, builder, _, v: _call(builder, context, v)


@intrinsic
def _correct(typing, address, width, first, second, S):
    """correct or steer of models.compiler.column_code."""
    return types.void(INTEGER, INTEGER, *[NUMBERS] * 3), lambda context, builder, _, v: _call(builder, context, v)


@intrinsic
def _at(typing, pointer, offset):
    """The pointer to pointer[offset]."""
    return pointer(pointer, INTEGER), lambda context, builder, _, values: builder.gep(values[0], [values[1]])


@njit(**INLINE)
def _curve(i, when, left, samples, NU, knots, u, pointer, curve, slope):
    """Input i at an instant, on the cubic through two samples; `left`: where two cubics meet, take the earlier one.

    Its slope at a sample is that of the parabola through the sample and its neighbours, at either end that to the only
    neighbour; beyond the ends the input is constant. slope[i] and slope[NU + i] become its first two derivatives at the
    instant. `curve` (NU, 7) is the cubic found last: its begin and end, the instant that it is expanded about, and its
    coefficients.
    """
    mine = 7 * i
    if not (curve[mine] <= when and (when < curve[mine + 1] or (left and when == curve[mine + 1]))):
        j = pointer[i]
        while j > 0 and knots[j * NU + i] > when:
            j -= 1
        while j < samples - 1 and (knots[(j + 1) * NU + i] < when or (not left and knots[(j + 1) * NU + i] == when)):
            j += 1
        pointer[i] = j
        knot = knots[j * NU + i]
        curve[mine + 2], curve[mine + 3] = knot, u[j * NU + i]
        curve[mine + 4], curve[mine + 5], curve[mine + 6] = 0.0, 0.0, 0.0
        if when < knot or (left and when == knot and j == 0):  # before the first sample
            curve[mine], curve[mine + 1] = -math.inf, knot
        elif j == samples - 1:
            curve[mine], curve[mine + 1] = knot, math.inf
        else:
            h = knots[(j + 1) * NU + i] - knot
            chord = (u[(j + 1) * NU + i] - u[j * NU + i]) / h
            begin, end = chord, chord
            if j > 0 and knots[(j - 1) * NU + i] < knot:
                before = knot - knots[(j - 1) * NU + i]
                begin = (h * (u[j * NU + i] - u[(j - 1) * NU + i]) / before + before * chord) / (h + before)
            if j < samples - 2 and knots[(j + 2) * NU + i] > knot + h:
                after = knots[(j + 2) * NU + i] - knots[(j + 1) * NU + i]
                end = (h * (u[(j + 2) * NU + i] - u[(j + 1) * NU + i]) / after + after * chord) / (h + after)
            curve[mine], curve[mine + 1] = knot, knot + h
            curve[mine + 4] = begin
            curve[mine + 5] = (3.0 * chord - 2.0 * begin - end) / h
            curve[mine + 6] = (begin + end - 2.0 * chord) / (h * h)
    since = when - curve[mine + 2]
    first, second, third = curve[mine + 4], curve[mine + 5], curve[mine + 6]
    slope[i] = first + since * (2.0 * second + 3.0 * third * since)
    slope[NU + i] = 2.0 * second + 6.0 * third * since
    return curve[mine + 3] + since * (first + since * (second + since * third))


@njit(**INLINE)
def _climb(row, i, NU, by_input, slope):
    """Time derivative, due to input i and its slope, of the quantity in this row of `by_input` (rows, 2 NU)."""
    mine = 2 * NU * row + i
    return by_input[mine] * slope[i] + by_input[mine + NU] * slope[NU + i]


@njit(**INLINE)
def _hold(i, h, tau, held, own, na, width, memory, memory_S):
    """Advances a lag's memory by h, with the input `held`. Column `own` is tau's; no other changes the input."""
    decay = math.exp(-h / tau) if tau > 0.0 else 0.0
    for c in range(na):
        memory_S[i * width + c] *= decay
    if own >= 0 and tau > 0.0:
        memory_S[i * width + own] += (memory[i] - held) * decay * h / (tau * tau)
    memory[i] = held + (memory[i] - held) * decay


@njit(**INLINE)
def _tilt(x):
    """The rise of a lag's response over h = x tau per unit of its initial distance above the input, and its slope.

    For the straight line with the response's mean and first moment: 12 (1 - e) / x^2 - 6 (1 + e) / x, e = exp(-x).
    """
    if x < 0.01:
        return x * (-1.0 + x * (0.5 - 0.15 * x)), -1.0 + x * (1.0 - 0.45 * x)
    e = math.exp(-x)
    return (
        (12.0 * (1.0 - e) / x - 6.0 * (1.0 + e)) / x,
        (12.0 * e - 24.0 * (1.0 - e) / x + 6.0 * e * x + 6.0 * (1.0 + e)) / (x * x),
    )


@njit(**INLINE)
def _lagged(i, h, tau, start, end, moved, own, na, width, memory, memory_S, begin_S, end_S, h_S, mean_S, tilt, tilt_S):
    """The mean over h of what a lag adds to a straight line from `start` to `end`; advances the lag's memory.

    tilt[i] becomes the rise of that over h: the lag's response is taken to be a straight line. The line's ends have
    derivatives `begin_S` and `end_S`, h has `h_S` if `moved`, and column `own` is tau's.
    """
    gone, over, rise, rise_slope = 1.0, 0.0, 0.0, 0.0
    if tau > 0.0:
        gone = -math.expm1(-h / tau)
        over = (1.0 - gone) / tau
        rise, rise_slope = _tilt(h / tau)
        rise_slope /= tau
    decay = 1.0 - gone
    share = tau / h * gone
    chord = (end - start) / h
    gap = memory[i] - start + chord * tau
    for c in range(na):
        longer = h_S[c] if moved else 0.0
        chord_c = (end_S[c] - begin_S[c] - chord * longer) / h
        gap_c = memory_S[i * width + c] - begin_S[c] + chord_c * tau
        mean_c = gap_c * share - chord_c * tau + gap * (decay - share) / h * longer
        end_c = end_S[c] - chord_c * tau + gap_c * decay - gap * over * longer
        tilt_c = gap_c * rise + gap * rise_slope * longer
        if c == own:
            mean_c += chord * share - chord + gap * (gone / h - over)
            end_c += chord * decay - chord + (gap * over * h / tau if tau > 0.0 else 0.0)
            # At lag 0 the derivative of the rise with respect to the lag is minus six times the gap over h.
            tilt_c += chord * rise - gap * (rise_slope * h / tau if tau > 0.0 else 6.0 / h)
        mean_S[i * width + c] = mean_c
        memory_S[i * width + c] = end_c
        tilt_S[i * width + c] = tilt_c
    memory[i] = end - chord * tau + gap * decay
    tilt[i] = gap * rise
    return gap * share - chord * tau


def run(
    functions,
    structure,
    samples,
    time,
    knots,
    u,
    y,
    p,
    na,
    active,
    gain,
    gain_S,
    x,
    given_S,
    memory,
    given_memory_S,
    pointer,
    first,
    last,
    substeps,
    skip,
    moving_gain,
    predicted,
    sensitivity,
    work,
    places,
):
    """Samples first to last: predict the outputs, correct the state by gain * (measured - predicted), integrate on.

    x, given_S (NX, na), memory, given_memory_S (NU, na) and pointer are continued, and left as they are after the
    correction at the last sample. `skip`: the first sample was predicted and corrected already. `active`: by column the
    parameter's number, or another number if the column is not a parameter; gain_S (NX * NY, na), used if `moving_gain`,
    are the gain's derivatives by the columns. `functions` are the addresses of models.compiler.kernel.FUNCTIONS,
    `structure` is that of models.compiler.codegen.Code; `work` and `places` are workspace, all zero.
    """
    prepare, slopes, observe = functions[0], functions[1], functions[2]
    begin_stage, middle_stage, finish_stage = functions[3], functions[4], functions[5]
    show, correct, steer = functions[6], functions[7], functions[8]
    NX, NU, NY, NP, ND, NC = structure[0], structure[1], structure[2], structure[3], structure[4], structure[5]
    drawn = _at(structure, 6)
    lag = _at(drawn, NU)
    delay_input = _at(lag, NU)
    delay_parameter = _at(delay_input, ND)
    driven = _at(delay_parameter, ND)  # the number of states that the inputs drive, then their indices
    width = (na + LANES - 1) // LANES * LANES
    derive = 1 if na > 0 else 0

    column = places
    moves = _at(places, NP)  # what active delays shift: input, column
    shifting = _at(moves, 2 * ND)  # the columns whose delays shift instants at which a step is cut
    lagged = _at(shifting, ND)
    B = work  # arrays with columns first, so that they are aligned to cache lines as `work` is
    D = _at(B, NX * width)
    shown = _at(D, NY * width)
    S = _at(shown, NY * width)
    total_S = _at(S, NX * width)
    stage_S = _at(total_S, NX * width)
    memory_S = _at(stage_S, NX * width)
    mean_S = _at(memory_S, NU * width)
    tilt_S = _at(mean_S, NU * width)
    later = _at(tilt_S, NU * width)
    h_S = _at(later, width)
    begin_S = _at(h_S, width)
    end_S = _at(begin_S, width)
    wide_gain_S = _at(end_S, width)
    constants = _at(wide_gain_S, NX * NY * width)
    delay = _at(constants, NC)
    f = _at(delay, NU)
    A = _at(f, NX)
    G = _at(A, NX * NX)
    T = _at(G, NX * 2 * NU)
    C = _at(T, NX)
    H = _at(C, NY * NX)
    error = _at(H, NY * 2 * NU)
    total = _at(error, NY)
    stage = _at(total, NX)
    value = _at(stage, NX)
    held = _at(value, NU)
    slope = _at(held, NU)
    shift = _at(slope, 2 * NU)
    curve = _at(shift, NU)
    tilt = _at(curve, 7 * NU)
    share = _at(tilt, NU)

    _prepare(prepare, p, constants)
    for i in range(NP):
        column[i] = -1
    for c in range(na):
        if 0 <= active[c] < NP:
            column[active[c]] = c
        for i in range(NX):
            S[i * width + c] = given_S[i * na + c]
        for i in range(NU):
            memory_S[i * width + c] = given_memory_S[i * na + c]
        if moving_gain:
            for i in range(NX * NY):
                wide_gain_S[i * width + c] = gain_S[i * na + c]
    correcting = moving_gain
    for i in range(NX * NY):
        correcting |= gain[i] != 0.0
    count, several = 0, 0
    curves, lagging = False, False
    for d in range(ND):
        delay[delay_input[d]] += p[delay_parameter[d]]
        if column[delay_parameter[d]] >= 0:
            moves[2 * count] = delay_input[d]
            moves[2 * count + 1] = column[delay_parameter[d]]
            count += 1
            if drawn[delay_input[d]]:
                curves = True
            else:
                shifting[several] = column[delay_parameter[d]]
                several += 1
                for q in range(several - 1):
                    if shifting[q] == shifting[several - 1]:
                        several -= 1
                        break
    for i in range(NU):
        if lag[i] >= 0 and (p[lag[i]] > 0.0 or column[lag[i]] >= 0):
            lagged[i] = 1
            lagging = True
        curve[7 * i], curve[7 * i + 1] = math.inf, -math.inf
    patched = derive and (curves or several > 0 or lagging)  # B gets more terms than those of the equations

    if not skip:
        for i in range(NU):
            pointer[i] = 0
            if drawn[i]:
                memory[i] = _curve(i, time[first] - delay[i], True, samples, NU, knots, u, pointer, curve, slope)
                for q in range(count):
                    if moves[2 * q] == i:
                        memory_S[i * width + moves[2 * q + 1]] -= slope[i]
            else:
                memory[i] = u[i]
                while pointer[i] < samples - 1 and knots[(pointer[i] + 1) * NU + i] + delay[i] < time[first]:
                    j = pointer[i] * NU + i
                    if lagged[i]:
                        _hold(i, knots[j + NU] - knots[j], p[lag[i]], u[j], column[lag[i]], na, width, memory, memory_S)
                    pointer[i] += 1
                j = pointer[i] * NU + i
                since = time[first] - delay[i] - knots[j]
                if lagged[i] and since > 0.0:
                    _hold(i, since, p[lag[i]], u[j], column[lag[i]], na, width, memory, memory_S)
                    for q in range(count):
                        if moves[2 * q] == i and p[lag[i]] > 0.0:
                            memory_S[i * width + moves[2 * q + 1]] -= (u[j] - memory[i]) / p[lag[i]]
                elif not lagged[i]:
                    memory[i] = u[j]

    for k in range(first, last + 1):
        if k > first or not skip:
            for i in range(NU):
                if drawn[i]:
                    value[i] = _curve(i, time[k] - delay[i], True, samples, NU, knots, u, pointer, curve, slope)
                else:
                    value[i] = u[pointer[i] * NU + i]
                if lagged[i]:
                    value[i] = memory[i]
            _equations(observe, time[k], x, value, slope, p, constants, column, width, derive, error, C, D, H, T)
            for j in range(NY):
                predicted[k * NY + j] = error[j]
                error[j] = y[k * NY + j] - error[j]
            if derive:
                _show(show, width, C, D, S, shown)
                for j in range(NY):
                    if lagging:
                        for i in range(NU):
                            if lagged[i]:
                                for c in range(na):
                                    shown[j * width + c] += H[2 * NU * j + i] * memory_S[i * width + c]
                    if curves:
                        for q in range(count):
                            i = moves[2 * q]
                            if lagged[i]:  # but its slope is not lagged
                                climb = H[2 * NU * j + NU + i] * slope[NU + i]
                            else:
                                climb = _climb(j, i, NU, H, slope)
                            shown[j * width + moves[2 * q + 1]] -= climb
                    for c in range(na):
                        sensitivity[(k * NY + j) * na + c] = shown[j * width + c]
            if correcting:
                for j in range(NY):
                    measured = math.isfinite(error[j])
                    if not measured:
                        error[j] = 0.0
                    for i in range(NX):
                        share[i * NY + j] = gain[i * NY + j] if measured else 0.0
                        x[i] += share[i * NY + j] * error[j]
                if derive:
                    _correct(correct, width, share, shown, S)
                    if moving_gain:
                        _correct(steer, width, wide_gain_S, error, S)
        if k == last:
            break
        begin = time[k]
        finish = time[k + 1]
        owner = -1
        while True:
            cut = finish
            following = -1
            for i in range(NU):
                if not drawn[i] and pointer[i] < samples - 1:
                    candidate = knots[(pointer[i] + 1) * NU + i] + delay[i]
                    if candidate < cut:
                        cut = candidate if candidate > begin else begin
                        following = i
            h = (cut - begin) / substeps
            moving = False
            if several > 0:
                for q in range(several):
                    h_S[shifting[q]] = 0.0
                    later[shifting[q]] = 0.0
                for q in range(count):
                    if moves[2 * q] == following:
                        h_S[moves[2 * q + 1]] += 1.0 / substeps
                        moving = True
                    if moves[2 * q] == owner:
                        h_S[moves[2 * q + 1]] -= 1.0 / substeps
                        later[moves[2 * q + 1]] += 1.0
                        moving = True
            for i in range(NU):
                if not drawn[i]:
                    held[i] = u[pointer[i] * NU + i]
            if moving and h <= 0.0:  # no time passes, but the state changes with the instant
                for i in range(NU):
                    value[i] = held[i]
                    if drawn[i]:
                        value[i] = _curve(i, begin - delay[i], False, samples, NU, knots, u, pointer, curve, slope)
                    if lagged[i] and p[lag[i]] > 0.0:
                        for q in range(several):
                            climb = (value[i] - memory[i]) / p[lag[i]]
                            memory_S[i * width + shifting[q]] += substeps * h_S[shifting[q]] * climb
                        value[i] = memory[i]
                _equations(slopes, begin, x, value, slope, p, constants, column, width, 0, f, A, B, G, T)
                for i in range(NX):
                    for q in range(several):
                        S[i * width + shifting[q]] += substeps * h_S[shifting[q]] * f[i]
            for step in range(substeps if h > 0.0 else 0):
                start = begin + step * h
                for i in range(NU):
                    value[i] = held[i]
                    if lagged[i]:
                        head = value[i]
                        tail = value[i]
                        for c in range(na):
                            begin_S[c] = 0.0
                            end_S[c] = 0.0
                        if drawn[i]:
                            head = _curve(i, start - delay[i], False, samples, NU, knots, u, pointer, curve, slope)
                            for q in range(count):
                                if moves[2 * q] == i:
                                    begin_S[moves[2 * q + 1]] -= slope[i]
                            if moving:
                                for q in range(several):
                                    begin_S[shifting[q]] += slope[i] * later[shifting[q]]
                            tail = _curve(i, start + h - delay[i], True, samples, NU, knots, u, pointer, curve, slope)
                            for q in range(count):
                                if moves[2 * q] == i:
                                    end_S[moves[2 * q + 1]] -= slope[i]
                            if moving:
                                for q in range(several):
                                    c = shifting[q]
                                    end_S[c] += slope[i] * (later[c] + h_S[c])
                        own = column[lag[i]]
                        shift[i] = _lagged(
                            i, h, p[lag[i]], head, tail, moving, own,
                            na, width, memory, memory_S, begin_S, end_S, h_S, mean_S, tilt, tilt_S,
                        )  # fmt: skip
                for i in range(NX):
                    stage[i] = x[i]
                    total[i] = 0.0
                for r in range(4):
                    node = 0.0 if r == 0 else (1.0 if r == 3 else 0.5)
                    t = start + node * h
                    if r != 2:
                        for i in range(NU):
                            value[i] = held[i]
                            if drawn[i]:
                                value[i] = _curve(i, t - delay[i], r == 3, samples, NU, knots, u, pointer, curve, slope)
                            if lagged[i]:
                                value[i] += shift[i] + (node - 0.5) * tilt[i]
                    if patched:
                        for i in range(NX * width):
                            B[i] = 0.0
                    _equations(slopes, t, stage, value, slope, p, constants, column, width, derive, f, A, B, G, T)
                    if patched:
                        for place in range(1, driven[0] + 1):
                            i = driven[place]
                            if curves:
                                for q in range(count):
                                    B[i * width + moves[2 * q + 1]] -= _climb(i, moves[2 * q], NU, G, slope)
                            if lagging:
                                for j in range(NU):
                                    if lagged[j]:
                                        for c in range(na):
                                            moved_by = mean_S[j * width + c] + (node - 0.5) * tilt_S[j * width + c]
                                            B[i * width + c] += G[2 * NU * i + j] * moved_by
                        if moving:  # the instant of this stage shifts, and with it all that changes continuously
                            for i in range(NX):
                                drift = T[i]
                                for j in range(NU):
                                    if drawn[j]:
                                        drift += _climb(i, j, NU, G, slope)
                                for q in range(several):
                                    c = shifting[q]
                                    B[i * width + c] += drift * (later[c] + node * h_S[c])
                    next_node = 1.0 if r == 2 else (0.5 if r < 2 else 0.0)
                    ahead = next_node * h
                    weight = 1.0 / 6.0 if r == 0 or r == 3 else 1.0 / 3.0
                    if derive:
                        if r == 0:
                            _stage(begin_stage, width, A, B, S, stage_S, total_S, ahead, weight)
                        elif r < 3:
                            _stage(middle_stage, width, A, B, S, stage_S, total_S, ahead, weight)
                        else:
                            _stage(finish_stage, width, A, B, S, stage_S, total_S, h, weight)
                    for i in range(NX):
                        total[i] += weight * f[i]
                        stage[i] = x[i] + ahead * f[i]
                    if moving:
                        for i in range(NX):
                            for q in range(several):
                                stage_S[i * width + shifting[q]] += next_node * h_S[shifting[q]] * f[i]
                for i in range(NX):
                    x[i] += h * total[i]
                if moving:
                    for q in range(several):
                        for i in range(NX):
                            S[i * width + shifting[q]] += h_S[shifting[q]] * total[i]
                        later[shifting[q]] += h_S[shifting[q]]
            begin = cut
            owner = following
            if following < 0:
                break
            pointer[following] += 1
    for c in range(na):
        for i in range(NX):
            given_S[i * na + c] = S[i * width + c]
        for i in range(NU):
            given_memory_S[i * na + c] = memory_S[i * width + c]


KINDS = (INTEGERS, INTEGERS, INTEGER, *[NUMBERS] * 5, INTEGER, INTEGERS, *[NUMBERS] * 6, INTEGERS)
KINDS += (*[INTEGER] * 5, *[NUMBERS] * 3, INTEGERS)
"""Of the arguments of `run`."""
FIRST, LAST, SKIP, WORK, PLACES = 17, 18, 20, 24, 25
"""Places among them."""


def intermediate_code(name: str) -> str:
    """LLVM's intermediate code of a function `name(table, first, last, skip)`, which empties the workspace and calls
    `run`. `table` holds all arguments, addresses as integers, then the bytes of `work` and of `places`: a caller from
    Python takes longer to give 26 arguments than `run` takes for a sample.
    """
    # numba only translates: otherwise it would optimise twice, and unroll loops that rarely run (see machine_code).
    level, config.OPT = config.OPT, type(config.OPT)(0)
    try:
        compiled = cfunc(types.void(*KINDS), **OPTIONS)(run)
    finally:
        config.OPT = level
    text, whole = compiled.inspect_llvm(), f"{name}_of_all"
    return "\n".join([text.replace(compiled.native_name, whole), *_by_table(name, whole)])


def _by_table(name: str, whole: str) -> list[str]:
    given = {FIRST: "%first", LAST: "%last", SKIP: "%skip"}
    empty = "call void @llvm.memset.p0.i64"
    lines = [
        "declare void @llvm.memset.p0.i64(ptr, i8, i64, i1)",
        f"define void @{name}(ptr %table, i64 %first, i64 %last, i64 %skip) {{",
    ]
    for place in range(len(KINDS) + 2):
        lines += [
            f"%at.{place} = getelementptr i64, ptr %table, i64 {place}",
            f"%v.{place} = load i64, ptr %at.{place}",
        ]
        if place < len(KINDS) and KINDS[place] is not INTEGER:
            lines += [f"%p.{place} = inttoptr i64 %v.{place} to ptr"]
    arguments = ", ".join(
        f"i64 {given.get(place, f'%v.{place}')}" if kind is INTEGER else f"ptr %p.{place}"
        for place, kind in enumerate(KINDS)
    )
    return [
        *lines,
        f"{empty}(ptr %p.{WORK}, i8 0, i64 %v.{len(KINDS)}, i1 false)",
        f"{empty}(ptr %p.{PLACES}, i8 0, i64 %v.{len(KINDS) + 1}, i1 false)",
        f"call ptr @{whole}({arguments}) noinline",
        "ret void",
        "}",
        "",
    ]
