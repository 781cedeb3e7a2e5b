"""PLY: bytes by hand, roundtrips as a property, and a table of malformed files that each get one line."""

import struct
from codecs import BOM_UTF8
from pathlib import Path

import pytest
import torch

from clear_strategies.data.ply import GaussianPly, read_gaussians, read_points, write_gaussians, write_points
from clear_strategies.errors import DataError


def gaussians(n: int, bands: int, seed: int = 0) -> GaussianPly:
    g, shapes = torch.Generator().manual_seed(seed), ((n, 3), (n, 1, 3), (n, bands, 3), (n,), (n, 3), (n, 4))
    return GaussianPly(*(torch.randn(shape, generator=g) for shape in shapes))


def header(*lines: str, form: str = "binary_little_endian") -> bytes:
    return "\n".join(["ply", f"format {form} 1.0", *lines, "end_header\n"]).encode("latin-1")


XYZ = ("property float x", "property float y", "property float z")


def test_gaussians_and_points_are_written_byte_for_byte_as_3dgs_reads_them(tmp_path: Path) -> None:
    shN = torch.arange(9.0).view(1, 3, 3) + 10  # band b, channel c: 10 + 3b + c
    one = GaussianPly(
        means=torch.tensor([[1.0, 2, 3]]), sh0=torch.tensor([[[4.0, 5, 6]]]), shN=shN, opacities=torch.tensor([7.0]),
        scales=torch.tensor([[-1.0, -2, -3]]), quats=torch.tensor([[0.5, 0.25, 0.125, 0]]),
    )  # fmt: skip
    write_gaussians(tmp_path / "g.ply", one)
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(9)]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    text = "ply\nformat binary_little_endian 1.0\ncomment SplatRenderMode: mip\nelement vertex 1\n"
    text += "".join(f"property float {name}\n" for name in names) + "end_header\n"
    channel_major = (10, 13, 16, 11, 14, 17, 12, 15, 18)
    values = (1, 2, 3, 0, 0, 0, 4, 5, 6, *channel_major, 7, -1, -2, -3, 0.5, 0.25, 0.125, 0)
    assert (tmp_path / "g.ply").read_bytes() == text.encode() + struct.pack("<26f", *values)
    write_points(tmp_path / "p.ply", torch.tensor([[1.0, 2, 3]]), torch.tensor([[0.0, 0.5, 1]]))
    text = "ply\nformat binary_little_endian 1.0\nelement vertex 1\n"
    text += "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    text += "".join(f"property uchar {name}\n" for name in ("red", "green", "blue")) + "end_header\n"
    assert (tmp_path / "p.ply").read_bytes() == text.encode() + struct.pack("<6f3B", 1, 2, 3, 0, 0, 0, 0, 128, 255)


@pytest.mark.parametrize(
    ("means", "colors", "message"),
    [
        (torch.full((1, 3), torch.nan), torch.zeros(1, 3), "finite"),
        (torch.zeros(1, 3), torch.full((1, 3), 255.0), "divide 8-bit values by 255"),
    ],
)
def test_points_that_no_file_should_hold_are_refused(tmp_path, means, colors, message):
    with pytest.raises(ValueError, match=message):
        write_points(tmp_path / "p.ply", means, colors)
    assert not (tmp_path / "p.ply").exists()


@pytest.mark.parametrize("bands", [0, 3, 8, 15])
@pytest.mark.parametrize("n", [0, 5])
def test_gaussians_survive_a_roundtrip_bitwise(tmp_path: Path, n: int, bands: int) -> None:
    g = gaussians(n, bands)
    g.means[:2] = torch.tensor([[-0.0, 1e-45, torch.finfo(torch.float32).max]])
    write_gaussians(tmp_path / "g.ply", g)
    again = read_gaussians(tmp_path / "g.ply")
    for name in ("means", "sh0", "shN", "opacities", "scales", "quats"):
        assert torch.equal(getattr(again, name).view(torch.int32), getattr(g, name).view(torch.int32))


RGB = tuple(f"property uchar {name}" for name in ("red", "green", "blue"))
POINT = ("element vertex 1", *XYZ, *RGB)
DOUBLES = ("element vertex 1", *(line.replace("float", "double") for line in XYZ), "property float nx",
           *(line.replace("uchar", "ushort") for line in RGB))  # fmt: skip
FOLLOWED = (*POINT, "element face 1", "property list uchar int vertex_indices")


@pytest.mark.parametrize(
    ("form", "lines", "body"),
    [
        ("binary_little_endian", POINT, struct.pack("<3f3B", 1, 2, 3, 255, 0, 51)),
        ("binary_big_endian", POINT, struct.pack(">3f3B", 1, 2, 3, 255, 0, 51)),
        ("ascii", POINT, b"1 2 3 255 0 51\n"),
        ("binary_little_endian", DOUBLES, struct.pack("<3df3H", 1, 2, 3, 9, 65535, 0, 13107)),
        ("binary_little_endian", FOLLOWED, struct.pack("<3f3BB3i", 1, 2, 3, 255, 0, 51, 3, 0, 0, 0)),
        ("ascii", FOLLOWED, b"1 2 3 255 0 51\n3 0 0 0\n"),
    ],
    ids=["little endian", "big endian", "ascii", "doubles and 16 bits", "other elements", "other elements in ascii"],
)
def test_a_point_is_read_from_every_layout(tmp_path, form, lines, body):
    for mark in (b"", BOM_UTF8):
        (tmp_path / "p.ply").write_bytes(mark + header(*lines, form=form).replace(b"\n", b"\r\n") + body)
        cloud = read_points(tmp_path / "p.ply")
        assert cloud.means.tolist() == [[1, 2, 3]]
        torch.testing.assert_close(cloud.colors, torch.tensor([[1, 0, 0.2]]))
    (tmp_path / "p.ply").write_bytes(header(*lines, form=form).replace(b"vertex 1", b"vertex 0"))
    if lines is POINT:
        assert len(read_points(tmp_path / "p.ply")) == 0


def test_colours_of_a_gaussian_file_and_of_none_and_properties_outside_the_layout(tmp_path, caplog):
    g = gaussians(1, 3)
    g.sh0[:] = torch.tensor([0.0, 1.0, -9.0])
    write_gaussians(f"{tmp_path}/g.ply", g)
    # 0.5 + f_dc · 1 / (2 √π), then into [0, 1]
    assert torch.allclose(read_points(f"{tmp_path}/g.ply").colors, torch.tensor([[0.5, 0.7820948, 0.0]]))
    (tmp_path / "p.ply").write_bytes(header("element vertex 1", *XYZ) + struct.pack("<3f", 1, 2, 3))
    assert read_points(tmp_path / "p.ply").colors.tolist() == [[0.5, 0.5, 0.5]]
    assert "no colours, so its points are grey" in caplog.text
    write_gaussians(tmp_path / "g.ply", gaussians(1, 0))
    content = (tmp_path / "g.ply").read_bytes()
    extra = content.replace(b"end_header", b"property float filter_3D\nend_header") + struct.pack("<f", 1)
    (tmp_path / "g.ply").write_bytes(extra)
    read_gaussians(f"{tmp_path}/g.ply")
    assert "filter_3D" in caplog.text


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    file = tmp_path / "g.ply"
    write_gaussians(str(file), gaussians(2, 3))
    before = file.read_bytes()
    bad = gaussians(2, 3)
    bad.scales[1, 2] = torch.nan
    with pytest.raises(ValueError, match="scale_2 = nan in number 1"):
        write_gaussians(file, bad)
    assert file.read_bytes() == before
    assert list(tmp_path.iterdir()) == [file]


def test_opacities_of_exactly_0_and_1_and_scales_of_0_are_read(tmp_path: Path) -> None:
    """As a PLY has them that was converted from a format of 8 bits; any other infinity is damage."""
    path, g = tmp_path / "a.ply", gaussians(3, 0)
    write_gaussians(path, g)
    content = path.read_bytes()
    at = content.index(struct.pack("<f", float(g.scales[1, 2])))
    path.write_bytes(content[:at] + struct.pack("<f", float("-inf")) + content[at + 4 :])
    assert 0 < float(read_gaussians(path).scales[1, 2].exp()) < 1e-12
    at = content.index(struct.pack("<f", float(g.opacities[1])))
    for value in (float("inf"), float("-inf")):
        path.write_bytes(content[:at] + struct.pack("<f", value) + content[at + 4 :])
        assert read_gaussians(path).opacities.sigmoid()[1] == pytest.approx(float(value > 0), abs=1e-6)
    path.write_bytes(content[:at] + struct.pack("<f", float("nan")) + content[at + 4 :])
    with pytest.raises(DataError, match="opacity: is not finite in vertex 1"):
        read_gaussians(path)
