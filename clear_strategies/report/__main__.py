"""`python -m clear_strategies.report`."""

from clear_strategies.report import main
from clear_strategies.run import program

program(main)
