"""The two base classes."""

import torch


class DensityControllerImpl(torch.nn.Module):
    def __init__(self, config):
        super().__init__()
        self.config = config

    def setup(self, stage, pl_module):
        pass

    def before_backward(self, outputs, batch, gaussian_model, optimizers, global_step, pl_module):
        pass

    def after_backward(self, outputs, batch, gaussian_model, optimizers, global_step, pl_module):
        pass


class DensityController:
    def instantiate(self, *args, **kwargs):
        return DensityControllerImpl(self)
