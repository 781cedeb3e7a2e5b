"""Dense stereo: the depth of every photo under known poses, from the photos alone.

A plane sweep (`cost`) over source photos chosen by angle and overlap (`sources`), semi-global smoothing (`smoothing`), and which
depths hold (`consistency`). `maps` puts them together, `cloud` makes points of the maps.
"""
