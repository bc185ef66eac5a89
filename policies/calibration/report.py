"""The report of a calibration: plain data, a picture of flow maps, and a page that shows both."""

import base64
import html
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gelflow.observation import Grid
from gelflow.policies.calibration.calibrated_randomization import calibrated_randomization
from gelflow.policies.calibration.calibration import ALLOWED_ERROR, FORMAT, Calibration, Estimate, FlowMaps
from gelflow.policies.calibration.comparison import unused_markers_text
from gelflow.policies.calibration.flow_picture import draw_flow_maps
from gelflow.session.records import to_plain


def plain_report(result: Calibration, sessions: Sequence[Path]) -> dict[str, Any]:
    """The calibration as plain data, the content of `report.json`."""
    held_out = result.held_out
    values: dict[str, Any] = {
        "format": FORMAT,
        "sessions": [str(path) for path in sessions],
        "attempts": {
            "fitted": len(result.fitted.recorded),
            "held_out": 0 if held_out is None else len(held_out.recorded),
        },
        "parameters": {e.parameter.name: _plain_estimate(e) for e in result.estimates},
        "part": result.recordings.task.part.to_json(),
        "randomization": calibrated_randomization(result),
        "correlated": [{"parameters": [a, b], "correlation": r} for a, b, r in result.correlated],
        "flow_maps": {
            "unit": result.unit,
            "noise": result.noise,
            "height_offset": result.height_offset,
            "unused_markers": int((~result.fitted.used).sum()),
            "fitted": _errors(result.fitted),
            "held_out": None if held_out is None else _errors(held_out),
            "explained": result.explained,
            "not_modelled": result.not_modelled(),
            "converged": result.converged,
            "reproduced": result.reproduced,
            "held_out_residual": result.held_out_residual,
            "predicted": result.predicted,
        },
        "record_next": [
            {"text": s.text, "pose": list(s.pose), "depth": s.depth, "gain": s.gain, "narrowed": s.narrowed}
            for s in result.suggestions
        ],
        "starts": {
            "used": len(result.fit.starts),
            "others": result.fit.others,
            "residual": [start.chi for start in result.fit.starts],
        },
    }
    plain: dict[str, Any] = to_plain(values)
    return plain


def _plain_estimate(estimate: Estimate) -> dict[str, Any]:
    p = estimate.parameter
    return {
        "value": estimate.value,
        "interval": [estimate.low, estimate.high],
        "prior_interval": [float(p.value(np.array(-1.96))), float(p.value(np.array(1.96)))],
        "unit": p.unit,
        "meaning": p.meaning,
        "relative_width": estimate.relative_width,
        "verdict": estimate.verdict,
    }


def _errors(maps: FlowMaps) -> dict[str, float]:
    return {
        "before": maps.error(maps.before),
        "after": maps.error(maps.after),
        "rms": maps.error(np.zeros_like(maps.recorded)),
    }


def flow_picture(result: Calibration, grid: Grid) -> bytes:
    """A PNG of recorded (blue) and simulated (red, narrower) flow maps: held-out attempts, or else fitted ones."""
    maps = result.fitted if result.held_out is None else result.held_out
    kind = "fitted" if result.held_out is None else "held-out"
    simulated = [("before", maps.before), ("calibrated", maps.after)]
    note = f"{kind} attempts; "
    figure = draw_flow_maps(maps.recorded, simulated, maps.names, grid, result.unit, used=maps.used, note=note)
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=100)
    return data.getvalue()


def page(result: Calibration, sessions: Sequence[Path], grid: Grid) -> str:
    """A self-contained HTML page."""
    picture = base64.b64encode(flow_picture(result, grid)).decode()
    rows = "".join(_row(estimate) for estimate in result.estimates)
    pairs = "".join(f"<li>{a} and {b}: {r:+.2f}</li>" for a, b, r in result.correlated) or "<li>none</li>"
    advice = "".join(f"<li>{html.escape(text)}</li>" for text in advice_lines(result)) or "<li>nothing</li>"
    names = html.escape(", ".join(str(path) for path in sessions))
    summary = "".join(f"<p>{html.escape(line)}</p>" for line in error_lines(result))
    return f"""<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>Calibration</title><style>
body {{ font-family: sans-serif; max-width: 60em; margin: 2em auto; padding: 0 1em; color: #222 }}
table {{ border-collapse: collapse }}
td, th {{ padding: 0.25em 0.7em; border-bottom: 1px solid #ccc; text-align: left }}
td.number {{ text-align: right; white-space: nowrap }} tr.unknown {{ color: #777 }} img {{ max-width: 100% }}
</style></head><body>
<h1>Calibration</h1><p>Sessions: {names}</p>{summary}
<h2>Parameters</h2>
<table><tr><th>parameter</th><th>value</th><th>95 % interval</th><th>unit</th>
<th>from the recordings</th><th>meaning</th></tr>{rows}</table>
<p>known: the interval is less than 0.3 times that of the prior; partly: less than 0.7 times; unknown otherwise.</p>
<h2>Only in combination</h2><p>Parameters with a correlation beyond ±0.8:</p><ul>{pairs}</ul>
<h2>Record next</h2><ul>{advice}</ul>
<h2>Flow maps</h2><img alt="recorded and simulated flow maps" src="data:image/png;base64,{picture}">
</body></html>
"""


def _row(estimate: Estimate) -> str:
    p = estimate.parameter
    cells = f'<td class="number">{estimate.value:.4g}</td>'
    cells += f'<td class="number">{estimate.low:.4g} … {estimate.high:.4g}</td>'
    cells += f"<td>{html.escape(p.unit)}</td><td>{estimate.verdict}</td><td>{html.escape(p.meaning)}</td>"
    return f'<tr class="{estimate.verdict}"><td>{p.name}</td>{cells}</tr>'


def error_lines(result: Calibration) -> list[str]:
    """Lines about the errors of flow maps."""
    lines = []
    for kind, maps in (("fitted", result.fitted), ("held-out", result.held_out)):
        if maps is None:
            lines.append("no insertion was held out: record at least two insertions to test the calibration")
            continue
        before, after = maps.error(maps.before), maps.error(maps.after)
        lines.append(
            f"{len(maps.recorded)} {kind} flow maps: error {before:.3g} {result.unit} before, "
            f"{after:.3g} {result.unit} after calibration; noise {result.noise:.3g} {result.unit}"
        )
    if text := unused_markers_text(result.fitted.used):
        lines.append(text)
    if not result.height_plausible:
        lines.append(
            f"in the fit the attempts start {abs(1e3 * result.height_offset):.1f} mm "
            f"{'higher' if result.height_offset > 0 else 'lower'} than the runner assumed: check the taught height of "
            "the hole and part.grasp_height, since stiffnesses depend on them"
        )
    if not result.reproduced:
        lines.append(
            f"the fit does not reproduce the recordings: its residual is {result.fit.best.chi:.1f} times that expected "
            "from noise and model; no parameter counts as known, and the intervals are not reliable"
        )
    if not result.converged:
        used = len(result.fit.starts)
        lines.append(
            f"only {used} of {used + result.fit.others} starts of the fit reached this residual, so a better fit may "
            "exist; no parameter counts as known: record more attempts, or repeat with another --seed"
        )
    if result.predicted is False:
        lines.append(
            "the calibration does not predict the held-out insertion: its residual is "
            f"{result.held_out_residual:.1f} times that expected from noise and model; no stiffness, friction or grasp "
            "counts as known"
        )
    if result.explained:
        lines.append(f"the held-out error is at most {ALLOWED_ERROR:g} times the noise")
    if text := result.not_modelled():
        lines.append(text)
    return lines


def advice_lines(result: Calibration) -> list[str]:
    """Lines about what to record next."""
    lines = []
    for suggestion in result.suggestions:
        if suggestion.narrowed:
            best = sorted(suggestion.narrowed, key=lambda name: suggestion.narrowed[name])[:4]
            named = ", ".join(f"{name} to {100 * suggestion.narrowed[name]:.0f} %" for name in best)
            lines.append(f"{suggestion.text}: narrows the interval of {named}")
    return lines
