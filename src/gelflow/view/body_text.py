"""The description of one body by `gelflow describe`, as Markdown."""

from gelflow.sim.benchmark.describe import Description, JointPart, PadPart

_UNITS = {"slide": "m", "hinge": "rad"}


def body_text(description: Description, name: str) -> str:
    """The description of a body and of the contacts and pads of its geometries."""
    body = next(part for part in description.bodies if part.name == name)
    lines = [f"**{_plain(body.name)}**"]
    if body.parent is not None:
        lines[0] += f", {body.mass:.4g} kg, moves in {_plain(body.parent)}"
    lines += [f"- joint {_joint(joint)}" for joint in body.joints]
    lines += [
        f"- actuator {_plain(actuator.name)}: {actuator.kind}" + (f", kp {actuator.kp:g}" if actuator.kp else "")
        for joint in body.joints
        for actuator in joint.actuators
    ]
    lines += [f"- {_plain(geometry)}" for geometry in body.geometry]
    lines += [f"- fixed to it: {_plain(merged)}" for merged in body.merged]
    owned = {geometry.split(" ", 1)[1] for geometry in body.geometry if " " in geometry}
    for contact in description.contacts:
        if contact.points.split(" ", 1)[1] in owned or owned & set(contact.against):
            numbers = ", ".join(f"{key} {value:g}" for key, value in contact.numbers.items())
            lines.append(
                f"- contact {_plain(contact.name)}: {_plain(contact.points)} ({contact.candidates} points) against "
                f"{_plain(', '.join(contact.against))}, {contact.law} friction, {numbers}"
            )
    lines += [f"- pad {_pad(pad)}" for pad in description.pads if pad.body == name]
    return "\n".join([lines[0], "", *lines[1:]])


def _joint(joint: JointPart) -> str:
    axis = "" if joint.axis is None else f" along {' '.join(f'{x:g}' for x in joint.axis)}"
    limits = "" if joint.range is None else f", {joint.range[0]:g} to {joint.range[1]:g} {_UNITS.get(joint.type, '')}"
    damping = f", damping {joint.damping:g}" if joint.damping else ""
    return f"{_plain(joint.name)}: {joint.type}{axis}{limits}{damping}"


def _pad(pad: PadPart) -> str:
    grid = f"{pad.rows} × {pad.cols} grid, pitch {pad.pitch_mm:g} mm" if pad.pitch_mm else f"{pad.markers} markers"
    against = _plain(", ".join(pad.against))
    return f"{_plain(pad.name)}: {pad.shape}, {grid}, touches {against}, {pad.law} law"


def _plain(text: str) -> str:
    """Text whose characters are no Markdown."""
    return "".join(f"\\{c}" if c in "\\`*_{}[]<>#|" else c for c in text)
