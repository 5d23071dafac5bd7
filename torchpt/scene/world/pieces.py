"""Keep the pieces of a world whose parameters have not changed, for the next assembly.

A *piece* is an intermediate result of an assembly: the corners of a part, a material on lanes, the light table. While a piece
is made, the parameters that it reads are recorded, directly or through other pieces. The next assembly returns the same object
if none of these has changed, so that a render that hands over one colour assembles one material, and kernels find the tables
of all other tensors laid out (:mod:`torchpt.engines.kernels.programs`).

Parameters that are handed over are compared by value; pieces made from very large ones are not kept. The scene's own parameters
are compared by memory and by torch's count of changes in place.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import wraps
from typing import Any, Concatenate, ParamSpec, TypeVar

import torch
from torch import Tensor

from torchpt.core.autograd import transforms_are_active
from torchpt.images import PackedTexels
from torchpt.physics.textures import TexelSource

__all__ = ["KeptPieces", "ParameterReads", "passing_piece", "piece"]

P = ParamSpec("P")
R = TypeVar("R")
M = TypeVar("M", bound="Pieced")

#: Most elements of a parameter that is compared by value, which takes some 15 microseconds of so many.
MOST_COMPARED = 1 << 14

#: State of a parameter: type, shape, and its values as bytes, or a tensor of the same memory and its count of changes.
_State = tuple[torch.dtype, torch.Size, bytes | tuple[Tensor, int]]


#: Stands among the names of parameters for what no state is known of.
_MORE = "..."


@dataclass(frozen=True)
class _Piece:
    """A kept piece, and the states of the parameters that it was made from."""

    value: Any
    states: Mapping[str, _State]


class KeptPieces:
    """The pieces of a scene's latest worlds; assemblies on several threads may share it."""

    def __init__(self) -> None:
        self._pieces: dict[Hashable, _Piece] = {}

    def find(self, key: Hashable) -> _Piece | None:
        """Return the piece of a key, which may be out of date."""
        return self._pieces.get(key)

    def keep(self, key: Hashable, value: Any, states: Mapping[str, _State]) -> None:
        """Keep a piece in place of an earlier one of the same key."""
        self._pieces[key] = _Piece(value, states)

    def drop(self, key: Hashable) -> None:
        """Drop a piece that is out of date, before another is made: memory need not hold both."""
        self._pieces.pop(key, None)

    def clear(self) -> None:
        """Drop all pieces."""
        self._pieces.clear()


class ParameterReads(TexelSource):
    """The parameters of one assembly, which records what pieces read.

    Args:
        parameters: every tensor by dotted name, on the host.
        kept: pieces of earlier assemblies; None: nothing is kept.
        own: names of the scene's own parameters, which live as long as the scene.
        variant: what pieces depend on beside parameters.
        packed: images of the scene's own that are packed, and whose tensors have no numbers yet; all of them or none.
    """

    def __init__(
        self,
        parameters: Mapping[str, Tensor],
        kept: KeptPieces | None = None,
        own: frozenset[str] = frozenset(),
        variant: Hashable = (),
        packed: Mapping[str, PackedTexels] | None = None,
    ) -> None:
        self._parameters, self._own = parameters, own
        self._packed, self._variant = packed or {}, (variant, bool(packed))
        # Tensors that are made inside of a transform of `torch.func` belong to it, those of inference mode to that mode.
        usable = not transforms_are_active() and not torch.is_inference_mode_enabled()
        self._kept = kept if usable else None
        self._states: dict[str, _State | None] = {}  # those that were asked for
        self._copies: dict[str, Tensor] = {}  # of parameters that are compared by value
        self._reads: list[set[str]] = []  # of the pieces that are being made, the innermost last
        # Pieces of this assembly, and the names that they depend on.
        self._made: dict[Hashable, tuple[Any, Collection[str]]] = {}

    def __getitem__(self, name: str) -> Tensor:
        if self._reads:
            self._reads[-1].add(name)
        image = self._packed.get(name)
        if image is not None and not image.has_numbers:
            return torch.from_numpy(image.image.values())
        state = None if self._kept is None or name in self._own else self._state(name)
        if state is None:
            return self._parameters[name]
        if name not in self._copies:  # a kept piece must not change with a caller's tensor
            self._copies[name] = self._parameters[name].detach().clone()
        return self._copies[name]

    def packed(self, name: str) -> PackedTexels | None:
        """Return an image packed; None for one that is not."""
        found = self._packed.get(name)
        if self._reads and found is not None:
            self._reads[-1].add(name)
        return found

    def __iter__(self) -> Iterator[str]:
        return iter(self._parameters)

    def __len__(self) -> int:
        return len(self._parameters)

    def __contains__(self, name: object) -> bool:
        return name in self._parameters  # not recorded: a scene's names never change

    def read_more(self) -> None:
        """Note that the piece that is being made depends on more than parameters, so that it is not kept."""
        if self._reads:
            self._reads[-1].add(_MORE)

    @contextmanager
    def structure_only(self) -> Iterator[None]:
        """Record no reads within: what is made there depends on shapes of parameters alone, not on their values."""
        self._reads.append(set())
        try:
            yield
        finally:
            self._reads.pop()

    def piece(self, key: Hashable, make: Callable[[], Any], keep: bool = True) -> Any:
        """Return the piece of a key: the kept one where the parameters that it was made from are unchanged, else a new one.

        Args:
            key: of the piece.
            make: makes it.
            keep: False: it is dropped with this assembly.
        """
        value, reads = self._found(key) or self._new(key, make, keep)
        if self._reads:
            self._reads[-1].update(reads)
        return value

    def _found(self, key: Hashable) -> tuple[Any, Collection[str]] | None:
        """Return the valid piece of a key, and the names that it depends on; None if it is to be made."""
        found = self._made.get(key)
        if found is not None or self._kept is None:
            return found
        kept = self._kept.find((key, self._variant))
        if kept is None or not all(self._has(name, state) for name, state in kept.states.items()):
            return None
        self._made[key] = kept.value, kept.states.keys()
        return self._made[key]

    def _new(self, key: Hashable, make: Callable[[], Any], keep: bool) -> tuple[Any, Collection[str]]:
        """Make the piece of a key, and keep it if so wished."""
        if self._kept is not None:
            self._kept.drop((key, self._variant))
        reads: set[str] = set()
        self._reads.append(reads)
        try:
            value = make()
        finally:
            self._reads.pop()
        self._made[key] = value, reads
        states = self._states_of(reads) if keep and self._kept is not None else None
        if self._kept is not None and states is not None:
            self._kept.keep((key, self._variant), value, states)
        return value, reads

    def _states_of(self, names: set[str]) -> dict[str, _State] | None:
        """Return the states of parameters; None if a piece that depends on them cannot be kept."""
        states: dict[str, _State] = {}
        for name in names:
            state = self._state(name)
            if state is None:
                return None
            states[name] = state
        return states

    def _has(self, name: str, state: _State) -> bool:
        """Return True if a parameter is in a state."""
        now = self._state(name)
        if now is state:
            return True
        if now is None or not _equal(now, state):
            return False
        self._states[name] = state  # so that other pieces find the same object
        return True

    def _state(self, name: str) -> _State | None:
        """Return the state of a parameter; None where pieces made from it cannot be kept."""
        if name == _MORE:
            return None
        if name not in self._states:
            self._states[name] = self._state_now(self._parameters[name], own=name in self._own)
        return self._states[name]

    def _state_now(self, value: Tensor, *, own: bool) -> _State | None:
        if value.is_inference() or (value.requires_grad and torch.is_grad_enabled()):
            return None
        if own:
            return (
                value.dtype,
                value.shape,
                (value.detach(), value._version),
            )  # with the same memory and count of changes
        if value.numel() > MOST_COMPARED:
            return None
        return (
            value.dtype,
            value.shape,
            value.detach().flatten().contiguous().view(torch.uint8).numpy(force=True).tobytes(),
        )


def _equal(now: _State, state: _State) -> bool:
    if now[:2] != state[:2]:
        return False
    contents, before = now[2], state[2]
    if isinstance(contents, bytes) or isinstance(before, bytes):
        return contents == before
    (tensor, version), (tensor_before, version_before) = contents, before
    # `before` holds its memory, so that no other tensor can have the same address.
    return (
        version == version_before
        and tensor.data_ptr() == tensor_before.data_ptr()
        and tensor.stride() == tensor_before.stride()
    )


class Pieced:
    """Base of an assembly whose methods :func:`piece` keeps.

    Args:
        parameters: what pieces may read beside what never changes.
    """

    def __init__(self, parameters: ParameterReads) -> None:
        self.parameters = parameters


def piece(method: Callable[Concatenate[M, P], R]) -> Callable[Concatenate[M, P], R]:
    """Keep the result of a method by its name and arguments, which must be hashable.

    The result may depend on ``self.parameters``, on other pieces, and on what is the same in all assemblies of a scene and
    variant.
    """
    return _pieced(method, keep=True)


def passing_piece(method: Callable[Concatenate[M, P], R]) -> Callable[Concatenate[M, P], R]:
    """Keep the result of a method as :func:`piece` does, but within one assembly: it is large, and only pieces read it."""
    return _pieced(method, keep=False)


def _pieced(method: Callable[Concatenate[M, P], R], keep: bool) -> Callable[Concatenate[M, P], R]:
    name = method.__name__

    @wraps(method)
    def kept(self: M, *args: P.args, **kwargs: P.kwargs) -> R:
        return self.parameters.piece((name, *args), lambda: method(self, *args, **kwargs), keep)

    return kept
