"""splat.html: its colours are those of the Gaussians, and nothing is loaded from elsewhere."""

from __future__ import annotations

import re

import pytest
import torch

from clear_strategies.viewing import page
from rasterizers.interface import Splats
from tests.helpers import saved_run, toy

CAMERAS = [view.hr.camera for view in saved_run.SCENE.train]


@pytest.fixture(scope="module")
def splats(tmp_path_factory) -> Splats:
    return saved_run.write(tmp_path_factory.mktemp("run")).baked()


def test_the_colour_is_the_mean_of_those_that_are_seen(splats):
    """A Gaussian that fills the picture has its own colour there."""
    seen = page.colors_seen(splats, CAMERAS[:1])
    image = toy.RASTERIZER
    for i in (0, 5):
        alone = Splats(
            splats.means[i : i + 1], splats.quats[i : i + 1], torch.full((1, 3), 9.0), torch.tensor([0.99]),
            splats.sh0[i : i + 1], splats.shN[i : i + 1],
            None if splats.rgb_offset is None else splats.rgb_offset[i : i + 1],
        )  # fmt: skip
        drawn = image(alone, CAMERAS[0]).image
        height, width = drawn.shape[:2]
        assert torch.allclose(drawn[height // 2, width // 2], seen[i], atol=0.03)
    both = page.colors_seen(splats, CAMERAS[:2])
    assert torch.allclose(both, (seen + page.colors_seen(splats, CAMERAS[1:2])) / 2)


def test_the_page_is_whole_and_has_its_title(splats, tmp_path, capfd):
    pytest.importorskip("viser")
    page.write_page(tmp_path / "a.html", splats, CAMERAS, "kitchen · <clear>", (0.0, 0.0, 0.0))
    text = (tmp_path / "a.html").read_text()
    assert "<title>kitchen · &lt;clear&gt;</title>" in text
    assert "__VISER_EMBED_DATA__" in text
    assert not re.search(r"(?:src|href)=[\"']https?://", text)
    assert capfd.readouterr().out == ""
