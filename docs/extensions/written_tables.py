"""Writes the tables of pages that come from the code: `python docs/extensions/written_tables.py`.

A table stands between `<!-- written by docs/extensions/written_tables.py: NAME -->` and `<!-- end -->`, so that the
pages show it without Sphinx too. `tests/project/test_written_tables.py` compares the pages with the code.
"""

import re
from collections.abc import Callable
from pathlib import Path

from markdown_table import markdown_table

from gelflow.gymnasium_registration import ENVIRONMENTS
from gelflow.mock_lab.promises.table import PROMISES
from gelflow.real.runner.phases import PHASES
from gelflow.sim.scene import load_scene
from gelflow.sim.tasks.randomization import Distribution
from gelflow.sim.tasks.registry import randomizations

DOCS = Path(__file__).resolve().parents[1]
PAGES = tuple(DOCS / name for name in ("guide/robot.md", "guide/scenes.md", "reference/environments.md"))
TABLE = re.compile(
    r"(<!-- written by docs/extensions/written_tables\.py: (?P<name>[\w-]+) -->\n)(?P<table>.*?)(<!-- end -->)",
    re.DOTALL,
)
# Included scene → its task.
_TASKS = {"rolling": "rolling", "pushing": "pushing", "insertion": "insertion", "grasp": "grasp", "dclaw": "cap"}


def phases() -> str:
    """The phases of a run: what happens, whether the arm may move, and the reaction to contact."""
    rows = [("phase", "what happens", "the arm may move", "reaction to contact")]
    rows += [
        (str(phase), rule.action, "yes" if rule.moves else "no", rule.on_contact) for phase, rule in PHASES.items()
    ]
    return markdown_table(rows)


def promises() -> str:
    """The promises of the runner with their bounds."""
    rows = [("name", "promise", "measured", "at most")]
    rows += [(f"`{p.name}`", p.text, p.measured, f"{p.bound:g} {p.unit}".strip()) for p in PROMISES.values()]
    return markdown_table(rows)


def scenes() -> str:
    """The included scenes: task, environment, friction law, integrator and step."""
    rows = [("scene", "task", "environment", "friction law", "integrator, step")]
    environments = {arguments.get("batch", "insertion"): name for name, (*_, arguments) in ENVIRONMENTS.items()}
    for name, task in _TASKS.items():
        scene = load_scene(name)
        how = f"{scene.integrator.upper()}, {1e3 * scene.step:g} ms"
        rows.append((f"`{name}`", f"`{task}`", f"`{environments[task]}`", scene.friction, how))
    return markdown_table(rows)


def randomization(task: str) -> str:
    """The quantities of a task with their distributions in each of its tables."""
    tables = randomizations(task)
    rows = [("quantity", "unit", *(f'"{name}"' for name in tables), "meaning")]
    for name, quantity in next(iter(tables.values())).quantities.items():
        law = f" ({quantity.friction} law)" if quantity.friction else ""
        cells = (_text(table[name].distribution) for table in tables.values())
        rows.append((f"`{name}`", quantity.unit, *cells, quantity.meaning + law))
    return markdown_table(rows)


def _text(distribution: Distribution) -> str:
    values = list(vars(distribution).values())
    kind = {"LogUniform": " (log)", "Normal": " (normal: mean, std)"}.get(type(distribution).__name__, "")
    if len(set(values)) == 1:
        return f"{values[0]:g}"
    return " … ".join(f"{value:g}" for value in values) + kind


TABLES: dict[str, Callable[[], str]] = {
    "phases": phases,
    "promises": promises,
    "scenes": scenes,
    **{
        f"randomization-{task}": lambda task=task: randomization(task)
        for task in ("pushing", "cap", "insertion", "grasp")
    },
}


def updated(text: str) -> str:
    """The text of a page with its tables as the code has them now."""
    return TABLE.sub(lambda found: f"{found[1]}{TABLES[found['name']]()}\n{found[4]}", text)


if __name__ == "__main__":
    for page in PAGES:
        page.write_text(updated(page.read_text(encoding="utf-8")), encoding="utf-8")
