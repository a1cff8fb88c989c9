"""The manual as a site: built with every warning as an error, and read from disk, without a network."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from html.parser import HTMLParser
from os.path import normpath
from pathlib import Path
from urllib.parse import unquote, urlsplit

import numpy as np
import pytest
import sympy
from playwright.sync_api import Page, expect
from watched import PATIENCE, chromium

import upright
from upright.models.effects.catalogue import CATALOGUE

REPOSITORY = Path(__file__).resolve().parents[2]
BUILD = REPOSITORY / "docs" / "site" / "build.py"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, as `make docs` builds it."""
    target = tmp_path_factory.mktemp("docs")
    done = subprocess.run([sys.executable, BUILD, target], capture_output=True, text=True, cwd=REPOSITORY)
    assert done.returncode == 0, done.stderr
    return target


class Links(HTMLParser):
    """What a page loads, where its links lead, and the anchors that it has."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.loaded: list[str] = []
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self.feed(page.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        self.anchors |= {given[name] for name in ("id", "name") if name in given}
        if tag in ("a", "form") and (target := given.get("href") or given.get("action")):
            self.links.append(target)
        elif target := given.get("src") or given.get("href"):
            self.loaded.append(target)


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, Links]:
    """The site's pages by their files."""
    return {page: Links(page) for page in site.rglob("*.html")}


def test_every_link_leads_to_a_page_and_an_anchor_of_the_site(pages: dict[Path, Links]) -> None:
    assert len(pages) > 100
    missing = []
    for page, found in pages.items():
        for target in {*found.links, *found.loaded}:
            parts = urlsplit(target)
            if parts.scheme in ("http", "https", "data"):
                continue
            file = Path(normpath(page.parent / unquote(parts.path))) if parts.path else page
            anchored = file not in pages or not parts.fragment or unquote(parts.fragment) in pages[file].anchors
            if not file.is_file() or not anchored:
                missing.append(f"{page.name}: {target}")
    assert not missing


def test_no_page_loads_anything_from_a_network(site: Path, pages: dict[Path, Links]) -> None:
    loaded = {target for found in pages.values() for target in found.loaded}
    styles = "".join(file.read_text() for file in site.rglob("*.css"))
    loaded |= set(re.findall(r"""(?:url\(|@import)\s*["']?([^"')]+)""", styles))
    assert len(loaded) > 50
    assert not [target for target in loaded if urlsplit(target).scheme in ("http", "https") or target[:2] == "//"]


def test_site_has_the_names_of_library_commands_and_schemas(site: Path, pages: dict[Path, Links]) -> None:
    library = pages[site / "reference" / "api.html"].anchors
    public = {f"upright.{name}" for name in upright.__all__ if not name.startswith("__")}
    assert not public - library
    assert {"upright.Recording.between", "upright.Effect.amplitudes"} <= library
    commands = pages[site / "reference" / "commands.html"].anchors
    assert {"upright-diagnose", "upright-config-schema", "upright-model-add"} <= commands
    keys = (site / "reference" / "vehicle-file-schema.html").read_text()
    assert all(f">{key}<" in keys for key in ("heartbeat_timeout", "angular_rate_change_deg", "missed_cycles"))
    assert "correlation_time_std" in (site / "reference" / "mqtt" / "diagnosis.html").read_text()


def test_every_effect_has_an_entry_with_a_picture(site: Path, pages: dict[Path, Links]) -> None:
    gallery, effects = (pages[site / "reference" / f"{page}.html"] for page in ("gallery", "effects"))
    for name in CATALOGUE:
        anchor = name.replace("_", "-")
        assert f"effects.html#{anchor}" in gallery.links
        assert anchor in effects.anchors
        assert f"../_images/{name}.svg" in gallery.loaded
        assert f"../_images/{name}.svg" in effects.loaded
        assert "<path" in (site / "_images" / f"{name}.svg").read_text()


MOTION = "(0.4 + 0.6 * t / (4 * pi)) * sin(t)"
"""Of what is moved in the pictures: as the page says, a sine whose amplitude grows."""


@pytest.mark.parametrize(
    ("name", "law"),
    [
        ("viscous_friction", lambda x, t: -sympy.diff(x, t)),
        ("cubic_stiffness", lambda x, t: -(x**3)),
        ("input_gain", lambda x, t: x),
        ("input_delay", lambda x, t: x.subs(t, t - sympy.Rational(1, 80)) - x),
        ("sensor_offset", lambda x, t: sympy.Integer(1) + 0 * t),
    ],
)
def test_picture_shows_the_textbook_s_law(
    monkeypatch: pytest.MonkeyPatch, name: str, law: Callable[[sympy.Expr, sympy.Symbol], sympy.Expr]
) -> None:
    monkeypatch.syspath_prepend(str(BUILD.parent))
    from pictures import LASTS, added

    t = sympy.Symbol("t")
    time = np.linspace(0.0, LASTS, 300)
    expected = np.broadcast_to(sympy.lambdify(t, law(sympy.sympify(MOTION, {"t": t}), t))(time), time.shape)
    drawn = np.broadcast_to(added(CATALOGUE[name], time), time.shape)
    size = np.dot(drawn, expected) / np.dot(expected, expected)  # the amplitude that the picture takes
    assert size > 0.0
    np.testing.assert_allclose(drawn, size * expected, atol=1e-9)


def test_picture_of_a_lag_obeys_its_differential_equation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(BUILD.parent))
    from pictures import LASTS, added

    time = np.linspace(0.0, LASTS, 20_001)
    command = (0.4 + 0.6 * time / LASTS) * np.sin(time)
    late = command + added(CATALOGUE["actuator_lag"], time)
    slope = np.gradient(late, time)[100:-1]
    behind = (command - late)[100:-1]
    lag = np.dot(behind, slope) / np.dot(slope, slope)
    assert lag > 0.0
    np.testing.assert_allclose(behind, lag * slope, atol=1e-3 * np.abs(behind).max())


def test_search_finds_an_effect_from_disk_in_a_browser(site: Path) -> None:
    with chromium() as browser:
        page: Page = browser.new_context(offline=True).new_page()
        errors: list[str] = []
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
        page.goto((site / "search.html").as_uri() + "?q=backlash")
        found = page.get_by_role("link", name="Effects > backlash", exact=True)
        expect(found).to_be_visible(timeout=PATIENCE)
        found.click()
        expect(page.get_by_role("heading", name="backlash", exact=True)).to_be_visible(timeout=PATIENCE)
    assert not errors


def test_links_without_a_target_fail_the_build(tmp_path: Path) -> None:
    source = tmp_path / "source"
    source.mkdir()
    (source / "index.md").write_text("# A manual\n\n[no page](no-page.md) and [no heading](index.md#no-heading)\n")
    code = "import sys; from pathlib import Path; from build import sphinx; sys.exit(sphinx(*map(Path, sys.argv[1:])))"
    command = [sys.executable, "-c", code, str(source), str(tmp_path / "site")]
    done = subprocess.run(command, capture_output=True, text=True, cwd=BUILD.parent)
    assert done.returncode != 0
    assert "no-page.md" in done.stderr
    assert "no-heading" in done.stderr
