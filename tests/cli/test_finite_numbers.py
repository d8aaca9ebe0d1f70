"""No option takes a number that is not finite: it would end in poses and images of NaN."""

import pytest
from typer.main import get_command
from typer.testing import CliRunner

from characterisation.files.errors import InputError
from mitsim.cli.program import app


def commands_of(group, *words):
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from commands_of(command, *words, name)
        else:
            yield (*words, name), command


def is_of_numbers(parameter):
    described = getattr(parameter, "type_descriptor", None)  # typer from 0.26; before, a type of click
    kind = getattr(parameter.type, "types", parameter.type) if described is None else described.annotation
    return "float" in repr(kind).lower()


def arguments_of(parameter, value):
    return [max(parameter.opts, key=len) if parameter.opts[0].startswith("-") else (), *[value] * abs(parameter.nargs)]


OPTIONS = [
    (words, command, parameter)
    for words, command in commands_of(get_command(app))
    for parameter in command.params
    if is_of_numbers(parameter)
]


def test_options_of_numbers_are_found():
    found = {(words[-1], parameter.name) for words, _, parameter in OPTIONS}
    assert {("render", "position"), ("render", "smoothing"), ("run", "minutes"), ("compare", "distance")} <= found


@pytest.mark.parametrize("value", ["nan", "inf", "-inf"])
@pytest.mark.parametrize(
    ("words", "command", "parameter"), OPTIONS, ids=[f"{'_'.join(words)}-{one.name}" for words, _, one in OPTIONS]
)
def test_a_number_that_is_not_finite_is_refused(words, command, parameter, value):
    others = [one for one in command.params if one.required and one is not parameter]
    given = [arguments_of(one, "1") for one in others]
    arguments = [word for part in [arguments_of(parameter, value), *given] for word in part if word]
    done = CliRunner().invoke(app, [*words, *arguments])
    assert done.exit_code != 0
    option = max(parameter.opts, key=len)
    if isinstance(done.exception, InputError):
        assert str(done.exception) == f"{option}: found {value}; allowed: a finite number"
    else:
        assert done.exit_code == 2 and f"Invalid value for '{option}'" in done.stderr  # a limit of the option


@pytest.mark.parametrize(
    ("command", "arguments", "option"),
    [
        ("map compare", ["ensenso-n10", "-o", ""], "--output"),
        ("export map", ["ensenso-n10", "--output="], "--output"),
        ("check", ["part.xml", "--pose", ""], "--pose"),
        ("report", [""], "folder"),
        ("measure clouds", ["a.ply", "", "--plane", "a"], "inputs"),
    ],
)
def test_an_empty_path_is_refused(command, arguments, option):
    """Before, the empty text of an unset variable of a shell was the current folder, into which exports then went."""
    commands = {" ".join(words): one for words, one in commands_of(get_command(app))}
    with pytest.raises(InputError) as caught:
        commands[command].make_context(command, list(arguments))
    assert str(caught.value) == f"{option}: found an empty text; allowed: a path; . is this folder"
    here = [word or "." for word in arguments if word != "--output="]
    assert commands[command].make_context(command, here if len(here) == len(arguments) else [*here, "-o", "."])


def test_a_text_may_be_empty():
    commands = {" ".join(words): one for words, one in commands_of(get_command(app))}
    assert commands["export map"].make_context("map", ["ensenso-n10", "-o", "kernel", "--sensor", ""])
