"""The diagram of the phases in the documentation shows every allowed change, and nothing in it overlaps."""

import itertools
import sys
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import pytest

from gelflow.real.runner.phases import PHASES, Phase

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "docs" / "extensions"))

from phase_svg import SIZE, Arrow, Box, arrows, boxes, svg  # type: ignore[import-not-found]  # noqa: E402


def segments(arrow: Arrow) -> list[tuple[float, float, float, float]]:
    """Left, right, top and bottom of each part of an arrow; all parts are horizontal or vertical."""
    found = []
    for (x, y), (u, v) in itertools.pairwise(arrow.points):
        assert x == u or y == v
        found.append((min(x, u), max(x, u), min(y, v), max(y, v)))
    return found


def inside(box: Box) -> tuple[float, float, float, float]:
    """The interior of a box."""
    return box.x - box.width / 2 + 1, box.x + box.width / 2 - 1, box.top + 1, box.bottom - 1


def overlap(a: tuple[float, float, float, float], b: tuple[float, float, float, float]) -> bool:
    return a[0] <= b[1] and b[0] <= a[1] and a[2] <= b[3] and b[2] <= a[3]


def test_every_allowed_change_has_an_arrow() -> None:
    drawn = set()
    for arrow in arrows(PHASES):
        drawn |= {(arrow.start, arrow.end)} | ({(arrow.end, arrow.start)} if arrow.both else set())
    allowed = {(a, b) for a, rule in PHASES.items() for b in rule.following if Phase.HOLD not in (a, b)}
    assert drawn == allowed
    text = "".join(ElementTree.fromstring(svg(PHASES)).itertext())
    assert all(str(phase) in text for phase in PHASES)


def test_boxes_and_arrows_do_not_overlap() -> None:
    placed = boxes()
    for one, other in itertools.combinations(placed.values(), 2):
        assert not overlap(inside(one), inside(other)), (one, other)
    drawn = arrows(PHASES)
    for arrow in drawn:
        for box, segment in itertools.product(placed.values(), segments(arrow)):
            assert not overlap(inside(box), segment), (arrow, box)
    for one, other in itertools.combinations(drawn, 2):
        assert not any(overlap(a, b) for a in segments(one) for b in segments(other)), (one, other)
    for box in placed.values():
        assert box.x - box.width / 2 > 0 and box.x + box.width / 2 < SIZE[0] and box.top > 0 and box.bottom < SIZE[1]


def test_arrows_end_at_the_boxes_of_their_phases() -> None:
    placed = boxes()
    for arrow in arrows(PHASES):
        for phase, (x, y) in ((arrow.start, arrow.points[0]), (arrow.end, arrow.points[-1])):
            box = placed[phase]
            across = abs(x - box.x) == box.width / 2 and abs(y - box.y) < box.height / 2
            upright = abs(y - box.y) == box.height / 2 and abs(x - box.x) < box.width / 2
            assert across or upright, (arrow, phase)


def test_a_change_without_a_way_in_the_picture_is_an_error() -> None:
    rule = PHASES[Phase.CORRECT]
    changed = {**PHASES, Phase.CORRECT: replace(rule, following=(*rule.following, Phase.IDLE))}
    with pytest.raises(ValueError, match="no way from correct to idle"):
        svg(changed)
