"""Stress tests: extreme inputs, faults, damaged files. `python -m tests.stress` runs them whole; pytest runs a slice."""
