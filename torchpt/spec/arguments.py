"""Declare keyword arguments once, in a ``TypedDict``: a static type and, by ``Annotated``, a spec for each.

A function takes them as ``**options: Unpack[Form]``. Type checkers read the form; the run-time signature
(``inspect.signature``, ``help``), checks and tables are made from it here. ``Form`` stands for such a ``TypedDict``, as
:class:`torchpt.scene.settings.CommonOptions`.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from enum import Enum
from functools import cache
from typing import Any, TypeVar, get_args, get_type_hints

from torchpt.core.errors import closest_names
from torchpt.spec.parameters import Spec
from torchpt.spec.reading import Refused

__all__ = [
    "SCENE_VALUE",
    "Argument",
    "DeclaredArgument",
    "InPython",
    "SceneValue",
    "arguments_of",
    "check_names",
    "expand_signature",
]

F = TypeVar("F", bound=Callable[..., Any])


@dataclass(frozen=True)
class Argument(Spec):
    """Spec of an argument that only Python calls take, no scene file; ``words`` say what is accepted.

    Attributes:
        fits: returns True for a value that is accepted.
    """

    fits: Callable[[Any], bool] = field(default=lambda _: True, kw_only=True, hash=False)

    @property
    def accepted(self) -> str:
        """See :class:`Spec`."""
        return self.words

    def read(self, value: Any) -> Any:
        """See :class:`Spec`."""
        if not self.fits(value):
            raise Refused(self.words)
        return value


class SceneValue(Enum):
    """Default of an argument where None has a meaning of its own: the value that the scene says, or the spec's default."""

    OWN = "the scene's"

    def __str__(self) -> str:
        return self.value

    __repr__ = __str__


#: Default of arguments for which None is a value.
SCENE_VALUE = SceneValue.OWN


@dataclass(frozen=True)
class InPython:
    """The differences from the spec in calls of Python, as further metadata of an argument.

    Attributes:
        default: default of the argument.
        accepted: phrase of what is accepted.
    """

    default: Any
    accepted: str


@dataclass(frozen=True)
class DeclaredArgument:
    """A keyword argument as its ``TypedDict`` declares it.

    Attributes:
        type: its annotation, without the spec.
        spec: says what is accepted and which value None stands for.
        in_python: what differs in Python; None: nothing.
    """

    type: Any
    spec: Spec
    in_python: InPython | None = None

    @property
    def default(self) -> Any:
        """Return the default in Python: None where the type allows it (the scene file may set the value), else the spec's."""
        if self.in_python is not None:
            return self.in_python.default
        return None if type(None) in get_args(self.type) else self.spec.default

    @property
    def accepted(self) -> str:
        """Return a phrase of what is accepted besides None."""
        if self.in_python is not None:
            return self.in_python.accepted
        return self.spec.expected.removeprefix("null or ").removeprefix("null, ")

    @property
    def stands_for(self) -> str:
        """Return a phrase of the value that the default stands for; "" where that is the default itself."""
        if self.spec.default is None or self.default not in (None, SCENE_VALUE):
            return ""
        return f"{self.default!r}: {self.spec.default}"

    def read(self, value: Any) -> Any:
        """Check a value and return it; the spec's default for None.

        Raises:
            Refused: the value is not accepted.
        """
        return self.spec.default if value is None and self.default is None else self.spec.read(value)


@cache
def arguments_of(form: Any) -> dict[str, DeclaredArgument]:
    """Return the arguments that a ``TypedDict`` declares by name, those of its bases first.

    Raises:
        TypeError: an argument without a spec.
    """
    found: dict[str, DeclaredArgument] = {}
    for name, hint in get_type_hints(form, include_extras=True).items():
        spec = next((item for item in getattr(hint, "__metadata__", ()) if isinstance(item, Spec)), None)
        if spec is None:
            raise TypeError(f"{form.__name__}.{name} has no spec: Annotated[TYPE, SPEC] declares one")
        in_python = next((item for item in hint.__metadata__ if isinstance(item, InPython)), None)
        found[name] = DeclaredArgument(hint.__origin__, spec, in_python)
    return found


def expand_signature(function: F) -> F:
    """Spell out ``**options: Unpack[Form]`` in a function's run-time signature and at the end of its docstring."""
    signature = inspect.signature(function, eval_str=True)
    *named, var_keyword = signature.parameters.values()  # the last is `**options`
    (form,) = get_args(var_keyword.annotation)
    arguments = arguments_of(form)
    expanded = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=argument.default, annotation=argument.type)
        for name, argument in arguments.items()
    ]
    function.__signature__ = signature.replace(parameters=[*named, *expanded])  # pyright: ignore[reportFunctionMemberAccess]
    if function.__doc__:
        lines = [
            f"    {name}: {item.spec.doc} ({'; '.join(filter(None, (item.accepted, item.stands_for)))})"
            for name, item in arguments.items()
        ]
        function.__doc__ = "\n".join(
            [f"{inspect.cleandoc(function.__doc__)}\n\n{var_keyword.name.capitalize()}:", *lines]
        )
    return function


def check_names(call: str, given: Collection[str], form: Any, own: Collection[str] = ()) -> None:
    """Raise Python's own error for arguments that a form does not declare, with the closest name.

    Args:
        call: name of the function, such as ``render_batch``.
        given: names of the arguments of this call.
        form: the ``TypedDict``.
        own: arguments of ``call`` that the form does not declare, which may be meant too.

    Raises:
        TypeError: an unknown argument.
    """
    known = arguments_of(form)
    for name in given:
        if name not in known:
            close = closest_names(name, sorted({*known, *own}), 1)  # one name at most
            hint = f". Did you mean '{close[0]}'?" if close else ""
            raise TypeError(f"{call}() got an unexpected keyword argument '{name}'{hint}")
