"""The page of all commands, from what `--help` prints of them.

Typer brings a copy of Click, which no extension of Sphinx reads; so the few lines here, on what Click has in common.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from typing import Any

import typer

from upright.service.cli import app

_HEAD = """\
# Commands, from `--help`

Every command with its arguments and options, as `upright COMMAND --help` prints them. What they do together, and how
they behave: [Command line](cli.md).

"""


def markdown() -> str:
    """The whole page."""
    return _HEAD + "".join(_section(name, command) for name, command in commands())


def commands() -> Iterator[tuple[str, Any]]:
    """(name, command) of every command that can be run, with groups expanded."""

    def walk(name: str, command: Any) -> Iterator[tuple[str, Any]]:
        if not hasattr(command, "commands"):
            yield name, command
            return
        for inner, each in command.commands.items():
            if not each.hidden:
                yield from walk(f"{name} {inner}", each)

    yield from walk("upright", typer.main.get_command(app))


def _section(name: str, command: Any) -> str:
    context = command.make_context(name, [], resilient_parsing=True)
    usage = " ".join([name, *command.collect_usage_pieces(context)])
    lines = [f"## `{name}`", "", "```text", usage, "```", "", inspect.cleandoc(command.help or ""), ""]
    records = [record for each in command.params if (record := each.get_help_record(context))]
    if records:
        lines += ["| argument or option | meaning |", "|---|---|"]
        lines += [f"| `{names}` | {_cell(meaning)} |" for names, meaning in records]
    return "\n".join([*lines, "", command.epilog or "", ""])


def _cell(text: str) -> str:
    return text.replace("\n", " ").replace("|", "\\|").replace("<", "&lt;").replace("[", "\\[").replace("*", "\\*")
