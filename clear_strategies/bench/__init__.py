"""Floor 5: `python -m clear_strategies.bench`: run time against error, on the machine that runs it.

Every figure comes from one run in which the contenders take turns, so that noise hits all alike; what is left out is
said. `scenes` is what is drawn, `rounds` takes the times, `accuracy` and `memory` the other two axes, `prototype` is a
peer, `tables` and `plot` show it all. The questions asked are `rasterizers`, `kernels`, `iteration` and, of whole
trainings of any scene that `run` reads, `pareto`.
"""
