from .camera import BayerPattern as BayerPattern
from .camera import CameraProfile as CameraProfile
from .camera import get_camera as get_camera
from .camera import list_cameras as list_cameras
from .camera_simulator import CameraSimulator as CameraSimulator
from .capture.plan import SimulationPlan as SimulationPlan
from .capture.prepared_scene import PreparedScene as PreparedScene
from .noise.noise_level_function import NoiseLevelFunction as NoiseLevelFunction
from .raw.develop import develop as develop
from .raw.develop import render_srgb as render_srgb
from .raw.dng import write_dng as write_dng
from .raw.image import RawImage as RawImage
from .raw.noise_estimation import estimate_nlf as estimate_nlf
from .raw.read import RawFileError as RawFileError
from .raw.read import read_raw as read_raw
from .reference.thin_lens import Lens as Lens
from .reference.thin_lens import defocus as defocus
from .settings import CameraSettings as CameraSettings
from .settings import exposure_ratio as exposure_ratio
from .settings import incident_ev100 as incident_ev100
from .settings import sensor_signal as sensor_signal

__version__: str
