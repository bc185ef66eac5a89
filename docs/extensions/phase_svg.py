"""Draws the phases of a run and their changes as SVG, from the table of the phases."""

from collections.abc import Mapping
from dataclasses import dataclass
from html import escape

from gelflow.real.runner.phases import Phase, PhaseRule

_ROW = (Phase.IDLE, Phase.PREFLIGHT, Phase.LOAD, Phase.APPROACH, Phase.DESCEND, Phase.LOWER, Phase.RELEASE)
_PITCH, _LEFT, _GAP = 128, 70, 16  # distance of two columns, first column, distance of parallel arrows [px]
_WIDTH, _HEIGHT = 100, 34  # of a box [px]
_TOP, _MIDDLE, _BOTTOM, _NOTES = 90, 160, 230, 306  # vertical centres of the rows [px]
SIZE = (2 * _LEFT + (len(_ROW) - 1) * _PITCH, 336)

Point = tuple[float, float]


@dataclass(frozen=True)
class Box:
    """A phase in the picture: centre and size [px]."""

    phase: Phase
    x: float
    y: float
    width: float = _WIDTH
    height: float = _HEIGHT

    @property
    def top(self) -> float:
        return self.y - self.height / 2

    @property
    def bottom(self) -> float:
        return self.y + self.height / 2


@dataclass(frozen=True)
class Arrow:
    """A change of phase; `both` if the way back is allowed too."""

    start: Phase
    end: Phase
    points: tuple[Point, ...]
    both: bool = False


def boxes() -> dict[Phase, Box]:
    """The boxes: the sequence in one row, retreat below it, correct between them, hold and latched apart."""
    columns = {phase: _LEFT + number * _PITCH for number, phase in enumerate(_ROW)}
    found = {phase: Box(phase, x, _TOP) for phase, x in columns.items()}
    first, last = columns[Phase.LOAD], columns[Phase.RELEASE]
    found[Phase.RETREAT] = Box(Phase.RETREAT, (first + last) / 2, _BOTTOM, last - first + _WIDTH)
    found[Phase.CORRECT] = Box(Phase.CORRECT, columns[Phase.DESCEND] - _GAP, _MIDDLE, 80)
    found[Phase.HOLD] = Box(Phase.HOLD, first, _NOTES)
    found[Phase.LATCHED] = Box(Phase.LATCHED, columns[Phase.LOWER], _NOTES)
    return found


def changes(table: Mapping[Phase, PhaseRule]) -> list[tuple[Phase, Phase, bool]]:
    """Every allowed change except those of hold and latched; the last value: the way back is allowed too."""
    pairs = [(a, b) for a, rule in table.items() for b in rule.following if Phase.HOLD not in (a, b)]
    order = list(Phase)
    single = [(a, b) for a, b in pairs if (b, a) not in pairs or order.index(a) < order.index(b)]
    return [(a, b, (b, a) in pairs) for a, b in single]


def arrows(table: Mapping[Phase, PhaseRule]) -> list[Arrow]:
    """The arrow of every allowed change. Raises ValueError for a change whose path is not defined here."""
    placed = boxes()
    return [Arrow(a, b, _path(placed, a, b), both) for a, b, both in changes(table)]


def _path(placed: Mapping[Phase, Box], start: Phase, end: Phase) -> tuple[Point, ...]:
    a, b = placed[start], placed[end]
    if start in _ROW and end in _ROW:
        right = 1 if b.x > a.x else -1
        if abs(_ROW.index(start) - _ROW.index(end)) == 1:
            return (a.x + right * a.width / 2, a.y), (b.x - right * b.width / 2, b.y)
        # Above the row; a longer way is higher and goes around the shorter one.
        outer = abs(_ROW.index(start) - _ROW.index(end)) > 2
        height, inset = (22, -_GAP) if outer else (46, _GAP)
        from_x, to_x = a.x + right * inset, b.x - right * inset
        return (from_x, a.top), (from_x, height), (to_x, height), (to_x, b.top)
    if {start, end} == {Phase.RETREAT, Phase.IDLE}:
        edge = (a.x - a.width / 2, a.y)
        return edge, (b.x, edge[1]), (b.x, b.bottom)
    upper, lower = (a, b) if a.y < b.y else (b, a)
    if Phase.LATCHED in (start, end) or Phase.IDLE in (start, end):
        raise ValueError(f"docs/extensions/phase_svg.py has no way from {start} to {end}; add one")
    # Vertical; descend is joined to retreat beside the box of correct.
    beside = {start, end} == {Phase.RETREAT, Phase.DESCEND}
    x = upper.x + 2 * _GAP if beside else (lower.x if lower.phase is Phase.CORRECT else upper.x)
    ends = (x, upper.bottom), (x, lower.top)
    return ends if upper is a else ends[::-1]


def svg(table: Mapping[Phase, PhaseRule]) -> str:
    """The picture. Raises ValueError when a phase or a change has no place in it."""
    placed = boxes()
    if missing := set(table) - set(placed):
        raise ValueError(f"docs/extensions/phase_svg.py has no place for {sorted(missing)}; add one")
    width, height = SIZE
    holdable = table[Phase.HOLD].following
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img" '
        f'style="width: 100%; max-width: {width}px" font-family="sans-serif" font-size="14">',
        "<title>Phases of a run and the allowed changes between them</title>",
        '<defs><marker id="phase-arrow" viewBox="0 0 10 10" refX="10" refY="5" markerWidth="9" markerHeight="9" '
        'markerUnits="userSpaceOnUse" orient="auto-start-reverse">'
        '<path d="M 0 0 L 10 5 L 0 10 z" fill="currentColor"/></marker></defs>',
        *(_line(arrow) for arrow in arrows(table)),
        *(_box(placed[phase], rule, phase in holdable) for phase, rule in table.items()),
        *_notes(placed),
        "</svg>",
    ]
    return "\n".join(parts)


def _line(arrow: Arrow) -> str:
    points = " ".join(f"{x:g},{y:g}" for x, y in arrow.points)
    back = ' marker-start="url(#phase-arrow)"' if arrow.both else ""
    return (
        f'<polyline points="{points}" fill="none" stroke="currentColor" stroke-width="1.4" '
        f'marker-end="url(#phase-arrow)"{back}/>'
    )


def _box(box: Box, rule: PhaseRule, holdable: bool) -> str:
    """A grey box where motion is allowed; a thick border for latched, two bars where hold is allowed."""
    fill = 'fill="currentColor" fill-opacity="0.14"' if rule.moves else 'fill="none"'
    border = 3 if box.phase is Phase.LATCHED else 1.4
    left = box.x - box.width / 2
    text = (
        f'<rect x="{left:g}" y="{box.top:g}" width="{box.width:g}" height="{box.height:g}" rx="5" {fill} '
        f'stroke="currentColor" stroke-width="{border}"/>'
        f'<text x="{box.x:g}" y="{box.y + 5:g}" text-anchor="middle" fill="currentColor">{escape(box.phase)}</text>'
    )
    bars = "".join(
        f'<rect x="{left + box.width - 10 + 4 * n:g}" y="{box.top + 4:g}" width="2" height="8" fill="currentColor"/>'
        for n in range(2)
    )
    return text + (bars if holdable else "")


def _notes(placed: Mapping[Phase, Box]) -> list[str]:
    """The words at hold and latched, in place of an arrow from every phase."""
    hold, latched = placed[Phase.HOLD], placed[Phase.LATCHED]
    texts = (
        (hold.x + hold.width / 2 + 12, "start", "from a phase with two bars, and back to it"),
        (latched.x + latched.width / 2 + 12, "start", "from every phase"),
        (hold.x - hold.width / 2 - 12, "end", "grey: the arm may move"),
    )
    return [
        f'<text x="{x:g}" y="{_NOTES + 5}" text-anchor="{anchor}" font-size="12" fill="currentColor">{words}</text>'
        for x, anchor, words in texts
    ]
