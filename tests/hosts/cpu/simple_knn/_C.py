# ruff: noqa: N999 - the host's name
"""The mean squared distance to the three nearest points; in FSGS also their indices."""

import os

import torch


def distCUDA2(points):
    squared = torch.cdist(points, points).square()
    squared.fill_diagonal_(float("inf"))
    nearest = squared.topk(3, largest=False)
    mean = nearest.values.mean(1)
    return (mean, nearest.indices.int()) if os.environ["HOST"] == "fsgs" else mean
