"""`upright fleet`: diagnose all recordings of a fleet, and show what has changed."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from upright.service.cli.arguments import (
    AlsoOption,
    AssumeOption,
    DiagnosedModelOption,
    EffectOption,
    MapOption,
    VehicleOption,
)
from upright.service.output import check_folder, page, people, print_json

EXAMPLES = """Examples:

`upright fleet runs --model pendulum.toml --report fleet.html`

`upright fleet s3://bucket/runs --out monocabs.parquet --dask tcp://server:8786`
"""


def register(app: typer.Typer) -> None:
    """Add the command of this module to `app`."""
    app.command(epilog=EXAMPLES)(fleet)


def fleet(
    folder: Annotated[
        str, typer.Argument(metavar="DIR", help="A folder, or a URL that fsspec knows, as s3://bucket/runs.")
    ],
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Results: a Parquet file with a row for each recording.")
    ] = Path("fleet.parquet"),
    vehicle: VehicleOption = "monocab",
    model: DiagnosedModelOption = None,
    effect: EffectOption = None,
    own: AlsoOption = None,
    map_: MapOption = None,
    assume: AssumeOption = None,
    budget: Annotated[
        float | None,
        typer.Option(
            "--budget",
            help="Time limit in seconds for each recording; inf means no limit.",
            show_default="as of `upright diagnose`",
        ),
    ] = None,
    only: Annotated[
        str, typer.Option("--only", help="Use only recordings whose path below DIR matches this pattern, e.g. *.mcap.")
    ] = "*",
    workers: Annotated[
        int | None, typer.Option(min=1, help="Number of processes on this machine.", show_default="one per core")
    ] = None,
    dask: Annotated[
        str | None,
        typer.Option(
            "--dask",
            metavar="ADDRESS",
            help="Dask scheduler to run on instead of this machine, as tcp://HOST:8786.",
            show_default=False,
        ),
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option("--report", help="Write a self-contained page with trends and changes: FILE.html."),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Diagnose all recordings in a folder, one row each, and show which parameters of which vehicle have changed.

    A recording that was not changed since it was diagnosed with the same options is skipped. Ctrl-C ends it and keeps
    what is finished; the same command continues. Exit code 1 if a recording could not be read.
    """
    from upright.service.cli.inputs import counting
    from upright.service.fleet.examine import Settings
    from upright.service.fleet.run import fleet as run
    from upright.service.fleet.store import Store
    from upright.service.fleet.trends import changes, trends
    from upright.service.spread import machines, processes
    from upright.service.whole_file import write_whole

    check_folder(out)
    check_folder(report)
    if budget is not None and not budget > 0.0:
        raise typer.BadParameter("has to be more than 0 s; inf means no limit.", param_hint="--budget")
    store = Store.of(folder)
    settings = Settings.of(
        vehicle,
        model,
        effects=effect or (),
        also=own or (),
        columns_as=map_ or (),
        assumed=assume or (),
        seconds=budget,
    )
    spread = machines(dask) if dask else processes(workers or os.cpu_count() or 1)
    with counting("recordings") as progress:
        found = run(store, out, settings, spread, only=only, progress=progress)
    over_time = trends(found.rows)
    changed = changes(over_time)
    if report is not None:
        from upright.service.fleet.report import write_fleet

        write_whole(report, write_fleet(found, over_time, folder))
    if json:
        print_json(
            {
                "recordings": len(found.rows),
                "skipped": found.skipped,
                "failed": {row.recording: row.reason for row in found.failures},
                "missing": found.missing,
                "changes": [trend.to_json(step) for trend, step in changed],
            }
        )
    else:
        from upright.service.fleet.report import summary

        page.print(f"{summary(found)}. {found.skipped} were unchanged.", markup=False, soft_wrap=True)
        for trend, step in changed:
            page.print(f"  {trend.change(step)}", markup=False, soft_wrap=True)
        for row in found.failures:
            page.print(f"Not read: {row.recording}: {row.reason}", markup=False, soft_wrap=True)
        page.print(
            f"\nResults: {out}" + (f"\nReport: {report}" if report is not None else ""), markup=False, soft_wrap=True
        )
    if found.missing:
        people.print(f"Interrupted: {found.missing} recordings are missing; the same command continues.")
        raise typer.Exit(130)
    if found.failures:
        raise typer.Exit(1)
