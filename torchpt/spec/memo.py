"""What plain values were read as, kept by what they say: the same surfaces and settings are read again and again."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any, Generic, TypeVar

__all__ = ["Memo", "frozen"]

T = TypeVar("T")
#: Longer lists are data of their own: not worth a key.
LONGEST = 64
#: Values that are their own keys, beside their type: 1, 1.0 and true are not the same.
_PLAIN = frozenset((int, bool, str, type(None)))


def frozen(value: Any) -> Hashable:
    """A key that only values of the same types and numbers share, to the bit.

    Raises:
        TypeError: something else than plain values in lists and dicts, or a long list.
    """
    kind = type(value)
    if kind in _PLAIN:
        return kind, value
    if kind is float:
        return repr(value)
    if kind is list or kind is tuple:
        if len(value) <= LONGEST:
            return kind, tuple([frozen(item) for item in value])
    elif kind is dict:
        return kind, tuple([(key, frozen(item)) for key, item in value.items()])
    raise TypeError(kind.__name__)


class Memo(Generic[T]):
    """Results by what they were made of; the oldest ones go.

    Args:
        most: how many are kept.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._known: dict[Hashable, T] = {}

    def get(self, names: Hashable, values: Any, make: Callable[[], T]) -> T:
        """What ``make`` makes of ``values``, which it is not to keep or change; errors are not kept.

        Args:
            names: what else it depends on, by identity or value.
            values: plain ones; for others nothing is kept.
            make: called where the result is not known.
        """
        try:
            key = names, frozen(values)
            found = self._known.get(key)
        except TypeError:
            return make()
        if found is None:
            found = self._known[key] = make()
            if len(self._known) > self._most:
                self._known.pop(next(iter(self._known)), None)
        return found
