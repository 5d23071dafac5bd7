"""The film as edges see it: what a change of the radiance at a place of it is worth to the loss, and where points lie on it."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchpt.math.vectors import take
from torchpt.physics.cameras import Camera
from torchpt.physics.film import Filter

__all__ = ["Worth", "film_places", "slopes"]


class Worth:
    """A cotangent of the picture seen through the reconstruction filter: a pixel is the integral of ``h(s - centre) L(s)``.

    Args:
        cotangent: ``(C, H, W)`` of the picture or of a layer.
        filter: of the film.
        crop: ``(x, y, width, height)`` of the picture on the film.
    """

    def __init__(self, cotangent: Tensor, filter: Filter, crop: tuple[int, int, int, int]) -> None:
        self._values = cotangent.double().reshape(cotangent.shape[0], -1)
        self._filter, self._crop = filter, crop
        x = torch.linspace(-filter.radius, filter.radius, (1 << 14) + 1, dtype=torch.float64)
        middle = 0.5 * (x[1:] + x[:-1])
        self._whole = float(torch.from_numpy(filter.profile(middle.numpy())).mean()) * 2.0 * filter.radius

    def bounds(self) -> tuple[float, float, float, float]:
        """Return least and greatest x, then y, of what the picture sees of the film."""
        x, y, width, height = self._crop
        beyond = max(self._filter.radius - 0.5, 0.0)
        return x - beyond, x + width + beyond, y - beyond, y + height + beyond

    def at(self, s: Tensor) -> Tensor:
        """Return ``(C, N)`` at places ``s (2, N)`` of the film, in pixels."""
        (x0, wx), (y0, wy) = (self._taps(s[k], self._crop[k], self._crop[k + 2]) for k in range(2))
        width, height = self._crop[2:]
        total = torch.zeros(len(self._values), s.shape[1], dtype=torch.float64, device=s.device)
        for j, across in enumerate(wy):
            row = (y0 + j).clamp(0, height - 1) * width
            for i, along in enumerate(wx):
                weight = along * across
                if bool((weight != 0).any()):  # the last tap of a box is 0 but for ties
                    total += take(self._values, row + (x0 + i).clamp(0, width - 1)) * weight
        return total

    def _taps(self, s: Tensor, low: int, size: int) -> tuple[Tensor, list[Tensor]]:
        """Return the first pixel ``(N,)`` that sees a coordinate, and the filter there and at those behind; 0 off the film."""
        radius = self._filter.radius
        first = torch.ceil(s - 0.5 - radius).long() - low
        weights = []
        for k in range(math.floor(2.0 * radius) + 1):
            pixel = first + k
            away = (s - (pixel + low) - 0.5).cpu().numpy()
            weight = torch.from_numpy(self._filter.profile(away)).to(s.device) / self._whole
            # A box ends at once: a place on the border of two pixels is half in each.
            weight = torch.where((s - (pixel + low) - 0.5).abs() == radius, 0.5 * weight, weight)
            weights.append(torch.where((pixel >= 0) & (pixel < size), weight, 0.0))
        return first, weights


def film_places(camera: Camera, p: Tensor, lens: Tensor | None) -> Tensor:
    """Return places ``(2, N)`` of points ``(3, N)`` on the film; any for those behind the camera.

    ``lens``: ``(2, N)`` samples of the lens, as for :meth:`torchpt.physics.cameras.Camera.film_of`.
    """
    seen = camera.film_of(p, lens)
    assert seen is not None
    return seen[:2] / torch.where(seen[2] > 0, seen[2], 1.0)


def slopes(camera: Camera, p: Tensor, lens: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return places ``(2, N)`` of points on the film and how they change with them ``(2, 3, N)``, detached."""
    # Homogeneous places are affine in the points.
    corners = torch.cat((torch.zeros_like(p[:, :1]), torch.eye(3, dtype=p.dtype, device=p.device)), 1)
    many, seen = 1 if lens is None else p.shape[1], camera.film_of(p, lens)
    at = camera.film_of(corners.repeat_interleave(many, 1), None if lens is None else lens.repeat(1, 4))
    assert at is not None and seen is not None
    ends = at[:3].detach().view(3, 4, many)
    slope = ends[:, 1:] - ends[:, :1]
    h = torch.where(seen[2] > 0, seen[2], 1.0).detach()
    s = seen[:2].detach() / h
    turned = torch.where(seen[2] > 0, s, 0.0)
    return s, torch.stack([(slope[k] - slope[2] * turned[k]) / h for k in range(2)])
