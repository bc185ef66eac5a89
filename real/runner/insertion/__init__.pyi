from .attempt import Attempt as Attempt
from .attempt import Insertion as Insertion
from .insertion_runner import InsertionRunner as InsertionRunner
from .insertion_runner import Operator as Operator

__all__ = ["Attempt", "Insertion", "InsertionRunner", "Operator"]
