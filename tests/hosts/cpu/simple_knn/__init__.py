"""In place of the CUDA module of 3DGS-style trainers."""
