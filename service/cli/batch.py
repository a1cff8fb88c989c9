"""Commands that read recordings: identify, replay, convert; compare is in service.cli.compare."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from service.cli.arguments import AssumeOption, FromOption, MapOption, RecordingsArgument, ToOption, VehicleOption
from service.cli.compare import compare
from service.cli.diagnose import diagnose
from service.cli.inputs import fitting, load_recording, load_recordings, working
from service.output import check_folder, live_estimates, page, print_json

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
        list[str] | None, typer.Option("--method", "-m", help="Method.", show_default="all, side by side")
    ] = None,
    model: Annotated[
        str | None,
        typer.Option(
            "--model", help="A shipped model or a model file.", show_default="the vehicle's with its CAD values"
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
    from math import tau

    from estimators.identify.run import identify as run
    from estimators.identify.subject import NOTHING_OWN
    from service.offline.diagnose import asked_of
    from service.offline.machine import is_of, support_of
    from service.offline.models import columns, identified_model
    from service.offline.provenance import assumed
    from telemetry.tables.mapping import said_of
    from vehicles import registry
    from vehicles.file import load
    from vehicles.load import refuse_loads

    file = load(vehicle)
    subject = identified_model(model, file)
    cad = file.parameters
    before: tuple[dict[str, float], dict[str, float]] = ({}, {})
    own = NOTHING_OWN
    if is_of(subject, file):
        before, own = (cad.values, cad.deviations), registry.of(file.vehicle.kind).identification()
    known = truths(truth or [])
    if picture is not None:
        from diagnosis.report.figures.methods import check_suffix

        check_suffix(picture)
    check_folder(report)
    user = said_of(map_ or [], assume or [], columns(model))
    loaded = load_recordings(recordings, file, [subject], user=user, begin=begin, end=end)
    refuse_loads(loaded)
    if asked := asked_of(subject, loaded, user.settled, support_of(subject, file)):
        raise asked
    with fitting() as progress:
        document = run(
            loaded,
            before[0],
            support_of(subject, file),
            method or (),
            deviations=before[1],
            model=subject,
            own=own,
            every=every,
            bandwidth=None if bandwidth is None else tau * bandwidth,
            progress=progress,
        )
    if picture is not None:
        from diagnosis.report.figures.methods import save_methods

        save_methods(document, picture, truth=known)
    if report is not None:
        from service.cli.identify_report import save_report

        with working() as step:
            save_report(report, document, file, subject, recordings, loaded, known, step)
    if json:
        print_json({**document, "assumed": assumed(loaded)})
    else:
        from service.cli.pages.identify import print_methods

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
    from service.offline.replay import replay as run
    from vehicles.file import load

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
    source: Annotated[Path, typer.Argument(help="A recording, a table of other origin, or a raw CAN .log.")],
    target: Annotated[
        Path, typer.Argument(help="A file; its suffix gives the format: .arrow, .parquet, .csv, .mat, .mf4 or .mcap.")
    ],
    vehicle: VehicleOption = "monocab",
    map_: MapOption = None,
    assume: AssumeOption = None,
) -> None:
    """Write a recording in another format. All measured channels of a raw CAN log are reconstructed.

    A table of any machine is read, and what was assumed is printed. If a logger began anew in it, the further parts are
    written beside the first, as NAME-2.
    """
    from service.offline.replay import convert as run
    from telemetry.tables.mapping import said_of
    from vehicles.file import load

    models = None if source.suffix == ".log" else ()
    user = said_of(map_ or [], assume or [])
    with working() as step:
        step(f"writing {target.name}")
        found = load_recordings([source], load(vehicle), models, user=user, as_stamped=True)
        targets = [target, *(target.with_stem(f"{target.stem}-{place}") for place in range(2, len(found) + 1))]
        for recording, path in zip(found, targets, strict=True):
            run(recording, path)
    for path in targets:
        page.print(f"{path}: {path.stat().st_size} bytes")
