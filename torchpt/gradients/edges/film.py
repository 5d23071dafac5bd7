"""The film as edges see it: what a change of the radiance at a place of it is worth to the loss, and where points lie on it."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cached_property

import torch
from torch import Tensor

from torchpt.math.vectors import cross, dot, take
from torchpt.physics.cameras import Camera
from torchpt.physics.cameras.kinds.perspective import Perspective
from torchpt.physics.film import Filter

__all__ = ["FilmMap", "Worth", "flat_places"]


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
        total = torch.zeros(len(self._values), s.shape[1], dtype=torch.float64, device=s.device)
        taps = self._taps(s)
        for pixel_y, across in ((pixel[1], weight[1]) for pixel, weight, some in taps if some[1]):
            for pixel_x, along in ((pixel[0], weight[0]) for pixel, weight, some in taps if some[0]):
                total += take(self._values, pixel_y * self._crop[2] + pixel_x) * (along * across)
        return total

    def _taps(self, s: Tensor) -> list[tuple[Tensor, Tensor, list[bool]]]:
        """Return taps of the filter: pixels along both axes ``(2, N)``, weights, 0 off the film, and which axes have others."""
        radius, found = self._filter.radius, []
        low, size = torch.tensor(self._crop, device=s.device)[:, None].split(2)
        begin = s - 0.5 - radius
        first = begin.ceil()
        last = math.floor(2.0 * radius)
        if last == 2.0 * radius and not bool((first == begin).any()):  # the filter ends within the last but one
            last -= 1
        first = first.long() - low
        for k in range(last + 1):
            pixel = first + k
            away = s - (pixel + low) - 0.5
            weight = torch.from_numpy(self._filter.profile(away.cpu().numpy())).to(s.device) / self._whole
            # A box ends at once: a place on the border of two pixels is half in each.
            weight = torch.where(away.abs() == radius, 0.5 * weight, weight)
            inside = torch.minimum(pixel.clamp_min(0), size - 1)
            weight = torch.where(inside == pixel, weight, 0.0)
            found.append((inside, weight, (weight != 0).any(1).tolist()))
        return found


class FilmMap:
    """Where points lie on the film of a camera, whose parameters stay: what they determine is computed once.

    Args:
        camera: of the film; one that :meth:`torchpt.physics.cameras.Camera.film_of` is known of.
    """

    def __init__(self, camera: Camera) -> None:
        self._camera = camera

    @cached_property
    def _affine(self) -> tuple[Tensor, Tensor]:
        """Return the matrix ``(4, 3)`` and the vector ``(4, 1)`` by which points become homogeneous places and depths.

        They are those of a camera without a lens, or of the middle of a lens.
        """
        pose = self._camera.to_world.clone()
        pose[:3, 3] = 0.0  # differences of places far from the origin would round
        corners = torch.cat((torch.zeros_like(pose[:3, :1]), torch.eye(3, dtype=pose.dtype, device=pose.device)), 1)
        at = replace(self._camera, to_world=pose).film_of(corners)
        assert at is not None
        slope = at[:, 1:] - at[:, :1]
        return slope, at[:, :1] - slope @ self._camera.origin()

    @cached_property
    def _ways(self) -> Tensor:
        """Return the matrix ``(3, 3)`` that makes directions of homogeneous places, of a pinhole."""
        return torch.linalg.inv(self._affine[0][:3])

    @cached_property
    def _faces(self) -> Tensor:
        """Return the matrix ``(3, 3)`` of cofactors of the one by which homogeneous places change."""
        x, y, h = self._affine[0][:3, :, None]
        return torch.cat((cross(y, h), cross(h, x), cross(x, y)), 1).T

    def of(self, p: Tensor, lens: Tensor | None) -> Tensor:
        """Return homogeneous places and depths ``(4, N)`` of points ``(3, N)``.

        ``lens``: ``(2, N)`` samples of the lens; both as for :meth:`torchpt.physics.cameras.Camera.film_of`.
        """
        if lens is not None:
            seen = self._camera.film_of(p, lens)
            assert seen is not None
            return seen
        slope, middle = self._affine
        return torch.addmm(middle, slope, p)

    def places(self, p: Tensor, lens: Tensor | None) -> Tensor:
        """Return places ``(2, N)`` of points ``(3, N)``; any for those behind the camera. ``lens``: as for :meth:`of`."""
        return flat_places(self.of(p, lens))

    def slopes(self, p: Tensor, lens: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return places ``(2, N)`` of points on the film and how they change with them ``(2, 3, N)``."""
        seen = self.of(p, lens)
        if lens is None:
            slope = self._affine[0][:3, :, None]
        else:  # homogeneous places are affine in the points
            corners = torch.cat((torch.zeros_like(p[:, :1]), torch.eye(3, dtype=p.dtype, device=p.device)), 1)
            many = p.shape[1]
            ends = self.of(corners.repeat_interleave(many, 1), lens.repeat(1, 4))[:3].view(3, 4, many)
            slope = ends[:, 1:] - ends[:, :1]
        front = seen[2] > 0
        h = torch.where(front, seen[2], 1.0)
        s = seen[:2] / h
        turned = torch.where(front, s, 0.0)
        return s, torch.stack([(slope[k] - slope[2] * turned[k]) / h for k in range(2)])

    def area(self, p: Tensor, n: Tensor, lens: Tensor | None) -> Tensor:
        """Return the areas ``(N,)`` of the film for one of surfaces at points before the camera; ``n (3, N)``: unit normals."""
        if lens is None:  # the cross product of both slopes, multiplied out
            x, y, h, _ = self.of(p, None)
            across = self._faces @ n
            return ((across[0] * x + across[1] * y) / h + across[2]).abs() / (h * h)
        _, jacobian = self.slopes(p, lens)
        return dot(cross(jacobian[0], jacobian[1]), n).abs()

    def rays(self, s: Tensor, lens: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return rays through places ``s (2, N)``, as :meth:`torchpt.physics.cameras.Camera.rays`."""
        if lens is not None or not isinstance(self._camera, Perspective):
            return self._camera.rays(s[0], s[1], lens)
        d = self._ways @ torch.cat((s, torch.ones_like(s[:1])))
        return self._camera.origin(), d / dot(d, d).sqrt()


def flat_places(seen: Tensor) -> Tensor:
    """Return places ``(2, N)`` of homogeneous ones ``(4, N)``; any for those behind the camera."""
    return seen[:2] / torch.where(seen[2] > 0, seen[2], 1.0)
