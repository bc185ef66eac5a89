from .backpropagation import Backpropagation as Backpropagation
from .backpropagation import BackpropagationSettings as BackpropagationSettings
from .checkpoint import Checkpoint as Checkpoint
from .checkpoint import default_checkpoint as default_checkpoint
from .checkpoint import load_checkpoint as load_checkpoint
from .checkpoint import load_network as load_network
from .checkpoint import load_policy as load_policy
from .checkpoint import save_checkpoint as save_checkpoint
from .checkpoint import shipped_checkpoints as shipped_checkpoints
from .episodes import OraclePolicy as OraclePolicy
from .episodes import RandomPolicy as RandomPolicy
from .episodes import evaluate_task as evaluate_task
from .evaluation import EvaluationResult as EvaluationResult
from .imitation import ImitationSettings as ImitationSettings
from .networks.base import Architecture as Architecture
from .networks.base import BatchPolicy as BatchPolicy
from .networks.base import Network as Network
from .networks.flow_map_policy import NetworkPolicy as NetworkPolicy
from .networks.mlp import MLP as MLP
from .networks.polynomial_gru import PolynomialGRU as PolynomialGRU
from .networks.polynomial_gru import PolynomialGRUNetwork as PolynomialGRUNetwork
from .networks.polynomial_mlp import PolynomialMLP as PolynomialMLP
from .networks.polynomial_mlp import PolynomialNetwork as PolynomialNetwork
from .ppo import PPOSettings as PPOSettings
from .recipes import recipe_for as recipe_for
from .recipes import train as train
from .training.run import Progress as Progress
from .training.run import TrainingResult as TrainingResult

__all__ = [
    "MLP",
    "Architecture",
    "Backpropagation",
    "BackpropagationSettings",
    "BatchPolicy",
    "Checkpoint",
    "EvaluationResult",
    "ImitationSettings",
    "Network",
    "NetworkPolicy",
    "OraclePolicy",
    "PPOSettings",
    "PolynomialGRU",
    "PolynomialGRUNetwork",
    "PolynomialMLP",
    "PolynomialNetwork",
    "Progress",
    "RandomPolicy",
    "TrainingResult",
    "default_checkpoint",
    "evaluate_task",
    "load_checkpoint",
    "load_network",
    "load_policy",
    "recipe_for",
    "save_checkpoint",
    "shipped_checkpoints",
    "train",
]
