"""The type stub of the C++ core agrees with the compiled module, and the core checks what it is passed."""

import ast
import inspect
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gelflow.sim import _core
from gelflow.sim.scene import load_scene
from gelflow.sim.simulator import Simulator

STUB = ast.parse(Path(inspect.getfile(_core)).with_suffix(".pyi").read_text())
CLASSES = {node.name: node for node in STUB.body if isinstance(node, ast.ClassDef)}
NOT_BOUND = {"LEVEL", "UsageError", "importlib", "os", "runs_v3"}  # names of the module that selects the build


def members_of(stub: ast.ClassDef) -> dict[str, ast.stmt]:
    """Members of a class of the stub by name, with those of its bases."""
    members: dict[str, ast.stmt] = {}
    for base in stub.bases:
        name = base.value if isinstance(base, ast.Subscript) else base
        if isinstance(name, ast.Name) and name.id in CLASSES:
            members |= members_of(CLASSES[name.id])
    for node in stub.body:
        if isinstance(node, ast.FunctionDef):
            members[node.name] = node
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            members[node.target.id] = node
    return members


def stub_arguments(function: ast.FunctionDef) -> list[tuple[str, bool]]:
    """Name of each argument of a function of the stub, and whether it has a default."""
    positional, keyword = function.args.args, function.args.kwonlyargs
    defaults = [False] * (len(positional) - len(function.args.defaults)) + [True] * len(function.args.defaults)
    pairs = zip([*positional, *keyword], [*defaults, *(d is not None for d in function.args.kw_defaults)], strict=True)
    return [(argument.arg, has_default) for argument, has_default in pairs if argument.arg != "self"]


def bound_arguments(function: Any) -> list[tuple[str, bool]]:
    """The same of a bound function, from the signature in its docstring."""
    match = re.match(r"\w+\((.*)\) -> ", function.__doc__)
    assert match, function.__doc__
    text = re.sub(r"\[[^\[\]]*\]", "", re.sub(r"\[[^\[\]]*\]", "", match[1]))  # annotations with brackets
    text = re.sub(r"array\([^)]*\)", "array", text)
    arguments = [part.strip() for part in text.split(", ") if re.match(r"\s*\w+:", part)]
    return [(part.split(":")[0], " = " in part) for part in arguments if not part.startswith("self:")]


def test_stub_and_module_have_the_same_names() -> None:
    functions = {node.name for node in STUB.body if isinstance(node, ast.FunctionDef)}
    in_stub = functions | {name for name in CLASSES if not name.startswith("_")}
    in_module = {name for name in vars(_core) if not name.startswith("_")}
    assert in_stub == in_module - NOT_BOUND


@pytest.mark.parametrize("name", [name for name in CLASSES if not name.startswith("_")])
def test_classes_have_the_members_of_the_stub(name: str) -> None:
    bound = getattr(_core, name)
    stub = members_of(CLASSES[name])
    in_module = {member for member in vars(bound) if not member.startswith("_")}
    assert in_module == {member for member in stub if not member.startswith("_")}
    for member, node in stub.items():
        attribute = getattr(bound, member)
        if isinstance(attribute, property):
            settable = attribute.fset is not None
            decorators = [ast.unparse(d) for d in getattr(node, "decorator_list", [])]
            assert settable == (isinstance(node, ast.AnnAssign) or decorators == [f"{member}.setter"]), member
        else:
            assert isinstance(node, ast.FunctionDef)
            assert bound_arguments(attribute) == stub_arguments(node), member


def test_functions_have_the_arguments_of_the_stub() -> None:
    functions = [node for node in STUB.body if isinstance(node, ast.FunctionDef)]
    assert functions
    for function in functions:
        assert bound_arguments(getattr(_core, function.name)) == stub_arguments(function)


def test_definitions_keep_their_fields() -> None:
    fields: dict[str, Any] = {
        "name": "pad",
        "body": 0,
        "positions": [(0, 0, 1)],
        "shapes": [0],
        "kn": 1.0,
        "kt": 2.0,
        "mu": 3.0,
    }
    axes = np.arange(9.0).reshape(1, 3, 3)
    pad = _core.PadDef(**fields, kd=4.0, axes=axes, weights=[5.0], pos=(1, 2, 3), collides=True)
    assert (pad.kn, pad.kt, pad.mu, pad.kd, pad.ks) == (1, 2, 3, 4, 0)
    np.testing.assert_array_equal(pad.axes, axes)
    np.testing.assert_array_equal(pad.positions, [(0, 0, 1)])
    assert pad.weights == [5.0]
    assert pad.collides
    pad.pos = (3, 2, 1)
    np.testing.assert_array_equal(pad.pos, (3, 2, 1))


def test_definitions_of_a_scene_can_be_read_back_and_added_again() -> None:
    spec = load_scene("rolling").model_spec()
    copy = _core.ModelSpec()
    for plural, add in (
        ("bodies", copy.add_body),
        ("joints", copy.add_joint),
        ("shapes", copy.add_shape),
        ("points", copy.add_points),
        ("contacts", copy.add_contact),
        ("pads", copy.add_pad),
        ("actuators", copy.add_actuator),
    ):
        for index, definition in enumerate(getattr(spec, plural)):
            assert add(definition) == index
    given, copied = _core.Model(spec), _core.Model(copy)
    assert sorted(given.param_names) == sorted(copied.param_names)
    values = dict(zip(copied.param_names, copied.param_defaults, strict=True))
    for name, value in zip(given.param_names, given.param_defaults, strict=True):
        assert values[name] == value or name.startswith("gravity")


def test_trajectories_of_wrong_type_or_shape_are_rejected() -> None:
    sim = Simulator(load_scene("rolling", overrides={"pads.pad.rows": 3, "pads.pad.cols": 3}))
    arrays = vars(sim.rollout(np.zeros((2, 1, sim.model.nu)), read_after=(1,)))
    batch = _core.Batch(sim.model, 1, 1)
    batch.rollout(_core.Trajectory(**arrays))
    for name in ("u", "q", "v", "anchors", "anchored", "history", "halvings", "status", "tactile"):
        with pytest.raises(ValueError, match=f"{name} must"):
            batch.rollout(_core.Trajectory(**arrays | {name: arrays[name][None]}))
        with pytest.raises(ValueError, match=f"{name} must be a C-contiguous array"):
            batch.rollout(_core.Trajectory(**arrays | {name: arrays[name].astype(np.complex128)}))
    with pytest.raises(ValueError, match="read_after must increase"):
        batch.rollout(_core.Trajectory(**arrays | {"read_after": np.array([3], np.int32)}))
