"""`python -m clear_strategies`: the same as `clear-strategies`."""

from clear_strategies.run import main

main()
