"""The losses of `reference` in NVIDIA Warp, for float32 images [H, W, 3] on CUDA; the same kernels run on a CPU, to check them.

This module does not import Warp; `launches` does. Losses stay on the device, and the host does not wait for it. All
work runs on torch's current stream in memory of torch's allocator. Results have the same bits in every run.
"""
