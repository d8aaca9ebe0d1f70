"""The notebooks run from top to bottom, and are kept with the outputs and pictures of such a run."""

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "notebooks"
BOOKS = sorted(FOLDER.glob("*.ipynb"))

by_book = pytest.mark.parametrize("path", BOOKS, ids=lambda path: path.stem)

#: a notebook on a code host is read, not downloaded
LARGEST_BYTES = 400_000


def code(book) -> list:
    return [cell for cell in book.cells if cell.cell_type == "code"]


def words(cell) -> str:
    """What a cell printed on stdout."""
    return "".join(one["text"] for one in cell.outputs if one.get("name") == "stdout")


def pictures(cell) -> int:
    return sum("image/png" in one.get("data", {}) for one in cell.outputs)


@by_book
def test_the_notebook_is_kept_as_it_was_run(path):
    book = nbformat.read(path, as_version=4)
    nbformat.validate(book)
    assert path.stat().st_size < LARGEST_BYTES
    cells = code(book)
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    assert not [one for cell in cells for one in cell.outputs if one.output_type == "error"]
    assert sum(map(pictures, cells)) >= 1
    assert path.name in (FOLDER.parent / "reference" / "interface.md").read_text(encoding="utf-8")


@by_book
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")
def test_the_notebook_runs(path):
    kept = nbformat.read(path, as_version=4)
    book = nbformat.read(path, as_version=4)
    NotebookClient(book, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(FOLDER)}}).execute()
    for before, after in zip(code(kept), code(book), strict=True):
        # values change with the machine; how much is printed and drawn does not
        assert len(words(after).splitlines()) == len(words(before).splitlines()), after.source
        assert pictures(after) == pictures(before), after.source
