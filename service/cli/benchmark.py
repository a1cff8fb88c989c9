"""Commands that measure the program itself: benchmark hidden-effects."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from upright.service.output import page, people, print_json

if TYPE_CHECKING:
    from upright.service.hidden_effects.cases import Grid
    from upright.service.hidden_effects.trial import Bench

benchmark = typer.Typer(help="Measure how good the diagnosis is.", no_args_is_help=True)

NO_BASELINE = "none"
EXAMPLES = """Examples:

`upright benchmark hidden-effects --quick` a short check, a few minutes

`upright benchmark hidden-effects --effects coulomb_friction,sensor_delay --sizes 1,2,4 --seeds 10`

`upright benchmark hidden-effects --scheduler tcp://server:8786 --output nightly.jsonl` on many machines

`upright benchmark hidden-effects --summary nightly.jsonl --picture confusion.png` only the figures of a results file
"""


def register(app: typer.Typer) -> None:
    """Add the commands of this module to `app`."""
    app.add_typer(benchmark, name="benchmark")


@benchmark.callback()
def group() -> None:
    """Make it a group although it has only one command."""


@benchmark.command("hidden-effects", epilog=EXAMPLES)
def hidden_effects(
    effects: Annotated[
        str | None,
        typer.Option(
            help="Effects to hide, separated by commas.",
            show_default="all that the model can lack, and some outside the catalogue",
        ),
    ] = None,
    sizes: Annotated[
        str | None, typer.Option(help="Amplitudes in multiples of the minimum detectable one.", show_default="1,2,4,8")
    ] = None,
    noise: Annotated[
        str | None, typer.Option(help="IMU noise in multiples of the data sheet's.", show_default="1")
    ] = None,
    excitations: Annotated[
        str | None, typer.Option(help="Experiments of the vehicle.", show_default="multisine,sweep,square,hold")
    ] = None,
    seeds: Annotated[int | None, typer.Option(min=1, help="Number of records of each kind.", show_default="3")] = None,
    disturbance: Annotated[
        str | None,
        typer.Option(
            help="Random torque of every record: RMS,CORRELATION_TIME in multiples of the sensor floor and s, or none.",
            show_default="drawn from 2 to 20 N m RMS and 0.05 to 3 s",
        ),
    ] = None,
    first: Annotated[
        int, typer.Option(min=0, help="Number of the first record: other numbers than before give new records.")
    ] = 0,
    quick: Annotated[
        bool, typer.Option("--quick", help="A few cases and no baselines, unless other options are given.")
    ] = False,
    baseline: Annotated[
        list[str] | None,
        typer.Option(
            "--baseline",
            help="Compare the diagnosis with differentiate_sindy, smoother_stepwise, exhaustive_bic, or none.",
            show_default="all",
        ),
    ] = None,
    model: Annotated[
        str, typer.Option(help="The model that lacks the hidden effects: monocab_roll or monocab_reduced.")
    ] = "monocab_roll",
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Results file, a JSON line per case; its cases are not run again.")
    ] = Path("hidden-effects.jsonl"),
    workers: Annotated[
        int | None, typer.Option(min=1, help="Number of processes on this machine.", show_default="one per core")
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(help="Dask scheduler to run on instead of this machine, as tcp://HOST:8786.", show_default=False),
    ] = None,
    summary: Annotated[
        Path | None, typer.Option("--summary", help="Show the figures of this results file; run nothing.")
    ] = None,
    picture: Annotated[
        Path | None, typer.Option("--picture", help="Picture of the confusion matrix: .png, .svg or .pdf.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Hide effects of known amplitude in virtual vehicles, and count how often the diagnosis names them.

    Ctrl-C ends it and shows the results up to then; the same command resumes.
    """
    from upright.diagnosis.report.figures.methods import check_suffix
    from upright.service.cli.inputs import counting
    from upright.service.hidden_effects.benchmark import benchmark as run
    from upright.service.hidden_effects.results import trials as results
    from upright.service.hidden_effects.results.summary import summarise
    from upright.service.spread import machines, processes

    if picture is not None:
        check_suffix(picture)
    interrupted = False
    if summary is not None:
        lines = results.read(summary)
    else:
        bench = _bench(quick, baseline, model, disturbance)
        grid = _grid(bench, quick, effects, sizes, noise, excitations, seeds, first)
        spread = machines(scheduler) if scheduler else processes(workers or os.cpu_count() or 1)
        try:
            with counting("cases") as progress:
                lines = run(grid.cases(), bench, output, spread, progress)
        except KeyboardInterrupt:
            interrupted = True
            lines = results.read(output) if output.exists() else {}
            people.print(f"Interrupted. The results up to now are in {output}; the same command resumes.")
    figures = summarise(lines.values())
    if picture is not None and lines:
        from upright.service.hidden_effects.results.confusion_picture import save_confusion

        save_confusion(figures, picture)
    if json:
        print_json(figures.to_json())
    else:
        from upright.service.cli.pages.benchmark import print_summary

        print_summary(figures)
        if picture is not None:
            page.print(f"\nPicture: {picture}")
    if interrupted:
        raise typer.Exit(130)
    if not figures.cases.get("ok"):
        raise typer.Exit(1)


def _grid(
    bench: Bench,
    quick: bool,
    effects: str | None,
    sizes: str | None,
    noise: str | None,
    excitations: str | None,
    seeds: int | None,
    first: int,
) -> Grid:
    """The grid that the options describe. Raises UnknownEffectError, and BadParameter for other invalid options."""
    from upright.service.hidden_effects.cases import QUICK, Grid
    from upright.vehicles.file import load

    base = QUICK if quick else Grid()
    if excitations is not None:
        there = load("monocab").experiments
        for name in _words(excitations):
            if name not in there:
                raise typer.BadParameter(f"{name!r} is not one of {', '.join(there)}", param_hint="--excitations")
    return Grid(
        effects=base.effects if effects is None else _words(effects),
        sizes=base.sizes if sizes is None else _numbers(sizes, "--sizes"),
        noises=base.noises if noise is None else _numbers(noise, "--noise"),
        excitations=base.excitations if excitations is None else _words(excitations),
        seeds=base.seeds if seeds is None else seeds,
        first=first,
    )


def _bench(quick: bool, baseline: list[str] | None, model: str, disturbance: str | None) -> Bench:
    """Raises BadParameter for an unknown baseline or an invalid disturbance, ModelError for an unknown model."""
    from upright.models.library import get
    from upright.service.hidden_effects.disturbances import drawn_for, parse_disturbances
    from upright.service.hidden_effects.methods.answers import diagnosis
    from upright.service.hidden_effects.methods.baselines import BASELINES
    from upright.service.hidden_effects.trial import SUBJECT, Bench

    chosen = baseline if baseline is not None else [] if quick else list(BASELINES)
    for name in chosen:
        if name not in BASELINES and name != NO_BASELINE:
            there = ", ".join((*BASELINES, NO_BASELINE))
            raise typer.BadParameter(f"{name!r} is not one of {there}", param_hint="--baseline")
    methods = {name: BASELINES[name] for name in chosen if name != NO_BASELINE}
    try:
        disturbances = parse_disturbances(disturbance, drawn_for("monocab"))
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--disturbance") from error
    return Bench(methods={SUBJECT: diagnosis, **methods}, model=get(model).name, disturbances=disturbances)


def _words(text: str) -> tuple[str, ...]:
    return tuple(dict.fromkeys(word.strip() for word in text.split(",") if word.strip()))


def _numbers(text: str, option: str) -> tuple[float, ...]:
    try:
        numbers = tuple(float(word) for word in _words(text))
    except ValueError:
        numbers = ()
    if not numbers or not all(0.0 < number < float("inf") for number in numbers):
        raise typer.BadParameter(f"{text!r} is not a list of positive numbers, separated by commas", param_hint=option)
    return numbers
