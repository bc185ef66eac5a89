from .ledger import Ledger as Ledger
from .rules import RULES as RULES
from .rules import RunFacts as RunFacts
from .rules import violations as violations
from .session_facts import SessionFacts as SessionFacts
from .session_facts import read_session as read_session

__all__ = [
    "RULES",
    "Ledger",
    "RunFacts",
    "SessionFacts",
    "read_session",
    "violations",
]
