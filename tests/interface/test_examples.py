"""The examples of every public function, as a reader would type them."""

import doctest
import inspect

import pytest

import characterisation
import mitsim
from characterisation.statements.statement import Statements


def public() -> dict[str, object]:
    """All public functions of both packages, and the promised methods that do more than return a field."""
    out = {}
    for package in (mitsim, characterisation):
        for name in package.__all__:
            if inspect.isfunction(one := getattr(package, name)):
                out[f"{package.__name__}.{name}"] = one
    for drawn in (mitsim.Capture, mitsim.Scene, mitsim.PointCloud, mitsim.PerformanceMap, mitsim.Statement):
        out[f"mitsim.{drawn.__name__}.plot"] = drawn.plot
    out["Statements.plot"] = Statements.plot
    out["characterisation.PointCloud.to_open3d"] = characterisation.PointCloud.to_open3d
    return out


@pytest.mark.parametrize("name", sorted(public()))
def test_the_example_does_what_it_says(name, workplace):
    found = doctest.DocTestFinder(recurse=False).find(public()[name], name, globs={})
    examples = [example for one in found for example in one.examples]
    assert examples, "no example"
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    told = []
    for one in found:
        runner.run(one, out=told.append)
    assert not runner.summarize(verbose=False).failed, "".join(told)


@pytest.mark.parametrize("name", sorted(public()))
def test_the_docstring_tells_parameters_results_and_errors(name):
    one = public()[name]
    text = inspect.getdoc(one)
    for section in ("Parameters", "Returns", "Examples"):
        if section == "Returns" and inspect.signature(one).return_annotation == "None":
            continue
        if section == "Parameters" and set(inspect.signature(one).parameters) <= {"self"}:
            continue
        assert f"\n{section}\n---" in text, section
    for parameter in inspect.signature(one).parameters:
        assert parameter == "self" or parameter in text, parameter
