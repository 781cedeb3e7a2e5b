"""Runs unchanged trainers on machines without a GPU:

    python -m integration.on_cpu simple_trainer.py default --data_dir data

Each module here takes the place of one that needs CUDA: `diff_gaussian_rasterization`, `simple_knn`, `fused_ssim`, what gsplat
compiles, and CUDA itself in torch. `--strategies best` before the script trains with the strategies, as `integration.gsplat` and
`integration.inria` do.
"""
