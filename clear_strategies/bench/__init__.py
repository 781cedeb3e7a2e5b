"""Floor 5: `python -m clear_strategies.bench`: run time against error, on the machine that runs it.

Every figure comes from one run in which the contenders take turns, so that noise hits all alike; what is left out is
said. `scenes` is what is drawn, `rounds` takes the times, `accuracy` and `memory` the other two axes, `counting` and
`peaks` say how much is left to gain, `prototype` and `peers` are other people's, `output` and `plot` show it all. The
questions asked are `rasterizers`, `kernels` (with `gaussians`), `iteration` and, of whole trainings of any scene that
`run` reads, `pareto`; `device` asks everything that only a GPU can answer.
"""
