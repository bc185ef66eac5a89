"""Gripper actions by hand: home, open, acknowledge a fault. Each checks, asks, and checks again."""

from gelflow.errors import SafetyError
from gelflow.protocols import GripperState
from gelflow.real.runner.cell import gripper_of
from gelflow.real.runner.manual.question import Result, Session
from gelflow.real.wsg.checks import may_hold_part
from gelflow.real.wsg.driver import WsgGripper

_WIDTH_TOLERANCE = 0.5e-3  # fingers that are open by less are opened [m]
_CLEARANCE = 5e-3  # beyond the width of a part that is wider than `open_width` [m]


def home(session: Session) -> Result:
    """Home the fingers outwards. A part that may be held needs an attending operator, because the fingers release it.

    Raises SafetyError while the gripper reports a fault, PeerError when it does not answer or refuses.
    """
    with _gripper(session) as gripper:
        state = state_without_fault(gripper)
        held = may_hold_part(state, grasped=False)
        if held and not session.attended:
            raise SafetyError(
                f"home refused: a part may be held ({_shown(state)}) and nobody is asked; release it with: "
                "gelflow robot open, or home without --yes"
            )
        what = f"a part may be held ({_shown(state)}): hold it, the fingers release it" if held else _shown(state)
        question = f"The fingers move outwards to their end stop; {what}. Is nothing else between or beside them?"
        if not session.agreed(question, gripper.state):
            return {"done": False, "state": state}
        if state.grasp == "holding":  # the device then accepts no other motion
            width = _release_width(gripper, state, session.lab.gripper.open_width)
            gripper.release(width=width, speed=session.lab.gripper.speed)
        gripper.home(part_removed=held)
        return {"done": True, "state": gripper.state()}


def open_fingers(session: Session) -> Result:
    """Open the fingers to the lab file's `open_width`, or beyond a wider part; a held part is released.

    Raises SafetyError while the gripper reports a fault or is not homed, PeerError when it does not answer or refuses.
    """
    lab = session.lab.gripper
    with _gripper(session) as gripper:
        state = state_without_fault(gripper)
        if not state.referenced:
            raise SafetyError("open refused: the gripper is not homed; use: gelflow robot home")
        held = may_hold_part(state, grasped=False)
        if not held and state.width > lab.open_width - _WIDTH_TOLERANCE:
            session.say(f"the fingers are open already: {_shown(state)}")
            return {"done": True, "state": state}
        what = "Hold the part: it is released" if held else "Hold a part that may fall"
        width = _release_width(gripper, state, lab.open_width) if held else lab.open_width
        question = f"{what}. The fingers open from {1e3 * state.width:.1f} to {1e3 * width:.1f} mm. Open?"
        if not session.agreed(question, gripper.state):
            return {"done": False, "state": state}
        if held:
            gripper.release(width=width, speed=lab.speed)
        else:
            gripper.move(width=width, speed=lab.speed)
        return {"done": True, "state": gripper.state()}


def acknowledge(session: Session) -> Result:
    """Acknowledge the fault of the gripper after an operator has inspected it. Nothing is sent without a fault.

    Raises SafetyError when it reports another fault after the answer than before the question.
    """
    with _gripper(session) as gripper:
        state = gripper.state()
        if not state.fault:
            session.say(f"the gripper reports no fault: {_shown(state)}")
            return {"done": True, "state": state, "fault": ""}
        session.say(f"the gripper reports {state.fault}: {_shown(state)}")
        question = f"After the acknowledgement of {state.fault} the fingers can move again. Is the cause removed?"
        if not session.agreed(question, gripper.state):
            return {"done": False, "state": state, "fault": state.fault}
        if (now := gripper.state().fault) != state.fault:
            raise SafetyError(
                f"acknowledge refused: the gripper reports {now or 'no fault'} now, and {state.fault} before the "
                "question; look at the fingers, and start again"
            )
        gripper.acknowledge_fault()
        return {"done": True, "state": gripper.state(), "fault": state.fault}


def _release_width(gripper: WsgGripper, state: GripperState, open_width: float) -> float:
    """`open_width`; for a part that is wider, its width and a clearance, within the gripper's limits [m]."""
    if state.width < open_width:
        return open_width
    return min(state.width + _CLEARANCE, gripper.limits.width[1])


def _gripper(session: Session) -> WsgGripper:
    return gripper_of(session.lab, session.clock, session.recorder, dry_run=session.dry_run)


def state_without_fault(gripper: WsgGripper) -> GripperState:
    """The state of the gripper. Raises SafetyError when it reports a fault."""
    state = gripper.state()
    if state.fault:
        raise SafetyError(f"the gripper reports {state.fault}; inspect it, then use: gelflow robot acknowledge")
    return state


def _shown(state: GripperState) -> str:
    return f"{state.grasp}, {1e3 * state.width:.1f} mm open, {state.force:.1f} N"
