"""The site: it builds without a warning, holds every page, command and public name, and fetches nothing."""

import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest
import typer

import characterisation
import mitsim
from mitsim.cli.program import app

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"

for needed in ("mkdocs", "material", "mkdocstrings", "mkdocs_jupyter"):
    pytest.importorskip(needed, exc_type=ImportError)


class Elements(HTMLParser):
    """The ids of a page, and what it loads and links."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.ids: set[str] = set()
        self.loaded: list[str] = []
        self.linked: list[str] = []
        self.feed(page.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        self.ids.add(given.get("id") or "")
        if tag in ("script", "img", "iframe", "source"):
            self.loaded.append(given.get("src") or "")
        if tag == "link" and given.get("rel") in ("stylesheet", "preconnect", "icon"):
            self.loaded.append(given.get("href") or "")
        if tag == "a":
            self.linked.append(given.get("href") or "")


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """The site, built once with warnings as errors."""
    folder = tmp_path_factory.mktemp("site")
    environment = os.environ | {"PYTHONPATH": str(ROOT), "NO_MKDOCS_2_WARNING": "1"}
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "-q", "-f", DOCS / "site/mkdocs.yml", "-d", folder],
        capture_output=True,
        text=True,
        env=environment,
        check=False,
        timeout=300,
        cwd=tmp_path_factory.mktemp("cache"),
    )
    assert built.returncode == 0, built.stdout + built.stderr
    return folder


@pytest.fixture(scope="module")
def navigation(site) -> set[str]:
    """Pages that the start page's navigation links."""
    text = (site / "index.html").read_text(encoding="utf-8")
    links = re.findall(r'<a href="([^"#:]+\.html)" class="md-nav__link', text)
    return {os.path.normpath(link) for link in links} | {"index.html"}


def test_every_page_is_in_the_navigation(navigation):
    pages = {
        path.relative_to(DOCS).with_suffix(".html").as_posix()
        for kind in ("*.md", "*.ipynb")
        for path in DOCS.rglob(kind)
    }
    assert len(pages) > 60
    assert pages - navigation == set()


def commands(command, words="mitsim"):
    """Every command by its words."""
    yield words, command
    for name, below in getattr(command, "commands", {}).items():
        yield from commands(below, f"{words} {name}")


def test_every_command_has_its_section_and_options(site):
    page = site / "reference/commands.html"
    ids, text = Elements(page).ids, page.read_text(encoding="utf-8")
    for words, command in commands(typer.main.get_command(app)):
        assert words.replace(" ", "-") in ids, words
        for option in command.params:
            assert option.param_type_name == "argument" or option.opts[0] in text, (words, option.name)


@pytest.mark.parametrize("package", [mitsim, characterisation], ids=lambda package: package.__name__)
def test_every_public_name_has_its_entry(site, package):
    page = site / f"reference/interface-{package.__name__}.html"
    text = page.read_text(encoding="utf-8")
    ids = Elements(page).ids
    missing = {name for name in package.__all__ if f"{package.__name__}.{name}" not in ids}
    assert missing == set()
    assert not re.search(r":(?:func|class|meth|data):", text)
    assert "<!-- names" not in text and ":::" not in text


def test_pages_fetch_nothing_and_their_links_lead_somewhere(site):
    for page in site.rglob("*.html"):
        elements = Elements(page)
        assert [one for one in elements.loaded if re.match(r"(https?:)?//", one)] == [], page.name
        if page.name == "404.html":  # its links start at the root of a host
            continue
        for link in elements.linked:
            path = link.partition("#")[0]
            if path and not re.match(r"[a-z]+:", path):
                assert (page.parent / path).exists(), (page.name, link)
