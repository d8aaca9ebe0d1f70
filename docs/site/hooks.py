"""What the site adds to the pages of ``docs``: references made from the code, and two files of the repository's root.

MkDocs calls the functions ``on_...`` while it builds. A page keeps its place for generated text as a comment:
``<!-- commands -->`` or ``<!-- names: mitsim -->``.
"""

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath
from typing import Any

from command_pages import command_reference
from interface_pages import name_reference
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[2]

#: pages made from files outside of ``docs``: file of the repository -> page of the site
FROM_ROOT = {"CHANGELOG.md": "changelog.md", "SECURITY.md": "security.md"}

LINK = re.compile(r"(?<!!)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s]+)\)")
FENCE = re.compile(r"^```.*?^```", re.DOTALL | re.MULTILINE)


def on_files(files: Files, config: Any) -> Files:
    """Add the pages made from files of the root."""
    for name, page in FROM_ROOT.items():
        files.append(File.generated(config, page, content=(ROOT / name).read_text(encoding="utf-8")))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Fill in the references, and mend the links that leave ``docs``."""
    if "<!-- commands -->" in markdown:
        markdown = markdown.replace("<!-- commands -->", command_reference())
    for package in re.findall(r"<!-- names: (\w+) -->", markdown):
        markdown = markdown.replace(f"<!-- names: {package} -->", name_reference(package))
    if page.file.src_uri.endswith(".md"):
        markdown = with_links_inside(markdown, page.file.src_uri)
    return markdown


def on_page_content(content: str, page: Any, config: Any, files: Files) -> str:
    """Lead the links of a notebook to pages of the site."""
    if page.file.src_uri.endswith(".ipynb"):
        content = re.sub(r'(href="[^":]+)\.(?:md|ipynb)(["#])', r"\1.html\2", content)
    return content


def with_links_inside(markdown: str, page: str) -> str:
    """Return the text of a page with each link that leaves ``docs`` led to a page of the site, or made a code span.

    ``page`` is the page's path from ``docs``. Links are relative to the file that was written: for a page made from a
    file of the root, to the root.
    """
    sources = {made: name for name, made in FROM_ROOT.items()}
    written = PurePosixPath(sources[page]) if page in sources else PurePosixPath("docs") / page
    depth = len(PurePosixPath(page).parents) - 1

    def mended(found: re.Match[str]) -> str:
        text, target = found.groups()
        path, mark, anchor = target.partition("#")
        if not path or re.match(r"[a-z]+:", target):
            return found.group()
        goal = (ROOT / written.parent / path).resolve().relative_to(ROOT).as_posix()
        if goal.startswith("docs/") and page not in sources:
            return found.group()
        inside = FROM_ROOT.get(goal) or (goal.removeprefix("docs/") if goal.startswith("docs/") else None)
        if inside is None:
            return f"{text} (`{goal}`)"
        return f"[{text}]({'../' * depth}{inside}{mark}{anchor})"

    pieces, at = [], 0
    for fence in FENCE.finditer(markdown):
        pieces += [LINK.sub(mended, markdown[at : fence.start()]), fence.group()]
        at = fence.end()
    return "".join([*pieces, LINK.sub(mended, markdown[at:])])
