from .geometry import PartGeometry as PartGeometry
from .outline import Outline as Outline
from .outline import Rectangle as Rectangle
from .part_file import load_part as load_part
from .part_file import part_names as part_names
from .part_file import shipped_mesh as shipped_mesh
from .part_file import with_shipped_mesh as with_shipped_mesh
from .part_scene import with_part as with_part
from .registry import part_geometry as part_geometry

__all__ = [
    "Outline",
    "PartGeometry",
    "Rectangle",
    "load_part",
    "part_geometry",
    "part_names",
    "shipped_mesh",
    "with_part",
    "with_shipped_mesh",
]
