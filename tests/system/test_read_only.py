"""Folders of a read-only file system: whoever wants to write there is told so in one line."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.report.conftest import write_run

ROOT = Path(__file__).parents[2]

MOUNT = 'mount --bind "$0" "$0" && mount -o remount,ro,bind "$0" && exec "$@"'

#: commands, ``{}`` being the folder, and what the last line says
COMMANDS = {
    "report": (["report", "{}/run"], "report.html: found Read-only file system"),
    "report --pdf": (["report", "--pdf", "{}/run"], "sheet.pdf: found Read-only file system"),
    "check": (["check", "scenes/coupon/matt_white.xml", "--html", "{}/a.html"], "which is not writable"),
    "score": (["study", "score", "scenes/two_pillars/study.toml", "-o", "{}/run"], "which is not writable"),
    "import": (["import", "{}/a.pcd", "-o", "{}/c"], "a.pcd"),
}

#: one process for all commands, as only processes that are started there see the mount, and each imports for seconds
CALL_ALL = """
import json, sys
from tests.plain_pages import without_pictures
from tests.shell import mitsim_here
calls = json.loads(sys.argv[1])
with without_pictures():
    ended = {name: mitsim_here(*call, code=None) for name, call in calls.items()}
print(json.dumps({name: [done.returncode, done.stderr] for name, done in ended.items()}))
"""


@pytest.fixture(scope="module")
def ended(tmp_path_factory):
    """Exit code and messages of each command, on a folder with a run that no command here can change."""
    folder = tmp_path_factory.mktemp("read_only")
    write_run(folder / "run", checked=[])  # without the pictures of clouds
    for names in ("-rm", "-m"):  # as anybody, where user namespaces are allowed; as root, where they are not
        unshared = ["unshare", names, "sh", "-c", MOUNT, str(folder)]
        try:
            if subprocess.run([*unshared, "true"], capture_output=True, check=False).returncode == 0:
                break
        except FileNotFoundError:
            pytest.skip("no unshare on this system")
    else:
        pytest.skip("no mounts here")
    calls = {name: [word.format(folder) for word in call] for name, (call, _) in COMMANDS.items()}
    call = [*unshared, sys.executable, "-c", CALL_ALL, json.dumps(calls)]
    paths = {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    done = subprocess.run(call, capture_output=True, text=True, cwd=ROOT, env=os.environ | paths, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize("command", COMMANDS)
def test_a_read_only_folder_is_one_line(ended, command):
    code, said = ended[command]
    assert code == 2, said
    assert COMMANDS[command][1] in said.splitlines()[-1]
    assert "Traceback" not in said and ".partial" not in said
