"""Geometry from posed photos: depth by dense stereo, a cloud of points, pseudo views."""
