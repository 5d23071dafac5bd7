"""What the examples share: their arguments, a rigid pose by six numbers, and pictures side by side."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import interpolate

import torchpt

__all__ = ["arguments", "grid", "pose", "turned_by"]


def arguments(
    about: str | None,
    steps: int,
    size: int,
    argv: Sequence[str] | None,
    more: Callable[[argparse.ArgumentParser], object] = lambda parser: None,
) -> argparse.Namespace:
    """``--out --steps --seed --size`` of an example, whose docstring is its help; the folder ``out`` is made.

    ``more`` adds arguments of the example's own.
    """
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("examples_out"), help="folder of what is written")
    parser.add_argument("--steps", type=int, default=steps, help="of the optimizer")
    parser.add_argument("--seed", type=int, default=0, help="of the pictures, and of whatever else is drawn")
    parser.add_argument("--size", type=int, default=size, help="of the square pictures, in pixels")
    more(parser)
    given = parser.parse_args(argv)
    given.out.mkdir(parents=True, exist_ok=True)
    return given


def pose(turn: Tensor, shift: Tensor) -> Tensor:
    """Return a rigid motion ``(4, 4)``: a rotation by ``|turn|`` radians about ``turn (3,)``, then a translation ``(3,)``.

    The exponential of a skew matrix is a rotation whatever its three numbers are (Rodrigues), so Adam may move them
    freely; sixteen free entries of a matrix would soon shear and stretch what they place.
    """
    x, y, z = turn
    o = torch.zeros_like(x)
    skew = torch.stack((torch.stack((o, -z, y)), torch.stack((z, o, -x)), torch.stack((-y, x, o))))
    last = torch.tensor([[0.0, 0.0, 0.0, 1.0]])
    return torch.cat((torch.cat((torch.linalg.matrix_exp(skew), shift[:, None]), 1), last))


def turned_by(a: Tensor, b: Tensor) -> float:
    """Return the angle between the rotations of two poses ``(4, 4)``, in degrees."""
    cosine = (torch.trace(a[:3, :3].detach().T @ b[:3, :3].detach()) - 1) / 2
    return float(torch.rad2deg(torch.arccos(cosine.double().clamp(-1, 1))))


def grid(path: Path, *rows: Sequence[Tensor], width: int = 192, exposure: float = 0.0) -> None:
    """Write rows of linear pictures ``(H, W, 3)`` as one file, each picture ``width`` pixels wide, with white between."""
    gap = 4
    shown = torch.ones(0, max(map(len, rows)) * (width + gap) - gap, 3)
    for row in rows:
        height = round(width * row[0].shape[0] / row[0].shape[1])
        line = torch.full((height + gap, shown.shape[1], 3), 2.0**-exposure)
        for k, picture in enumerate(row):
            image = interpolate(picture.detach().permute(2, 0, 1)[None], (height, width), mode="nearest-exact")
            line[:height, k * (width + gap) :][:, :width] = image[0].permute(1, 2, 0)
        shown = torch.cat((shown, line))
    torchpt.write_image(path, shown[:-gap], exposure=exposure)
