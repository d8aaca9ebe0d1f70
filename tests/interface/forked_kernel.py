"""A kernel of IPython, ``forked_kernel.py -f CONNECTION``, forked from a process that has imported the program."""

from __future__ import annotations

import os
import signal
from typing import Any

from jupyter_client import AsyncKernelManager
from jupyter_client.provisioning import LocalProvisioner
from quick_process import QuickProcess


class Forked:
    """A :class:`QuickProcess` as the manager of a kernel asks for it, by the names of ``Popen``."""

    stdin = stdout = stderr = None

    def __init__(self, command: list[str], folder: str) -> None:
        self._process = QuickProcess(*command, folder=folder)

    def poll(self) -> int | None:
        return self._process.exitcode

    def wait(self) -> int:
        return self._process.wait()[0]

    def send_signal(self, number: int) -> None:
        os.kill(self._process.pid, number)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


class ForkedProvisioner(LocalProvisioner):
    async def launch_kernel(self, cmd: list[str], **kwargs: Any) -> Any:
        place = cmd.index("-f")
        self.process = Forked([__file__, *cmd[place : place + 2]], kwargs["cwd"])
        return self.connection_info


def forked_kernels() -> AsyncKernelManager:
    """Return a manager whose kernel is forked; ``cwd`` is to be given on its start."""
    manager = AsyncKernelManager(kernel_name="python3")
    manager.provisioner = ForkedProvisioner(parent=manager, kernel_spec=manager.kernel_spec, kernel_id="forked")
    return manager


if __name__ == "__main__":
    import matplotlib
    from ipykernel.kernelapp import launch_new_instance

    # a kernel names it in the environment, which is too late where Matplotlib is imported already
    matplotlib.use("module://matplotlib_inline.backend_inline")
    launch_new_instance()
