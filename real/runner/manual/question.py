"""Context of a manual action: the lab, the recording, and the operator, who is asked before anything moves."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from gelflow.clock import ScaledClock
from gelflow.real.runner.lab import Lab
from gelflow.real.runner.motion_executor import MotionExecutor
from gelflow.session.recorder import SessionRecorder

# Asks the operator a question; the second argument is called while the operator thinks, and raises when a device fails.
Ask = Callable[[str, Callable[[], object]], bool]


@dataclass(frozen=True)
class Session:
    """One manual action."""

    lab: Lab
    clock: ScaledClock
    recorder: SessionRecorder | None  # None: a dry run, which sends nothing
    ask: Ask
    attended: bool = True  # False: `ask` agrees without an operator
    say: Callable[[str], None] = lambda line: None
    on_motion: Callable[[MotionExecutor], None] = lambda motion: None  # before the arm moves

    @property
    def dry_run(self) -> bool:
        """Whether nothing is sent."""
        return self.recorder is None

    def agreed(self, question: str, check: Callable[[], object]) -> bool:
        """Ask, unless this is a dry run, and record question and answer."""
        if self.recorder is None:
            self.say(f"dry run: nothing is sent; a run would ask: {question}")
            return False
        answer = self.ask(question, check)
        self.recorder.event("operator", {"question": question, "yes": answer, "attended": self.attended})
        return answer


Result = dict[str, Any]  # for `--json`
