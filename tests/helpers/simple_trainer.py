"""A stand-in for gsplat's examples/simple_trainer.py, in its shape: a Runner whose renderings go by `image_id`, a checkpoint
and a PLY at the end. On a CPU; contains nothing of CLEAR.
"""

import argparse
from dataclasses import dataclass, field
from typing import Any

import torch
from gsplat import export_splats
from gsplat.distributed import cli
from gsplat.rendering import rasterization
from gsplat.strategy import DefaultStrategy

from integration.examples.demo import splats_with_optimizers
from tests.helpers import toy
from tests.helpers.host_parts import as_item, photometric


@dataclass
class Config:
    result_dir: str
    max_steps: int = 8
    pose_noise: float = 0.0
    app_opt: bool = False
    init_type: str = "sfm"
    strategy: Any = field(
        default_factory=lambda: DefaultStrategy(
            refine_start_iter=2, refine_stop_iter=7, refine_every=3, grow_grad2d=2e-4
        )
    )


class Parser:
    def __init__(self, scene):
        self.scene = scene
        self.image_names = ["test.png", *(f"{view.name}.png" for view in scene.train)]
        self.points, self.points_rgb = scene.cloud.means.numpy(), (scene.cloud.colors * 255).numpy()


class Dataset:
    def __init__(self, parser, split="train"):
        first = {"train": 1, "val": 0}[split]
        self.parser, self.indices = parser, list(range(first, len(parser.image_names) if first else 1))

    def __len__(self):
        return len(self.indices)

    def __getitem__(self, item):
        return as_item(self.parser.scene.train[item].lr, item)


def create_splats_with_optimizers(parser, init_type="sfm", device="cpu"):
    points, colors = torch.from_numpy(parser.points).float(), torch.from_numpy(parser.points_rgb / 255).float()
    if init_type == "random":
        points, colors = torch.rand(50, 3), torch.rand(50, 3)
    splats, optimizers = splats_with_optimizers(points, colors)
    return torch.nn.ParameterDict(splats).to(device), optimizers


class Runner:
    def __init__(self, local_rank, world_rank, world_size, cfg):
        torch.manual_seed(42)
        self.cfg, self.world_size, self.device = cfg, world_size, "cpu"
        self.parser = Parser(toy.scene(24))
        self.trainset = Dataset(self.parser)
        self.splats, self.optimizers = create_splats_with_optimizers(
            self.parser, init_type=cfg.init_type, device=self.device
        )
        cfg.strategy.check_sanity(self.splats, self.optimizers)
        self.strategy_state = cfg.strategy.initialize_state(scene_scale=4.0)
        self.render = self.rasterize_splats  # 1.6 hands the bound method to its Stage

    def rasterize_splats(self, camtoworlds, Ks, width, height, masks=None, **kwargs):
        kwargs.pop("image_ids", None)
        p = self.splats
        return rasterization(
            means=p["means"], quats=p["quats"], scales=torch.exp(p["scales"]), opacities=torch.sigmoid(p["opacities"]),
            colors=torch.cat([p["sh0"], p["shN"]], 1), viewmats=torch.linalg.inv(camtoworlds), Ks=Ks, width=width,
            height=height, packed=False, **kwargs,
        )  # fmt: skip

    def train(self):
        cfg = self.cfg
        for step in range(cfg.max_steps):
            data = self.trainset[step % len(self.trainset)]
            pose, pixels = data["camtoworld"][None], data["image"][None] / 255
            if cfg.pose_noise:
                pose[:, :3, 3] += cfg.pose_noise * torch.randn(1, 3)
            renders, _, info = self.render(
                camtoworlds=pose, Ks=data["K"][None], width=24, height=16, sh_degree=3,
                image_ids=torch.tensor([data["image_id"]]),
            )  # fmt: skip
            cfg.strategy.step_pre_backward(self.splats, self.optimizers, self.strategy_state, step, info)
            photometric(renders[0], pixels[0]).backward()
            for optimizer in self.optimizers.values():
                optimizer.step()
                optimizer.zero_grad(set_to_none=True)
            cfg.strategy.step_post_backward(self.splats, self.optimizers, self.strategy_state, step, info, packed=False)
        torch.save({"step": cfg.max_steps, "splats": self.splats.state_dict()}, f"{cfg.result_dir}/ckpt.pt")
        names = ("means", "scales", "quats", "opacities", "sh0", "shN")
        export_splats(**{n: self.splats[n] for n in names}, format="ply", save_to=f"{cfg.result_dir}/cloud.ply")
        torch.save(self.eval(), f"{cfg.result_dir}/image.pt")

    @torch.no_grad()
    def eval(self):
        data = self.trainset[0]
        return self.render(camtoworlds=data["camtoworld"][None], Ks=data["K"][None], width=24, height=16, sh_degree=3)[
            0
        ]


def main(local_rank, world_rank, world_size, cfg):
    Runner(local_rank, world_rank, world_size, cfg).train()


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--result_dir")
    parser.add_argument("--app_opt", action="store_true")
    for name, value in {"max_steps": 8, "pose_noise": 0.0, "init_type": "sfm", "refine_stop_iter": 7}.items():
        parser.add_argument(f"--{name}", type=type(value), default=value)
    options = vars(parser.parse_args())
    stop = options.pop("refine_stop_iter")
    cfg = Config(**options)
    cfg.strategy.refine_stop_iter = stop
    cli(main, cfg, verbose=True)
