"""`python -m clear_strategies.bench`: benchmarks of time, memory and error.

Each benchmark of the command line is the module of its name. `scenes` makes the scenes, `results` times contenders in turns and
writes the files.
"""
