"""Unused elements of a scene have no cost: same model, bitwise same results, same number of instructions.

Instructions are counted by valgrind, in a process that only builds models and steps.
"""

import math
import os
import pickle
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from gelflow.sim import _core
from gelflow.sim.scene import Scene, load_scene
from gelflow.sim.simulator import Simulator

SHORT, LONG = 200, 400  # steps; the pad is on the ball after the short run
PUSH = [0.02, 0.01, 0.2]  # force on the pad [N]: down onto the ball, and slowly sideways

UNREAD_PAD = """
[pads.unread]
site = "pad_face"
rows = 200
cols = 200
size = [0.05, 0.05]
against = "ball"
law = "viscous"
kn = 1.0
kt = 0.01
mu = 2.0
kd = 0.003
"""
DECORATIONS = "".join(
    f'<body name="decoration{i}" pos="0.00{i % 10} 0 0.01" quat="1 0.{i} 0 0">'
    '<geom type="box" size="0.001 0.002 0.003" mass="0"/></body>'
    for i in range(10)
)
POST = '<geom name="post" type="cylinder" pos="0.02 0 0.05" size="0.01 0.05"/>'
RIB = '<geom name="rib" type="capsule" pos="0 0 0.01" size="0.002 0.01" mass="0"/>'

# Additions to the TOML file, the world, the pad's body and the ball's body.
ADDED = {
    "unread pad": (UNREAD_PAD, "", "", ""),
    "welded decorations": ("", "", DECORATIONS, DECORATIONS.replace("decoration", "badge")),
    "geometry in no pair": ("", POST, RIB, RIB.replace("rib", "spot")),
}

# Geometry 0.5 m away from the pad's points.
FAR = """
<geom name="far_plane" type="plane" size="1 1 0.1" pos="0 0 -0.5"/>
<geom name="far_sphere" type="sphere" size="0.03" pos="0.5 0 0"/>
<geom name="far_box" type="box" size="0.03 0.02 0.01" pos="0 0.5 0"/>
"""
FAR_CONTACT = """
[contacts.far]
points = "pad"
against = ["far_plane", "far_sphere", "far_box"]
kn = 5.0
mu = 1.0
kd = 1.0
kt = 1.0
"""
POINTS_PER_GROUP = 128  # points that share a bounding sphere
MOST_PER_GROUP = (
    400  # instructions per step: evaluations of the step equation, each with the relative pose and one bounds test
)


def rolling_with(folder: Path, toml: str = "", world: str = "", pad: str = "", ball: str = "") -> Scene:
    """A copy of the rolling scene in `folder`, with additions to its files."""
    path = load_scene("rolling").path
    xml = path.with_suffix(".xml").read_text()
    for mark, more in (("<worldbody>", world), ('<body name="pad" pos="0 0 0.06">', pad), ('"ball"/>', ball)):
        assert xml.count(mark) == 1
        xml = xml.replace(mark, mark + more)
    (folder / "rolling.xml").write_text(xml)
    (folder / "rolling.toml").write_text(path.read_text() + toml)
    return load_scene(folder / "rolling.toml")


def described(scene: Scene) -> dict[str, Any]:
    """The core model of a scene, without pads and their parameters."""
    model = scene.build()
    names = ("nq", "nv", "nu", "step", "q0", "body_names", "joint_names", "contact_names", "actuator_names")
    pads = tuple(f"{name}." for name in model.pad_names)
    numbers = zip(model.param_names, model.param_defaults, strict=True)
    return {
        **{name: getattr(model, name) for name in (*names, "joint_q", "joint_v")},
        "numbers": [(name, value) for name, value in numbers if not name.startswith(pads)],
        "shapes": [shape.name for shape in scene.shapes],
        "points": [(p.name, p.points.tobytes()) for p in scene.points],
    }


def run(scene: Scene) -> bytes:
    """All positions and velocities, and the final marker forces of the pad; the unread pad is not evaluated."""
    sim = Simulator(scene)
    parts = []
    for _ in range(LONG):
        sim.step(PUSH)
        parts += [sim.q.tobytes(), sim.v.tobytes()]
    sim.check()
    readings = sim.tactile()[0, sim.marker_slice("pad")]
    assert readings.any()  # the pad is on the ball
    return b"".join([*parts, readings.tobytes()])


@pytest.mark.parametrize("added", ADDED)
def test_unused_elements_do_not_change_results(added: str, tmp_path: Path) -> None:
    plain, more = load_scene("rolling"), rolling_with(tmp_path, *ADDED[added])
    assert described(more) == described(plain)
    assert run(more) == run(plain)


LISTS = {"bodies": "body", "joints": "joint", "shapes": "shape", "points": "points", "contacts": "contact"}
LISTS |= {"pads": "pad", "actuators": "actuator"}


def definitions_of(scene: Scene) -> tuple[dict[str, Any], list[tuple[str, str, dict[str, Any]]]]:
    """A scene as plain data for a process without MuJoCo.

    Options, and for each definition the name of its add function, its class and its fields.
    """
    spec = scene.model_spec()
    options = {name: getattr(spec, name) for name in ("gravity", "step", "integrator", "tolerance")}
    definitions = [
        (f"add_{kind}", type(definition).__name__, fields_of(definition))
        for plural, kind in LISTS.items()
        for definition in getattr(spec, plural)
    ]
    return options, definitions


def fields_of(definition: object) -> dict[str, Any]:
    return {name: getattr(definition, name) for name in dir(definition) if not name.startswith("_")}


STEPPING = """
import os
import pickle
import sys
from gelflow.sim import _core
from gelflow.sim.simulator import Simulator

with open(sys.argv[1], "rb") as file:
    scenes = pickle.load(file)
for (options, definitions), q, u in scenes:
    spec = _core.ModelSpec()
    for name, value in options.items():
        setattr(spec, name, value)
    for add, kind, fields in definitions:
        getattr(spec, add)(getattr(_core, kind)(**fields))
    sim = Simulator(_core.Model(spec))
    sim.q[:] = q
    sim.step(u, int(sys.argv[2]))
    os.getppid()  # valgrind dumps its counts here
    sim.step(u, int(sys.argv[3]))
    os.getppid()
    sim.check()
"""


def instructions_per_step(scenes: list[Scene], folder: Path) -> list[float]:
    """Instructions per step after the first SHORT steps, without evaluation of marker forces."""
    data = [(definitions_of(scene), scene.q0, PUSH) for scene in scenes]
    (folder / "scenes.pickle").write_bytes(pickle.dumps(data))
    out = folder / "callgrind"
    valgrind = ["valgrind", "-q", "--tool=callgrind", f"--callgrind-out-file={out}", "--dump-before=getppid"]
    steps = [str(SHORT), str(LONG - SHORT)]
    env = {**os.environ, "PYTHONHASHSEED": "0", "OPENBLAS_NUM_THREADS": "1"}
    command = [*valgrind, sys.executable, "-c", STEPPING, str(folder / "scenes.pickle"), *steps]
    done = subprocess.run(command, env=env, capture_output=True)
    assert done.returncode == 0, done.stderr.decode()
    counts = []
    for k in range(len(scenes)):
        total = re.search(r"^totals: (\d+)", Path(f"{out}.{2 * k + 2}").read_text(), re.MULTILINE)
        assert total
        counts.append(int(total[1]) / (LONG - SHORT))
    return counts


def everything(folder: Path) -> Scene:
    return rolling_with(folder, *("".join(texts) for texts in zip(*ADDED.values(), strict=True)))


@pytest.fixture(scope="module")
def counted(tmp_path_factory: pytest.TempPathFactory) -> dict[str, float]:
    """Instructions per step of the scene, of the scene with unused elements, and with a distant contact."""
    if shutil.which("valgrind") is None:
        pytest.skip("valgrind is not installed: instructions are not counted")
    if _core.LEVEL == "sanitize":
        pytest.skip("instructions are counted in a core that is in use, not in the sanitizers'")
    folders = [tmp_path_factory.mktemp(name) for name in ("plain", "more", "far")]
    scenes = [load_scene("rolling"), everything(folders[1]), rolling_with(folders[2], FAR_CONTACT, FAR)]
    return dict(zip(("plain", "more", "far"), instructions_per_step(scenes, folders[0]), strict=True))


def test_unused_elements_cost_no_instructions(counted: dict[str, float]) -> None:
    assert counted["plain"] > 10_000
    assert counted["more"] == pytest.approx(counted["plain"], rel=0.01)


def test_distant_contact_costs_one_bounds_test_per_group(counted: dict[str, float], tmp_path: Path) -> None:
    """Per group of points and shape, independent of the number of points in a group."""
    far = rolling_with(tmp_path, FAR_CONTACT, FAR)
    assert run(far) == run(load_scene("rolling"))
    (pad,) = (p for p in far.points if p.name == "pad")
    groups = 3 * math.ceil(len(pad.points) / POINTS_PER_GROUP)
    assert 0 < counted["far"] - counted["plain"] <= MOST_PER_GROUP * groups
