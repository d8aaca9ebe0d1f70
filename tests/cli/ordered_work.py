"""Commands of a test, as ``python ordered_work.py FOLDER WAY``: two processes work on orders of a minute.

The command keeps what is finished, as ``mitsim render --many``; ``in order`` also ends as ``mitsim study state`` does.
"""

import sys
import time
from pathlib import Path


def last(order):
    number, folder = order
    Path(folder, f"began_{number}").write_text("")
    if number:
        time.sleep(60)
    return number


def write_finished(folder):
    from mitsim.running.executor import Pool

    for number, _ in Pool(2).distribute(range(6), lambda number: (number, str(folder)), last):
        (folder / f"finished_{number}").write_text("")


def work(folder: Path, way: str):
    from mitsim.running.time_limit import ending_in_order, stopped_by_user

    if way == "at once":
        write_finished(folder)
        return
    with ending_in_order():
        write_finished(folder)
        (folder / "written").write_text("")
        stopped = stopped_by_user()
    if stopped:
        raise KeyboardInterrupt


if __name__ == "__main__":  # not in the processes, which would import the program too
    from mitsim.cli.program import run_application

    run_application(lambda: work(Path(sys.argv[1]), sys.argv[2]))
