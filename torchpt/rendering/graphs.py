"""``render`` in graphs of ``torch.compile``: custom operators for the forward and the backward pass, with fake kernels.

A graph holds tensors, numbers and text. So the scene is passed by its number, options as text, and parameters as the operators'
tensors; the seed is a separate number, so that another seed does not recompile. Everything else breaks the graph and is
rendered outside of it: ``full=True`` (a :class:`torchpt.Rendering`), scenes with models of the user's own, arguments that are
not plain values.

The backward operator calls ``render`` again, with parameters that require gradients, and differentiates its picture. It does
not trace that picture again: an empty one with the same number of samples stands in for it (:func:`reuse_rendering`), as
gradients do not depend on its pixels.
"""

from __future__ import annotations

import ast
import math
import threading
from collections.abc import Callable, Mapping, Sequence
from contextvars import ContextVar
from functools import partial, wraps
from typing import Any, NamedTuple, ParamSpec, TypeVar

import torch
from torch import Tensor

from torchpt.core.errors import RenderError
from torchpt.rendering import Rendering
from torchpt.scene import Scene
from torchpt.scene.formats.description import settings
from torchpt.scene.scene import scene_by_number
from torchpt.scene.settings import BLOCKS, SeedOfCall
from torchpt.scene.versions import AFTER, check_unchanged
from torchpt.spec.arguments import SCENE_VALUE

__all__ = ["as_custom_op", "reuse_rendering", "with_graph_break"]

#: Parameters and result of a wrapped function.
P = ParamSpec("P")
R = TypeVar("R")

#: Types of arguments that can be written as text. (Older torch traces no unions of types, but tuples of them.)
_LIST_TYPES, _PLAIN_TYPES = (list, tuple), (bool, int, str)
#: While an operator runs: a list that gets, or in the backward pass has, the rendering of the forward pass. None outside.
_forward_rendering: ContextVar[list[Rendering] | None] = ContextVar("reuse_rendering", default=None)


def reuse_rendering(make: Callable[[], Rendering]) -> Rendering:
    """Return the rendering of the forward pass inside an operator's backward pass; else call ``make``.

    Inside an operator's forward pass the result is also stored for the operator, which returns its number of samples.
    """
    known = _forward_rendering.get()
    if known:
        return known[0]
    rendering = make()
    if known is not None:
        known.append(rendering)
    return rendering


def as_custom_op(render: Callable[P, R]) -> Callable[P, R]:
    """Return a function that calls ``render`` in eager code and its custom operator while a graph is traced."""
    _register(render)

    @wraps(render)
    def eager_or_operator(*args: Any, **options: Any) -> Any:
        return in_graph(*args, **options) if torch.compiler.is_compiling() else render(*args, **options)

    in_graph = partial(_in_graph, render)
    return eager_or_operator


def with_graph_break(call: Callable[P, R]) -> Callable[P, R]:
    """Return a function that calls ``call`` in eager code and breaks the graph while one is traced."""

    @wraps(call)
    def eager_or_break(*args: P.args, **options: P.kwargs) -> R:
        outside: Any = torch.compiler.disable(call) if torch.compiler.is_compiling() else call
        return outside(*args, **options)

    return eager_or_break


def _in_graph(
    render: Callable[..., Any],
    scene: Scene,
    params: Mapping[str, Tensor] | None = None,
    full: bool = False,
    seed: SeedOfCall = SCENE_VALUE,
    dtype: torch.dtype = torch.float32,
    **options: Any,
) -> Any:
    """Call the operator, or ``render`` outside of the graph; ``torch.compile`` traces this function."""
    if full or len(scene.own_models) > 0 or not _fits_graph(params, seed, dtype, options):
        outside: Any = torch.compiler.disable(render)
        return outside(scene, params=params, full=full, seed=seed, dtype=dtype, **options)
    given = dict(params) if params is not None else {}
    if torch.is_grad_enabled():
        for name, value in scene.raw_params.items():
            if value.requires_grad and name not in given:
                given[name] = value
    differentiated = [name for name in given if given[name].requires_grad]
    text = _to_text([options, list(given), differentiated, dtype is torch.float64])  # read by _OperatorCall.read
    picture, _ = torch.ops.torchpt.render(scene.number, text, -1 if seed is SCENE_VALUE else seed, list(given.values()))
    return picture


def _fits_graph(params: Any, seed: Any, dtype: Any, options: Mapping[str, Any]) -> bool:
    """Return True if the arguments can be part of a graph; others, also invalid ones, are rendered outside of it."""
    is_float = dtype is torch.float32 or dtype is torch.float64
    is_number = isinstance(seed, int) and not isinstance(seed, bool)
    if params is not None and not (
        isinstance(params, Mapping) and all([isinstance(value, Tensor) for value in params.values()])
    ):
        return False
    return is_float and (seed is SCENE_VALUE or (is_number and 0 <= seed < 1 << 63)) and _is_plain(options)


def _is_plain(value: Any) -> bool:
    """Return True for nested mappings and lists of finite numbers, strings and None."""
    if isinstance(value, Mapping):
        return all([isinstance(key, str) and _is_plain(value[key]) for key in value])
    if isinstance(value, _LIST_TYPES):
        return all([_is_plain(item) for item in value])
    if isinstance(value, float):
        return -math.inf < value < math.inf
    return value is None or isinstance(value, _PLAIN_TYPES)


def _to_text(value: Any) -> str:
    """Return the source text of nested plain values, for ``ast.literal_eval``."""
    if isinstance(value, Mapping):
        return "{" + ", ".join([repr(key) + ": " + _to_text(value[key]) for key in value]) + "}"
    if isinstance(value, _LIST_TYPES):
        return "[" + ", ".join([_to_text(item) for item in value]) + "]"
    return repr(value)


class _OperatorCall(NamedTuple):
    """The arguments of a call of the operator.

    Attributes:
        scene: the scene.
        options: arguments of ``render``.
        names: dotted names of the operator's tensors.
        differentiated: the names that are differentiated.
    """

    scene: Scene
    options: dict[str, Any]
    names: list[str]
    differentiated: list[str]

    @classmethod
    def read(cls, number: int, text: str, seed: int) -> _OperatorCall:
        """Return the arguments that :func:`_in_graph` wrote.

        Args:
            number: number of the scene.
            text: options, names, differentiated names, and whether the dtype is float64.
            seed: the seed; -1: the scene's.

        Raises:
            RenderError: the scene was garbage-collected.
        """
        scene = scene_by_number(int(number))
        if scene is None:
            raise RenderError("the scene that this compiled graph renders is gone: keep a reference to it")
        options, names, differentiated, is_double = ast.literal_eval(text)
        options |= {
            "dtype": torch.float64 if is_double else torch.float32,
            "seed": SCENE_VALUE if seed < 0 else int(seed),
        }
        return cls(scene, options, names, differentiated)

    def versions(self) -> dict[str, int]:
        """Return the versions of the scene's own parameters, without those that are passed as tensors."""
        return {name: version for name, version in self.scene.versions().items() if name not in self.names}

    def empty_picture(self) -> Tensor:
        """Return an uninitialized picture of the right size, dtype and device."""
        blocks = {name: self.options.get(name) for name in BLOCKS if name != "render"}
        film = settings(self.scene.description, blocks).film
        _, _, width, height = film.window
        return torch.empty(height, width, 3, dtype=self.options["dtype"], device=self.scene.device)


def _in_thread(work: Callable[[], R], known: list[Rendering], device: torch.device) -> R:
    """Return ``work()``, run in another thread: in the operator's own thread autograd would not record it.

    Args:
        work: renders.
        known: list for :func:`reuse_rendering`: empty in the forward pass, which adds its rendering, else with that rendering.
        device: of the scene; the work runs on the current CUDA stream of the calling thread.
    """
    stream = torch.cuda.current_stream(device) if device.type == "cuda" else None
    found: list[R] = []
    failed: list[BaseException] = []

    def run() -> None:
        _forward_rendering.set(known)
        try:
            with torch.cuda.stream(stream):
                found.append(work())
        except BaseException as error:
            failed.append(error)

    thread = threading.Thread(target=run, name="torchpt.render")
    thread.start()
    thread.join()
    if failed:
        raise failed[0]
    return found[0]


def _register(render: Callable[..., Any]) -> None:
    """Make the operators ``torchpt::render`` and ``torchpt::render_gradients``.

    ``torchpt::render`` returns the picture and ``facts``, an int64 tensor: the samples a pixel, then the versions of the
    scene's own parameters, by which the backward pass refuses parameters that were changed in place since.
    """

    def picture(number: int, text: str, seed: int, tensors: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        request, known = _OperatorCall.read(number, text, seed), list[Rendering]()

        def work() -> Tensor:
            given = {name: value.detach() for name, value in zip(request.names, tensors, strict=True)}
            with torch.no_grad():
                return render(request.scene, params=given, **request.options).contiguous()

        versions = request.versions().values()
        image = _in_thread(work, known, request.scene.device)
        return image, torch.tensor([known[0].spp, *versions])

    def like_picture(number: int, text: str, seed: int, tensors: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        # Any seed will do; to compare a symbolic one would bind the graph to it.
        request = _OperatorCall.read(number, text, seed=0)
        return request.empty_picture(), torch.empty(1 + len(request.versions()), dtype=torch.int64)

    def gradients(
        number: int, text: str, seed: int, tensors: Sequence[Tensor], facts: Tensor, cotangent: Tensor
    ) -> list[Tensor]:
        request = _OperatorCall.read(number, text, seed)
        spp, *versions = facts.tolist()
        now = request.versions()
        check_unchanged(dict(zip(now, versions, strict=True)), now, AFTER)
        known = [Rendering(request.empty_picture(), spp=spp)]  # stands in for the picture

        def work() -> list[Tensor]:
            given = {name: value.detach() for name, value in zip(request.names, tensors, strict=True)}
            leaves = {name: given[name].requires_grad_() for name in request.differentiated}
            image = render(request.scene, params=given, **request.options)
            grads = dict(zip(leaves, torch.autograd.grad(image, list(leaves.values()), cotangent), strict=True))
            every = (grads.get(name, torch.zeros_like(value)) for name, value in given.items())
            return [value.detach().contiguous() for value in every]

        return _in_thread(work, known, request.scene.device)

    def like_gradients(
        number: int, text: str, seed: int, tensors: Sequence[Tensor], facts: Tensor, cotangent: Tensor
    ) -> list[Tensor]:
        return [torch.empty_like(value, memory_format=torch.contiguous_format) for value in tensors]

    def save_for_backward(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
        *ctx.call, tensors = inputs  # ctx.call: scene number, text, seed
        _, facts = output
        ctx.mark_non_differentiable(facts)
        ctx.save_for_backward(facts, *tensors)

    def backward(ctx: Any, cotangent: Tensor, _: Any) -> tuple[Any, ...]:
        facts, *tensors = ctx.saved_tensors
        # None for the number, the text and the seed.
        return None, None, None, gradients_operator(*ctx.call, tensors, facts, cotangent)

    render_operator = torch.library.custom_op("torchpt::render", picture, mutates_args=())
    render_operator.register_fake(like_picture)
    render_operator.register_autograd(backward, setup_context=save_for_backward)
    gradients_operator = torch.library.custom_op("torchpt::render_gradients", gradients, mutates_args=())
    gradients_operator.register_fake(like_gradients)
