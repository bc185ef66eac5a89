"""`gelflow describe SCENE`: model, omissions and size of a scene, and the time of a step."""

import argparse
import dataclasses
from typing import TYPE_CHECKING

from rich.console import Group
from rich.markup import escape
from rich.padding import Padding
from rich.table import Table
from rich.tree import Tree

from gelflow.cli.exit_codes import SUCCESS
from gelflow.cli.options import add_json, add_preset, add_repeats, check_at_least
from gelflow.cli.output import Output, progress_bar

if TYPE_CHECKING:
    from gelflow.sim.benchmark.describe import (
        ActuatorPart,
        BodyPart,
        ContactPart,
        Description,
        JointPart,
        PadPart,
        ShapePart,
        Size,
    )
    from gelflow.sim.benchmark.step_times import StepTimes
    from gelflow.sim.scene import Scene


def configure(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("scene", metavar="SCENE", help="name of an included scene, or a TOML, MJCF or URDF file")
    parser.add_argument("--friction", choices=["viscous", "elastic"], help="friction law (default: that of the scene)")
    parser.add_argument("--no-timing", action="store_true", help="omit the measured times")
    add_repeats(parser, "timed repeats (%(default)s)", default=60)
    add_preset(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Describe the scene and measure its step times."""
    check_at_least(args, repeats=1)
    from gelflow.sim.benchmark.describe import describe
    from gelflow.sim.scene import load_scene

    output = Output(args.json)
    scene = load_scene(args.scene, preset=args.preset, friction=args.friction)
    description = describe(scene)
    if output.json:
        times = None if args.no_timing else dataclasses.asdict(_measured(scene, args.repeats))
        output.result(dataclasses.asdict(description) | {"times": times})
        return SUCCESS
    parts = (tree(description), *_hints(description), _not_modelled(description), _size(description.size))
    output.console.print(*parts, markup=True)
    if not args.no_timing:
        output.console.print(_times(_measured(scene, args.repeats)), markup=True)
    return SUCCESS


def _measured(scene: "Scene", repeats: int) -> "StepTimes":
    from gelflow.sim.benchmark.step_times import measure

    with progress_bar() as progress:
        task = progress.add_task("timing", total=repeats)
        return measure(scene, repeats=repeats, done=lambda: progress.advance(task))


def tree(d: "Description") -> Tree:
    """Tree of the parts of a scene."""
    gravity = " ".join(f"{g:g}" for g in d.gravity)
    root = Tree(
        f"[bold]{escape(d.scene)}[/bold]: steps of {d.step * 1e3:g} ms, {d.friction} law, gravity {gravity} m/s², "
        f"{d.integrator.upper()}"
    )
    bodies = root.add("[bold]bodies[/bold]")
    for body in d.bodies:
        _add_body(bodies, body)
    if d.couplings:
        couplings = root.add("[bold]couplings[/bold]")
        for line in d.couplings:
            couplings.add(escape(line))
    if d.shapes:
        shapes = root.add("[bold]shapes[/bold]")
        for shape in d.shapes:
            shapes.add(_shape(shape))
    contacts = root.add("[bold]contacts[/bold]" if d.contacts else "[bold]contacts[/bold]: none")
    for contact in d.contacts:
        _add_contact(contacts, contact)
    pads = root.add("[bold]pads[/bold]" if d.pads else "[bold]pads[/bold]: none")
    for pad in d.pads:
        _add_pad(pads, pad)
    return root


def _add_body(at: Tree, body: "BodyPart") -> None:
    name = f"[cyan]{escape(body.name)}[/cyan]"
    on = "" if body.parent in (None, "world") else f" on {escape(str(body.parent))}"
    branch = at.add(name if body.parent is None else f"{name}{on}: {body.mass:.4g} kg")
    for joint in body.joints:
        leaf = branch.add(_joint(joint))
        for actuator in joint.actuators:
            leaf.add(_actuator(actuator, "N m" if joint.type == "hinge" else "N"))
    if body.merged:
        branch.add(escape(f"attached: {', '.join(body.merged)}"))
    if body.geometry:
        branch.add(escape(f"geometry: {', '.join(body.geometry)}"))


def _joint(joint: "JointPart") -> str:
    angle = joint.type in ("hinge", "ball")
    unit, per = ("rad", "N m/rad") if angle else ("m", "N/m")
    words = [joint.type]
    if joint.prescribed:
        words.append("moved from outside")
    if joint.axis is not None:
        words[0] += f" {'about' if angle else 'along'} ({' '.join(f'{a:.3g}' for a in joint.axis)})"
    if joint.range is not None:
        low, high = joint.range
        words.append(f"range {low:g} to {high:g} {unit} (stop {joint.limit_stiffness:g} {per})")
    if joint.damping:
        of_all = "" if joint.type == "free" else " N m s/rad" if angle else " N s/m"
        words.append(f"damping {joint.damping:g}{of_all}")
    if joint.stiffness:
        words.append(f"spring {joint.stiffness:g} {per}")
    if joint.frictionloss:
        words.append(f"dry friction {joint.frictionloss:g} {'N m' if angle else 'N'}")
    if joint.armature:
        words.append(f"armature {joint.armature:g} {'kg m²' if angle else 'kg'}")
    return f"joint [green]{escape(joint.name)}[/green]: {', '.join(words)}"


def _actuator(actuator: "ActuatorPart", unit: str) -> str:
    words = [actuator.kind]
    if actuator.kp or actuator.kd:
        words.append(f"k_p {actuator.kp:g}, k_d {actuator.kd:g}")
    if actuator.gear != 1:
        words.append(f"gear {actuator.gear:g}")
    if actuator.gain != 1 or actuator.bias:
        words.append(f"gain {actuator.gain:g}, bias {actuator.bias:g}")
    for what, (low, high), of in (("force", actuator.force, f" {unit}"), ("control", actuator.control, "")):
        if low is not None or high is not None:
            words.append(f"{what} {'-∞' if low is None else f'{low:g}'} to {'∞' if high is None else f'{high:g}'}{of}")
    return f"actuator [yellow]{escape(actuator.name)}[/yellow]: {', '.join(words)}"


def _shape(shape: "ShapePart") -> str:
    words = []
    if shape.cells is not None and shape.spacing is not None and shape.bytes is not None:
        size = f"{shape.bytes / 1e6:.1f} MB"
        words.append(f"grid of {' × '.join(map(str, shape.cells))} cells of {shape.spacing * 1e3:.3g} mm, {size}")
    if shape.rounding:
        words.append(f"edges rounded by {shape.rounding * 1e3:.3g} mm")
    return f"[cyan]{escape(shape.name)}[/cyan]: {shape.kind}, {', '.join(words)}"


def _add_contact(at: Tree, contact: "ContactPart") -> None:
    count = "one exact point" if contact.unit == "one exact point" else f"{contact.candidates} points"
    text = f"{count} on {contact.points} against {', '.join(contact.against)}"
    branch = at.add(f"[cyan]{escape(contact.name)}[/cyan]: {escape(text)}")
    linear = ", linear damping" if contact.damping == "linear" else ""
    branch.add(
        _law(contact.law, contact.unit, contact.numbers, linear, damped_by_depth=contact.damping == "hunt-crossley")
    )


def _add_pad(at: Tree, pad: "PadPart") -> None:
    if pad.pitch_mm is None:
        markers = (
            f"{pad.markers} markers at given points"
            if pad.shape == "points"
            else f"{pad.markers} markers, a {pad.shape}"
        )
    else:
        markers = f"{pad.rows} × {pad.cols} markers, {pad.pitch_mm:g} mm apart"
    text = f"{markers}, on {pad.body} against {', '.join(pad.against)}"
    text += ", which they push" if pad.collides else ""
    branch = at.add(f"[cyan]{escape(pad.name)}[/cyan]: {escape(text)}")
    branch.add(_law(pad.law, pad.unit, pad.numbers, "", damped_by_depth=True))
    if pad.gel is not None:
        branch.add(escape(f"gel: {pad.gel}"))


def _law(law: str, unit: str, numbers: "dict[str, float]", more: str, *, damped_by_depth: bool) -> str:
    """Text of a force law; units as in docs/reference/conventions.md, linear damping has that of k_t."""
    stiffness, friction, by_depth = ("N/m³", "N s/m³", "N s/m⁴") if unit == "per area" else ("N/m", "N s/m", "N s/m²")
    words = [f"k_n {numbers['kn']:g} {stiffness}"]
    if law == "elastic":
        words.append(f"k_s {numbers['ks']:g} {stiffness}")
    words.append(f"k_t {numbers['kt']:g} {friction}")
    words.append(f"k_d {numbers['kd']:g} {by_depth if damped_by_depth else friction}")
    words.append(f"µ {numbers['mu']:g}")
    of = "" if unit == "one exact point" else f" {unit}"
    return f"{law}{of}{more}: {', '.join(words)}"


def _hints(d: "Description") -> "list[Tree]":
    if not d.hints:
        return []
    root = Tree("[bold]accuracy[/bold]: docs/reference/accuracy.md")
    for line in d.hints:
        root.add(escape(line))
    return [root]


def _not_modelled(d: "Description") -> Tree:
    root = Tree("[bold]not modelled, and why[/bold]")
    for line in d.not_modelled:
        root.add(escape(line))
    return root


def _size(size: "Size") -> Table:
    table = Table(title="Size", title_justify="left", show_header=False)
    table.add_column("what")
    table.add_column("number", justify="right", no_wrap=True)

    def count(what: str, number: int | None) -> None:
        table.add_row(what, "unknown" if number is None else f"{number:,}".replace(",", " "))

    count("positions (nq)", size.nq)
    count("velocities, the unknowns of a step (nv)", size.nv)
    count("controls (nu)", size.nu)
    count("contact pairs: points against one geometry", size.contact_pairs)
    count("candidate points of all pairs", size.candidate_points)
    count("anchors: memory of the elastic law", size.anchors)
    count("markers", size.markers)
    count("parameters", size.parameters)
    table.add_section()
    count("bytes of state, per environment", size.state_bytes)
    count("bytes of parameters, per environment", size.parameter_bytes)
    count("bytes of one reading, per environment", size.reading_bytes)
    count("bytes of workspace, per thread, about", size.workspace_bytes)
    count("bytes of the model, shared, about", size.model_bytes)
    return table


def _times(times: "StepTimes") -> Group:
    table = Table(title="Microseconds per step by part", title_justify="left")
    table.add_column("part")
    table.add_column("µs", justify="right", no_wrap=True)
    table.add_column("share", justify="right", no_wrap=True)

    def row(name: str, microseconds: float) -> None:
        # Adding 0 to the rounded value turns −0.0 into 0.0.
        table.add_row(
            escape(name), f"{round(microseconds, 1) + 0:.1f}", f"{round(100 * microseconds / times.whole) + 0:.0f} %"
        )

    for part in times.parts:
        row(part.name, part.microseconds)
    table.add_section()
    row("whole step", times.whole)
    if times.reading is not None:
        table.add_section()
        row("one reading of all markers, not part of the step", times.reading)
    low, high = times.quartiles
    halved = f", {times.halved_steps} of the steps were halved" if times.halved_steps else ""
    text = (
        f"One environment, one thread of {times.machine}. Steps from {times.timed_steps} states of a run: "
        f"{times.run_steps} steps from the scene's start, servos at their start positions, other controls 0. The time "
        "of a contact or pad is the increase of the step time when the scene has it twice, once without force; "
        "bodies and solver are the remainder. These are differences of whole steps, whose noise few repeats do not "
        "average out. "
        f"Medians of {times.repeats} interleaved repeats; half of the whole steps took {low:.1f} to {high:.1f} µs, the "
        f"first step {times.at_start:.1f} µs. Newton's method took {times.newton_iterations:.2f} iterations per step"
        f"{halved}."
    )
    return Group(table, Padding(escape(text), (0, 0)))
