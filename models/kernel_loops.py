"""The loops of a compiled model: one pass over a stretch of data, with all sensitivities.

This file is a template: models.codegen writes the model's sizes in front of it and its equations in place of the lines
that begin with `EQUATIONS`, once each, so that numba compiles model and loops as one function, without calls in between.

Classical Runge-Kutta of order four on states and variational equations: discretise, then differentiate, so the
sensitivities are those of the numbers that are returned. A step is cut where a held input changes; moving that instant
by a delay moves the ends of two pieces, which is how a delay gets its derivative. An input behind a first-order lag is
the exact response to a straight line, in the mean over each piece, and is exactly neutral at lag 0.
"""

# ruff: noqa
# mypy: ignore-errors


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _lagged(h, tau, start, chord, memory):
    """How a first-order lag moves the mean of a straight line over h, and where it ends; with all derivatives."""
    decay = math.exp(-h / tau) if tau > 0.0 else 0.0
    over = decay / tau if tau > 0.0 else 0.0
    share = tau / h * (1.0 - decay)
    gap = memory - start + chord * tau
    mean = -chord * tau + gap * share
    end = start + chord * h - chord * tau + gap * decay
    mean_tau = -chord + chord * share + gap * ((1.0 - decay) / h - over)
    end_tau = -chord + chord * decay + (gap * over * h / tau if tau > 0.0 else 0.0)
    return mean, end, mean_tau, end_tau, gap * (decay - share) / h, chord - gap * over, share, decay


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def run(time, knots, u, y, p, active, gain, x, S, memory, memory_S, pointer, first, last, substeps, skip, predicted, sensitivity):
    """Rows first to last: predict the outputs, correct the state by gain * (measured - predicted), integrate on.

    x, S (NX, na), memory, memory_S and pointer are taken over and left as they are after the last row's correction.
    `skip`: the first row was predicted and corrected already. `active`: parameter number, NP + number of an initial
    state, or NP + NX + i * NY + j for the gain from output j to state i.
    """
    na = len(active)
    rows = len(u)
    column = np.full(NP, -1, dtype=np.int64)
    for c in range(na):
        if active[c] < NP:
            column[active[c]] = c
    delay = np.zeros(NU)
    moves = np.zeros((len(DELAY_INPUT), 2), dtype=np.int64)  # what delays that are active move: input, column
    count = 0
    lines = False
    switching = False
    for d in range(len(DELAY_INPUT)):
        delay[DELAY_INPUT[d]] += p[DELAY_PARAMETER[d]]
        if column[DELAY_PARAMETER[d]] >= 0:
            moves[count, 0] = DELAY_INPUT[d]
            moves[count, 1] = column[DELAY_PARAMETER[d]]
            count += 1
            lines |= FIRST_ORDER[DELAY_INPUT[d]]
            switching |= not FIRST_ORDER[DELAY_INPUT[d]]

    f = np.zeros(NX)
    A = np.zeros((NX, NX))
    B = np.zeros((NX, na))
    G = np.zeros((NX, NU))
    C = np.zeros((NY, NX))
    D = np.zeros((NY, na))
    H = np.zeros((NY, NU))
    value = np.zeros(NU)
    slope = np.zeros(NU)
    shift = np.zeros(NU)
    bend = np.zeros((NU, na))
    error = np.zeros(NY)
    total = np.zeros(NX)
    stage = np.zeros(NX)
    total_S = np.zeros((NX, na))
    stage_S = np.zeros((NX, na))
    k_S = np.zeros((NX, na))
    stretch = np.zeros(na)
    ends = np.zeros((2, NU))
    end_slopes = np.zeros((2, NU))

    if not skip:
        for i in range(NU):
            pointer[i] = 0
            while pointer[i] < rows - 1 and knots[pointer[i] + 1, i] + delay[i] < time[first]:
                pointer[i] += 1
            memory[i] = u[pointer[i], i]

    for k in range(first, last + 1):
        if k > first or not skip:
            for i in range(NU):
                READ_LINE(time[k]; True; value[i]; slope[i])
            t = time[k]
            for i in range(NX):
                stage[i] = x[i]
            EQUATIONS_observe
            for j in range(NY):
                predicted[k, j] = error[j]
                error[j] = y[k, j] - error[j]
                for c in range(na):
                    sensitivity[k, j, c] = D[j, c]
                for i in range(NX):
                    if C[j, i] != 0.0:
                        for c in range(na):
                            sensitivity[k, j, c] += C[j, i] * S[i, c]
                if lines:
                    for q in range(count):
                        sensitivity[k, j, moves[q, 1]] -= H[j, moves[q, 0]] * slope[moves[q, 0]]
            for j in range(NY):
                if math.isfinite(error[j]):
                    for i in range(NX):
                        if gain[i, j] != 0.0:
                            x[i] += gain[i, j] * error[j]
                            for c in range(na):
                                S[i, c] -= gain[i, j] * sensitivity[k, j, c]
            for c in range(na):
                entry = active[c] - NP - NX
                if entry >= 0 and math.isfinite(error[entry % NY]):
                    S[entry // NY, c] += error[entry % NY]
        if k == last:
            break
        begin = time[k]
        finish = time[k + 1]
        owner = -1
        while True:
            cut = finish
            following = -1
            for i in range(NU):
                if not FIRST_ORDER[i] and pointer[i] < rows - 1:
                    candidate = knots[pointer[i] + 1, i] + delay[i]
                    if candidate < cut:
                        cut = max(candidate, begin)
                        following = i
            h = (cut - begin) / substeps
            steps = substeps if h > 0.0 else 0
            moving = False
            if switching:
                for c in range(na):
                    stretch[c] = 0.0
                for q in range(count):
                    if moves[q, 0] == following:
                        stretch[moves[q, 1]] += 1.0
                        moving = True
                    if moves[q, 0] == owner:
                        stretch[moves[q, 1]] -= 1.0
                        moving = True
                if moving and steps == 0:
                    steps = 1  # no time goes by, but the state moves with the instant
            for c in range(na):
                stretch[c] /= max(steps, 1)
            for step in range(steps):
                start = begin + step * h
                if LAGGING and h > 0.0:
                    for side in range(2):
                        for i in range(NU):
                            READ_LINE(start + side * h; side == 1; ends[side, i]; end_slopes[side, i])
                    for i in range(NU):
                        if LAG[i] >= 0:
                            chord = (ends[1, i] - ends[0, i]) / h
                            mean, after, mean_tau, after_tau, mean_h, after_h, share, decay = _lagged(
                                h, p[LAG[i]], ends[0, i], chord, memory[i]
                            )
                            for c in range(na):
                                start_c = 0.0
                                end_c = 0.0
                                if FIRST_ORDER[i]:
                                    for q in range(count):
                                        if moves[q, 0] == i and moves[q, 1] == c:
                                            start_c -= end_slopes[0, i]
                                            end_c -= end_slopes[1, i]
                                chord_c = (end_c - start_c) / h
                                gap_c = memory_S[i, c] - start_c + chord_c * p[LAG[i]]
                                bend[i, c] = -chord_c * p[LAG[i]] + gap_c * share
                                memory_S[i, c] = end_c - chord_c * p[LAG[i]] + gap_c * decay
                                if column[LAG[i]] == c:
                                    bend[i, c] += mean_tau
                                    memory_S[i, c] += after_tau
                                if moving:
                                    bend[i, c] += mean_h * stretch[c]
                                    memory_S[i, c] += after_h * stretch[c]
                            shift[i] = mean
                            memory[i] = after
                for i in range(NX):
                    stage[i] = x[i]
                    total[i] = 0.0
                    for c in range(na):
                        stage_S[i, c] = S[i, c]
                        total_S[i, c] = 0.0
                for r in range(4):
                    t = start + NODES[r] * h
                    if r != 2:
                        for i in range(NU):
                            READ_LINE(t; r == 3; value[i]; slope[i])
                            value[i] += shift[i]
                    EQUATIONS_slopes
                    for i in range(NX):
                        for c in range(na):
                            k_S[i, c] = B[i, c]
                        for j in range(NX):
                            a = A[i, j]
                            if a != 0.0:
                                for c in range(na):
                                    k_S[i, c] += a * stage_S[j, c]
                        if lines:
                            for q in range(count):
                                k_S[i, moves[q, 1]] -= G[i, moves[q, 0]] * slope[moves[q, 0]]
                        if LAGGING:
                            for j in range(NU):
                                if LAG[j] >= 0:
                                    for c in range(na):
                                        k_S[i, c] += G[i, j] * bend[j, c]
                    ahead = h * NODES[r + 1]
                    weight = WEIGHTS[r]
                    for i in range(NX):
                        total[i] += weight * f[i]
                        stage[i] = x[i] + ahead * f[i]
                        for c in range(na):
                            total_S[i, c] += weight * k_S[i, c]
                            stage_S[i, c] = S[i, c] + ahead * k_S[i, c]
                        if moving:
                            for c in range(na):
                                stage_S[i, c] += NODES[r + 1] * stretch[c] * f[i]
                for i in range(NX):
                    x[i] += h * total[i]
                    for c in range(na):
                        S[i, c] += h * total_S[i, c]
                    if moving:
                        for c in range(na):
                            S[i, c] += stretch[c] * total[i]
            begin = cut
            owner = following
            if following < 0:
                break
            pointer[following] += 1
