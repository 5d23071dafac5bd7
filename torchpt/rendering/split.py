"""Share a render's passes among ranks: each samples some pixels of every pixel set, then films are joined.

A :class:`torchpt.rendering.run.Run` with more than one rank calls a :class:`DistributedRender` in place of its engine. A
rank is one of the processes of ``torch.distributed`` that render the same picture.

The pixels of a rank are a pixel set with films of their own. Their sums continue those of the whole film, sample by sample, so
a joined film has the bits of a render by one process.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchpt.compiler.graph import Unsupported
from torchpt.core import tree
from torchpt.core.version import __version__
from torchpt.engines.engine import SampleRange
from torchpt.paths.nonfinite import NonFinite
from torchpt.paths.wave import PixelSet, RayCounts
from torchpt.physics.film import Film
from torchpt.ranks import Group, dealt
from torchpt.rendering.checkpoint import RenderState
from torchpt.scene import Scene
from torchpt.scene.fingerprint import fingerprints
from torchpt.scene.settings import Settings, settings_with
from torchpt.spec import Role

if TYPE_CHECKING:
    from torchpt.rendering.run import Run

__all__ = ["DistributedRender", "render_fingerprint"]


class _PassCounts(NamedTuple):
    """The report of one rank after a pass, as numbers: counts of this pass, and two flags (0 or 1).

    Attributes:
        paths: paths traced.
        rays: rays traced.
        truncated: truncated paths.
        nonfinite: non-finite samples.
        stopped: ``on_progress`` stopped the render.
        failed: a kernel could not be made.
    """

    paths: float
    rays: float
    truncated: float
    nonfinite: float
    stopped: float
    failed: float


class DistributedRender:
    """The share of this rank in a render.

    Args:
        group: the ranks that share the render.
    """

    def __init__(self, group: Group) -> None:
        self.group = group
        self._parts: list[tuple[PixelSet, PixelSet]] = []  # a pixel set of the render, and this rank's pixels of it

    def forget_parts(self) -> None:
        """Forget the films of an attempt that is started again."""
        self._parts.clear()

    def take(self, run: Run, spans: list[SampleRange]) -> bool:
        """Take this rank's samples of a pass, add the counts of all ranks to ``run``, and return True if all were taken.

        Raises:
            Unsupported: a rank cannot make a kernel.
        """
        done, rays, truncated = run.done, run.ray_counts.rays, run.ray_counts.truncated
        nonfinite, clamp_sums = run.nonfinite, run.clamp_sums
        run.nonfinite, run.clamp_sums = NonFinite(), torch.zeros_like(clamp_sums)  # those of this rank and pass
        run.done_before_pass, run.sharing_ranks = done, self.group.size
        reason = ""
        try:
            run.take_alone([(self._part(pixel_set), first, count) for pixel_set, first, count in spans])
        except Unsupported as error:
            reason = str(error) or "unsupported"
        own = _PassCounts(
            paths=run.done - done,
            rays=run.ray_counts.rays - rays,
            truncated=run.ray_counts.truncated - truncated,
            nonfinite=run.nonfinite.count,
            stopped=run.stopped_by_caller,
            failed=bool(reason),
        )
        counts = [_PassCounts(*numbers) for numbers in self.group.all_gather_numbers("a pass", *own)]  # by rank
        if any(rank.failed for rank in counts):
            raise Unsupported(reason or "what another rank met")
        run.done = done + sum(int(rank.paths) for rank in counts)
        run.done_before_pass, run.sharing_ranks = 0, 1
        run.ray_counts = RayCounts(
            rays=rays + sum(int(rank.rays) for rank in counts),
            truncated=truncated + sum(int(rank.truncated) for rank in counts),
        )
        if any(rank.nonfinite for rank in counts):
            nonfinite.add(self._gather_nonfinite(run.nonfinite))
        run.nonfinite = nonfinite
        for part in self.group.gather(run.clamp_sums) if run.integrator.clamp is not None else ():
            clamp_sums = clamp_sums + part
        run.clamp_sums = clamp_sums
        # A rank that asks for a stop at its last tasks does not know whether others have any left.
        stopped = any(rank.stopped for rank in counts)
        run.stopped_by_caller = stopped and run.done < run.requested_paths()
        return not run.stopped_by_caller

    def join(self) -> None:
        """Make films whole on every rank."""
        for whole, part in self._parts:
            for film, own in zip(_films(whole), _films(part), strict=True):
                self._join(film, own)
        self._parts.clear()

    def broadcast_numbers(self, seconds: float, error: float | None) -> tuple[float, float | None]:
        """Return seconds and error of the first rank."""
        seconds, known, error_there = self.group.broadcast_numbers("seconds", seconds, error is not None, error or 0.0)
        return seconds, error_there if known else None

    def is_due(self, due: bool) -> bool:
        """Return True if a checkpoint is due on the first rank; ``due``: it is on this rank."""
        return bool(self.group.broadcast_numbers("a checkpoint", due)[0])

    def from_first_rank(self, own: Tensor) -> Tensor:
        """Return the integers ``(n,)`` of the first rank in place of ``own``: other processors may round differently."""
        return self.group.broadcast(own)

    def broadcast_state(self, own: RenderState | None, like: RenderState) -> RenderState | None:
        """Return the state that the first rank read from a checkpoint; None if it read none.

        Args:
            own: what this rank read: None on all but the first.
            like: a state whose arrays have the names, shapes and dtypes of the checkpoint's.
        """
        text = "" if own is None else json.dumps(own.facts)
        sent = bytes(self.group.broadcast(torch.tensor(list(text.encode()), dtype=torch.uint8)).tolist())
        if not sent:
            return None
        arrays = {}
        for name, value in like.arrays.items():
            values = value if own is None else own.arrays[name]
            arrays[name] = self.group.broadcast(values.reshape(-1)).view(value.shape)
        return RenderState(json.loads(sent), arrays)

    def _part(self, pixel_set: PixelSet) -> PixelSet:
        """Return the pixels of a pixel set that this rank samples."""
        for whole, part in self._parts:
            if whole is pixel_set:
                return part
        device = pixel_set.film.sums.device
        pixels = dealt(pixel_set.film.width * pixel_set.film.height, self.group.rank, self.group.size).to(device)
        layers = {name: film.extract(pixels) for name, film in pixel_set.layers.items()}
        picture_pixels = pixels if pixel_set.indices is None else pixel_set.indices[pixels]
        part = PixelSet(pixel_set.film.extract(pixels), layers, pixel_set.randomizations, picture_pixels)
        self._parts.append((pixel_set, part))
        return part

    def _join(self, whole: Film, own: Film) -> None:
        """Gather the pixels of all ranks into a film."""
        # Sums are float64, counts int64: the bits of all travel as one int64 tensor.
        sent = torch.cat([value.reshape(-1).view(torch.int64) for value in own.state().values()])
        for rank, values in enumerate(self.group.gather(sent)):
            pixels = dealt(whole.width * whole.height, rank, self.group.size).to(sent.device)
            part = whole.empty_part(len(pixels))
            state, first = {}, 0
            for name, value in part.state().items():
                state[name] = values[first : first + value.numel()].view(value.dtype).view(value.shape)
                first += value.numel()
            part.restore(state)
            whole.write_back(pixels, part)

    def _gather_nonfinite(self, own: NonFinite) -> NonFinite:
        """Return the non-finite samples of all ranks."""
        text = json.dumps(own.plain()).encode()
        every = NonFinite()
        for values in self.group.gather(torch.tensor(list(text), dtype=torch.uint8)):
            every.add(NonFinite.read(json.loads(bytes(values.tolist()))))
        return every


def _films(pixel_set: PixelSet) -> list[Film]:
    """Return the film of a pixel set, and those of its AOVs."""
    return [pixel_set.film, *pixel_set.layers.values()]


def render_fingerprint(
    scene: Scene, settings: Settings, params: Mapping[str, Tensor] | None, dtype: torch.dtype
) -> bytes:
    """Return a hash of everything that ranks must have in common to share a render."""
    free = settings_with(Role.FREE, but=Role.FILES)  # ranks must have the same file settings
    free["render"] = (*free["render"], "device")
    own = settings.integrator if settings.integrator.is_foreign else None
    return tree.fingerprint((__version__, settings.plain(free), own, fingerprints(scene, params), dtype))
