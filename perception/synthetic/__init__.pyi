from .accurate_renderer import AccurateGelRenderer as AccurateGelRenderer
from .accurate_renderer import RenderedImage as RenderedImage
from .appearance import DegradedGelAppearance as DegradedGelAppearance
from .appearance import GelAppearance as GelAppearance
from .appearance import make_appearance as make_appearance
from .error_bound import cramer_rao_errors as cramer_rao_errors
from .fast_renderer import FastGelRenderer as FastGelRenderer
from .lens import Lens as Lens
from .sequence_files import GroundTruth as GroundTruth
from .sequence_files import read_truth as read_truth
from .sequence_files import write_sequence as write_sequence
from .sequences import GelSequence as GelSequence

__all__ = [
    "AccurateGelRenderer",
    "DegradedGelAppearance",
    "FastGelRenderer",
    "GelAppearance",
    "GelSequence",
    "GroundTruth",
    "Lens",
    "RenderedImage",
    "cramer_rao_errors",
    "make_appearance",
    "read_truth",
    "write_sequence",
]
