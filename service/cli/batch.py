"""Commands that read recordings: identify, replay, convert; compare is in service.cli.compare."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from upright.service.cli.arguments import (
    AssumeOption,
    DbcOption,
    FromOption,
    MapOption,
    RecordingsArgument,
    ToOption,
    VehicleOption,
    methods,
    models,
)
from upright.service.cli.compare import compare
from upright.service.cli.diagnose import diagnose
from upright.service.cli.inputs import fitting, load_recording, load_recordings, working
from upright.service.output import check_folder, live_estimates, page, print_json
from upright.service.whole_file import write_whole

JsonOption = Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")]


def register(app: typer.Typer) -> None:
    """Add the commands of this module to `app`."""
    app.command(epilog="Example: `upright identify recordings/*.arrow --picture methods.png`")(identify)
    app.command(
        epilog="Example: `upright compare recordings/*sweep.arrow --model recordings/*sweep.estimates.json`,"
        " or with a model file of your own: `upright compare run.arrow --model mine.toml --picture where.png`"
    )(compare)
    app.command(
        epilog="Example: `upright diagnose recordings/*multisine.arrow`, or until nothing is missing any more:"
        " `upright diagnose step.arrow sweep.arrow --auto repaired.toml`"
    )(diagnose)
    app.command(epilog="Example: `upright replay recordings/*sweep.log --vehicle monocab`")(replay)
    app.command(epilog="Example: `upright convert recordings/*sweep.log sweep.csv`")(convert)


def identify(
    recordings: RecordingsArgument,
    vehicle: VehicleOption = "monocab",
    method: Annotated[
        list[str] | None,
        typer.Option("--method", "-m", help="Method.", show_default="all, side by side", autocompletion=methods),
    ] = None,
    model: Annotated[
        str | None,
        typer.Option(
            "--model",
            help="A shipped model or a model file.",
            show_default="the vehicle's with its CAD values",
            autocompletion=models,
        ),
    ] = None,
    every: Annotated[
        bool, typer.Option("--every-recording", help="Give each method all recordings, not only the suitable ones.")
    ] = False,
    bandwidth: Annotated[
        float | None, typer.Option(help="Hz, bandwidth of the filter of the regression methods.", show_default="5")
    ] = None,
    truth: Annotated[
        list[str] | None,
        typer.Option(
            "--truth", help="NAME=VALUE that is known to be true, as for a virtual vehicle.", show_default=False
        ),
    ] = None,
    begin: FromOption = 0.0,
    end: ToOption = math.inf,
    map_: MapOption = None,
    assume: AssumeOption = None,
    dbc: DbcOption = None,
    picture: Annotated[Path | None, typer.Option("--picture", help="The paper's figure 3: .png, .svg or .pdf.")] = None,
    report: Annotated[
        Path | None,
        typer.Option("--report", help="Write a self-contained page to read, mail and print: FILE.html."),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Estimate the vehicle's parameters and their standard deviations from recordings, by several methods.

    Ctrl-C ends the estimation and shows the results up to then.
    """
    from upright.service.offline.identify import identified
    from upright.service.offline.inputs.machine import name_of
    from upright.service.offline.models import columns, identified_model
    from upright.service.offline.provenance import assumed, provenance
    from upright.telemetry.tables.mapping import said_of
    from upright.vehicles.file import load

    file = load(vehicle)
    subject = identified_model(model, file)
    known = truths(truth or [])
    if picture is not None:
        from upright.diagnosis.report.figures.methods import check_suffix

        check_suffix(picture)
    check_folder(report)
    user = said_of(map_ or [], assume or [], columns(model))
    loaded = load_recordings(recordings, file, [subject], user=user, begin=begin, end=end, database=dbc)
    with fitting() as progress:
        answer = identified(
            loaded, file, model=subject, methods=method or (), every=every, bandwidth=bandwidth, progress=progress
        )
    document = answer.document
    if picture is not None:
        from upright.diagnosis.report.figures.methods import save_methods

        save_methods(document, picture, truth=known)
    if report is not None:
        with working() as step:
            origin = provenance(name_of(subject, file), recordings, loaded)
            write_whole(report, answer.page(origin, known, step))
    if json:
        print_json({**document, "assumed": assumed(loaded)})
    else:
        from upright.service.pages.identify import print_methods

        print_methods(document, known)
        if picture is not None:
            page.print(f"\nPicture: {picture}")
        if report is not None:
            page.print(f"\nReport: {report}")
    if document["cancelled"]:
        raise typer.Exit(130)
    unusable = {"failed", "missing_channel", "bad_data", "not_suited"}
    if all(entry["status"] in unusable for entry in document["methods"].values()):
        raise typer.Exit(1)


def truths(options: list[str]) -> dict[str, float]:
    """The values of `--truth` by name."""
    known = {}
    for option in options:
        name, _, value = option.partition("=")
        try:
            known[name] = float(value)
        except ValueError:
            raise typer.BadParameter(
                f"{option!r} is not NAME=VALUE, as in inertia=1650", param_hint="--truth"
            ) from None
    return known


def replay(recordings: RecordingsArgument, vehicle: VehicleOption = "monocab", json: JsonOption = False) -> None:
    """Run recordings or raw CAN logs through the live estimators again, with bit-identical results."""
    from upright.service.offline.inputs.replay import replay as run
    from upright.vehicles.file import load

    file = load(vehicle)
    results = {}
    with working() as step:
        for path in recordings:
            step(f"replaying: {path.name}")
            results[str(path)] = run(load_recording(path, vehicle, as_stamped=True), file)
    if json:
        print_json({"recordings": results})
        return
    for name, estimates in results.items():
        page.print(live_estimates(estimates, title=Path(name).name))


def convert(
    source: Annotated[Path, typer.Argument(help="A recording, a table or log of another program, or a CAN log.")],
    target: Annotated[
        Path, typer.Argument(help="A file; its suffix gives the format: .arrow, .parquet, .csv, .mat, .mf4 or .mcap.")
    ],
    vehicle: VehicleOption = "monocab",
    dbc: DbcOption = None,
    map_: MapOption = None,
    assume: AssumeOption = None,
) -> None:
    """Write a recording in another format. All measured channels of a CAN log are reconstructed.

    A CAN log is one of upright, of `candump`, or an ASC, BLF, TRC or MF4 of another tool. A table of any machine is
    read, and what was assumed is printed. If a logger began anew in it, the further parts are written beside the first,
    as NAME-2.
    """
    from upright.service.offline.inputs.can_log import is_can_log
    from upright.service.offline.inputs.replay import convert as run
    from upright.telemetry.tables.mapping import said_of
    from upright.vehicles.file import load

    models = None if is_can_log(source) else ()
    user = said_of(map_ or [], assume or [])
    with working() as step:
        step(f"writing {target.name}")
        found = load_recordings([source], load(vehicle), models, user=user, as_stamped=True, database=dbc)
        targets = [target, *(target.with_stem(f"{target.stem}-{place}") for place in range(2, len(found) + 1))]
        for recording, path in zip(found, targets, strict=True):
            run(recording, path)
    for path in targets:
        page.print(f"{path}: {path.stat().st_size} bytes")
