"""Python imports this at its start: the networks that trainers would download are not there, and torchvision need not be.

Only for the programs that tests/hosts starts.
"""

import importlib.util
import sys
import types

import torch
import torchmetrics.image.lpip  # before torchvision is replaced, whose networks it would use
from PIL import Image


class NoNetwork(torch.nn.Module):
    """LPIPS of torchmetrics and of 3DGS-style trainers: 0."""

    def __init__(self, *_, **__):
        super().__init__()

    def forward(self, *_, **__):
        return torch.zeros(())


class Midas(torch.nn.Module):
    """In place of FSGS's depth network."""

    def forward(self, x):
        return x.mean(1)


class Transforms:
    def dpt_transform(self, x):
        return torch.as_tensor(x).permute(2, 0, 1)[None].float() / 255


def save_image(image, path):
    """torchvision.utils.save_image of one image."""
    pixels = (image.detach() * 255 + 0.5).clamp(0, 255).byte().permute(1, 2, 0)
    Image.fromarray(pixels.numpy()).save(path)


torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity = NoNetwork
sys.modules["lpipsPyTorch"] = types.SimpleNamespace(lpips=NoNetwork())
torch.hub.load = lambda repository, name, *_, **__: Transforms() if name == "transforms" else Midas()
if importlib.util.find_spec("torchvision") is None:
    utils = types.SimpleNamespace(save_image=save_image)
    sys.modules |= {"torchvision": types.SimpleNamespace(utils=utils), "torchvision.utils": utils}
