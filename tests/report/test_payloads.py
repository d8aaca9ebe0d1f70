"""Whatever text a run folder holds is text of its page: it adds no element, no attribute and no end of a script.

Every text of the folder is all payloads of a page in a row. Each adds an element or attribute of its own where it comes
through, so the fault names it. Those with a slash come first, as a page shows the last part of a path; the one that
opens a comment has a page of its own, as it would hide the others.
"""

import json
import shutil
from html.parser import HTMLParser

import pytest
import xarray as xr

from characterisation.files.atomic_io import write_netcdf
from mitsim.report.page import write_report
from tests.report.conftest import plain_pictures

PAYLOADS = {
    "elements and attributes": (
        "<script>alert(1)</script>",
        "</script><svg/onload=alert(1)>",
        "\u2028</style><iframe src=javascript:alert(1)>\x00\x1b[2J\u202e",
        '"><img src=x onerror=alert(1)>',
        "' autofocus onfocus=alert(1) x='",
    ),
    "a comment": ("<!--<script>]]>{{7*7}}{% raw %}${7*7}",),
}


class Elements(HTMLParser):
    def __init__(self):
        super().__init__()
        self.tags, self.attributes = [], set()

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes |= {name for name, _ in attrs}


def elements(path):
    found = Elements()
    found.feed(path.read_text(encoding="utf-8"))
    return found


def spoilt(value, payload):
    if isinstance(value, dict):
        return {key: spoilt(one, payload) for key, one in value.items()}
    if isinstance(value, list):
        return [spoilt(one, payload) for one in value]
    return payload if isinstance(value, str) and value not in ("mm", "deg") else value


@pytest.fixture(scope="module")
def before(expecting, tmp_path_factory) -> Elements:
    """The page of the same run without payloads, with its pictures, as they contain text as well."""
    folder = tmp_path_factory.mktemp("before") / "run"
    shutil.copytree(expecting, folder)
    with plain_pictures():
        return elements(write_report(folder))


@pytest.mark.parametrize("payloads", PAYLOADS.values(), ids=PAYLOADS)
def test_payloads_add_nothing_to_the_page(expecting, before, tmp_path, payloads):
    folder, payload = tmp_path / "run", "".join(payloads)
    text = payload.replace("\0", "")  # no string of netCDF has one
    shutil.copytree(expecting, folder)
    about = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    kept = {"measurements": about["measurements"]}
    (folder / "run.json").write_text(json.dumps(spoilt(about, payload) | kept), encoding="utf-8")
    for name in ("scores.nc", "map.nc"):
        data = xr.load_dataset(folder / name)
        if "limit" in data:
            data["limit"] = data["limit"].astype(object).where(False, text)
            data["limiting_feature"] = data["limiting_feature"].astype(object).where(False, text)
        data.attrs = {key: text if isinstance(value, str) else value for key, value in data.attrs.items()}
        write_netcdf(data, folder / name)
    with plain_pictures():
        after = elements(write_report(folder))
    assert (set(after.tags) - set(before.tags), after.attributes - before.attributes) == (set(), set())
    assert not any(name.startswith("on") for name in after.attributes)
    assert after.tags.count("script") == before.tags.count("script")
