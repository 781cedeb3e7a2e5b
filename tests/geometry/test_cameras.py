"""What cameras look at: their common box, which of them are compared, and which see a surface."""

import math
from dataclasses import replace

import torch

from clear_strategies.core.view import Photo
from clear_strategies.geometry.cameras import common_box, partners
from clear_strategies.geometry.projection import project, sample_colors
from rasterizers.interface import Camera
from tests.helpers import planes
from tests.helpers.planes import camera, photo


def test_cameras_around_an_object_have_the_ball_that_they_all_see_in_common() -> None:
    photos = []
    for k in range(8):
        c, s = math.cos(k * math.pi / 4), math.sin(k * math.pi / 4)
        pose = torch.tensor([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 4], [0, 0, 0, 1.0]])
        photos.append(Photo(Camera(pose, 100.0, 100.0, 50.0, 40.0, 100, 80), torch.zeros(80, 100, 3)))
    low, high = common_box(photos)
    half = 4 * math.sin(math.atan(0.4))  # the narrow side: 40 px of 100
    assert torch.allclose(low, torch.full((3,), -half), atol=0.01)
    assert torch.allclose(high, torch.full((3,), half), atol=0.01)


def test_parallel_cameras_have_a_box_ahead_in_common() -> None:
    low, high = common_box([photo(-1.0), photo(1.0)])
    middle = (low + high) / 2
    assert torch.allclose(middle, torch.tensor([0.0, 0, 10]), atol=0.1)
    pixels, depth = project(photo(0.0).camera, middle[None])
    assert depth > 0
    assert torch.allclose(pixels, torch.full((1, 2), 20.0).double(), atol=0.1)
    low, high = common_box([photo()])  # one camera alone
    assert bool(low.isfinite().all() and high.isfinite().all() and (high > low).all())


def test_few_cameras_are_all_compared_and_of_many_the_nearest_and_some_far_ones_of_other_places() -> None:
    assert partners([camera(0.0)]) == [[]]
    assert partners([camera(float(i)) for i in range(13)])[4] == [i for i in range(13) if i != 4]
    assert partners([camera(float(i)) for i in range(200)])[0] == [1, 2, 3, 4, 5, 6, 7, 8, 9, 25, 71, 199]
    bursts = [camera(float(i // 15)) for i in range(60)]
    assert all(len({b // 15 for b in others}) > 1 for others in partners(bursts))


# ---- colours between pixel centres
def test_colours_lie_between_pixel_centres_and_hidden_ones_count_in_no_mean():
    pair = Photo(replace(small_camera(0.0), width=2, height=1), torch.tensor([[[0.0, 0, 0], [1.0, 1, 1]]]))
    at = torch.tensor([[0.5, 0.5], [1.0, 0.5], [1.25, 0.5], [1.5, 0.5], [0.1, 0.2]])
    assert torch.allclose(sample_colors(pair, at)[:, 0], torch.tensor([0, 0.5, 0.75, 1, 0]))
    for colors in (pair.image, pair.image + 0.5):  # whatever colour a mask hides
        hidden = replace(pair, image=colors, shown=torch.tensor([[False, True]]))
        assert torch.allclose(sample_colors(hidden, at[1:4]), colors[0, 1])


def small_camera(x: float) -> Camera:
    """A pixel is 0.1 wide at a depth of 1."""
    return planes.camera(x, 10, 10, 10.0)
