"""The gallery of effects: a card for each effect of the catalogue, and its picture in the page that describes it."""

from __future__ import annotations

from pictures import picture

from upright.models.effect import Effect
from upright.models.effects.catalogue import CATALOGUE, families

_HEAD = """\
# Effects gallery

What a model may lack, as one sees it: each effect at its usual values, while its place is moved to and fro with growing
amplitude (grey). At a joint the force is drawn, on an actuator the change of the command, on a sensor the error of the
reading; over time, over the coordinate, and over its rate. Each name leads to equation, parameters with units, trace in
a record, neighbours, and the experiment that separates them ([effects](effects.md)).

"""


def index() -> str:
    """The page of all cards, by family."""
    parts = [_HEAD]
    for family, effects in families().items():
        cards = "\n".join(map(_card, effects))
        parts.append(f'## {family.replace("_", " ").capitalize()}\n\n<div class="gallery">\n\n{cards}\n</div>\n\n')
    return "".join(parts)


def pictures() -> dict[str, str]:
    """SVG by its place in the site."""
    return {f"reference/effects/{name}.svg": picture(effect) for name, effect in CATALOGUE.items()}


def illustrated(page: str) -> str:
    """The page of effects with the picture of each below its heading."""
    for name in CATALOGUE:
        heading = f"### `{name}`\n"
        page = page.replace(heading, f"{heading}\n{_image(name)}\n", 1)
    return page


def _card(effect: Effect) -> str:
    neighbours = ", ".join(f"[{name}](effects.md#{name})" for name in effect.confused_with)
    lines = [f"[`{effect.name}`](effects.md#{effect.name})", _image(effect.name), f"{effect.title}."]
    lines += [f"`{effect.equation}`", f"Confused with {neighbours}."]
    return "\n\n".join(['<div class="card">', *lines, "</div>", ""])


def _image(name: str) -> str:
    return f"![What {name} adds, over time, coordinate and rate](effects/{name}.svg)"
