"""The type stub of the compiled tracker module agrees with the module."""

import ast
import re
from pathlib import Path

import numpy as np

from gelflow.perception import _tracker
from gelflow.perception.synthetic import AccurateGelRenderer, make_appearance
from gelflow.perception.tracker import MarkerTracker

STUB = ast.parse(Path(_tracker.__file__).with_name("_tracker.pyi").read_text())


def stub_classes() -> dict[str, dict[str, ast.FunctionDef]]:
    return {
        node.name: {item.name: item for item in node.body if isinstance(item, ast.FunctionDef)}
        for node in STUB.body
        if isinstance(node, ast.ClassDef)
    }


def test_the_stub_declares_every_name_of_the_module() -> None:
    variables = {
        node.target.id for node in STUB.body if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)
    }
    public = {name for name in vars(_tracker) if not name.startswith("_")}
    assert variables | set(stub_classes()) == public
    assert isinstance(_tracker.PROFILE_STEPS, int)


def test_the_stub_declares_every_member_of_each_class() -> None:
    for name, members in stub_classes().items():
        bound = {member for member in vars(getattr(_tracker, name)) if not member.startswith("_")}
        assert set(members) - {"__init__"} == bound, name


def test_the_stub_has_no_any_and_the_arguments_of_the_bindings() -> None:
    assert "Any" not in ast.unparse(STUB)
    for name, members in stub_classes().items():
        for member, function in members.items():
            if [ast.unparse(decorator) for decorator in function.decorator_list] == ["property"]:
                assert isinstance(vars(getattr(_tracker, name))[member], property)
                continue
            arguments = [argument.arg for argument in (*function.args.args[1:], *function.args.kwonlyargs)]
            signature = getattr(_tracker, name).__dict__[member].__doc__.splitlines()[0]
            bound = re.findall(r"(\w+): ", signature.split("->")[0])
            assert [argument for argument in bound if argument not in ("self", "arg0")] == arguments, f"{name}.{member}"


def test_the_results_have_the_declared_types() -> None:
    image = AccurateGelRenderer(make_appearance("clean", markers=35)).render(np.zeros((35, 2))).image
    tracker = MarkerTracker()
    tracker.start(image)
    assert tracker._reference is not None
    native = tracker._reference.tracker
    dtypes = {"np.float64": np.float64, "np.bool_": np.bool_}
    for result in (native.start(image), native.track(image)):
        for member, function in stub_classes()[type(result).__name__].items():
            assert function.returns is not None
            declared = re.fullmatch(r"NDArray\[(.+)\]", ast.unparse(function.returns))
            assert declared is not None and getattr(result, member).dtype == dtypes[declared.group(1)], member
    assert native.rest().dtype == np.float64 and native.rest().shape == (35, 2)
