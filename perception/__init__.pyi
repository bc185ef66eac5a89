from .camera_calibration import CameraCalibration as CameraCalibration
from .camera_calibration import fit_calibration as fit_calibration
from .camera_calibration import load_calibration as load_calibration
from .camera_calibration import save_calibration as save_calibration
from .errors import TrackerInitError as TrackerInitError
from .force.estimator import ForceEstimate as ForceEstimate
from .force.estimator import ForceEstimator as ForceEstimator
from .force.slip import SlipEstimate as SlipEstimate
from .force.slip import SlipEstimator as SlipEstimator
from .frames import CameraMount as CameraMount
from .frames import decode_image as decode_image
from .frames import tactile_frame as tactile_frame
from .mount_check import check_scale as check_scale
from .overlay import draw_overlay as draw_overlay
from .sensors.profile import SensorProfile as SensorProfile
from .sensors.profile import load_sensor_profile as load_sensor_profile
from .sources import ImageSource as ImageSource
from .sources import SourceImage as SourceImage
from .sources import image_source as image_source
from .tracker import MarkerTracker as MarkerTracker
from .tracker import TrackerConfig as TrackerConfig
from .tracker import TrackingResult as TrackingResult

__all__ = [
    "CameraCalibration",
    "CameraMount",
    "ForceEstimate",
    "ForceEstimator",
    "ImageSource",
    "MarkerTracker",
    "SensorProfile",
    "SlipEstimate",
    "SlipEstimator",
    "SourceImage",
    "TrackerConfig",
    "TrackerInitError",
    "TrackingResult",
    "check_scale",
    "decode_image",
    "draw_overlay",
    "fit_calibration",
    "image_source",
    "load_calibration",
    "load_sensor_profile",
    "save_calibration",
    "tactile_frame",
]
