"""Import the libraries that write other programs' formats, on demand."""

from __future__ import annotations

import importlib
from typing import Any

from characterisation.files.errors import MissingEnvironmentError


def needed(module: str, package: str, wanted: str) -> Any:
    """Import a module of the extra ``export``.

    Raises MissingEnvironmentError if it is not installed; ``wanted`` states the purpose, ``package`` its name on PyPI.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        raise MissingEnvironmentError(
            f"{wanted} needs {package}, which is not installed: pip install 'mitsim[export]'"
        ) from None
