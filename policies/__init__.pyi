from .checkpoint import Checkpoint as Checkpoint
from .checkpoint import default_checkpoint as default_checkpoint
from .checkpoint import load_checkpoint as load_checkpoint
from .checkpoint import load_policy as load_policy
from .checkpoint import save_checkpoint as save_checkpoint
from .checkpoint import shipped_checkpoints as shipped_checkpoints
from .environment import FlowMapNoise as FlowMapNoise
from .environment import PolicyEnv as PolicyEnv
from .environment import make_insertion_env as make_insertion_env
from .evaluation import EvaluationResult as EvaluationResult
from .evaluation import NetworkActor as NetworkActor
from .evaluation import RandomActor as RandomActor
from .evaluation import evaluate as evaluate
from .imitation import ImitationSettings as ImitationSettings
from .networks.base import Architecture as Architecture
from .networks.base import BatchPolicy as BatchPolicy
from .networks.base import Network as Network
from .networks.flow_map_policy import NetworkPolicy as NetworkPolicy
from .networks.polynomial_gru import PolynomialGRU as PolynomialGRU
from .networks.polynomial_gru import PolynomialGRUNetwork as PolynomialGRUNetwork
from .networks.polynomial_mlp import PolynomialMLP as PolynomialMLP
from .networks.polynomial_mlp import PolynomialNetwork as PolynomialNetwork
from .ppo import PPOSettings as PPOSettings
from .recipes import train as train
from .training.run import Progress as Progress
from .training.run import TrainingResult as TrainingResult

__all__ = [
    "Architecture",
    "BatchPolicy",
    "Checkpoint",
    "EvaluationResult",
    "FlowMapNoise",
    "ImitationSettings",
    "Network",
    "NetworkActor",
    "NetworkPolicy",
    "PPOSettings",
    "PolicyEnv",
    "PolynomialGRU",
    "PolynomialGRUNetwork",
    "PolynomialMLP",
    "PolynomialNetwork",
    "Progress",
    "RandomActor",
    "TrainingResult",
    "default_checkpoint",
    "evaluate",
    "load_checkpoint",
    "load_policy",
    "make_insertion_env",
    "save_checkpoint",
    "shipped_checkpoints",
    "train",
]
