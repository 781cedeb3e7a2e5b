"""`python -m clear_strategies.bench`: run time against error, and what a second of training buys.

The questions are `rasterizers`, `kernels`, `iteration` (one training iteration, stage by stage),
`seconds` (whole trainings: seconds to the same PSNR) and `device` (all checks that need a GPU). `scenes`
makes what is drawn; `timing` and `accuracy` take the measurements; `peers` wraps other rasterizers;
`results` and `plots` write the files.
"""

from importlib.util import find_spec

if find_spec("pandas") is None:
    raise ModuleNotFoundError("the benchmark needs pandas: pip install 'clear-strategies[bench]'")
