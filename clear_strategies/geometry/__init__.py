"""Geometry from posed photos: `stereo` computes depth maps and a coloured point cloud, `depth_maps` the maps alone, and
`exposure_gains` the gains that bring the photos to one exposure.

Needs torch, numpy and Pillow only. With OpenCV, kornia and SciPy (extra [train]) features bound the range of depth, outliers
are removed and gaps are filled; the log names what is left out without them.
"""

from clear_strategies.geometry.dense_stereo.maps import depth_maps
from clear_strategies.geometry.dense_stereo.settings import StereoSettings
from clear_strategies.geometry.exposure import exposure_gains
from clear_strategies.geometry.reconstruction import Stereo, stereo

__all__ = ["Stereo", "StereoSettings", "depth_maps", "exposure_gains", "stereo"]
