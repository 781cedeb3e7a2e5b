"""`python -m clear_strategies.bench`: run time against error, and what a second of training buys.

A question of the command line is the module of its name. `scenes` makes what is drawn, `results` lets contenders take turns and
writes the files.
"""
