"""Is each effect still found beside a random torque? With 0, 1 and 3 times the RMS torque of the effect itself.

`python benchmarks/beside_disturbance.py --times 0,1,3 --seed 7` hides each effect of the catalogue in the virtual
MONOCAB, with the amplitude of `upright demo --hide EFFECT`. The RMS of the random torque that a model without the
effect estimates is called the effect's own RMS. The vehicle is then disturbed by a random torque of each of these
multiples, with a correlation time of `--time` s, and the record is diagnosed as by `upright diagnose`.

Answers: "right": the effect is named first, or tied with the first. "seen beside others": it is named later. "wrong":
only other effects are named. If no effect is named, the answer is the verdict; `adequate` means that the effect is
below what the record can show beside this disturbance.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial

from upright.diagnosis.diagnose import Diagnosis, Verdict
from upright.diagnosis.parts import diagnose_parts
from upright.estimators.identify.run import with_values
from upright.estimators.methods.prediction_error import prediction_error
from upright.service.hidden_effects.trial import Bench
from upright.service.offline.diagnose import default_budget
from upright.service.virtual.run import record
from upright.simulation.monocab.hidden import HIDDEN
from upright.telemetry.errors import UprightError
from upright.vehicles import registry
from upright.vehicles.file import load

LEARNED = "gyro_bias"
"""The roll filter has estimated it before the vehicle moves, so the recording contains nothing of it."""
LEVELS = {"end_stop": "end_stop=0.05", "backlash": "backlash=0.02"}
"""At level 1 the buffers stop the vehicle before its support does, and the gimbals rattle in their backlash."""
VEHICLE = "monocab"


@dataclass(frozen=True, slots=True)
class Answer:
    """The diagnosis of `effect` beside a disturbance of `times` its own RMS, `rms` N m."""

    effect: str
    times: float
    rms: float
    answer: str
    names: str


def answer(found: Diagnosis, effect: str) -> str:
    """The answer of `found` if `effect` is hidden, as in the module's docstring."""
    names = [{each.effect, *each.tied_with} for each in found.findings]
    if names and effect in names[0]:
        return "right"
    if any(effect in each for each in names):
        return "seen beside others"
    return "wrong" if names and found.verdict is not Verdict.UNKNOWN else found.verdict.value


def tried(effect: str, times: Sequence[float], seed: int, duration: float, correlation_time: float) -> list[Answer]:
    """The diagnoses of one effect beside each of the disturbances."""
    vehicle = load(VEHICLE)
    cad, hide = vehicle.parameters, LEVELS.get(effect, effect)
    model = Bench().nominal
    actuators = [with_values(each, cad.values, cad.deviations) for each in registry.of(VEHICLE).models().actuators]
    still = record(VEHICLE, "multisine", hide=[hide], seed=seed, duration=duration)
    own = prediction_error(model, [still], support=vehicle.support).disturbance[0].std or 0.0
    answers = []
    for number, each in enumerate(times):
        rms = each * own
        disturbance = [f"disturbance={rms:.6g},{correlation_time:g}"] if rms else []
        try:
            run = record(VEHICLE, "multisine", hide=[hide, *disturbance], seed=seed + number, duration=duration)
        except UprightError as error:
            answers.append(Answer(effect, each, rms, "not recorded", str(error)))
            continue
        found = diagnose_parts(model, actuators, [run], support=vehicle.support, budget=default_budget([run]))
        names = ", ".join("/".join((one.effect, *one.tied_with)) for one in found.findings)
        answers.append(Answer(effect, each, rms, answer(found, effect), names))
    return answers


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", default="0,1,3", help="RMS of the disturbance as multiples of the effect's own")
    parser.add_argument("--time", type=float, default=0.3, help="s: the disturbance's correlation time")
    parser.add_argument("--seed", type=int, default=7, help="seed of the first record of each effect")
    parser.add_argument("--duration", type=float, default=30.0, help="s, length of the multisine")
    parser.add_argument("--effects", help="only these effects, separated by commas")
    parser.add_argument("--jobs", type=int, default=2, help="number of processes")
    chosen = parser.parse_args()
    times = [float(each) for each in chosen.times.split(",")]
    effects = chosen.effects.split(",") if chosen.effects else sorted(HIDDEN.keys() - {LEARNED})
    one = partial(tried, times=times, seed=chosen.seed, duration=chosen.duration, correlation_time=chosen.time)
    answers: list[Answer] = []
    with ProcessPoolExecutor(chosen.jobs) as pool:
        for number, each in enumerate(pool.map(one, effects), start=1):
            answers += each
            for line in each:
                text = f"{line.effect:24} {line.times:g} x, {line.rms:8.3g} N m  {line.answer:18} {line.names}"
                print(text, flush=True)
            print(f"\r{number} of {len(effects)}", end="\r", file=sys.stderr, flush=True)
    print()
    for each in times:
        some = [line.answer for line in answers if line.times == each]
        counts = ", ".join(f"{some.count(word)} {word}" for word in dict.fromkeys(sorted(some)))
        print(f"beside {each:g} times its own RMS, of {len(some)}: {counts}")


if __name__ == "__main__":
    main()
