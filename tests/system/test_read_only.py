"""Folders of a read-only file system: whoever wants to write there is told so in one line."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "tests"))

from report.conftest import write_run  # noqa: E402

MOUNT = 'mount --bind "$0" "$0" && mount -o remount,ro,bind "$0" && exec "$@"'


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a run, which no command here can change."""
    made = tmp_path_factory.mktemp("read_only")
    write_run(made / "run")
    return made


@pytest.mark.parametrize(
    ("command", "told"),
    [
        (["report", "{}/run"], "report.html: found Read-only file system"),
        (["report", "--pdf", "{}/run"], "sheet.pdf: found Read-only file system"),
        (["check", "scenes/coupon/matt_white.xml", "--html", "{}/a.html"], "which is not writable"),
        (["score", "scenes/two_pillars/study.toml", "-o", "{}/run"], "which is not writable"),
        (["import", "{}/a.pcd", "-o", "{}/c"], "a.pcd"),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_a_read_only_folder_is_one_line(folder, command, told):
    for names in ("-rm", "-m"):  # as anybody, where user namespaces are allowed; as root, where they are not
        unshared = ["unshare", names, "sh", "-c", MOUNT, str(folder)]
        try:
            if subprocess.run([*unshared, "true"], capture_output=True, check=False).returncode == 0:
                break
        except FileNotFoundError:
            pytest.skip("no unshare on this system")
    else:
        pytest.skip("no mounts here")
    call = [sys.executable, "-m", "mitsim", *(one.format(folder) for one in command)]
    done = subprocess.run([*unshared, *call], capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 2, done.stderr
    assert told in done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr and ".partial" not in done.stderr
