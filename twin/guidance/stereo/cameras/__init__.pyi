from .calibration import CameraCalibration as CameraCalibration, calibrate as calibrate
from .camera import Camera as Camera, stereo_pair as stereo_pair, tangent_axes as tangent_axes
from .circle import Circle as Circle, cone as cone, consensus as consensus, refit as refit
from .lens import coefficient_slope as coefficient_slope, distortion_slope as distortion_slope, undistort as undistort
from .triangulation import Points as Points, triangulate as triangulate
