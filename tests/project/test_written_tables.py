"""The tables of the documentation that come from the code are those that the code has now."""

import sys
from pathlib import Path

import pytest

from gelflow.sim.scene import scene_names
from gelflow.sim.tasks.insertion import insertion_scene
from gelflow.sim.tasks.registry import make_task

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "docs" / "extensions"))

from written_tables import DOCS, PAGES, TABLE, TABLES, scenes, updated  # type: ignore[import-not-found]  # noqa: E402


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_tables_of_a_page_are_current(page: Path) -> None:
    text = page.read_text()
    assert TABLE.search(text)
    assert updated(text) == text, "write them again with: python docs/extensions/written_tables.py"


def test_every_table_is_on_a_page() -> None:
    texts = {page: page.read_text() for page in DOCS.rglob("*.md")}
    assert {page for page, text in texts.items() if TABLE.search(text)} == set(PAGES)
    assert {found["name"] for text in texts.values() for found in TABLE.finditer(text)} == set(TABLES)


def test_scenes_have_the_law_of_their_tasks() -> None:
    rows = [[cell.strip(" `") for cell in line.strip("|").split("|")] for line in scenes().splitlines()[2:]]
    assert {row[0] for row in rows} == set(scene_names())
    for scene, task, _, law, _ in rows:
        batch = make_task(task, 1, threads=1)
        used = insertion_scene() if task == "insertion" else batch.scene  # type: ignore[attr-defined]
        assert (used.path.stem, used.friction) == (scene, law)
