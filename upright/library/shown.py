"""Results for people: as text, in a notebook, and as a table of pandas."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from io import StringIO
from pathlib import Path
from shutil import get_terminal_size
from typing import TYPE_CHECKING, Any

from rich.console import Console

from upright.library.layers.effects import UprightError
from upright.library.layers.recordings import in_python

if TYPE_CHECKING:
    import pandas
    from numpy.typing import NDArray

    from upright.library.layers.recordings import Recorded

NOTEBOOK_WIDTH = 110
"""Characters of a line in a notebook."""
BLOCK = '<pre style="white-space:pre;overflow-x:auto;line-height:1.25">{code}</pre>'

Print = Callable[[Console], None]


class MissingPackage(UprightError):
    """An optional `package` that a function needs is not installed."""

    def __init__(self, what: str, package: str) -> None:
        super().__init__(
            f"{what} needs {package}, which is not installed.", remedy=f"pip install 'upright[{package}]'."
        )
        self.package = package


@in_python()
def as_text(write: Print) -> str:
    """What `write` prints, without colours, as wide as the terminal."""
    text = StringIO()
    write(_console(text, get_terminal_size((100, 24)).columns))
    return "\n".join(line.rstrip() for line in text.getvalue().splitlines())


@in_python()
def as_html(write: Print) -> str:
    """What `write` prints, for a notebook."""
    console = _console(StringIO(), NOTEBOOK_WIDTH, record=True, color_system="truecolor")
    write(console)
    return console.export_html(inline_styles=True, code_format=BLOCK)


def _console(file: StringIO, width: int, **more: Any) -> Console:
    """A console that writes to `file` alone, in a notebook, too."""
    return Console(file=file, width=width, highlight=False, force_jupyter=False, **more)


def as_frame(columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> pandas.DataFrame:
    """The rows as a table of pandas. Raises MissingPackage."""
    return frame_of({name: [row[place] for row in rows] for place, name in enumerate(columns)})


def frame_of(columns: Mapping[str, Sequence[Any] | NDArray[Any]]) -> pandas.DataFrame:
    """The columns as a table of pandas. Raises MissingPackage."""
    try:
        import pandas
    except ModuleNotFoundError as error:
        raise MissingPackage("to_frame", "pandas") from error
    return pandas.DataFrame(dict(columns))


def existing(recordings: Sequence[Recorded]) -> list[Path]:
    """The files that the recordings are of."""
    sources = dict.fromkeys(each.source for each in recordings)
    return [Path(source) for source in sources if Path(source).is_file()]
