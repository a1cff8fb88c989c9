"""The command `upright`. Each command imports its modules when it runs, so that `--help` answers at once.

Exit codes: 0 done, 1 failed, 2 usage, 3 refused by a safety interlock, 4 vehicle fault. With `--json` one document goes
to stdout, and all text for the user to stderr.
"""

from __future__ import annotations

import os
import sys
from typing import Annotated

# The matrices are small: multithreaded BLAS is slower than a single thread, tenfold on a busy machine.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import typer

from upright.service.cli import (
    batch,
    benchmark,
    commission,
    dashboard,
    design,
    doctor,
    fleet,
    live,
    multisine,
    talk,
    vehicle,
)
from upright.service.cli.models import shown as model
from upright.telemetry.errors import UprightError

app = typer.Typer(
    name="upright",
    help="Commissions vehicles that fall over by themselves: balance over CAN, identify while balancing, "
    "see which physical effect the model lacks.\n\nStart with `upright demo`; it needs no hardware.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
)


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"upright {version('upright')}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


live.register(app)
talk.register(app)
commission.register(app)
batch.register(app)
design.register(app)
multisine.register(app)
vehicle.register(app)
model.register(app)
fleet.register(app)
benchmark.register(app)
dashboard.register(app)
doctor.register(app)


def main() -> None:
    """Entry point. An UprightError is shown as a sentence with its remedy; any other exception shows its traceback."""
    try:
        app(prog_name="upright")
    except UprightError as error:
        typer.echo(f"upright: {error}", err=True)
        sys.exit(1)
    except KeyboardInterrupt:
        typer.echo("upright: interrupted", err=True)
        sys.exit(130)
