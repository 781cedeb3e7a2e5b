"""Dense stereo: the depth of every photo with a known pose, from the photos alone.

A plane sweep (`cost`) over source photos chosen by angle and overlap (`sources`), semi-global smoothing (`smoothing`), and checks
of consistency (`consistency`). `maps` combines them to depth maps, `cloud` makes points of the maps.
"""
