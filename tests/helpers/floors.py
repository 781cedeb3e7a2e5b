"""Which folder of clear_strategies/ may import which, and which heavy libraries it may use."""

from __future__ import annotations

# The floors of clear_strategies/, from the bottom: a folder, the folders that it may import, and the heavy libraries that
# it may use. docs/explanation/architecture.md shows the same table.
GROUND = {"errors", "files", "schedules"}
FLOORS: dict[str, tuple[set[str], set[str]]] = {
    "errors": (set(), set()),
    "files": ({"errors"}, set()),
    "schedules": ({"errors"}, set()),
    "console": (set(), set()),
    "core": (GROUND, {"PIL"}),
    "kernels": (GROUND | {"core"}, {"warp"}),
    "geometry": (GROUND | {"core"}, {"cv2", "kornia", "open3d"}),
    "strategies": (GROUND | {"core", "geometry"}, set()),
    "merging": (GROUND | {"core", "kernels", "strategies"}, set()),
    "data": (GROUND | {"core", "geometry"}, {"cv2", "PIL"}),
    "training": (GROUND | {"core", "kernels", "geometry", "strategies", "merging", "data"}, set()),
    "density": (GROUND | {"core", "geometry", "strategies", "merging", "data", "training"}, set()),
    "viewing": (GROUND | {"core", "data", "training"}, set()),
    "outputs": (
        GROUND | {"core", "geometry", "strategies", "merging", "data", "training", "density", "viewing"},
        set(),
    ),
    "settings": ({"errors"}, set()),
    "compose": (GROUND | {"settings", "strategies", "merging"}, {"hydra", "omegaconf"}),
    "jobs": (
        GROUND
        | {"settings", "compose", "core", "strategies", "merging", "data", "training", "density", "viewing", "outputs"},
        {"hydra", "omegaconf"},
    ),
}
# The doors may import every floor.
DOORS = {
    "run": set(),
    "hydra_app": {"hydra", "omegaconf"},
    "__main__": set(),
    "commands": set(),
    "notebook": {"PIL"},
    "report": set(),
    "bench": set(),
}
