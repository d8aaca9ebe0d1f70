"""What live cameras of all makers share: they are left as they were found on closing, on every error and on Ctrl-C."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Self

from mitsim.capture.devices.device_error import check_open


class LiveCamera(ABC):
    """An open camera, with its name ``where`` in messages; a context manager that closes it.

    After an error the camera must be opened again.
    """

    where: str
    _fault = ""
    _closed = False

    def close(self) -> None:
        """Restore the camera's previous state, and close it; further calls do nothing."""
        if not self._closed:
            self._closed = True
            self._release()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    @contextmanager
    def _closed_on_error(self, operation: str) -> Iterator[None]:
        """Run a block with a working camera; on any error close it before the error is raised."""
        check_open(self.where, operation, self._closed, self._fault)
        try:
            yield
        except BaseException as error:  # Ctrl-C as well
            self._fault = operation
            try:
                fault = self._fault_of(error, operation)  # may need the library, so before closing
            finally:
                self.close()
            if fault is error:
                raise
            raise fault from error

    @abstractmethod
    def _release(self) -> None:
        """Restore and close the device, as far as it responds."""

    @abstractmethod
    def _fault_of(self, error: BaseException, operation: str) -> BaseException:
        """Return the error to raise instead of ``error``, or ``error`` itself."""
