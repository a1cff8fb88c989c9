"""`upright commission`: the steps of a commissioning, one after the other, with a person who decides."""

from __future__ import annotations

import json as json_module
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from upright.service.cli.arguments import VehicleOption
from upright.service.cli.live import HideOption
from upright.service.output import check_folder, page, people
from upright.service.whole_file import write_whole

if TYPE_CHECKING:
    from upright.service.commission.guide import Guide
    from upright.vehicles.commissioning import Entry, Step
    from upright.vehicles.file import VehicleFile

BUS = "virtual:upright-commission"
MARKS = {
    "accepted": "[green]accepted[/green]",
    "not_accepted": "[red]NOT ACCEPTED[/red]",
    "failed": "[red]FAILED[/red]",
}


def register(app: typer.Typer) -> None:
    """Add the command of this module to `app`."""
    app.command(
        epilog="Example: `upright commission --virtual --yes` shows the whole way without hardware; on a vehicle,"
        " `upright commission`, and on the next day `upright commission --resume`"
    )(commission)


def commission(
    vehicle: VehicleOption = "monocab",
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask; stop at the first step that fails.")] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Go on where the last one stopped.")] = False,
    begin: Annotated[
        bool, typer.Option("--begin", help="Begin a new one; the record of the last one is kept.")
    ] = False,
    first: Annotated[
        str | None, typer.Option("--from", metavar="STEP", help="Repeat from this step on.", show_default=False)
    ] = None,
    only: Annotated[
        str | None, typer.Option("--step", metavar="STEP", help="Carry out this step alone.", show_default=False)
    ] = None,
    recording: Annotated[
        Path | None,
        typer.Option("--recording", help="With --step: evaluate this recording of its experiment.", show_default=False),
    ] = None,
    skip: Annotated[
        str | None, typer.Option("--skip", metavar="STEP", help="Skip this step, with --reason.", show_default=False)
    ] = None,
    reason: Annotated[
        str, typer.Option("--reason", help="Why the step may be skipped; kept in the record.", show_default=False)
    ] = "",
    report: Annotated[
        Path | None, typer.Option("--report", help="Write the report to this file, and do nothing else.")
    ] = None,
    virtual: Annotated[
        bool, typer.Option("--virtual", help="Commission a virtual vehicle, with a daemon of its own.")
    ] = False,
    hide: HideOption = None,
    seed: Annotated[int, typer.Option(help="With --virtual: seed of the sensors' noise and of the disturbance.")] = 1,
    data: Annotated[
        Path | None,
        typer.Option("--data", help="With --virtual: folder of the recordings.", show_default="recordings/virtual"),
    ] = None,
    socket: Annotated[
        Path | None, typer.Option("--socket", help="The daemon's control socket.", show_default=False)
    ] = None,
    json: Annotated[
        bool, typer.Option("--json", help="One JSON document per event on stdout; nothing is asked.")
    ] = False,
) -> None:
    """Commission a vehicle, from drives switched off to the full controller: every step says why, why now, what has to
    be prepared, and what is accepted.

    The daemon (`upright serve`) keeps the record, so that it can be resumed after a restart or a day, here or on the
    dashboard. Ctrl-C during an experiment lowers the vehicle. Exit code 1: a step was not accepted.
    """
    from upright.service.cli.talk import follow
    from upright.service.commission.guide import Guide
    from upright.service.control.clients import api
    from upright.vehicles.file import load

    check_folder(report)
    given = [
        name
        for name, value in (
            ("--step", only),
            ("--skip", skip),
            ("--from", first),
            ("--resume", resume),
            ("--begin", begin),
            ("--report", report),
        )
        if value
    ]
    if len(given) > 1:
        raise typer.BadParameter("give one of them", param_hint=", ".join(given))
    if (hide or data) and not virtual:
        raise typer.BadParameter("applies to a virtual vehicle: --virtual", param_hint="--hide, --data")
    if recording is not None and only is None:
        raise typer.BadParameter("needs --step", param_hint="--recording")
    file = load(vehicle)
    events = Events(json=json)
    with ExitStack() as beside:
        sockets = [socket] if socket else api.socket_candidates(file.vehicle.id)
        begins = begin or (virtual and not given)
        if virtual:
            place = data or Path("recordings/virtual")
            sockets = [beside.enter_context(_virtual(file, hide or [], seed, place, begins=begins))]
        guide = Guide(file, sockets, events.followed(follow))
        code = _commission(
            guide,
            events,
            yes=yes,
            resume=resume,
            begin=begins,
            first=first,
            only=only,
            recording=recording,
            skip=skip,
            reason=reason,
            report=report,
        )
    if code:
        raise typer.Exit(code)


def _commission(
    guide: Guide,
    events: Events,
    *,
    yes: bool,
    resume: bool,
    begin: bool,
    first: str | None,
    only: str | None,
    recording: Path | None,
    skip: str | None,
    reason: str,
    report: Path | None,
) -> int:
    if report is not None:
        write_whole(report, guide.report())
        events.result(0, f"Report: {report}")
        return 0
    if skip is not None:
        entry = guide.skip(skip, reason)
        events.outcome(guide, entry)
        events.result(0, f"{skip} is skipped.")
        return 0
    if only is not None:
        outcome = _carried_out(guide, events, guide.steps.find(only), yes=yes, recording=recording)
        if outcome is None:
            return 1
        done = outcome.state in ("accepted", "skipped")
        events.result(0 if done else 1, "" if done else f"{only}: {outcome.state.value.replace('_', ' ')}.")
        return 0 if done else 1
    began = [each for each in guide.record() if each.step]
    if begin:
        guide.begin()
    elif began and not resume and first is None:
        from upright.vehicles.commissioning import CommissioningError

        following = guide.steps.next(guide.record())
        raise CommissioningError(
            f"a commissioning was begun, and {following.id if following else 'nothing'} comes next.",
            remedy="--resume goes on, --from STEP repeats from a step on, --begin begins a new one.",
        )
    return _go_through(guide, events, first, yes=yes)


def _go_through(guide: Guide, events: Events, first: str | None, *, yes: bool) -> int:
    """Step after step, from `first` on or from the next one on."""
    again = [each.id for each in guide.steps.step]
    again = again[again.index(guide.steps.find(first).id) :] if first is not None else []
    while True:
        record = guide.record()
        step = guide.steps.find(again.pop(0)) if again else guide.steps.next(record)
        if step is None:
            report = guide.save_report()
            events.result(0, f"The commissioning is complete. Report: {report}")
            return 0
        events.step(guide, step)
        if events.json and not yes:
            events.result(0, f"{step.id} comes next; --yes carries it out, --step and --skip do one at a time.")
            return 0
        outcome = _carried_out(guide, events, step, yes=yes)
        if outcome is None:
            events.result(1, "Stopped. `upright commission --resume` goes on.")
            return 1
        done = outcome.state in ("accepted", "skipped")
        if yes and not done:
            report = guide.save_report()
            events.result(1, f"Stopped at {step.id}. Report: {report}")
            return 1
        if not done and again:
            again.insert(0, step.id)


def _carried_out(guide: Guide, events: Events, step: Step, *, yes: bool, recording: Path | None = None) -> Entry | None:
    """One step, as the person decides; None if the person stops."""
    if not yes and not events.json:
        answer = typer.prompt("  [Enter] carry it out, s skip it, q stop", default="", show_default=False, err=True)
        if answer.strip().lower().startswith("q"):
            return None
        if answer.strip().lower().startswith("s"):
            entry = guide.skip(step.id, typer.prompt("  Why may it be skipped?", err=True))
            events.outcome(guide, entry)
            return entry
    entry = guide.carry_out(step.id, recording)
    events.outcome(guide, entry)
    return entry


class Events:
    """What happens, as text for people or as JSON lines for programs."""

    def __init__(self, *, json: bool) -> None:
        self.json = json

    def _say(self, **event: Any) -> None:
        typer.echo(json_module.dumps(event, default=str))
        sys.stdout.flush()

    def followed(self, follow: Any) -> Any:
        """`follow` for people; the messages of an experiment themselves for programs."""
        if not self.json:
            return follow

        def passed(messages: Any) -> dict[str, Any]:
            last: dict[str, Any] = {}
            for last in messages:
                if last["type"] == "event":
                    self._say(**last)
            return last

        return passed

    def step(self, guide: Guide, step: Step) -> None:
        """A step comes next."""
        if self.json:
            self._say(type="step", **step.model_dump())
            return
        number = [each.id for each in guide.steps.step].index(step.id) + 1
        page.print(f"\n[bold]{number}. {step.title}[/bold]  ({step.id}, {number} of {len(guide.steps.step)})")
        page.print(f"  {step.why}\n  Now: {step.why_now}")
        if step.prepare:
            page.print(f"  [yellow]Before:[/yellow] {step.prepare}")
        for each in step.acceptance:
            page.print(f"  accepted if {each.title}: {each.limits}")

    def outcome(self, guide: Guide, entry: Entry) -> None:
        """What became of a step."""
        if self.json:
            self._say(type="outcome", **entry.model_dump(mode="json"))
            return
        from upright.service.commission.report import number_text
        from upright.vehicles.commissioning import is_within

        for line in entry.text:
            page.print(f"  {line}", markup=False)
        if entry.reason:
            page.print(f"  {entry.reason}", markup=False)
        step = guide.steps.find(entry.step)
        for each in step.acceptance if entry.numbers else ():
            number = entry.numbers.get(each.quantity)
            value = number_text(number.value, number.std, number.unit) if number else "not known"
            within = is_within(each, entry.numbers)
            mark = "[green]within[/green]" if within else "[red]NOT WITHIN[/red]"
            page.print(f"  {each.title}: [bold]{value}[/bold]  ({each.limits}) {mark}")
            if not within:
                page.print(f"    [yellow]{each.remedy}[/yellow]")
        page.print(f"  {step.id}: {MARKS.get(entry.state.value, entry.state.value)}")

    def result(self, code: int, text: str) -> None:
        """The end."""
        if self.json:
            self._say(type="result", exit_code=code, text=text)
        elif text:
            (people if code else page).print(f"\n{text}")


def _virtual(file: VehicleFile, hide: list[str], seed: int, data: Path, *, begins: bool) -> Any:
    """A virtual vehicle and its daemon, as a context manager that gives the control socket. `begins`: it has not been
    commissioned yet."""
    from contextlib import contextmanager

    from upright.service.cli.inputs import working
    from upright.service.control.daemon import Places
    from upright.service.observer.live.online_estimators import estimators_of
    from upright.service.virtual.daemon import daemon_beside
    from upright.service.virtual.vehicle import before_commissioning, requested_disturbance

    @contextmanager
    def beside() -> Any:
        data.mkdir(parents=True, exist_ok=True)
        with working() as step:
            step("preparing the estimators (on the first start on a computer, their model is compiled)")
            estimators_of(file).join()
        places = Places(BUS, BUS, data, data.absolute() / f"{file.vehicle.id}.sock")
        people.print(f"A virtual {file.vehicle.id} gets ready; recordings are in {data}.")
        shaken = requested_disturbance(file, hide)
        how = before_commissioning(file) if begins else lambda configuration: configuration
        with daemon_beside(file, places, hide, seed, disturbance=shaken, configure=how):
            yield places.socket

    return beside()
