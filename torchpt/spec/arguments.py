"""Keyword arguments that are declared once, in a ``TypedDict``: a static type and, by ``Annotated``, a spec for each.

A function takes them as ``**options: Unpack[Form]``. Type checkers read the form; what is seen at run time
(``inspect.signature``, ``help``), checks and tables are made of it here.
"""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from functools import cache
from typing import Any, TypeVar, get_args, get_type_hints

from torchpt.spec.parameters import Spec
from torchpt.spec.reading import Refused

__all__ = ["Argument", "DeclaredArgument", "arguments_of", "check_names", "expand_signature"]

F = TypeVar("F", bound=Callable[..., Any])


@dataclass(frozen=True)
class Argument(Spec):
    """Spec of an argument of a call in Python that is no setting of a scene file; ``words`` say what is accepted.

    Attributes:
        fits: whether a value is accepted.
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


@dataclass(frozen=True)
class DeclaredArgument:
    """A keyword argument.

    Attributes:
        type: as it is annotated.
        spec: what is accepted, and what stands for None.
    """

    type: Any
    spec: Spec

    @property
    def default(self) -> Any:
        """Return the default in Python: None where that may be given, as a scene file may say it, else the spec's own."""
        return None if type(None) in get_args(self.type) else self.spec.default

    @property
    def accepted(self) -> str:
        """Return what is accepted besides None, in words."""
        return self.spec.expected.removeprefix("null or ").removeprefix("null, ")

    @property
    def stands_for(self) -> str:
        """Return what None, as the default, stands for; "" where that is for no value."""
        return "" if self.default is not None or self.spec.default is None else f"None: {self.spec.default}"

    def read(self, value: Any) -> Any:
        """Return a value as it was given, checked.

        Raises:
            Refused: it is not accepted.
        """
        return self.spec.default if value is None and self.default is None else self.spec.read(value)


@cache
def arguments_of(form: Any) -> dict[str, DeclaredArgument]:
    """Return the arguments that a ``TypedDict`` declares by name, those of its bases first.

    Raises:
        TypeError: one without a spec.
    """
    found: dict[str, DeclaredArgument] = {}
    for name, hint in get_type_hints(form, include_extras=True).items():
        spec = next((item for item in getattr(hint, "__metadata__", ()) if isinstance(item, Spec)), None)
        if spec is None:
            raise TypeError(f"{form.__name__}.{name} has no spec: Annotated[TYPE, SPEC] declares one")
        found[name] = DeclaredArgument(hint.__origin__, spec)
    return found


def expand_signature(function: F) -> F:
    """Spell out ``**options: Unpack[Form]`` in a function's run-time signature and at the end of its docstring."""
    signature = inspect.signature(function, eval_str=True)
    *own, rest = signature.parameters.values()
    arguments = arguments_of(get_args(rest.annotation)[0])
    every = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=argument.default, annotation=argument.type)
        for name, argument in arguments.items()
    ]
    function.__signature__ = signature.replace(parameters=[*own, *every])  # pyright: ignore[reportFunctionMemberAccess]
    if function.__doc__:
        lines = [
            f"    {name}: {item.spec.doc} ({'; '.join(filter(None, (item.accepted, item.stands_for)))})"
            for name, item in arguments.items()
        ]
        function.__doc__ = "\n".join([f"{inspect.cleandoc(function.__doc__)}\n\n{rest.name.capitalize()}:", *lines])
    return function


def check_names(call: str, given: Collection[str], form: Any, own: Collection[str] = ()) -> None:
    """Refuse arguments that a form does not declare, in Python's own words.

    Args:
        call: who takes them, such as ``render_batch``.
        given: names that were given.
        form: a ``TypedDict``.
        own: names that ``call`` takes itself, which may be meant.

    Raises:
        TypeError: an unknown one.
    """
    known = arguments_of(form)
    for name in given:
        if name not in known:
            close = difflib.get_close_matches(name, sorted({*known, *own}), 1)
            hint = f". Did you mean '{close[0]}'?" if close else ""
            raise TypeError(f"{call}() got an unexpected keyword argument '{name}'{hint}")
