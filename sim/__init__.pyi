from .benchmark.describe import describe as describe
from .drawing.camera import Camera as Camera
from .drawing.renderer import render as render
from .drawing.scene_drawing import Polyline as Polyline
from .reductions import TactileReduction as TactileReduction
from .reductions import center_of_pressure as center_of_pressure
from .reductions import mean_shear as mean_shear
from .reductions import pad_forces as pad_forces
from .reductions import pad_moments as pad_moments
from .reductions import pad_pressures as pad_pressures
from .reductions import shear_features as shear_features
from .scene.loader import load_scene as load_scene
from .scene.loader import scene_names as scene_names
from .scene.scene import Scene as Scene
from .simulator import STATUS_MESSAGES as STATUS_MESSAGES
from .simulator import Simulator as Simulator
from .tasks.cap_rotation import CapRotationTask as CapRotationTask
from .tasks.differentiable_pushing import DifferentiablePushing as DifferentiablePushing
from .tasks.grasp import GraspTask as GraspTask
from .tasks.gripper.flow_map_noise import FlowMapNoise as FlowMapNoise
from .tasks.gymnasium_envs import TaskEnv as TaskEnv
from .tasks.gymnasium_envs import TaskVectorEnv as TaskVectorEnv
from .tasks.insertion import InsertionAttempts as InsertionAttempts
from .tasks.insertion import insertion_scene as insertion_scene
from .tasks.insertion_environments import InsertionEnv as InsertionEnv
from .tasks.insertion_environments import InsertionVectorEnv as InsertionVectorEnv
from .tasks.pushing import Pushing as Pushing
from .tasks.pushing import PushingTask as PushingTask
from .tasks.randomization import Fixed as Fixed
from .tasks.randomization import LogUniform as LogUniform
from .tasks.randomization import Normal as Normal
from .tasks.randomization import Randomization as Randomization
from .tasks.randomization import Uniform as Uniform
from .tasks.registry import make_task as make_task
from .tasks.registry import task_names as task_names
from .tasks.task_batch import TaskBatch as TaskBatch
from .torch_layer import TorchRollout as TorchRollout
from .torch_layer import TorchState as TorchState
from .torch_layer import torch_rollout as torch_rollout
from .torch_layer import torch_site_poses as torch_site_poses
from .torch_layer import torch_state as torch_state
from .torch_layer import torch_step as torch_step
from .trajectory import TouchStop as TouchStop
from .trajectory import Trajectory as Trajectory
from .trajectory import TrajectoryGradient as TrajectoryGradient
from .validation.energy import Energy as Energy
from .validation.energy import EnergyGauge as EnergyGauge

__all__ = [
    "STATUS_MESSAGES",
    "Camera",
    "CapRotationTask",
    "DifferentiablePushing",
    "Energy",
    "EnergyGauge",
    "Fixed",
    "FlowMapNoise",
    "GraspTask",
    "InsertionAttempts",
    "InsertionEnv",
    "InsertionVectorEnv",
    "LogUniform",
    "Normal",
    "Polyline",
    "Pushing",
    "PushingTask",
    "Randomization",
    "Scene",
    "Simulator",
    "TactileReduction",
    "TaskBatch",
    "TaskEnv",
    "TaskVectorEnv",
    "TorchRollout",
    "TorchState",
    "TouchStop",
    "Trajectory",
    "TrajectoryGradient",
    "Uniform",
    "center_of_pressure",
    "describe",
    "insertion_scene",
    "load_scene",
    "make_task",
    "mean_shear",
    "pad_forces",
    "pad_moments",
    "pad_pressures",
    "render",
    "scene_names",
    "shear_features",
    "task_names",
    "torch_rollout",
    "torch_site_poses",
    "torch_state",
    "torch_step",
]
