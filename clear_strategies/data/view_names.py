"""A view's name, and the names of files that are made of it. Views of several cameras may have equal file names."""

from __future__ import annotations

from clear_strategies.data.photo_files import SUFFIXES


def bare(name: str) -> str:
    """The name without the suffix of an image: "cam1/0001" of "cam1/0001.png", and "rgb.0001" of "rgb.0001"."""
    stem, dot, suffix = name.rpartition(".")
    return stem if f"{dot}{suffix}".lower() in SUFFIXES else name


def file_stem(name: str) -> str:
    """The stem of a file that is made of the view, one of its own in a flat folder: "cam1_0001" of "cam1/0001.png"."""
    return bare(name).replace("/", "_")
