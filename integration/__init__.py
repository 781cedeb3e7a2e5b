"""Strategies inside other people's trainers. Imports no trainer of ours: a host must not pull one in."""
