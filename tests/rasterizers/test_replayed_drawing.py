"""`rasterization` by replays, on the CPU that stands in for a CUDA device and on a GPU: the bits of live drawings."""

import threading

import pytest
import torch

from clear_strategies.geometry.projection import intrinsics
from rasterizers import rasterization, replayed_drawing
from rasterizers.recording import Recording
from rasterizers.replays import write
from tests.helpers import toy
from tests.helpers.backends import needs
from tests.helpers.strict_cuda import Stream

pytestmark = needs("warp")
ANGLES = (0.0, 0.3, -0.2, 0.5)


@pytest.fixture
def replays(monkeypatch):
    """How often a pass of a drawing was replayed."""
    counted, replay = [], Recording.replay
    monkeypatch.setattr(Recording, "replay", lambda self: counted.append(self) or replay(self))
    monkeypatch.setattr(replayed_drawing, "_thread", replayed_drawing._Thread())
    return counted


def parameters(device, n=40, bands=15):
    s = toy.splats(n, bands=bands)
    raw = {"means": s.means, "quats": s.quats, "scales": s.scales, "opacities": s.opacities}
    raw["colors"] = torch.cat((s.sh0, s.shN), 1)
    return {name: x.to(device).requires_grad_() for name, x in raw.items()}


def render(params, angle=0.0, *, replay=True, width=48, height=32, cameras=1, sh_degree=3, **call):
    seen = [toy.camera(angle + 0.1 * k, width, height) for k in range(cameras)]
    like = params["means"]
    poses = torch.stack([c.world_to_camera for c in seen]).to(like).requires_grad_()
    Ks = torch.stack([intrinsics(c) for c in seen]).to(like)
    settings = {"width": width, "height": height, "sh_degree": sh_degree, "backend": "warp", "replay": replay}
    return *rasterization(**params, viewmats=poses, Ks=Ks, **settings, **call), poses


def loss_of(image):
    return (image * torch.linspace(-1, 1, image.numel(), device=image.device).view(image.shape)).sum()


def step(params, *args, by_alpha=False, rate=0.02, **call):
    """What a step of a loop sees: the pictures, what densification reads, and the gradients."""
    image, alpha, info, poses = render(params, *args, **call)
    info["means2d"].retain_grad()
    (loss_of(image) + (loss_of(alpha) if by_alpha else 0.0)).backward()
    seen = [image.detach().clone(), alpha.detach(), info["radii"], info["means2d"].grad, poses.grad]
    moved = [p for p in params.values() if p.grad is not None]
    seen = [x.clone() for x in (*seen, *(p.grad for p in moved))]
    with torch.no_grad():
        for p in moved:
            p.sub_(rate * p.grad)
            p.grad = None
    return seen


def require_same(found, expected):
    assert len(found) == len(expected)
    for i, (a, b) in enumerate(zip(found, expected, strict=True)):
        assert torch.equal(a, b), f"tensor {i} differs"


def both(device, steps):
    """What the steps see, replayed, after a comparison with live ones."""
    live = steps(parameters(device), replay=False)
    found = steps(parameters(device), replay=True)
    for a, b in zip(found, live, strict=True):
        require_same(a, b)
    return found


@pytest.mark.parametrize("background", [None, "constant", "another in each step"])
def test_a_loop_sees_the_bits_of_live_drawings(recorded_on, replays, background):
    def steps(params, **how):
        seen = []
        for t in range(8):
            color = {"constant": (0.2, 0.4, 0.9), "another in each step": (0.1 * t, 0.5, 0.0)}.get(background)
            behind = None if color is None else torch.tensor([color], device=recorded_on)
            seen.append(step(params, ANGLES[t % 4], backgrounds=behind, **how))
        return seen

    both(recorded_on, steps)
    assert len(replays) == 2 * 6 + 1  # the first is live; the backward pass of that which is recorded is a replay, too


def test_a_loop_on_a_stream_of_its_own(recorded_on, replays, request):
    if recorded_on.type == "cuda":
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
    else:
        stream = Stream(request.getfixturevalue("strict_cuda"))
    with torch.cuda.stream(stream):
        both(recorded_on, lambda params, **how: [step(params, angle, **how) for angle in ANGLES])
    torch.cuda.synchronize()
    assert replays


def test_other_numbers_of_gaussians_bands_sizes_and_pairs(recorded_on, replays):
    def steps(params, **how):
        seen = [step(params, angle, **how) for angle in ANGLES]
        fewer = {name: p.detach()[:30].clone().requires_grad_() for name, p in params.items()}
        seen += [step(fewer, angle, **how) for angle in ANGLES]
        seen += [step(fewer, angle, sh_degree=1, **how) for angle in ANGLES]
        seen += [step(fewer, angle, width=40, **how) for angle in ANGLES]
        with torch.no_grad():
            fewer["scales"] *= 20  # many times as many pairs
        return seen + [step(fewer, angle, rate=0.0, width=40, **how) for angle in ANGLES]

    both(recorded_on, steps)
    assert len(replays) > 20


@pytest.mark.parametrize(
    "call",
    [
        {"render_mode": "RGB+ED"}, {"render_mode": "D"}, {"by_alpha": True}, {"cameras": 2}, {"packed": True},
        {"rasterize_mode": "antialiased"}, {"sh_degree": 0, "render_mode": "RGB+D"}, {"far_plane": 4.2},
    ],
    ids=str,
)  # fmt: skip
def test_every_call_sees_the_bits_of_live_drawings(recorded_on, replays, call):
    both(recorded_on, lambda params, **how: [step(params, angle, **call, **how) for angle in ANGLES])
    assert replays


def test_drawings_before_their_backward_passes_and_backward_passes_after_the_next_drawing(recorded_on, replays):
    def steps(params, **how):
        for angle in ANGLES[:3]:
            step(params, angle, rate=0.0, **how)
        first, second = (render(params, angle, **how) for angle in ANGLES[:2])
        kept = [first[0].detach().clone(), second[0].detach().clone()]
        loss_of(first[0]).backward(retain_graph=True)
        third = render(params, 0.1, **how)
        seen = [[p.grad.clone() for p in params.values()]]
        for drawn in (third, second, first):
            loss_of(drawn[0]).backward()
            seen.append([*(p.grad.clone() for p in params.values()), drawn[2]["radii"]])
        return [*seen, [first[0].detach(), second[0].detach()], kept]

    *_, last, kept = both(recorded_on, steps)
    require_same(last, kept)
    assert replays


def test_what_has_no_backward_pass_or_absolute_gradients_is_live(recorded_on, replays):
    params = parameters(recorded_on)
    for _ in range(4):
        with torch.no_grad():
            render(params)
        image, _, info, _ = render(params, absgrad=True)
        loss_of(image).backward()
        assert info["means2d"].absgrad.any()
    assert not replays


def test_a_number_that_is_not_finite_is_refused_as_by_live_drawings_and_replays_go_on(recorded_on, replays):
    params = parameters(recorded_on)
    for _ in range(3):
        expected = step(params, rate=0.0)
    broken = {name: p.detach().clone().requires_grad_() for name, p in params.items()}
    with torch.no_grad():
        broken["means"][3] = float("nan")
    with pytest.raises(ValueError, match="must be finite"):
        render(broken)
    count = len(replays)
    for _ in range(3):
        require_same(step(params, rate=0.0), expected)
    assert len(replays) > count


def test_where_a_recording_fails_drawings_are_live_from_then_on_and_one_line_says_why(
    recorded_on, replays, monkeypatch, caplog
):
    def fails(*_):
        raise RuntimeError("no capture here\nand a second line")

    monkeypatch.setattr(replayed_drawing, "Recording", fails)
    both(recorded_on, lambda params, **how: [step(params, angle, **how) for angle in ANGLES])
    assert caplog.text.count("the replay of drawings ends at") == 1
    assert "no capture here" in caplog.text
    assert not replays


@pytest.mark.parametrize("which", [0, 1], ids=["forward", "backward"])
def test_a_recording_with_other_bits_than_a_live_drawing_is_not_used(recorded_on, replays, monkeypatch, caplog, which):
    made = []

    class Wrong(Recording):
        def __init__(self, *args):
            super().__init__(*args)
            made.append(self)
            if len(made) == which + 1:
                (self.result if which else self.result[1])[0].view(-1)[0] += 1

    monkeypatch.setattr(replayed_drawing, "Recording", Wrong)
    both(recorded_on, lambda params, **how: [step(params, angle, **how) for angle in ANGLES])
    assert caplog.text.count("a replay has other bits than a live drawing of the same splats") == 1
    assert len(made) == 2
    assert not replays


def test_each_thread_has_drawings_of_its_own(recorded_on, replays):
    if recorded_on.type == "cpu":
        pytest.skip("the stand-in stands in for this thread only")
    params, found = parameters(recorded_on), []
    expected = [step(params, angle, rate=0.0) for angle in ANGLES][-1]
    others = [
        threading.Thread(target=lambda: found.append([step(parameters(recorded_on), a, rate=0.0) for a in ANGLES][-1]))
        for _ in range(2)
    ]
    for thread in others:
        thread.start()
    for thread in others:
        thread.join()
    for one in found:
        require_same(one, expected)


def test_what_work_is_given_is_written_by_one_kernel_for_each_type():
    zeros = [torch.zeros(n, dtype=kind) for kind in (torch.float32, torch.uint8) for n in (2, 3, 4)]
    own, given = [*zeros, None, torch.zeros(2, 3)], [*map(torch.ones_like, zeros), None, torch.ones(3, 2).T]
    with toy.Operations() as done:
        write(own, given)
    assert done.count == {"_foreach_copy_": 2, "copy_": 1}
    assert all(bool(x.all()) for x in own if x is not None)
