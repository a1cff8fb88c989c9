"""Commands that run something on a bus: demo, simulate, serve."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from upright.service.cli.arguments import VehicleArgument, VehicleOption
from upright.service.output import page, people
from upright.service.whole_file import write_whole

if TYPE_CHECKING:
    from upright.simulation.physics.disturbance import Disturbance
    from upright.vehicles.file import VehicleFile

BusOption = Annotated[
    list[str] | None,
    typer.Option(
        "--bus",
        help="IFACE:CHANNEL for everything, or drives=IFACE:CHANNEL and imu=IFACE:CHANNEL. "
        "Interfaces: socketcan, udp_multicast, slcan, virtual.",
        show_default="the vehicle file's",
    ),
]
HideOption = Annotated[
    list[str] | None,
    typer.Option(
        "--hide",
        help="EFFECT, EFFECT=LEVEL or EFFECT=LEVEL@SECONDS (time of onset): a physical effect that the model lacks. "
        "Also disturbance, or disturbance=RMS,CORRELATION_TIME (N m, s): a random torque; 0 switches it off. "
        "Also narrow_band, or narrow_band=RMS,FREQUENCY,DAMPING (N m, Hz): a narrow-band random torque.",
        show_default=False,
    ),
]
DataOption = Annotated[Path | None, typer.Option("--data", help="Folder of the recordings.", show_default="recordings")]


def register(app: typer.Typer) -> None:
    """Add the commands of this module to `app`."""
    app.command(epilog="Example: `upright demo --hide coulomb_friction`")(demo)
    app.command(epilog="Example: `upright simulate monocab --bus socketcan:vcan0 --fault imu_silent@20`")(simulate)
    app.command(epilog="Example: `upright serve monocab --bus socketcan:can0`")(serve)


def demo(
    vehicle: VehicleOption = "monocab",
    hide: HideOption = None,
    experiment: Annotated[
        list[str] | None,
        typer.Option("--experiment", help="Experiments to run.", show_default="those of the vehicle's demo"),
    ] = None,
    data: DataOption = None,
    seed: Annotated[int, typer.Option(help="Seed of the simulated sensors' noise and of the disturbance.")] = 1,
    dashboard: Annotated[
        bool, typer.Option("--dashboard", help="Serve the page live, in real time, and go on until Ctrl-C.")
    ] = False,
    port: Annotated[int, typer.Option(help="Port of the dashboard, on this machine only.")] = 8765,
    show: Annotated[
        bool, typer.Option("--open/--no-open", help="Open the report in the browser, if there is one.")
    ] = True,
) -> None:
    """Run everything without hardware: a virtual vehicle is balanced, excited, identified and diagnosed."""
    import math

    from upright.diagnosis.prediction.compare import compare as compare_models
    from upright.service.cli.inputs import load_recording, working
    from upright.service.cli.talk import follow
    from upright.service.demo.figure import save_run
    from upright.service.demo.run import run_demo
    from upright.service.observer.live.online_estimators import estimators_of
    from upright.service.offline.models import compared_models, estimates_beside
    from upright.service.pages.compare import comparison_table
    from upright.service.virtual.vehicle import requested_disturbance
    from upright.vehicles import registry
    from upright.vehicles.file import load

    file = load(vehicle)
    story = registry.of(file.vehicle.kind).views.story
    with working() as step:
        step("preparing the estimators (on the first start on a computer, their model is compiled)")
        estimators_of(file).join()

    def evaluate(recordings: list[Path]) -> None:
        last = recordings[-1]
        if not story.settling:
            identified(last, story.begin, file)
        for path in recordings:
            picture = path.with_suffix(".png")
            estimates = estimates_beside(path if story.settling else last)
            with working() as step:
                step(f"comparing and drawing {path.name}")
                recording = load_recording(path, vehicle)
                if recording.duration <= story.begin:
                    why = recording.metadata.get("end_reason", "")
                    people.print(f"[yellow]{path.name} ends after {recording.duration:.1f} s: {why}[/yellow]")
                    continue
                moving = recording.between(story.begin, math.inf)
                models = compared_models([estimates], file)
                comparisons = compare_models(models, [moving], support=file.support, progress=step)
                save_run(recording, file, picture)
            page.print(comparison_table(comparisons, title=path.stem))
            page.print(f"  recording {path}\n  picture   {picture}")
        from upright.diagnosis.report.words import gist
        from upright.service.browser import open_page
        from upright.service.cli.diagnose import diagnose

        report = last.with_name("diagnosis.html")
        try:
            found = diagnose([last], vehicle=vehicle, begin=story.begin, report=report)
        except typer.Exit:  # insufficient data, which is said; the page goes on
            if not dashboard:
                raise
            return
        page.print(
            "\nNext: `upright model add mine.toml EFFECT --recording RECORDING` adds a missing effect. The whole way to"
            f" a controller: `upright commission --virtual --vehicle {vehicle}`."
        )
        page.print(f"\n[bold]{escape(gist(found))}[/bold]")
        opened = show and not dashboard and open_page(report)
        page.print(f"Report{', opened in the browser' if opened else ''}: {report.absolute()}", soft_wrap=True)

    experiments, data = experiment or list(story.experiments), data or Path("recordings")
    print_disturbance(requested_disturbance(file, hide or []))
    run_demo(file, hide or [], experiments, data, seed, follow, evaluate, port=port if dashboard else None)


def identified(path: Path, begin: float, file: VehicleFile) -> None:
    """Identify the recording at `path` from `begin` s on, print the result, and write it as the live estimates."""
    import json
    import math

    from upright.service.cli.inputs import fitting, load_recording
    from upright.service.offline.identify import identified as run
    from upright.service.offline.models import estimates_beside
    from upright.service.pages.identify import print_methods

    recording = load_recording(path, file.path).between(begin, math.inf)
    with fitting() as progress:
        document = run([recording], file, progress=progress).document
    print_methods(document, {})
    write_whole(estimates_beside(path), json.dumps(document))


def simulate(
    vehicle: VehicleArgument,
    bus: BusOption = None,
    hide: HideOption = None,
    fault: Annotated[
        list[str] | None,
        typer.Option("--fault", help="NAME@SECONDS: a fault that occurs at this time.", show_default=False),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the simulated sensors' noise and of the disturbance.")] = 1,
    socket: Annotated[
        Path | None,
        typer.Option(
            "--socket", help="The daemon's control socket, which says when to put a load on.", show_default=False
        ),
    ] = None,
) -> None:
    """Run a virtual vehicle on a CAN bus in real time: plant, servo inverters and IMU with their real protocols.

    Ctrl-C ends it. The daemon connects to it as to the real vehicle. When an experiment asks for a load, the virtual
    vehicle gets it.
    """
    import threading

    from upright.service.control.clients.api import socket_candidates
    from upright.service.virtual import vehicle as virtual_vehicle
    from upright.service.virtual.passenger import passenger
    from upright.simulation.faults import parse_faults
    from upright.vehicles.file import load

    file = load(vehicle)
    drives, imu = buses(file, bus)
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    disturbance = virtual_vehicle.requested_disturbance(file, hide or [])
    configuration = virtual_vehicle.configuration(file, hide or [], seed, disturbance=disturbance)
    faults = parse_faults(fault or [], [drive.name for drive in file.drive])
    people.print(f"Virtual {file.vehicle.id} on {' and '.join(dict.fromkeys((drives, imu)))}. Ctrl-C ends it.")
    print_disturbance(disturbance)
    with passenger([socket] if socket else socket_candidates(file.vehicle.id)) as person:
        run = virtual_vehicle.run(configuration, drives, imu, stop=stop, faults=faults, load=person)
    people.print(f"{run.cycles} cycles, {run.late_cycles} late, {run.skipped_cycles} skipped, {run.syncs} SYNCs.")


def serve(
    vehicle: VehicleArgument,
    bus: BusOption = None,
    data: DataOption = None,
    socket: Annotated[Path | None, typer.Option("--socket", help="Control socket.", show_default=False)] = None,
    mqtt: Annotated[
        str | None, typer.Option("--mqtt", help="Broker, HOST:PORT.", show_default="the vehicle file's")
    ] = None,
    metrics: Annotated[
        int,
        typer.Option(
            "--metrics",
            envvar="UPRIGHT_METRICS",
            min=0,
            max=65535,
            help="Serve metrics for Prometheus at this port of this machine, at /metrics; 0: do not.",
        ),
    ] = 0,
    foxglove: Annotated[
        int,
        typer.Option(
            "--foxglove",
            envvar="UPRIGHT_FOXGLOVE",
            min=0,
            max=65535,
            help="Show the vehicle to Foxglove, Lichtblick and PlotJuggler at this port of this machine; 0: do not.",
        ),
    ] = 0,
    virtual: Annotated[
        bool,
        typer.Option("--virtual", help="Use a virtual vehicle instead of a bus, in real time."),
    ] = False,
    hide: HideOption = None,
    seed: Annotated[int, typer.Option(help="With --virtual: seed of the sensors' noise and of the disturbance.")] = 1,
) -> None:
    """Run the daemon, which balances and identifies the vehicle.

    It starts disarmed; `upright experiment NAME` starts an experiment.
    """
    import asyncio
    import logging
    import os
    from contextlib import ExitStack

    # Matrices of six rows do not become faster by threads, and threads make the control loop miss its deadlines.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # The set-up reports a drive that does not answer once; canopen would report it twice a second.
    logging.getLogger("canopen").setLevel(logging.CRITICAL)

    from upright.service.bounded_log import bounded_log
    from upright.service.control.clients.api import default_socket
    from upright.service.control.daemon import Daemon, Places
    from upright.service.journal import log_as
    from upright.service.virtual.passenger import passenger
    from upright.service.virtual.serving import BUS, virtual_vehicle_beside
    from upright.service.virtual.vehicle import requested_disturbance
    from upright.vehicles.file import load

    file = load(vehicle)
    log_as(file.vehicle.id)
    if mqtt is not None:
        file = file.model_copy(update={"mqtt": file.mqtt.model_copy(update={"broker": mqtt})})
    if virtual and bus:
        raise typer.BadParameter("a virtual vehicle has its own bus", param_hint="--bus")
    if hide and not virtual:
        raise typer.BadParameter("only a virtual vehicle can hide effects: --virtual", param_hint="--hide")
    drives, imu = (BUS, BUS) if virtual else buses(file, bus)
    places = Places(
        drives_bus=drives,
        imu_bus=imu,
        data=data or Path(os.environ.get("STATE_DIRECTORY", "recordings")),
        socket=socket or default_socket(file.vehicle.id),
        metrics_port=metrics,
        foxglove_port=foxglove,
    )

    async def run() -> None:
        daemon = Daemon(file, places, lock_step=virtual, alone=True)
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) is not signal.SIG_IGN:  # as under nohup, where a closed terminal ends nothing
                loop.add_signal_handler(number, daemon.stop)
        people.print(
            f"Serving {file.vehicle.id} on {drives}" + (f" and {imu}" if imu != drives else "") + ", disarmed."
        )
        people.print(f"Use `upright status` or `upright experiment NAME` to control it (socket {places.socket}).")
        await daemon.run()

    disturbance = requested_disturbance(file, hide or []) if virtual else None
    print_disturbance(disturbance)
    with ExitStack() as beside:
        beside.enter_context(bounded_log())
        if virtual:
            person = beside.enter_context(passenger([places.socket]))
            beside.enter_context(virtual_vehicle_beside(file, hide or [], seed, disturbance=disturbance, load=person))
        asyncio.run(run())


def print_disturbance(disturbance: Disturbance | None) -> None:
    """Print the random torque that acts on the virtual vehicle, if any."""
    if disturbance is not None:
        people.print(f"Random disturbance: {disturbance}. `--hide disturbance=0` switches it off.")


def buses(vehicle: VehicleFile, options: list[str] | None) -> tuple[str, str]:
    """Addresses of the buses of drives and IMU, from --bus or the vehicle file."""
    drives, imu = vehicle.bus.drives, vehicle.bus.imu
    for option in options or []:
        role, _, address = option.rpartition("=") if option.startswith(("drives=", "imu=")) else ("", "", option)
        if ":" not in address:
            raise typer.BadParameter(f"{option!r} is not IFACE:CHANNEL, as in socketcan:can0", param_hint="--bus")
        if role in ("", "drives"):
            drives = address
        if role in ("", "imu"):
            imu = address
    return drives, imu
