"""``import mitsim`` loads nothing heavy, and the names are those that type checkers see."""

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import characterisation
import mitsim

HEAVY = (
    "numpy",
    "scipy",
    "xarray",
    "matplotlib",
    "mitsuba",
    "drjit",
    "cv2",
    "trimesh",
    "pydantic",
    "netCDF4",
    "pandas",
)

PACKAGES = pytest.mark.parametrize("package", [mitsim, characterisation], ids=lambda package: package.__name__)


def run(code: str) -> str:
    return subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout


@PACKAGES
def test_the_import_loads_no_heavy_module(package):
    code = f"import sys, {package.__name__}; print(*sys.modules)"
    loaded = {name.partition(".")[0] for name in run(code).split()}
    assert package.__name__ in loaded
    assert not loaded & set(HEAVY)


@pytest.mark.parametrize(
    "modules", ["mitsim.scene.authoring.check, mitsim.report.scene_table", "mitsim.decoding.checks.checked_cloud"]
)
def test_checking_a_scene_and_decoding_load_neither_figures_nor_tables(modules):
    """They take longer to import than a small scene to check."""
    loaded = set(run(f"import sys, {modules}; print(*sys.modules)").split())
    assert set(modules.split(", ")) <= loaded
    assert not {"matplotlib", "xarray", "pandas", "scipy.stats"} & loaded


@PACKAGES
def test_the_import_takes_under_a_fifth_of_a_second(package):
    code = f"import time; t = time.process_time(); import {package.__name__}; print(time.process_time() - t)"
    assert min(float(run(code)) for _ in range(3)) < 0.2


@PACKAGES
def test_dir_and_all_name_what_can_be_had(package):
    assert set(package.__all__) <= set(dir(package))
    assert set(package.__all__) == set(package._NAMES)
    for name in package.__all__:
        assert getattr(package, name).__name__ == name


def test_no_function_has_the_name_of_a_package():
    """Importing such a package would replace the function: ``ms.decode`` would become a module."""
    folders = {path.name for path in Path(mitsim.__file__).parent.iterdir() if (path / "__init__.py").exists()}
    assert not folders & set(mitsim.__all__)


@PACKAGES
def test_type_checkers_see_the_same_names(package):
    tree = ast.parse(Path(package.__file__).read_text(encoding="utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If))
    seen = {alias.name: one.module for one in block.body for alias in one.names}
    assert seen == package._NAMES


@PACKAGES
def test_other_names_are_an_attribute_error(package):
    with pytest.raises(AttributeError, match="no attribute 'rendr'"):
        getattr(package, "rendr")  # noqa: B009
    with pytest.raises(ImportError):
        importlib.import_module(f"{package.__name__}.rendr")


def test_a_name_is_kept_once_it_was_used():
    assert mitsim.Transform is vars(mitsim)["Transform"]
