from .contacts import CONTACT_PARAMS as CONTACT_PARAMS
from .contacts import FRICTION_LAWS as FRICTION_LAWS
from .contacts import ContactDef as ContactDef
from .contacts import PointsDef as PointsDef
from .gel import Gel as Gel
from .gel import LayerGel as LayerGel
from .gel import SpringGel as SpringGel
from .geometry.distance_grid import DistanceGrid as DistanceGrid
from .geometry.distance_grid import distance_grid as distance_grid
from .geometry.mesh import TriangleMesh as TriangleMesh
from .joint_limits import JointLimit as JointLimit
from .loader import INTEGRATORS as INTEGRATORS
from .loader import PRECISIONS as PRECISIONS
from .loader import load_scene as load_scene
from .loader import scene_names as scene_names
from .mjcf.actuators import ActuatorDef as ActuatorDef
from .mjcf.mechanics import WORLD as WORLD
from .mjcf.mechanics import BodyDef as BodyDef
from .mjcf.mechanics import JointDef as JointDef
from .mjcf.mechanics import SiteDef as SiteDef
from .pads import PadDef as PadDef
from .presets import PRESET_NAMES as PRESET_NAMES
from .scene import DEFAULT_TOLERANCE as DEFAULT_TOLERANCE
from .scene import Precision as Precision
from .scene import Scene as Scene
from .shapes import ShapeDef as ShapeDef

__all__ = [
    "CONTACT_PARAMS",
    "DEFAULT_TOLERANCE",
    "FRICTION_LAWS",
    "INTEGRATORS",
    "PRECISIONS",
    "PRESET_NAMES",
    "WORLD",
    "ActuatorDef",
    "BodyDef",
    "ContactDef",
    "DistanceGrid",
    "Gel",
    "JointDef",
    "JointLimit",
    "LayerGel",
    "PadDef",
    "PointsDef",
    "Precision",
    "Scene",
    "ShapeDef",
    "SiteDef",
    "SpringGel",
    "TriangleMesh",
    "distance_grid",
    "load_scene",
    "scene_names",
]
