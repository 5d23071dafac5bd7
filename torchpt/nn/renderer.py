"""A scene with chosen parameters as ``nn.Parameter``: ``forward`` renders it."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Any, Unpack

import torch
from torch import Tensor, nn

from torchpt.core.errors import SceneError
from torchpt.nn.parametrizations import parametrization_of
from torchpt.rendering.api import render
from torchpt.scene import Scene
from torchpt.scene.devices import device_of
from torchpt.scene.entry import as_scene
from torchpt.scene.settings import BatchOptions, RenderOptions
from torchpt.spec.arguments import check_names, expand_signature

__all__ = ["Renderer"]


class Renderer(nn.Module):
    """A scene that is rendered, and optimized, as any other module.

    The chosen parameters are ``nn.Parameter`` objects without bounds, which :mod:`torchpt.nn.parametrizations` keeps in range: as long as
    they are finite, the scene can be rendered, but for places too far away and for what must go together: a spot whose
    ``beam_width`` is larger than its ``cutoff_angle``, or whose ``position`` is its ``target``, is refused by the render.
    ``values()`` gives what they stand for.

    Each ``forward`` in training mode draws other samples: with the same ones in every step an optimizer fits their noise. The
    seed is ``seed + steps``, where the buffer ``steps`` counts calls in training mode; with ``torch.distributed`` set up,
    ``seed + steps * world + rank``, so that ranks render different samples of one picture (but with ``ranks=``, where they
    share it). In ``eval()`` mode it is ``seed``, always. A seed that is handed to ``forward`` wins, and counts nothing.

    Scenes are shared, not copied, and never changed: ``scene.params`` keeps what it had (:meth:`write` changes it). Weights of
    BSDF models of your own are theirs: hand them to the optimizer beside ``parameters()``.

    Args:
        scene: from ``torchpt.load``.
        names: dotted names of ``scene.params``, and patterns of them such as ``materials.*.reflectance``; None: no parameters.
        seed: any integer from 0.
        rigid: whether poses are turned and moved alone (six numbers each); False: their 16 numbers are parameters, as they are,
            where poses need not keep angles, as those of balls and cameras must.
        full: whether calls return a :class:`torchpt.Rendering`.
        options: further arguments of ``torchpt.render`` for each call.

    Raises:
        SceneError: no scene, a name or pattern without a parameter, a render's argument that has a place of its own here.
        TypeError: an argument that ``render`` does not know.
    """

    steps: Tensor

    @expand_signature
    def __init__(
        self,
        scene: Scene,
        names: str | Sequence[str] | None = None,
        *,
        seed: int = 0,
        rigid: bool = True,
        full: bool = False,
        **options: Unpack[BatchOptions],
    ) -> None:
        super().__init__()
        check_names("Renderer", options, RenderOptions, ("names", "rigid"))
        if type(rigid) is not bool:
            raise SceneError("rigid", rigid, "True or False")
        if "params" in options:
            raise SceneError("params", options["params"], "an argument of Renderer.forward")
        if type(seed) is not int or seed < 0:
            raise SceneError("seed", seed, "a whole number >= 0")
        self.scene, self.seed, self.full, self.options = as_scene(scene), seed, full, options
        self.names = () if names is None else _matching_names(scene, (names,) if isinstance(names, str) else names)
        with torch.no_grad():
            starts = [scene.params[name].detach() for name in self.names]
            ranges = [
                parametrization_of(scene.spec(n), start, rigid, scene.length)
                for n, start in zip(self.names, starts, strict=True)
            ]
            free = {
                _key(name): nn.Parameter(found.inverse(start).clone())
                for name, found, start in zip(self.names, ranges, starts, strict=True)
            }
        self.ranges, self.free = nn.ModuleList(ranges), nn.ParameterDict(free)
        self.register_buffer("steps", torch.zeros((), dtype=torch.int64))

    @expand_signature
    def forward(
        self,
        params: Mapping[str, Tensor] | None = None,
        *,
        seed: int | None = None,
        full: bool | None = None,
        **options: Unpack[BatchOptions],
    ) -> Any:
        """Render.

        Args:
            params: further parameters in place of the scene's, by dotted name, such as those of the camera; of a name that is a
                parameter of this module, in place of that.
            seed: in place of the counted one.
            full: in place of what was said at first.
            options: arguments of ``torchpt.render``, in place of those given at first.

        Returns:
            The picture ``(H, W, 3)``; with ``full=True`` a :class:`torchpt.Rendering`.
        """
        given: BatchOptions = {**self.options, **options}
        if seed is None:
            seed = self._next_seed(given.get("ranks") is not None)
        full = self.full if full is None else full
        return render(self.scene, params={**self.values(), **(params or {})}, seed=seed, full=full, **given)

    def values(self) -> dict[str, Tensor]:
        """What the parameters stand for, by dotted name, as ``torchpt.render(params=...)`` takes them; gradients flow."""
        with torch.autocast(self.steps.device.type, enabled=False):  # a pose of half precision is another one
            return {name: found(self.free[_key(name)]) for name, found in zip(self.names, self.ranges, strict=True)}

    @torch.no_grad()
    def assign(self, values: Mapping[str, Tensor]) -> None:
        """Let parameters stand for other values, by dotted name: all of them, or none where one is refused.

        Raises:
            SceneError: a name that is not chosen, or values that the scene does not accept, with those that stay.
        """
        for name in values:
            if name not in self.names:
                raise SceneError(f"params.{name}", name, f"one of {', '.join(self.names)}")
        self.scene.check({**self.values(), **values})
        found: dict[str, Tensor] = {}
        for name, value in values.items():
            try:
                found[name] = self.ranges[self.names.index(name)].inverse(value.to(self.free[_key(name)]))  # pyright: ignore[reportCallIssue]
            except ValueError:
                expected = "the pose at first, turned and moved (rigid=False takes any)"
                raise SceneError(f"params.{name}", value.tolist(), expected) from None
        for name, value in found.items():
            self.free[_key(name)].copy_(value)

    @torch.no_grad()
    def write(self) -> None:
        """Put the values into ``scene.params``."""
        for name, value in self.values().items():
            self.scene.params[name] = value.detach().clone()

    def _next_seed(self, together: bool) -> int:
        if not self.training:
            return self.seed
        rank, world = 0, 1
        if not together and torch.distributed.is_available() and torch.distributed.is_initialized():
            rank, world = torch.distributed.get_rank(), torch.distributed.get_world_size()
        seed = self.seed + int(self.steps) * world + rank
        self.steps += 1
        return seed

    def _apply(self, fn: Callable[..., Any], recurse: bool = True) -> Renderer:
        device_of(fn(self.steps).device)  # one that is not there is refused before anything has moved
        super()._apply(fn, recurse)
        self.scene = self.scene.to(self.steps.device)
        return self

    def extra_repr(self) -> str:
        """The scene and the names, for ``print``."""
        return f"{self.scene.name or 'scene'}: {', '.join(self.names) or 'no parameters'}; seed {self.seed}"


def _key(name: str) -> str:
    """How ``torch`` may call a parameter: without dots."""
    return name.replace(".", "/")


def _matching_names(scene: Scene, names: Sequence[str]) -> tuple[str, ...]:
    """The parameters that names and patterns stand for, in the scene's order."""
    if not isinstance(names, Iterable) or isinstance(names, Mapping):
        raise SceneError("names", names, "a name of scene.params, or a sequence of names and patterns")
    names = tuple(names)
    if not names:
        raise SceneError("names", [], "one name at least, or None for a module without parameters")
    found: set[str] = set()
    for name in names:
        if not isinstance(name, str):
            raise SceneError("names", name, "a name of scene.params or a pattern of some, as text")
        matches = [each for each in scene.params if each == name or fnmatchcase(each, name)]
        if not matches:
            close = difflib.get_close_matches(name, scene.params, 3) or list(scene.params)[:8]
            raise SceneError(
                "names", name, f"a parameter of this scene or a pattern of some, such as {', '.join(close)}"
            )
        found.update(matches)
    return tuple(name for name in scene.params if name in found)
