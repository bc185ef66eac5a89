"""The type stubs of the compiled modules agree with the modules."""

import ast
import re
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from gelflow.perception import _tracker
from gelflow.perception.force import _contact_fit
from gelflow.perception.synthetic import AccurateGelRenderer, make_appearance
from gelflow.perception.tracker import MarkerTracker

MODULES = pytest.mark.parametrize("module", [_tracker, _contact_fit], ids=lambda module: module.__name__)


def stub_of(module: ModuleType) -> ast.Module:
    assert module.__file__ is not None
    return ast.parse(Path(module.__file__).with_name(module.__name__.rpartition(".")[2] + ".pyi").read_text())


def stub_classes(module: ModuleType) -> dict[str, dict[str, ast.FunctionDef]]:
    return {
        node.name: {item.name: item for item in node.body if isinstance(item, ast.FunctionDef)}
        for node in stub_of(module).body
        if isinstance(node, ast.ClassDef)
    }


def stub_functions(module: ModuleType) -> dict[str, ast.FunctionDef]:
    return {node.name: node for node in stub_of(module).body if isinstance(node, ast.FunctionDef)}


def check_arguments(bound: object, function: ast.FunctionDef) -> None:
    arguments = [argument.arg for argument in (*function.args.args, *function.args.kwonlyargs)]
    signature = str(bound.__doc__).splitlines()[0].split("->")[0]
    found = [argument for argument in re.findall(r"(\w+): ", signature) if argument not in ("self", "arg0")]
    assert found == [argument for argument in arguments if argument != "self"], function.name


@MODULES
def test_the_stub_declares_every_name_of_the_module(module: ModuleType) -> None:
    variables = {
        node.target.id: node.annotation
        for node in stub_of(module).body
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)
    }
    public = {name for name in vars(module) if not name.startswith("_")}
    assert {*variables, *stub_classes(module), *stub_functions(module)} == public
    for name, annotation in variables.items():
        assert type(getattr(module, name)).__name__ == ast.unparse(annotation)


@MODULES
def test_the_stub_declares_every_member_of_each_class(module: ModuleType) -> None:
    for name, members in stub_classes(module).items():
        bound = {member for member in vars(getattr(module, name)) if not member.startswith("_")}
        assert set(members) - {"__init__"} == bound, name


@MODULES
def test_the_stub_has_no_any_and_the_arguments_of_the_bindings(module: ModuleType) -> None:
    assert "Any" not in ast.unparse(stub_of(module))
    for name, function in stub_functions(module).items():
        check_arguments(getattr(module, name), function)
    for name, members in stub_classes(module).items():
        for member, function in members.items():
            bound = vars(getattr(module, name))[member]
            if [ast.unparse(decorator) for decorator in function.decorator_list] == ["property"]:
                assert isinstance(bound, property)
            else:
                check_arguments(bound, function)


def test_the_results_have_the_declared_types() -> None:
    image = AccurateGelRenderer(make_appearance("clean", markers=35)).render(np.zeros((35, 2))).image
    tracker = MarkerTracker()
    tracker.start(image)
    assert tracker._reference is not None
    native = tracker._reference.coarse.tracker
    dtypes = {"np.float64": np.float64, "np.bool_": np.bool_}
    refined = native.refine(image, native.rest(), np.ones(35, dtype=bool))
    for result in (native.start(image), native.track(image), refined):
        for member, function in stub_classes(_tracker)[type(result).__name__].items():
            assert function.returns is not None
            declared = re.fullmatch(r"NDArray\[(.+)\]", ast.unparse(function.returns))
            assert declared is not None and getattr(result, member).dtype == dtypes[declared.group(1)], member
    assert native.rest().dtype == np.float64 and native.rest().shape == (35, 2)
