"""Backward passes of the small pictures of a batch, side by side on threads.

Autograd calls the backward passes of a batch's pictures one after another, and that of a small picture is a single task. So the
pictures pass through one more node, whose backward comes first and has the cotangents of all of them: it takes the passes on
threads, and the node of each picture finds its gradients ready. A pass has the bits that it has alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchpt.core.autograd import Backward
from torchpt.core.threads import TaskQueue, limited_threads, without_autocast
from torchpt.rendering.requests import RenderRequest
from torchpt.scene.prepare import is_small, uses_kernels

__all__ = ["SharedBackward"]


class _Pass(NamedTuple):
    """The backward pass of a picture, and the tensors that it is called with."""

    backward: Backward
    tensors: tuple[Tensor, ...]


class SharedBackward:
    """Takes the backward passes of a batch.

    Args:
        threads: ``render.threads`` of the batch.
    """

    def __init__(self, threads: int | str) -> None:
        self.threads = threads
        self._passes: list[_Pass] = []
        # By number of the pass: the cotangent, and the gradients for it, which the picture's node takes.
        self._ready: dict[int, tuple[Tensor, Sequence[Tensor | None]]] = {}

    def accepts(self, request: RenderRequest) -> bool:
        """Return True for a picture whose backward pass is a single task by kernels on a CPU."""
        settings, call = request.settings, request.call
        return (
            call.ranks is None
            and settings.render.max_memory is None
            and request.scene.device.type == "cpu"
            and uses_kernels(settings, request.scene.device, call.dtype)
            and is_small(request.scene, settings)
        )

    def share(self, backward: Backward, tensors: tuple[Tensor, ...]) -> Backward:
        """Return a function that stands for the backward pass of the next picture: it returns what is ready, or calls it.

        Args:
            backward: the backward pass.
            tensors: arguments that autograd will call it with, after the cotangents.
        """
        number = len(self._passes)
        self._passes.append(_Pass(backward, tuple(tensor.detach() for tensor in tensors)))

        def taken(cotangents: tuple[Tensor, ...], *tensors: Tensor) -> Sequence[Tensor | None]:
            cotangent, gradients = self._ready.pop(number, (None, ()))
            # Another cotangent: the loss depends on the picture in other ways too, by `rows` of the batch.
            if cotangent is not None and torch.equal(cotangent, cotangents[0]):
                return gradients
            return backward(cotangents, *tensors)

        return taken

    def join(self, images: Sequence[Tensor]) -> Sequence[Tensor]:
        """Return the pictures of the shared passes, in their order, through the common node."""
        return images if len(images) < 2 else _Joined.apply(self, *images)  # pyright: ignore[reportReturnType]

    def take(self, cotangents: dict[int, Tensor]) -> None:
        """Take passes by number on threads, and keep their gradients."""
        self._ready.clear()
        with limited_threads(self.threads):
            queue = TaskQueue[int, Sequence[Tensor | None]](torch.get_num_threads())
            try:
                for number, cotangent in cotangents.items():
                    queue.add(number, partial(self._gradients, number, cotangent))
                while queue.pending:
                    finished = queue.next(wait=True)
                    if finished is None:
                        continue
                    number, gradients = finished
                    if isinstance(gradients, BaseException):
                        raise gradients
                    self._ready[number] = cotangents[number], gradients
            finally:
                queue.close()

    def _gradients(self, number: int, cotangent: Tensor) -> Sequence[Tensor | None]:
        """Return the gradients of a pass (on a thread of the pool)."""
        backward, tensors = self._passes[number]
        with without_autocast(cotangent.device):
            return tuple(backward((cotangent,), *tensors))


def _is_used(cotangent: Tensor) -> bool:
    """Return True unless a cotangent is zero, or a batch of cotangents (``vmap``), which the pictures' own nodes refuse."""
    try:
        return bool(cotangent.any())
    except RuntimeError:
        return False


class _Joined(torch.autograd.Function):
    """The identity of pictures; its backward pass takes those of all pictures on threads."""

    @staticmethod
    def forward(ctx: Any, shared: SharedBackward, *images: Tensor) -> tuple[Tensor, ...]:
        ctx.shared = shared
        ctx.nodes = [image.grad_fn for image in images]
        return tuple(image.detach() for image in images)

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        # Not taken: passes that nobody asks for (`torch.autograd.grad` of some inputs), or whose picture the loss leaves out.
        wanted = {
            number: cotangent.detach()
            for number, (cotangent, node) in enumerate(zip(cotangents, ctx.nodes, strict=True))
            if torch._C._will_engine_execute_node(node) and _is_used(cotangent)  # pyright: ignore
        }
        if len(wanted) > 1:
            ctx.shared.take(wanted)
        return (None, *cotangents)
