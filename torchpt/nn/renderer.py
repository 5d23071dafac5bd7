"""A module that renders a scene, with some of its parameters as ``nn.Parameter``."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Any, Unpack

import torch
from torch import Tensor, nn

from torchpt.core.autograd import outside_transforms, transforms_are_active
from torchpt.core.errors import ArgumentValueError, SceneError
from torchpt.nn.parametrizations import Parametrization, PoseParametrization, parametrization_of
from torchpt.rendering.api import render
from torchpt.rendering.requests import check_options
from torchpt.scene import Scene
from torchpt.scene.devices import device_of
from torchpt.scene.entry import as_scene
from torchpt.scene.selection import matching_names
from torchpt.scene.settings import Params, RendererOptions, RenderOptions, base_seed
from torchpt.scene.validation import params_as_tensors
from torchpt.spec.arguments import check_names, expand_signature

__all__ = ["Renderer"]

#: A parametrization, or a function of a parameter's initial value and the scene's length that makes one.
ParametrizationOf = Parametrization | Callable[[Tensor, float], Parametrization]


class Renderer(nn.Module):
    """A module that renders a scene and optimizes its parameters.

    The parameters are unconstrained ``nn.Parameter`` tensors, which :mod:`torchpt.nn.parametrizations` maps to their ranges;
    ``values()`` returns the mapped ones. As long as they are finite the scene can be rendered, with two exceptions: positions
    too far away, and parameters that do not fit together, such as a ``beam_width`` above the ``cutoff_angle``: the render
    refuses them.

    Each ``forward`` in training mode draws new samples: with the same ones in every step an optimizer would fit their noise.
    The seed is ``seed + steps``, where the buffer ``steps`` counts calls in training mode; with ``torch.distributed``
    initialized it is ``seed + steps * world + rank``, so that ranks render different samples of one picture (with ``ranks=``
    they share it). In ``eval()`` mode it is always ``seed``. A seed passed to ``forward`` takes precedence, and does not
    count as a step. With ``seed=None`` every call draws a new one from torch's default generator, in both modes.

    The scene is shared, not copied, and not changed: only :meth:`write` changes ``scene.params``. Weights of your own BSDF
    models are not among ``parameters()``: pass them to the optimizer too.

    Args:
        scene: a scene from ``torchpt.load``.
        names: dotted names of ``scene.params``, or patterns such as ``materials.*.reflectance``; None: no parameters.
        seed: any integer from 0, also as a tensor; None: a new one for each call.
        rigid: True: poses move rigidly (six numbers each); False: their 16 numbers are optimized, except for poses that must
            keep angles, as those of spheres and cameras.
        parametrizations: maps in place of those chosen by the range of parameters, by name or pattern: a
            :class:`~torchpt.nn.Parametrization` such as ``LargeSteps(faces)``, or a function of the initial value and the
            scene's length that makes one, such as the classes ``QuaternionPose`` and ``LookAtPose``.
        full: True makes calls return a :class:`torchpt.Rendering`.
        options: further arguments of ``torchpt.render`` for all calls.

    Raises:
        SceneError: no scene, a name or pattern that matches no parameter, an argument that ``forward`` or this class has, or
            one that ``torchpt.render`` refuses.
        TypeError: an unknown argument.
    """

    steps: Tensor

    @expand_signature
    def __init__(
        self,
        scene: Scene,
        names: str | Sequence[str] | None = None,
        *,
        seed: int | Tensor | None = 0,
        rigid: bool = True,
        parametrizations: Mapping[str, ParametrizationOf] | None = None,
        full: bool = False,
        **options: Unpack[RendererOptions],
    ) -> None:
        super().__init__()
        check_names("Renderer", options, RenderOptions, own=("names", "rigid", "parametrizations"))
        if type(rigid) is not bool:
            raise SceneError("rigid", rigid, "True or False")
        if "params" in options:
            raise SceneError("params", options["params"], "an argument of Renderer.forward")
        if seed is not None:
            seed = base_seed(seed)
        if type(full) is not bool:
            raise SceneError("full", full, "True or False")
        self.scene, self.seed, self.full, self.options = as_scene(scene), seed, full, options
        check_options(scene, options)
        self.names = () if names is None else _matching_names(scene, names)
        with torch.no_grad():
            starts = [scene.params[name].detach() for name in self.names]
            chosen = _chosen(parametrizations, self.names)
            maps = [
                parametrization_of(scene.spec(name), start, rigid=rigid, length=scene.length)
                if name not in chosen
                else _made(name, chosen[name], start, scene.length)
                for name, start in zip(self.names, starts, strict=True)
            ]
            free = {
                _key(name): nn.Parameter(_inverse(name, parametrization, start).clone())
                for name, parametrization, start in zip(self.names, maps, starts, strict=True)
            }
        # `free` has the numbers that are optimized, `ranges` maps them to parameters; both names are in saved state dicts
        self.ranges, self.free = nn.ModuleList(maps), nn.ParameterDict(free)
        self.register_buffer("steps", torch.zeros((), dtype=torch.int64))

    @expand_signature
    def forward(
        self,
        params: Params | None = None,
        *,
        seed: int | Tensor | None = None,
        full: bool | None = None,
        **options: Unpack[RendererOptions],
    ) -> Any:
        """Render the scene with the current parameters.

        Args:
            params: values in place of parameters of the scene or of this module, by dotted name, such as those of the camera.
            seed: seed in place of the counted one, which None keeps.
            full: in place of the constructor's ``full``.
            options: arguments of ``torchpt.render``, in place of the constructor's.

        Returns:
            The picture ``(H, W, 3)``; with ``full=True`` a :class:`torchpt.Rendering`.

        Raises:
            SceneError: ``params`` is no mapping, or as :func:`torchpt.render`.
        """
        if params is not None and not isinstance(params, Mapping):
            raise SceneError("params", params, "a mapping from names of scene.params to values, or None")
        all_options: RendererOptions = {**self.options, **options}
        if seed is None:
            seed = self._next_seed(shares_picture=all_options.get("ranks") is not None)
        full = self.full if full is None else full
        return render(self.scene, params={**self.values(), **(params or {})}, seed=seed, full=full, **all_options)

    def values(self) -> dict[str, Tensor]:
        """Return the parameters in their ranges by dotted name, for ``torchpt.render(params=...)``; gradients flow."""
        with torch.autocast(self.steps.device.type, enabled=False):  # half precision would move poses
            free = [self.free[_key(name)] for name in self.names]
            return {
                name: parametrization(x) for name, parametrization, x in zip(self.names, self.ranges, free, strict=True)
            }

    @torch.no_grad()
    def assign(self, values: Params) -> None:
        """Set parameters to values by dotted name, tensors or as in scene files: all of them, or none if one is refused.

        Raises:
            SceneError: no mapping, a name that is no parameter of this module, or values that the scene does not accept.
        """
        if not isinstance(values, Mapping):
            raise SceneError("values", values, "a mapping from names of the module's parameters to values")
        for name in values:
            if name not in self.names:
                raise SceneError(f"params.{name}", name, f"one of {', '.join(self.names)}")
        tensors = params_as_tensors(self.scene, values)
        self.scene.check({**self.values(), **tensors})
        numbers: dict[str, Tensor] = {}  # the unconstrained numbers of each value
        for name, value in tensors.items():
            parametrization: Any = self.ranges[self.names.index(name)]
            numbers[name] = _inverse(name, parametrization, value.to(self.free[_key(name)]))
        for name, value in numbers.items():
            self.free[_key(name)].copy_(value)

    @torch.no_grad()
    def write(self) -> None:
        """Write the current values to ``scene.params``."""
        for name, value in self.values().items():
            self.scene.params[name] = value.detach().clone()

    def _next_seed(self, *, shares_picture: bool) -> int | None:
        """Return the seed of a call, and count it in training mode; ``shares_picture``: ranks render one picture together."""
        if self.seed is None or not self.training:
            return self.seed
        rank, world = 0, 1
        if not shares_picture and torch.distributed.is_available() and torch.distributed.is_initialized():
            rank, world = torch.distributed.get_rank(), torch.distributed.get_world_size()
        if torch.compiler.is_compiling() or not transforms_are_active():
            return self.seed + self._count_step() * world + rank
        with outside_transforms():  # which refuse changes in place of tensors from outside
            return self.seed + self._count_step() * world + rank

    def _count_step(self) -> int:
        """Return the number of steps before this one."""
        steps = int(self.steps)
        self.steps += 1
        return steps

    def _apply(self, fn: Callable[..., Any], recurse: bool = True) -> Renderer:
        device_of(fn(self.steps).device)  # raises for a missing device before anything moves
        super()._apply(fn, recurse)
        self.scene = self.scene.to(self.steps.device)
        return self

    def extra_repr(self) -> str:
        """Return the scene's name, the parameters and the seed, for ``print``."""
        return f"{self.scene.name or 'scene'}: {', '.join(self.names) or 'no parameters'}; seed {self.seed}"


def _key(name: str) -> str:
    """Return a parameter's name for ``torch``, which allows no dots."""
    return name.replace(".", "/")


def _chosen(given: Any, names: Sequence[str]) -> dict[str, ParametrizationOf]:
    """Return the parametrizations that a caller chose, by name of the parameter; the first that matches counts.

    Raises:
        SceneError: no mapping, or a pattern that matches no parameter of the module.
    """
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise SceneError("parametrizations", given, "a mapping from names or patterns to parametrizations")
    chosen: dict[str, ParametrizationOf] = {}
    for pattern, parametrization in given.items():
        matches = [name for name in names if name == pattern or fnmatchcase(name, str(pattern))]
        if not matches:
            known = (
                f"one of {', '.join(names)}, or a pattern of some" if names else "none: the module has no parameters"
            )
            raise SceneError("parametrizations", pattern, known)
        chosen = {name: parametrization for name in matches} | chosen
    return chosen


def _made(name: str, chosen: ParametrizationOf, start: Tensor, length: float) -> Parametrization:
    """Return the parametrization of a parameter.

    Raises:
        SceneError: it is none, or not of values such as the initial one.
    """
    expected = "a torchpt.nn.Parametrization, or a function of the initial value and a length that makes one"
    if isinstance(chosen, type) and issubclass(chosen, PoseParametrization) and start.shape != (4, 4):
        raise SceneError(f"parametrizations.{name}", chosen.__name__, "a parametrization of values that are no poses")
    made = chosen(start, length) if callable(chosen) and not isinstance(chosen, Parametrization) else chosen
    if not isinstance(made, Parametrization):
        raise SceneError(f"parametrizations.{name}", made, expected)
    return made


def _inverse(name: str, parametrization: Parametrization, value: Tensor) -> Tensor:
    """Return the unconstrained numbers of a parameter's value.

    Raises:
        SceneError: the parametrization has no such value.
    """
    try:
        return parametrization.inverse(value)
    except ArgumentValueError as error:  # of an argument of the parametrization
        raise SceneError(f"parametrizations.{name}.{error.key}", error.value, error.expected) from None
    except ValueError as error:
        shown = value.tolist() if value.numel() <= 16 else tuple(value.shape)
        raise SceneError(f"params.{name}", shown, str(error)) from None


def _matching_names(scene: Scene, names: str | Sequence[str]) -> tuple[str, ...]:
    """Return the parameters that match names and patterns, in the scene's order."""
    if isinstance(names, Iterable) and not isinstance(names, str | Mapping):
        names = tuple(names)
        if not names:
            raise SceneError("names", [], "one name at least, or None for a module without parameters")
    matched = frozenset(matching_names(scene, names))
    return tuple(name for name in scene.raw_params if name in matched)
