"""The libraries that write other programs' formats: asked for only where one is wanted."""

from __future__ import annotations

import importlib
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mitsim.errors import MissingEnvironmentError


def needed(module: str, package: str, wanted: str) -> Any:
    """Import a module of the extra ``export``.

    Raises
    ------
    MissingEnvironmentError
        If it is not installed: ``wanted`` says for what, ``package`` its name on PyPI.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        raise MissingEnvironmentError(
            f"{wanted} needs {package}, which is not installed: pip install 'mitsim[export]'"
        ) from None


@contextmanager
def written_by_name(path: str | Path) -> Iterator[Path]:
    """Give a place of the same name in a folder beside ``path``, for libraries that go by the end of a name.

    The file takes its place when the block ends well; otherwise what was at ``path`` is there still.
    """
    path = Path(path).absolute()
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
        partial = Path(folder) / path.name
        yield partial
        partial.replace(path)
