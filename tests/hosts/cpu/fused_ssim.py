"""SSIM of two images [1, 3, H, W], as the compiled package of that name has it."""

import torch
import torch.nn.functional as F

C1, C2 = 0.01**2, 0.03**2


def fused_ssim(a, b, padding="same", train=True):
    x = torch.arange(11.0) - 5
    line = torch.exp(-(x**2) / (2 * 1.5**2))
    window = torch.outer(line, line) / line.sum() ** 2

    def mean(image):
        return F.conv2d(image, window.expand(3, 1, 11, 11), padding=5 if padding == "same" else 0, groups=3)

    ma, mb = mean(a), mean(b)
    va, vb, both = mean(a * a) - ma**2, mean(b * b) - mb**2, mean(a * b) - ma * mb
    return ((2 * ma * mb + C1) * (2 * both + C2) / ((ma**2 + mb**2 + C1) * (va + vb + C2))).mean()
