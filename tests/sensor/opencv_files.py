"""Calibrations as OpenCV's programs write them."""

from pathlib import Path
from typing import Any

import cv2


def opencv_file(path: Path, /, **values: Any) -> Path:
    """Write values by name into a file of OpenCV's FileStorage."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in values.items():
        storage.write(name, value)
    storage.release()
    return path
